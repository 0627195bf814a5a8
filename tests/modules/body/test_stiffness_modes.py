"""Stiffness modes: waves on the body's box, of mean 0 and variance 1 on its particles, none shorter than promised."""

import pytest
import torch

from mosa.errors import ConfigError
from mosa.modules.body.heterogeneity import HeterogeneitySettings
from mosa.modules.body.stiffness_modes import StiffnessModes

LOW, HIGH = torch.tensor([-0.1, 0.0, 0.2]).double(), torch.tensor([0.3, 0.2, 0.4]).double()
"""Sides 0.4, 0.2, 0.2 m."""


def particles(count=500):
    draw = torch.rand(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return LOW + (HIGH - LOW) * draw


def modes(**options) -> StiffnessModes:
    found = StiffnessModes(LOW, HIGH, HeterogeneitySettings(**options)).double()
    found.settle(particles())
    return found


@pytest.mark.parametrize("wavelength", [0.25, 0.33, 0.5, 1.0])
def test_modes_have_mean_0_and_variance_1_and_differ(wavelength):
    basis = modes(wavelength=wavelength).basis(particles())
    assert basis.mean(0).abs().max() < 1e-12
    assert torch.allclose(basis.var(0), torch.ones(basis.shape[1]).double(), rtol=1e-9)
    off = torch.corrcoef(basis.T) - torch.eye(basis.shape[1]).double()
    assert off.abs().max() < 0.5  # cosines are orthogonal, up to the drawn particles
    assert torch.linalg.matrix_rank(basis) == basis.shape[1]


@pytest.mark.parametrize("wavelength", [0.25, 0.33, 0.5, 1.0])
def test_no_wave_is_shorter_than_promised_and_none_that_fits_is_left_out(wavelength):
    """cos(pi a x/L_x) ... has the wave vector pi (a/L_x, b/L_y, c/L_z): its length is 2/|(a/L_x, ...)|."""
    field, sides = modes(wavelength=wavelength, most=4096), HIGH - LOW
    lengths = 2 / (field.waves.double() / sides).norm(dim=1)
    longest = float(sides.max())
    assert lengths.min() >= wavelength * longest * (1 - 1e-6) and (lengths.diff() <= 1e-6).all()
    counts = torch.cartesian_prod(*(torch.arange(20).double() for _ in range(3)))[1:]
    assert len(lengths) == int(
        (2 / (counts / sides).norm(dim=1) >= wavelength * longest * (1 - 1e-9)).sum()
    )
    assert float(lengths[0]) == pytest.approx(2 * longest)  # half a wave along the longest side
    assert torch.allclose(field.size.double(), 2 * longest / lengths, rtol=1e-6)


def test_a_mode_is_the_product_of_its_cosines():
    field, X = modes(), particles(50)
    x = (X - LOW) / (HIGH - LOW)
    for k in (0, 5, len(field.size) - 1):
        a, b, c = field.waves[k].tolist()
        expected = (
            torch.cos(torch.pi * a * x[:, 0])
            * torch.cos(torch.pi * b * x[:, 1])
            * torch.cos(torch.pi * c * x[:, 2])
        )
        assert torch.allclose(field.raw(X)[:, k], expected, rtol=0, atol=1e-12)


def test_the_longest_waves_come_first_where_there_are_too_many():
    every, few = modes(most=4096), modes(most=7)
    assert len(few.size) == 7 < len(every.size) and torch.equal(few.waves, every.waves[:7])


def test_the_factor_is_within_its_amplitude_and_1_without_coefficients():
    field = modes(amplitude=0.3)
    assert (field.factor(particles()) == 1).all()
    with torch.no_grad():
        field.coefficients.copy_(
            torch.randn(len(field.size), generator=torch.Generator().manual_seed(1))
        )
    factor = field.factor(particles())
    assert factor.max() <= 1.3 and factor.min() >= 0.7 and factor.max() - factor.min() > 0.4
    eta = field(particles())
    assert torch.allclose(factor, 1 + 0.3 * torch.tanh(eta)) and torch.allclose(
        eta, field.basis(particles()) @ field.coefficients
    )


@pytest.mark.parametrize("options, key", [
    ({"amplitude": 1.0}, "amplitude"), ({"amplitude": 0.0}, "amplitude"), ({"wavelength": 0.0}, "wavelength"),
    ({"wavelength": 1e-9}, "wavelength"),
    ({"wavelength": 2.1}, "wavelength"), ({"wavelength": float("nan")}, "wavelength"), ({"most": 0}, "most"),
    ({"most": 2.5}, "most"),
])  # fmt: skip
def test_what_is_out_of_range_is_named(options, key):
    with pytest.raises(ConfigError, match=rf"heterogeneity\.{key}: expected"):
        StiffnessModes(LOW, HIGH, HeterogeneitySettings(**options))


def test_a_flat_box_is_refused_and_the_longest_wavelength_is_one_mode():
    with pytest.raises(ConfigError, match="no volume"):
        StiffnessModes(LOW, torch.tensor([0.3, 0.0, 0.4]))
    assert StiffnessModes(LOW, HIGH, HeterogeneitySettings(wavelength=2.0)).waves.tolist() == [
        [1.0, 0.0, 0.0]
    ]

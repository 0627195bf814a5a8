"""Young's moduli of an orthotropic stiffness against the textbook's formula, its stiffest direction, cones of draws."""

import math

import pytest
import torch

from mosa.evaluation.analysis.stiffness import angle_between, cone, directional_moduli, stiffest
from mosa.modules.adapters.microplane import isotropic_stiffness

E1, E2, E3, NU12, NU13, NU23, G12, G13, G23 = 3.0, 2.0, 1.0, 0.2, 0.25, 0.3, 0.9, 0.6, 0.5


def orthotropic() -> torch.Tensor:
    """(6, 6) in Mandel scaling from engineering constants (Lekhnitskii): its compliance, inverted."""
    C = torch.diag(
        torch.tensor(
            [1 / E1, 1 / E2, 1 / E3, 1 / (2 * G23), 1 / (2 * G13), 1 / (2 * G12)],
            dtype=torch.float64,
        )
    )
    for i, j, value in ((0, 1, NU12 / E1), (0, 2, NU13 / E1), (1, 2, NU23 / E2)):
        C[i, j] = C[j, i] = -value
    return torch.linalg.inv(C)


def test_moduli_of_an_orthotropic_material():
    """1/E(t) = cos^4/E1 + (1/G12 - 2 nu12/E1) sin^2 cos^2 + sin^4/E2 in the plane of the first two axes."""
    t = torch.linspace(0, math.pi, 19, dtype=torch.float64)
    c, s = torch.cos(t), torch.sin(t)
    expected = 1 / (c**4 / E1 + (1 / G12 - 2 * NU12 / E1) * s**2 * c**2 + s**4 / E2)
    found = directional_moduli(orthotropic(), torch.stack([c, s, 0 * t], -1))
    assert torch.allclose(found, expected, rtol=1e-13)
    axes = directional_moduli(
        torch.stack([orthotropic(), 2 * orthotropic()]), torch.eye(3).double()
    )
    assert torch.allclose(
        axes, torch.tensor([[E1, E2, E3], [2 * E1, 2 * E2, 2 * E3]]).double(), rtol=1e-13
    )


def test_an_isotropic_stiffness_has_one_modulus():
    """2 mu C0 with mu = 1: E = 2 (1 + nu)."""
    n = torch.nn.functional.normalize(
        torch.randn(30, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    )
    found = directional_moduli(2 * isotropic_stiffness(torch.tensor(0.3, dtype=torch.float64)), n)
    assert torch.allclose(found, torch.full_like(found, 2.6), rtol=1e-13)


def test_the_stiffest_direction_and_its_ratio():
    axis, ratio = stiffest(orthotropic())
    assert float(angle_between(axis, torch.tensor([1.0, 0, 0]).double())) < 1.5
    dense = directional_moduli(
        orthotropic(),
        torch.nn.functional.normalize(
            torch.randn(200_000, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        ),
    )
    assert float(ratio) == pytest.approx(float(dense.max() / dense.min()), rel=0.01)
    assert stiffest(torch.stack([orthotropic()] * 2))[1].shape == (2,)


def test_angles_are_those_of_axes_and_cones_hold_their_share():
    a = torch.tensor([1.0, 0, 0]).double()
    for degrees in (0.0, 30.0, 90.0, 150.0, 180.0):
        b = (
            2
            * torch.tensor(
                [math.cos(math.radians(degrees)), math.sin(math.radians(degrees)), 0.0]
            ).double()
        )
        assert float(angle_between(a, b)) == pytest.approx(min(degrees, 180 - degrees), abs=1e-5)
    t = torch.deg2rad(torch.arange(1, 101, dtype=torch.float64) / 10)
    drawn = torch.stack([torch.cos(t), torch.sin(t), 0 * t], -1)[
        torch.randperm(100, generator=torch.Generator().manual_seed(2))
    ]
    assert cone(a, drawn) == pytest.approx(9.5, abs=1e-6) and cone(a, drawn, 0.5) == pytest.approx(
        5.0, abs=1e-6
    )
    assert cone(a, -drawn, 1.0) == pytest.approx(10.0, abs=1e-6)

"""The basis of view-dependent colour against scipy's complex harmonics, and its use."""

import math

import pytest
import torch
from drawn_splats import draw
from scipy.special import sph_harm_y

from mosa.errors import ConfigError
from mosa.rendering.appearance.spherical_harmonics import (
    basis,
    colors_in,
    constant_coefficients,
    mean_colors,
)
from mosa.rendering.cameras import centers


def test_basis_is_the_real_one_of_the_complex_harmonics():
    """Real harmonics with the Condon-Shortley phase: sqrt 2 Im Y_l^|m| for m < 0, Y_l^0, sqrt 2 Re Y_l^m for m > 0."""
    directions = torch.randn(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    x, y, z = (directions / directions.norm(dim=1, keepdim=True)).T.numpy()
    found = basis(3.7 * directions, 3)
    index = 0
    for degree in range(4):
        for m in range(-degree, degree + 1):
            value = sph_harm_y(
                degree, abs(m), [math.acos(c) for c in z], [math.atan2(b, a) for a, b in zip(x, y)]
            )
            wanted = value.real if m == 0 else math.sqrt(2) * (value.imag if m < 0 else value.real)
            torch.testing.assert_close(
                found[:, index], torch.as_tensor(wanted), rtol=1e-12, atol=1e-13
            )
            index += 1
    assert found.shape == (50, 16) == (50, index)


def test_a_constant_colour_is_the_same_from_everywhere():
    colors = torch.rand(6, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    coefficients = constant_coefficients(colors)
    assert coefficients.shape == (6, 1, 3)
    directions = torch.randn(
        4, 6, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64
    )
    torch.testing.assert_close(colors_in(coefficients, directions), colors.expand(4, 6, 3))
    torch.testing.assert_close(mean_colors(coefficients), colors)


def test_a_camera_sees_the_side_that_faces_it():
    """A coefficient along -x (index 3 of degree 1 is -x times a constant) reddens what is seen looking along -x."""
    scene = draw(3, states=1, images=2)
    coefficients = torch.zeros(3, 4, 3).double()
    coefficients[:, 3, 0] = 0.5
    scene.means = torch.zeros(1, 3, 3).double()
    eyes = centers(scene.cameras)
    colors = colors_in(coefficients, scene.means[[0, 0]] - eyes[:, None])
    along = -eyes / eyes.norm(dim=1, keepdim=True)
    wanted = 0.5 - 0.5 * math.sqrt(3 / (4 * math.pi)) * along[:, 0]
    torch.testing.assert_close(colors[..., 0], wanted[:, None].expand(-1, 3))
    torch.testing.assert_close(colors[..., 1:], torch.full((2, 3, 2), 0.5).double())


def test_colours_do_not_fall_below_black():
    coefficients = torch.full((1, 1, 3), -5.0)
    assert torch.equal(colors_in(coefficients, torch.ones(1, 3)), torch.zeros(1, 3))
    assert torch.equal(mean_colors(coefficients), torch.zeros(1, 3))


@pytest.mark.parametrize("count", [0, 2, 25])
def test_a_count_that_is_no_degree_is_named(count):
    with pytest.raises(ConfigError, match=rf"K = 1, 4, 9 or 16, found \(5, {count}, 3\)"):
        colors_in(torch.zeros(5, count, 3), torch.ones(5, 3))

"""Neighbourhood deformation, its rotation and stretch, the modes and the two forms of cues."""

from __future__ import annotations

import pytest
import torch

from mosa.errors import DataError
from mosa.reconstruction.motion.cues import (
    gaussian_cues,
    neighbourhood,
    neighbourhood_cues,
    polar,
)
from mosa.reconstruction.motion.modes import deformation_modes
from mosa.rendering.covariance import quaternion_to_matrix
from mosa.types import Splats


def lattice(n: int = 7, spacing: float = 0.01) -> torch.Tensor:
    axis = torch.arange(n, dtype=torch.float64) * spacing
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)


def random_deformation(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.eye(3, dtype=torch.float64) + 0.3 * torch.randn(
        3, 3, generator=generator, dtype=torch.float64
    )


@pytest.mark.parametrize("seed", range(4))
def test_affine_motion_is_exact(seed):
    rest = lattice()
    F = random_deformation(seed)
    found = neighbourhood(rest).deformation(rest @ F.T + 0.4)
    assert torch.allclose(found, F.expand_as(found), atol=1e-12)


def test_quadratic_motion_is_second_order_inside():
    """The estimate inside a lattice is symmetric, so a quadratic field leaves no error there, only at the boundary."""
    rest = lattice() - 0.03
    moved = rest.clone()
    moved[:, 0] += 20 * rest[:, 1] ** 2
    found = neighbourhood(rest, neighbours=26).deformation(moved)
    inner = (rest.abs() < 0.021).all(1)
    expected = torch.eye(3, dtype=torch.float64).repeat(int(inner.sum()), 1, 1)
    expected[:, 0, 1] = 40 * rest[inner, 1]
    assert torch.allclose(found[inner], expected, atol=1e-9)
    assert (found[~inner][:, 0, 1] - 40 * rest[~inner, 1]).abs().max() > 1e-3


def test_flat_neighbourhoods_have_no_weight():
    rest = lattice()
    flat = rest[rest[:, 2] < 1e-9]
    around = neighbourhood(flat, neighbours=10)
    assert around.weight.max() == 0
    cues = neighbourhood_cues(
        torch.stack([flat, flat + 1.0]),
        torch.zeros(2, len(flat), 3, 3, dtype=torch.float64),
        around,
    )
    assert cues.weight.max() == 0
    assert torch.equal(cues.rotation, torch.eye(3, dtype=torch.float64).expand_as(cues.rotation))
    assert torch.equal(cues.stretch, torch.ones_like(cues.stretch))
    assert neighbourhood(rest).weight.min() == 1


def test_too_few_particles_is_an_error():
    with pytest.raises(DataError, match="at least 5 particles, found 3"):
        neighbourhood(torch.zeros(3, 3))


def test_polar_keeps_rotations_proper():
    F = torch.stack(
        [random_deformation(s) for s in range(30)]
        + [torch.diag(torch.tensor([2.0, 1.5, -0.3]).double())]
    )
    rotation, stretch = polar(F)
    assert torch.allclose(torch.linalg.det(rotation), torch.ones(31, dtype=torch.float64))
    assert torch.allclose(stretch.prod(-1), torch.linalg.det(F))
    assert (stretch[:, :-1] >= stretch[:, 1:] - 1e-12).all()
    right = rotation.transpose(-1, -2) @ F
    assert torch.allclose(right, right.transpose(-1, -2), atol=1e-12)


def test_neighbourhood_cues_of_a_turned_and_stretched_body():
    rest = lattice()
    turn = quaternion_to_matrix(torch.tensor([0.9, 0.1, -0.3, 0.2], dtype=torch.float64))
    F = turn @ torch.diag(torch.tensor([0.8, 1.3, 1.0], dtype=torch.float64))
    positions = torch.stack([rest, rest @ F.T])
    cues = neighbourhood_cues(
        positions, torch.zeros(2, len(rest), 3, 3, dtype=torch.float64), neighbourhood(rest)
    )
    assert torch.allclose(cues.rotation[1], turn.expand(len(rest), 3, 3), atol=1e-10)
    assert torch.allclose(
        cues.stretch[1], torch.tensor([1.3, 1.0, 0.8], dtype=torch.float64).expand(len(rest), 3)
    )
    assert cues.weight.min() == 1


def test_gaussian_cues_are_relative_to_the_first_frame():
    n = 6
    start = torch.nn.functional.normalize(torch.tensor([0.8, 0.2, 0.1, 0.3]).repeat(n, 1), dim=-1)
    end = torch.nn.functional.normalize(torch.tensor([0.5, 0.2, -0.7, 0.3]).repeat(n, 1), dim=-1)
    splats = Splats(
        torch.zeros(n, 3), torch.full((n, 3), 0.01), start, torch.ones(n), torch.ones(n, 3)
    )
    scales = torch.stack([splats.scales, splats.scales * torch.tensor([0.5, 2.0, 1.0])])
    cues = gaussian_cues(
        torch.zeros(2, n, 3), torch.zeros(2, n, 3, 3), splats, scales, torch.stack([start, end])
    )
    assert torch.allclose(cues.rotation[0], torch.eye(3).expand(n, 3, 3), atol=1e-6)
    assert torch.allclose(
        cues.rotation[1] @ quaternion_to_matrix(start), quaternion_to_matrix(end), atol=1e-6
    )
    assert torch.allclose(cues.stretch[1], torch.tensor([2.0, 1.0, 0.5]).expand(n, 3))


def test_modes_hold_affine_motion_and_their_gradients():
    rest = lattice()
    around = neighbourhood(rest)
    modes = deformation_modes(rest, around, count=30)
    N = len(rest)
    assert torch.allclose(
        modes.values.T @ modes.values / N, torch.eye(30, dtype=torch.float64), atol=1e-9
    )
    assert torch.equal(modes.energy[:4], torch.zeros(4, dtype=torch.float64))
    assert (modes.energy.diff() >= -1e-9).all() and modes.energy[4] > 1e-6
    # an affine field is met by the first four exactly; a modes' gradient is that of its values
    field = rest @ torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64) + 3
    left = field - modes.values[:, :4] @ (modes.values[:, :4].T @ field) / N
    assert left.abs().max() < 1e-10
    u = modes.values @ torch.randn(
        30, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    gradient = around.deformation(rest + u)
    direct = torch.einsum("njk,ki->nij", modes.gradient, (modes.values.T @ u) / N) + torch.eye(
        3, dtype=torch.float64
    )
    assert torch.allclose(direct, gradient, atol=1e-9)


def test_modes_at_other_points_are_affine_exact_and_close_in_between():
    rest = lattice()
    modes = deformation_modes(rest, neighbourhood(rest), count=20)
    between = rest[::5] * 0.93 + 0.0021
    there = modes.at(between, rest)
    linear = torch.linalg.lstsq(
        torch.cat([torch.ones(len(rest), 1, dtype=torch.float64), rest], 1), modes.values[:, :4]
    ).solution
    assert torch.allclose(
        there.values[:, :4],
        torch.cat([torch.ones(len(between), 1).double(), between], 1) @ linear,
        atol=1e-9,
    )
    at_particles = modes.at(rest, rest)
    assert (at_particles.values - modes.values)[:, :12].abs().mean() < 0.05

"""Cells across thin parts, on bodies whose thickness is known."""

import pytest
import torch

from mosa.reconstruction.resolution import ENOUGH, resolution

SPACING = 0.01


def block(*layers):
    return torch.cartesian_prod(*(torch.arange(n) * SPACING for n in layers))


@pytest.mark.parametrize("layers", [2, 3, 4, 6, 8])
def test_a_slab_is_as_thick_as_its_layers(layers):
    found = resolution(block(24, 24, layers), SPACING)
    assert found.cells == layers / 2  # two particles to a cell and axis
    assert found.enough == (layers / 2 >= ENOUGH)


def test_a_thin_part_counts_where_it_is_a_tenth_of_the_body():
    ball = block(14, 14, 14)
    handle = block(60, 3, 3) + torch.tensor([0.14, 0.05, 0.05])  # 540 of 3284 particles
    stub = block(10, 3, 3) + torch.tensor([0.14, 0.05, 0.05])  # 90 of 2834
    assert resolution(torch.cat([ball, handle]), SPACING).cells == 1.5
    assert resolution(torch.cat([ball, stub]), SPACING).cells >= 3  # the cube's own, whose edges no ball fills


def test_the_particles_asked_for_resolve_the_slab():
    slab = resolution(block(24, 24, 2), SPACING)
    finer = (slab.particles / (24 * 24 * 2)) ** (1 / 3)
    assert not slab.enough and abs(2 * finer / 2 - ENOUGH) < 0.01  # so many more layers, two to a cell


def test_particles_off_the_lattice_by_a_third_of_the_spacing_are_the_same_slab():
    slab = block(24, 24, 4)
    moved = slab + 0.3 * SPACING * (torch.rand(slab.shape, generator=torch.Generator().manual_seed(0)) - 0.5)
    assert abs(resolution(moved, SPACING).cells - 2.0) <= 0.5

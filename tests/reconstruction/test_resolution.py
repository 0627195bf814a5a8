"""Cells across thin parts, on bodies whose thickness is known."""

import pytest
import torch

from mosa.reconstruction.resolution import ENOUGH, grid_spacing, particles_for, resolution

SPACING = 0.01


def block(*layers):
    return torch.cartesian_prod(*(torch.arange(n) * SPACING for n in layers))


def block_of(a, b, c, spacing):
    return torch.cartesian_prod(
        *(torch.arange(max(1, round(side / spacing))) * spacing for side in (a, b, c))
    )


@pytest.mark.parametrize("layers", [2, 3, 4, 6, 8])
def test_a_slab_is_as_thick_as_its_layers(layers):
    for dx in (2 * SPACING, 1.5 * SPACING):
        found = resolution(block(24, 24, layers), SPACING, dx)
        assert found.cells == pytest.approx(layers * SPACING / dx, rel=1e-12)
        assert found.enough == (layers * SPACING / dx >= ENOUGH)


def test_a_thin_part_counts_where_it_is_a_tenth_of_the_body():
    ball = block(14, 14, 14)
    handle = block(60, 3, 3) + torch.tensor([0.14, 0.05, 0.05])  # 540 of 3284 particles
    stub = block(10, 3, 3) + torch.tensor([0.14, 0.05, 0.05])  # 90 of 2834
    assert resolution(torch.cat([ball, handle]), SPACING, 2 * SPACING).cells == 1.5
    assert (
        resolution(torch.cat([ball, stub]), SPACING, 2 * SPACING).cells >= 3
    )  # the cube's own, whose edges no ball fills


def test_the_particles_asked_for_resolve_the_slab():
    slab = resolution(block(24, 24, 2), SPACING, 2 * SPACING)
    finer = (slab.particles / (24 * 24 * 2)) ** (1 / 3)
    assert (
        not slab.enough and abs(2 * finer / 2 - ENOUGH) < 0.01
    )  # so many more layers, two to a cell


def test_pieces_that_do_not_touch_are_counted():
    ball = block(6, 6, 6)
    # next to each other, a layer apart, four apart
    for gap, pieces in ((0.06, 1), (0.07, 1), (0.1, 2)):
        apart = torch.cat([ball, ball + torch.tensor([gap, 0.0, 0.0])])
        assert resolution(apart, SPACING, 2 * SPACING).pieces == pieces
    corner = torch.cat([ball, ball + 6 * SPACING])
    assert resolution(corner, SPACING, 2 * SPACING).pieces == 1


def test_a_grid_of_that_spacing_has_as_many_particles_to_a_cell():
    assert grid_spacing(SPACING, 8) == pytest.approx(2 * SPACING, rel=1e-12)
    assert grid_spacing(SPACING, 4) ** 3 / SPACING**3 == pytest.approx(4, rel=1e-12)


def test_thin_bodies_get_more_particles_within_bounds():
    def slab(thickness):
        return lambda spacing: block_of(0.24, 0.24, thickness, spacing)

    thick, thin = 0.24**2 * 0.1, 0.24**2 * 0.02
    assert particles_for(slab(0.1), thick, per_cell=8, least=2000, most=10**6) == 2000
    some = particles_for(slab(0.02), thin, per_cell=8, least=1000, most=10**6)
    spacing = (thin / some) ** (1 / 3)
    assert resolution(slab(0.02)(spacing), spacing, 2 * spacing).cells == pytest.approx(
        ENOUGH, abs=0.51
    )  # a layer is half a cell
    assert (
        some > 2000 and particles_for(slab(0.02), thin, per_cell=8, least=1000, most=1500) == 1500
    )


def test_particles_off_the_lattice_by_a_third_of_the_spacing_are_the_same_slab():
    slab = block(24, 24, 4)
    moved = slab + 0.3 * SPACING * (
        torch.rand(slab.shape, generator=torch.Generator().manual_seed(0)) - 0.5
    )
    assert abs(resolution(moved, SPACING, 2 * SPACING).cells - 2.0) <= 0.5

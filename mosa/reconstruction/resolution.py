"""How well a grid resolves a body: cells across its thin parts, and how many particles it would take.

A law is identified through the grid. On a thin ring of known isotropic law 4000 particles, 2 cells across, gave a modulus 17 % too
high and an operator where there is nothing to find; no fit repairs that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from torch import Tensor

ENOUGH = 2.5
"""Cells across below which a run is warned: the rabbit's ears have 2.5. A wave of 8 cells in half a length is 1.5 % off its speed
(docs/results/verification.md)."""
PER_CELL = 4.0
"""Particles to a cell, unless told otherwise. With 8 of them the true laws of rabbit, chick1, mandarin, peanut and calf are 1.3 to
2.5 times as far from the truth on held-out drops as the same particles are with 4; with fewer than 3 thin parts have empty cells.
"""
THIN = 0.1
"""Share of the body that has to be thinner for its thin parts to count."""
MOST = 5.0
"""Cells of two layers across beyond which nobody looks."""


@dataclass(frozen=True)
class Resolution:
    """cells: across the thinnest tenth of the body, at most `MOST`; particles: that `ENOUGH` cells there would take; pieces:
    that do not touch."""

    cells: float
    particles: int
    pieces: int

    @property
    def enough(self) -> bool:
        return self.cells >= ENOUGH


def grid_spacing(spacing: float, per_cell: float = PER_CELL) -> float:
    """dx [m] of the grid on which particles that are `spacing` [m] apart fill a cell with `per_cell`."""
    return per_cell ** (1 / 3) * spacing


def resolution(rest: Tensor, spacing: float, dx: float) -> Resolution:
    """Of particles at rest (N, 3) [m] on a lattice of `spacing` [m], simulated on a grid of dx [m].

    The local thickness of a particle is the diameter of the largest ball of lattice cells that holds it and lies within the body.
    """
    points = rest.detach().double().cpu().numpy()
    index = np.floor((points - points.min(0)) / spacing + 0.5).astype(int) + 1
    solid = np.zeros(index.max(0) + 2, bool)
    solid[tuple(index.T)] = True
    # particles sit at the centroids of their voxels, up to half a spacing off the lattice
    solid = ndimage.binary_closing(solid)
    # two half cells for each: a ball is then centred between layers, whether their number is even or odd
    fine = solid.repeat(2, 0).repeat(2, 1).repeat(2, 2)
    inside = ndimage.distance_transform_edt(fine)
    thickness = np.zeros(fine.shape)
    for radius in range(1, round(2 * MOST) + 1):
        covered = ndimage.distance_transform_edt(inside < radius) < radius
        thickness[covered & fine] = radius  # half cells, of which the diameter has twice as many
    layers = thickness[tuple(2 * index.T)]
    cells = float(np.quantile(layers, THIN)) * spacing / dx
    needed = len(points) * max(1.0, ENOUGH / max(cells, 0.5)) ** 3
    pieces = ndimage.label(solid, np.ones((3, 3, 3)))[1]
    return Resolution(cells, int(needed), pieces)


def particles_for(
    fill: Callable[[float], Tensor], volume: float, *, per_cell: float, least: int, most: int
) -> int:
    """How many particles resolve a body of `volume` [m^3], at least `least` and at most `most`.

    fill: positions (N, 3) [m] of the body's particles at a spacing [m]."""
    spacing = (volume / least) ** (1 / 3)
    wanted = resolution(fill(spacing), spacing, grid_spacing(spacing, per_cell)).particles
    return min(max(wanted, least), most) if wanted > 1.1 * least else least

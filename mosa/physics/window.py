"""The window of grid nodes that a segment works on: where the particles are and may come to."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from mosa.errors import SimulationDiverged

MAX_NODES = 2**23
"""Nodes of the largest window: 200 cells across."""
FARTHEST = 2**30
"""Nodes of the farthest window from the origin."""
SMALL = 2**16
"""Nodes that a window may have too many: over a segment they cost about what a segment less, or a capture less, saves."""
GAINED = 1.5
"""A window has room for particles that come to move faster by this factor along the axes on which they move,"""
TURNED = 0.5
"""and in any direction at this times the largest speed: what hits the ground spreads."""


def extent(x: Tensor, v: Tensor) -> Tensor:
    """(..., 12): lowest and highest x (..., N, 3), lowest and highest v (..., N, 3). NaN stays."""
    return torch.cat([*torch.aminmax(x, dim=-2), *torch.aminmax(v, dim=-2)], -1)


def fallen(bounds: Sequence[float], gravity: Sequence[float], time: float) -> list[float]:
    """`extent` with the velocities of a body that gravity (3,) [m/s^2] pulls on for `time` seconds."""
    lowest = [v + min(g * time, 0.0) for v, g in zip(bounds[6:9], gravity)]
    highest = [v + max(g * time, 0.0) for v, g in zip(bounds[9:], gravity)]
    return [*bounds[:6], *lowest, *highest]


def grid_window(
    x: Tensor, v: Tensor, dx: float, time: float, margin: int, bounds: Sequence[float] | None = None
) -> tuple[tuple, tuple]:
    """(lowest node, nodes per axis) that hold the stencils of all particles for `time` seconds.

    x, v: (N, 3); bounds: their extent, where the host has it already. Errors: SimulationDiverged for non-finite input or particles
    spread over more than 2^23 nodes.
    """
    bounds = extent(x, v).tolist() if bounds is None else bounds  # the only transfer to the host
    if not all(math.isfinite(b) for b in bounds):
        bad = int((~(torch.isfinite(x).all(1) & torch.isfinite(v).all(1))).nonzero()[0])
        raise SimulationDiverged(f"particle {bad} has a non-finite position or velocity before the substep")
    low, dims = window_of(bounds, dx, time, margin)
    if max(map(abs, low)) + max(dims) > FARTHEST:
        raise SimulationDiverged(
            f"a particle is {max(map(abs, bounds[:6])):.3g} m from the origin, more than {FARTHEST} nodes of {dx} m: use more "
            "substeps, or a box"
        )
    if math.prod(dims) > MAX_NODES:
        raise SimulationDiverged(
            f"particles spread over {list(dims)} grid nodes of {dx} m (speeds to {_largest_speed(bounds):.3g} m/s): use more "
            "substeps, or a box"
        )
    return low, dims


def _largest_speed(bounds: Sequence[float]) -> float:
    """Largest component of a velocity."""
    return max(map(abs, bounds[6:]))


def window_of(bounds: Sequence[float], dx: float, time: float, margin: int) -> tuple[tuple, tuple]:
    """As `grid_window`, of an extent and of any size."""
    turned = TURNED * _largest_speed(bounds)

    def nodes(speed: float) -> int:
        return math.ceil(max(GAINED * speed, turned) * time / dx) + margin

    low = [math.floor(x / dx - 0.5) - nodes(-v) for x, v in zip(bounds[:3], bounds[6:9])]
    high = [math.floor(x / dx - 0.5) + 2 + nodes(v) for x, v in zip(bounds[3:6], bounds[9:])]
    return tuple(low), tuple(h - l + 1 for l, h in zip(low, high))

"""The window of grid nodes that a segment works on: where the particles are and may come to."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from mosa.errors import SimulationDiverged

MAX_NODES = 2**23
"""Nodes of the largest window: 200 cells across."""
SMALL = 2**16
"""Nodes that a window may have too many: over a segment they cost about what a segment less, or a capture less, saves."""


def extent(x: Tensor, v: Tensor) -> Tensor:
    """(7,): lowest and highest x (N, 3), largest component of v (N, 3). NaN stays."""
    return torch.cat([*torch.aminmax(x, dim=0), v.abs().amax().reshape(1)])


def fallen(bounds: Sequence[float], gravity: Sequence[float], time: float) -> list[float]:
    """`extent` with the speed of a body that gravity (3,) [m/s^2] pulls on for `time` seconds."""
    return [*bounds[:6], bounds[6] + math.hypot(*gravity) * time]


def grid_window(
    x: Tensor, v: Tensor, dx: float, travel_time: float, margin: int, bounds: Sequence[float] | None = None
) -> tuple[tuple, tuple]:
    """(lowest node, nodes per axis) that hold the stencils of all particles for `travel_time` seconds.

    x, v: (N, 3); bounds: their extent, where the host has it already. Errors: SimulationDiverged for non-finite input or particles
    spread over more than 2^23 nodes.
    """
    bounds = extent(x, v).tolist() if bounds is None else bounds  # the only transfer to the host
    if not all(math.isfinite(b) for b in bounds):
        bad = int((~(torch.isfinite(x).all(1) & torch.isfinite(v).all(1))).nonzero()[0])
        raise SimulationDiverged(f"particle {bad} has a non-finite position or velocity before the substep")
    low, dims = window_of(bounds, dx, travel_time, margin)
    if math.prod(dims) > MAX_NODES:
        raise SimulationDiverged(
            f"particles spread over {list(dims)} grid nodes of {dx} m (speeds to {bounds[6]:.3g} m/s): use more substeps, or a box"
        )
    return low, dims


def window_of(bounds: Sequence[float], dx: float, travel_time: float, margin: int) -> tuple[tuple, tuple]:
    """As `grid_window`, of an extent and of any size."""
    reach = math.ceil(bounds[6] * travel_time / dx) + margin
    low = [math.floor(b / dx - 0.5) - reach for b in bounds[:3]]
    high = [math.floor(b / dx - 0.5) + 2 + reach for b in bounds[3:6]]
    return tuple(low), tuple(h - l + 1 for l, h in zip(low, high))

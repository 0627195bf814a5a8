"""The window of grid nodes that a segment works on: where the particles are and may come to."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from mosa.errors import SimulationDiverged

MAX_NODES = 2**23
"""Nodes of the largest window: 200 cells across."""
MOST_NODES = 2**30
"""Nodes of the windows of all worlds together: the kernels count them in 32 bits."""
FARTHEST = 2**30
"""Nodes of the farthest window from the origin."""
SMALL = 2**16
"""Nodes that a window may have too many: over a segment they cost about what a segment less, or a capture less, saves."""
GAINED = 1.5
"""A window has room for particles that come to move faster by this factor along the axes on which they move,"""
TURNED = 0.5
"""and in any direction at this times the largest speed: what hits the ground spreads."""
_OUTWARDS = np.repeat([-1.0, 1.0], 3)
"""Of lowest and highest velocities: what moves a body's lower and its upper ends away from it."""


def extent(*vectors: Tensor) -> Tensor:
    """(..., 6) of x (..., N, 3), its lowest and highest coordinates; (..., 12) of x and v, those of x first. NaN stays."""
    return torch.cat([end for x in vectors for end in torch.aminmax(x.detach(), dim=-2)], -1)


def fallen(bounds: np.ndarray, gravity: np.ndarray, time: float) -> np.ndarray:
    """`extent` (..., 12) with the velocities of bodies that gravity (..., 3) [m/s^2] pulls on for `time` seconds."""
    bounds = np.array(bounds, dtype=np.float64)
    gained = np.asarray(gravity, dtype=np.float64) * time
    bounds[..., 6:9] += np.minimum(gained, 0.0)
    bounds[..., 9:] += np.maximum(gained, 0.0)
    return bounds


@np.errstate(over="ignore", invalid="ignore")
def grid_window(
    x: Tensor, v: Tensor, dx: float, time: float, margin: int, bounds: np.ndarray | None = None,
    name: Callable[[int], str] = lambda world: "",
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """(lowest node, nodes per axis) (..., 3) that hold the stencils of all particles of each world for `time` seconds.

    x, v: (..., N, 3); bounds: their extent, where the host has it already; name: of a world, for messages. Errors:
    SimulationDiverged for non-finite input or particles of a world spread over more than 2^23 nodes."""
    # the only transfer to the host
    bounds = extent(x, v).numpy(force=True) if bounds is None else bounds
    rows = np.reshape(bounds, (-1, 12))
    if not np.isfinite(rows).all():
        world = int((~np.isfinite(rows)).any(1).nonzero()[0][0])
        x, v = (t.reshape(len(rows), -1, 3)[world] for t in (x, v))
        bad = int((~(torch.isfinite(x).all(1) & torch.isfinite(v).all(1))).nonzero()[0])
        raise SimulationDiverged(
            f"{name(world)}particle {bad} has a non-finite position or velocity before the substep"
        )
    low, dims = window_of(bounds, dx, time, margin)
    # as shares of the most; NaN, of infinite ends, is too much as well
    most = np.maximum(dims.prod(-1) / MAX_NODES, (np.abs(low).max(-1) + dims.max(-1)) / FARTHEST)
    if not (most.max() <= 1 and dims.prod(-1).sum() <= MOST_NODES):
        world = int(np.argmax(most))
        spread = " x ".join(f"{n:.6g}" for n in dims.reshape(-1, 3)[world])
        reach, speed = np.abs(rows[world].reshape(2, 6)).max(1)
        raise SimulationDiverged(
            f"{name(world)}particles spread over {spread} grid nodes of {dx} m, to {reach:.3g} m from the origin (speeds to "
            f"{speed:.3g} m/s): use more substeps, or a box"
        )
    return low.astype(np.int64), dims.astype(np.int64)


def window_of(
    bounds: np.ndarray, dx: float, time: float | np.ndarray, margin: int
) -> tuple[np.ndarray, np.ndarray]:
    """As `grid_window`, of extents (..., 12) and of any size, in float64; time: one, or some that broadcast with (..., 1)."""
    bounds = np.asarray(bounds, dtype=np.float64)
    speeds = _OUTWARDS * bounds[..., 6:]
    # by the largest component of a velocity
    turned = TURNED * np.abs(speeds).max(-1, keepdims=True)
    ahead = np.ceil(np.maximum(GAINED * speeds, turned) * time / dx) + margin
    cells = np.floor(bounds[..., :6] / dx - 0.5)
    low, high = cells[..., :3] - ahead[..., :3], cells[..., 3:] + 2 + ahead[..., 3:]
    return low, high - low + 1

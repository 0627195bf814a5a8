"""Filling: from a fine occupancy volume to simulation particles of a given spacing, with their volumes and shell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from mosa.data.hull import Volume, voxel_counts
from mosa.errors import DataError

INSIDE, SMALLEST_PART = 0.5, 0.25
"""Occupancy of the body, and share of a cell below which it has no particle of its own."""
SMALLEST_PIECE = 0.02
"""Connected pieces below this part of the largest one are debris of the hull (ghosts seen by every matte) and are dropped."""


@dataclass(frozen=True)
class Particles:
    """positions: (N, 3) [m]; volume: (N,) [m^3]; spacing [m]."""

    positions: Tensor
    volume: Tensor
    spacing: float


def _body(volume: Volume) -> np.ndarray:
    """Boolean grid of the body: above the threshold, cavities closed (nothing can see into them), debris dropped."""
    inside = ndimage.binary_fill_holes((volume.values > INSIDE).cpu().numpy())
    labels, pieces = ndimage.label(inside)
    if pieces == 0:
        raise DataError("filling: the occupancy volume is empty; check the mattes and scene.box")
    sizes = np.bincount(labels.ravel())[1:]
    return np.isin(labels, 1 + np.flatnonzero(sizes >= SMALLEST_PIECE * sizes.max()))


def body_volume(volume: Volume) -> float:
    """Volume of the body [m^3], debris dropped and cavities closed."""
    return float(_body(volume).sum()) * volume.pitch**3


def _keep_thin_features(
    kept: np.ndarray, count: np.ndarray, cell: np.ndarray, voxels: np.ndarray, centres: np.ndarray, reach: float,
) -> None:  # fmt: skip
    """Keeps further cells, the fullest first, until no voxel is farther than `reach` from a kept cell's centre.

    kept, count: per cell; cell: (M,) cell of each voxel; voxels: (M, 3); centres: of all cells. Changes `kept`."""
    far = np.flatnonzero(~kept[cell])
    far = far[cKDTree(centres[kept]).query(voxels[far])[0] > reach] if len(far) else far
    while len(far):
        best = cell[far][np.argmax(count[cell[far]])]
        kept[best] = True
        far = far[np.linalg.norm(voxels[far] - centres[best], axis=1) > reach]


def fill(volume: Volume, *, spacing: float) -> Particles:
    """Particles on a lattice of `spacing` [m] inside the 0.5 level of an occupancy volume (pitch well below the spacing).

    The fullest cells hold a particle each, as many as volume / spacing^3, but none filled by less than `SMALLEST_PART`.
    Each voxel of the body belongs to the particle of its cell or, where that has none, to the nearest one; a particle's
    volume is that of its voxels and it sits at their centroid: so total volume, centre of mass and, nearly, moments of
    inertia are those of the body, and the interior is a regular lattice.
    Features thinner than the lattice keep particles of their own. Raises DataError for an empty volume."""
    body = _body(volume)
    origin = volume.origin.double().cpu().numpy()
    voxels = np.argwhere(body) * volume.pitch + origin
    centre = voxels.mean(0)
    cell = np.floor((voxels - centre) / spacing)
    low = cell.min(0)
    shape = np.array(voxel_counts(cell.max(0) - low + 1))
    flat = np.ravel_multi_index((cell - low).astype(np.int64).T, shape)
    count = np.bincount(flat, minlength=int(shape.prod()))
    # the fullest cells, as many as the volume holds: so a particle's mean volume is spacing^3 for thin bodies too
    wanted = max(1, round(len(voxels) * (volume.pitch / spacing) ** 3))
    full = (spacing / volume.pitch) ** 3
    last = -min(wanted, len(count))
    kept = count >= max(np.partition(count, last)[last], SMALLEST_PART * full)
    cells = np.stack(np.unravel_index(np.arange(len(count)), shape), -1)
    centres = (cells + low + 0.5) * spacing + centre
    _keep_thin_features(kept, count, flat, voxels, centres, 1.5 * spacing)
    names = np.flatnonzero(kept)
    owner = np.full(len(count), -1)
    owner[names] = np.arange(len(names))
    owner = owner[flat]
    stray = owner < 0
    if stray.any():
        owner[stray] = cKDTree(centres[names]).query(voxels[stray])[1]
    held = np.bincount(owner, minlength=len(names))
    sums = [np.bincount(owner, voxels[:, a], len(names)) for a in range(3)]
    positions = np.stack(sums, -1) / held[:, None]
    device = volume.values.device
    return Particles(
        torch.as_tensor(positions, dtype=torch.float32, device=device),
        torch.as_tensor(held * volume.pitch**3, dtype=torch.float32, device=device),
        spacing,
    )

"""The solid inside a shell of Gaussians: what a 3DGS file of an object encloses, found without any image.

Gaussians lie on the surface, with nothing inside and with gaps. They are widened until most gaps are closed. A voxel is inside
where lines from it, in 26 directions, end at this shell: a gap that is left opens a few of them, a side that was never filmed, as
the one an object stood on, more, and all of those can be declared closed. What the widening added outside is taken away again: as
much as the outermost Gaussians' centres came to lie deeper below the surface than their own thickness.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import torch
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from mosa.data.hull import Volume, voxel_counts
from mosa.errors import DataError
from mosa.rendering.covariance import covariance_from
from mosa.types import Splats

CHUNK = 2_000_000
"""Voxels of Gaussians that are looked at together."""
REACH = 2.5
"""Standard deviations to which a Gaussian counts."""
LARGEST = 24
"""Voxels to each side that a Gaussian may reach: a wider one is background, or haze."""
MARGIN = 3
"""Empty voxels around the object."""
LEVEL = 0.3
"""Opacity at which the widened shell begins."""
WIDER = 0.6
"""Of the typical distance to the fourth neighbour, by which Gaussians are widened, and of a voxel where that is more."""
GAP, PART = 0.1, 0.01
"""Of the extent of nine tenths of the Gaussians, and of their number: smaller groups that lie farther away are strays."""
OUTERMOST = 0.05
"""Share of the Gaussians whose centres lie nearest to the surface: of the others many hide below it."""
HALF = 1.13
"""Standard deviations at which a Gaussian of opacity 0.95 has fallen to one half: that far out is the surface that it shows."""


def opacity_field(
    splats: Splats, origin: Tensor, shape: tuple[int, int, int], pitch: float, wider: float
) -> np.ndarray:
    """1 - prod_i (1 - o_i exp(-q_i / 2)) on a grid of voxels, of Gaussians whose variances are larger by wider^2 [m^2]."""
    covariances = covariance_from(splats.scales, splats.rotations).double()
    covariances = covariances + wider**2 * torch.eye(3).double()
    places = (splats.means.double() - origin.double()) / pitch
    widest = REACH * covariances.diagonal(dim1=1, dim2=2).amax(1).sqrt() / pitch
    inverse, reach = torch.linalg.inv(covariances / pitch**2), widest.ceil()
    left = torch.zeros(shape, dtype=torch.float64).flatten()  # sum of log(1 - alpha)
    limits = torch.tensor(shape)
    for width in reach[reach <= LARGEST].unique().long().tolist():
        members = (reach == width).nonzero()[:, 0]
        axis = torch.arange(-width, width + 1)
        around = torch.cartesian_prod(axis, axis, axis)
        for part in members.split(max(1, CHUNK // len(around))):
            cells = places[part].round().long()[:, None] + around
            away = cells - places[part][:, None]
            q = torch.einsum("mki,mij,mkj->mk", away, inverse[part], away)
            alpha = splats.opacities[part].double()[:, None].clamp(max=0.99) * (-0.5 * q).exp()
            inside = ((cells >= 0) & (cells < limits)).all(-1) & (q < REACH**2)
            flat = (cells * torch.tensor([shape[1] * shape[2], shape[2], 1])).sum(-1)
            left.index_add_(0, flat[inside], torch.log1p(-alpha[inside]))
    return (1 - left.exp()).reshape(shape).numpy()


def blocked(shell: np.ndarray, direction: tuple[int, int, int]) -> np.ndarray:
    """Whether a line from each voxel in a direction of -1, 0, 1 per axis meets the shell before the grid ends."""
    axis = next(i for i, d in enumerate(direction) if d)
    moved, shell = np.moveaxis(np.zeros_like(shell), axis, 0), np.moveaxis(shell, axis, 0)
    others = [d for i, d in enumerate(direction) if i != axis]
    order = range(len(shell) - 2, -1, -1) if direction[axis] > 0 else range(1, len(shell))
    for k in order:
        ahead = shell[k + direction[axis]] | moved[k + direction[axis]]
        into = tuple(slice(max(0, -d), n - max(0, d)) for d, n in zip(others, ahead.shape))
        out_of = tuple(slice(max(0, d), n - max(0, -d)) for d, n in zip(others, ahead.shape))
        moved[k][into] = ahead[out_of]
    return np.moveaxis(moved, 0, axis)


def solid_of(
    splats: Splats, *, resolution: int = 80, share: float = 0.9, up: Tensor | None = None
) -> Volume:
    """The solid that Gaussians (CPU) enclose, occupancy in [0, 1].

    resolution: voxels along the longest side; share: of 26 directions that have to end at the shell; up: (3,), given where the
    underside is open: directions that fall count as closed. Errors: DataError where nothing is enclosed."""
    low, high = splats.means.amin(0), splats.means.amax(0)
    extent = float((high - low).max())
    if not 0 < extent < np.inf:
        raise DataError(f"solid: expected Gaussians that fill space, found extent {extent:.3g}")
    pitch = extent / resolution
    gap = float(np.median(cKDTree(splats.means.numpy()).query(splats.means.numpy(), k=5)[0][:, 4]))
    wider = WIDER * max(gap, pitch)
    room = MARGIN * pitch + 3 * wider
    origin = low - room
    shape = voxel_counts(((high - low + 2 * room) / pitch).ceil() + 1)
    shell = opacity_field(splats, origin, shape, pitch, wider) > LEVEL
    closed, directions = np.zeros(shape, np.int32), list(filter(any, product((-1, 0, 1), repeat=3)))
    for direction in directions:
        along = (
            torch.zeros(()) if up is None else torch.tensor(direction).float() @ up.float().cpu()
        )
        closed += 1 if float(along) < -0.3 else blocked(shell, direction)
    inside = ndimage.binary_fill_holes(shell | (closed >= share * len(directions)))
    if up is not None:  # what lies below the lowest of the shell is the ground, not the object
        cells = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
        height = cells @ up.cpu().double().numpy()
        inside &= height >= height[shell].min() if shell.any() else False
    if not inside.any():
        raise DataError(
            "solid: expected Gaussians that enclose something, found none opaque enough; is the object cut out of its "
            "surroundings, and what is its opacity?"
        )
    # the surface lies half a voxel outside of the outermost centres
    depth = (ndimage.distance_transform_edt(inside) - 0.5) * pitch
    places = ((splats.means - origin) / pitch).T.double().numpy()
    centres = ndimage.map_coordinates(depth, places, order=1)
    beneath = float(np.quantile(centres, OUTERMOST)) - HALF * float(splats.scales.amin(1).median())
    values = np.clip(0.5 + (depth - max(beneath, 0.0)) / pitch, 0, 1).astype(np.float32)
    return Volume(torch.from_numpy(values), origin, pitch)


def together(means: Tensor) -> Tensor:
    """(N,) which Gaussians are the object: with those that are at most `GAP` of its extent away, at least `PART` of all."""
    x = means.double().numpy()
    extent, near = np.ptp(np.quantile(x, [0.05, 0.95], axis=0), axis=0), cKDTree(x).query(x, k=2)[0]
    gap = max(GAP * float(extent.max()), 3 * float(np.median(near[:, 1])), 1e-30)
    cells, at = np.unique(np.floor(x / gap), axis=0, return_inverse=True)
    pairs = cKDTree(cells).query_pairs(1.0, p=np.inf, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(cells),) * 2)
    piece = connected_components(links, directed=False)[1][at.reshape(-1)]
    count = np.bincount(piece)[piece]
    return torch.from_numpy(count > PART * len(means))

"""Scalar fields on a regular grid: values at points, smoothing, sums of points onto the grid, and where rays meet a surface.

Plain torch on any device; sums are made in integers, so that equal arguments give equal bits on a GPU too.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
import torch.nn.functional as F
from torch import Tensor

from mosa.data.hull import Volume

FIXED_POINT = 2.0**24


def sample(values: Tensor, index: Tensor) -> Tensor:
    """Trilinear values (..., C) of fields (C, X, Y, Z) at grid coordinates index (..., 3); beyond the grid those of its border."""
    size = index.new_tensor(values.shape[1:]) - 1
    grid = (2 * index / size - 1).flip(-1).reshape(1, 1, 1, -1, 3)
    found = F.grid_sample(values[None], grid, padding_mode="border", align_corners=True)
    return found.reshape(len(values), -1).T.reshape(*index.shape[:-1], len(values))


def at(volume: Volume, points: Tensor) -> Tensor:
    """Value of a volume at world points (..., 3) [m]."""
    return sample(volume.values[None], (points - volume.origin) / volume.pitch)[..., 0]


def bell(sigma: float, like: Tensor) -> Tensor:
    """Weights of a Gaussian of `sigma` cells to three of them either side, with sum 1."""
    reach = max(1, round(3 * sigma))
    cells = torch.arange(-reach, reach + 1, device=like.device, dtype=like.dtype)
    weights = torch.exp(-0.5 * (cells / sigma) ** 2)
    return weights / weights.sum()


def smooth(values: Tensor, sigma: float, dims: tuple[int, ...] = (-3, -2, -1)) -> Tensor:
    """Gaussian mean over the last axes named by `dims`; beyond the border the values of the border.

    By sums of shifted copies and not by a convolution, whose rounding depends on the device."""
    weights = bell(sigma, values).tolist()
    reach = len(weights) // 2
    for dim in dims:
        size = values.shape[dim]
        index = torch.arange(-reach, size + reach, device=values.device).clamp(0, size - 1)
        padded = values.index_select(dim % values.dim(), index)
        values = sum(w * padded.narrow(dim, k, size) for k, w in enumerate(weights))
    return values


def scatter(shape: tuple[int, ...], index: Tensor, values: Tensor) -> Tensor:
    """Sums (C, X, Y, Z) of values (N, C) shared among the eight grid points around each index (N, 3); exact in any order."""
    low = index.floor()
    part, low = index - low, low.long()
    limit = torch.tensor(shape, device=index.device)
    fixed = (values.double() * FIXED_POINT).round()
    total = torch.zeros(
        values.shape[1], shape[0] * shape[1] * shape[2], dtype=torch.long, device=index.device
    )
    for corner in range(8):
        offset = torch.tensor([corner >> 2 & 1, corner >> 1 & 1, corner & 1], device=index.device)
        cell = low + offset
        weight = torch.where(offset.bool(), part, 1 - part).prod(1) * (
            (cell >= 0) & (cell < limit)
        ).all(1)
        cell = torch.minimum(cell.clamp(min=0), limit - 1)
        flat = (cell[:, 0] * shape[1] + cell[:, 1]) * shape[2] + cell[:, 2]
        total.index_add_(1, flat, (fixed * weight[:, None].double()).round().long().T.contiguous())
    return (total.double() / FIXED_POINT).to(values).reshape(-1, *shape)


def gradient(values: Tensor, pitch: float) -> Tensor:
    """(3, X, Y, Z) derivatives of a field (X, Y, Z) by central differences."""
    return torch.stack(torch.gradient(values, spacing=pitch))


def span(volume: Volume) -> tuple[Tensor, float]:
    """Centre (3,) and radius [m] of the ball around a volume's grid."""
    size = volume.pitch * (torch.tensor(volume.values.shape, device=volume.values.device) - 1)
    return volume.origin + size / 2, float(size.norm()) / 2


def at_once(like: Tensor) -> int:
    """Steps of a ray that are looked at together: a call, and on a GPU a launch, costs more than points that turn out needless."""
    return 32 if like.is_cuda else 8


def first_crossing(
    distance: Volume, origin: Tensor, direction: Tensor, start: Tensor | None = None
) -> Tensor:
    """Way (M,) [m] along rays (M, 3) to where a distance (negative inside) first falls below 0; infinite where it never does.

    start: (M,) ways before which nothing is looked for; nan: from the grid's border."""
    centre, radius = span(distance)
    middle = ((centre - origin) * direction).sum(-1)
    first = middle - radius
    way = first if start is None else torch.where(start.isnan(), first, torch.maximum(start, first))
    hit = torch.full_like(way, float("inf"))
    before = torch.full_like(way, float("inf"))
    left = torch.arange(len(way), device=way.device)
    step, count = 0.7 * distance.pitch, at_once(way)
    ahead = step * torch.arange(count, device=way.device)
    for _ in range(0, int(2 * radius / step) + 2, count):
        ways = way[left, None] + ahead
        found = at(distance, origin[left, None] + ways[..., None] * direction[left, None])
        inside = found < 0
        first = inside.to(torch.uint8).argmax(1, keepdim=True)
        earlier = torch.cat([before[left, None], found[:, :-1]], 1)
        last, now, here = (t.gather(1, first)[:, 0] for t in (earlier, found, ways))
        passed = last / (last - now).clamp(min=1e-9)
        share = torch.where(last.isinf(), 1.0, passed)
        inside = inside.any(1)
        hit[left[inside]] = (here + (share - 1) * step)[inside]
        before[left] = found[:, -1]
        left = left[~inside]
        way[left] = way[left] + count * step
        left = left[way[left] < (middle + radius)[left]]
        if len(left) == 0:
            break
    return hit


def marched(distance: Volume, origin: Tensor, direction: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Ways (M, k) [m] along rays (M, 3) from one border of the grid to the other, a cell apart, some at once, and the distances
    (M, k) there."""
    centre, radius = span(distance)
    begin = ((centre - origin) * direction).sum(-1) - radius
    steps = torch.arange(int(2 * radius / distance.pitch) + 1, device=begin.device)
    for ahead in steps.split(at_once(begin)):
        ways = begin[:, None] + ahead * distance.pitch
        yield ways, at(distance, origin[:, None] + ways[..., None] * direction[:, None])


def nearest_passing(distance: Volume, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Smallest distance (M,) that rays (M, 3) meet inside the grid, and the way (M,) [m] to it."""
    best, way = torch.full_like(origin[:, 0], float("inf")), torch.zeros_like(origin[:, 0])
    for ways, found in marched(distance, origin, direction):
        found, nearest = found.min(1)
        here = ways.gather(1, nearest[:, None])[:, 0]
        nearer = found < best
        best, way = torch.where(nearer, found, best), torch.where(nearer, here, way)
    return best, way

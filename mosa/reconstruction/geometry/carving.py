"""Space carving by colour: which voxels of a visual hull are air, because no surface can be where several cameras look at them.

For every pixel the ray is followed into the body. A point of the surface has one colour in all cameras that see it; the first
depth whose colours agree nearly as well as the best on this ray is where its surface can begin, and what lies before it is air
for this camera. A voxel is emptied where more cameras say so than say that the surface is there. Where the colours tell nothing
(a plain surface agrees everywhere, a glossy one nowhere), the first depth is the hull's own, or there is no vote: the hull stays.
Kutulakos and Seitz, A theory of shape by space carving (IJCV 2000), with votes of windows in place of single pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from kornia.morphology import dilation
from torch import Tensor

from mosa.data.hull import Volume
from mosa.reconstruction.geometry.field import at, camera_rays, first_crossing, smooth
from mosa.reconstruction.motion.observed import Windows
from mosa.rendering.cameras import sample_images

UNSEEN = 9.0


@dataclass(frozen=True)
class CarvingSettings:
    """passes: rounds at most, each from the surface that the one before left (0: none); neighbours: cameras that a camera is
    compared with, the nearest by direction within `degrees`, of which the best `agreeing` count (others may not see the point);
    depth: steps of 0.75 voxels a ray is followed; noise: difference of colours (of 1) that says nothing; good: what the best depth
    of a ray may have at most to have a vote; ratio: how much worse (squared) than the best a depth may be that is taken for the
    surface; votes: how many cameras more must see air than matter, as a mean over a voxel's neighbourhood."""

    passes: int = 3
    neighbours: int = 4
    agreeing: int = 2
    degrees: float = 70.0
    depth: int = 40
    noise: float = 0.025
    good: float = 0.09
    ratio: float = 2.0
    votes: float = 0.8


def _at_pixels(image: Tensor, pixel: Tensor) -> Tensor:
    """Bilinear values (C, ...) of an image (C, H, W) at pixels (..., 2); 0 outside."""
    return sample_images(image[None], pixel.reshape(1, -1, 2)).reshape(
        len(image), *pixel.shape[:-1]
    )


def _window_mean(values: Tensor) -> Tensor:
    return F.avg_pool2d(values[:, None], 3, 1, 1)[:, 0]


def _pixels(points: Tensor, K: Tensor, w2c: Tensor) -> Tensor:
    seen = points @ w2c[:3, :3].T + w2c[:3, 3]
    pixel = seen @ K.T
    return pixel[..., :2] / pixel[..., 2:].clamp(min=1e-6)


def _disagreement(
    body: Volume,
    views: Windows,
    v: int,
    others: list[int],
    points: Tensor,
    met: Tensor,
    settings: CarvingSettings,
) -> Tensor:
    """Mean squared difference of colours (K, H, W) between view v and the others that agree best, at points (K, H, W, 3) along its
    rays, the first where they meet the body. met: (H, W) rays that do."""
    inside = (at(body, points) > 0.5) & met
    inside[0] = met
    own = views.images[v].permute(2, 0, 1)[:, None]
    costs = []
    for u in others:
        seen = torch.cat(
            [views.images[u] * views.mattes[u][..., None], views.mattes[u][..., None]], -1
        ).permute(2, 0, 1)
        found = _at_pixels(seen, _pixels(points, views.cameras.K[u], views.cameras.w2c[u]))
        difference = (found[:3] / found[3:].clamp(min=0.05) - own).square().mean(0).clamp(max=0.09)
        weight = ((found[3] > 0.9) & inside & (views.mattes[v] > 0.95)).to(own)
        share = _window_mean(weight)
        cost = _window_mean(difference * weight) / share.clamp(min=1e-6)
        costs.append(torch.where(share > 0.35, cost, torch.full_like(cost, UNSEEN)))
    best = torch.stack(costs).sort(0).values[: settings.agreeing].mean(0)
    return torch.where(inside, best, torch.full_like(best, UNSEEN))


def _partners(centres: Tensor, middle: Tensor, settings: CarvingSettings) -> list[list[int]]:
    """For each camera the nearest others by direction from the body, none farther than settings.degrees."""
    towards = F.normalize(centres - middle, dim=-1)
    cosine = (towards @ towards.T).fill_diagonal_(-2.0)
    value, index = cosine.topk(min(settings.neighbours, len(cosine) - 1), 1)
    near = value > math.cos(math.radians(settings.degrees))
    return [
        [u for u, ok in zip(row, good) if ok] for row, good in zip(index.tolist(), near.tolist())
    ]


def votes(body: Volume, views: Windows, settings: CarvingSettings) -> Tensor:
    """Cameras that see air minus cameras that see matter, for each voxel of a body (values 0 or 1); 0 outside of it."""
    centres, directions = camera_rays(views.cameras)
    inside = body.values > 0.5
    points = body.points()[inside]
    partners = _partners(centres, points.mean(0), settings)
    signed = replace(body, values=0.5 - body.values)
    steps = 0.75 * body.pitch * torch.arange(settings.depth, device=points.device)
    tally = torch.zeros(len(points), device=points.device)
    height, width = views.mattes.shape[1:]
    for v, others in enumerate(partners):
        if len(others) < settings.agreeing:
            continue
        seen = views.mattes[v] > 0.5
        begin = torch.full_like(views.mattes[v], float("inf"))
        ray = directions[v][seen]
        begin[seen] = first_crossing(signed, centres[v].expand_as(ray), ray)
        met = begin.isfinite()
        begin = torch.where(met, begin, torch.zeros_like(begin))
        along = centres[v] + (begin + steps[:, None, None])[..., None] * directions[v]
        cost = _disagreement(body, views, v, others, along, met, settings)
        least, best = cost.min(0)
        first = (cost <= settings.ratio * least + settings.noise**2).to(torch.uint8).argmax(0)
        sure = (least < settings.good**2) & met
        pixel = _pixels(points, views.cameras.K[v], views.cameras.w2c[v]).long()
        column, row = pixel[:, 0].clamp(0, width - 1), pixel[:, 1].clamp(0, height - 1)
        way, margin = (points - centres[v]).norm(dim=-1), 0.5 * body.pitch
        surface, end = (
            (begin + steps[first])[row, column] - margin,
            (begin + steps[best])[row, column] + 1.5 * body.pitch,
        )
        tally += (sure[row, column] & (way < surface)).to(tally) - (
            sure[row, column] & (way >= surface) & (way < end)
        ).to(tally)
    grid = torch.zeros_like(body.values)
    grid[inside] = tally
    return grid


def keep_silhouettes(kept: Tensor, body: Volume, views: Windows) -> Tensor:
    """`kept` with the body's voxels given back on rays of the mattes that nothing kept covers any more: no part is ever lost.

    A bin beside a covered one counts as covered: a surface may move by the width of one, a limb cannot vanish.
    """
    inside = body.values > 0.5
    points, held = body.points()[inside], kept[inside]
    missing = torch.zeros_like(held)
    for K, w2c, matte in zip(views.cameras.K, views.cameras.w2c, views.mattes):
        # bins as wide as a voxel and a half is seen: a column of voxels leaves no hole
        size = max(
            1.0, 1.5 * body.pitch * float(K[0, 0]) / float((points @ w2c[2, :3] + w2c[2, 3]).mean())
        )
        columns, rows = int(views.cameras.width / size) + 1, int(views.cameras.height / size) + 1
        pixel = _pixels(points, K, w2c)
        seen = _at_pixels(matte[None], pixel)[0] > 0.5
        column, row = (pixel / size).long().unbind(1)
        ray = row.clamp(0, rows - 1) * columns + column.clamp(0, columns - 1)
        covered = torch.zeros(rows * columns, device=kept.device)
        covered[ray[held]] = 1.0
        covered = (
            dilation(covered.reshape(1, 1, rows, columns), covered.new_ones(3, 3)).reshape(-1) > 0.5
        )
        missing |= seen & ~covered[ray]
    result = kept.clone()
    result[inside] = held | missing
    return result


def carve(body: Volume, views: Windows, settings: CarvingSettings) -> Volume:
    """The body (values 0 or 1) without the voxels that the colours show to be air; views: windows of one pose of the body.

    Ends before settings.passes rounds where one changes less than a thousandth of the body.
    """
    for _ in range(settings.passes):
        inside = body.values > 0.5
        air = smooth(votes(body, views, settings), 1.0) >= settings.votes
        kept = keep_silhouettes(inside & ~air, body, views)
        body = replace(body, values=kept.to(body.values))
        if int(kept.sum()) > 0.999 * int(inside.sum()):
            break
    return body

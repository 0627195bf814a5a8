"""Space carving by colour: which voxels of a visual hull are air, because no surface can be where several cameras look at them.

For every pixel the ray is followed into the body. A point of the surface has one colour in all cameras that see it; the first
depth whose colours agree nearly as well as the best on this ray is where its surface can begin, and what lies before it is air
for this camera. A voxel is emptied where more cameras say so than say that the surface is there. Where the colours tell nothing
(a plain surface agrees everywhere, a glossy one nowhere), the first depth is the hull's own, or there is no vote: the hull stays.
Kutulakos and Seitz, A theory of shape by space carving (IJCV 2000), with votes of windows in place of single pixels.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
import torch.nn.functional as F
from kornia.morphology import dilation
from torch import Tensor

from mosa.data.hull import Volume
from mosa.reconstruction.geometry.field import at, first_crossing, smooth
from mosa.reconstruction.motion.observed import Windows
from mosa.rendering.cameras import rays, sample_images

UNSEEN = 9.0
PASSES = 3
"""Rounds at most, each from the surface that the one before left."""
NEIGHBOURS, DEGREES, AGREEING = 4, 70.0, 2
"""Cameras that a camera is compared with, the nearest by direction within an angle, and how many of them count: the best, as others
may not see the point."""
DEPTH, STEP = 40, 0.75
"""Steps that a ray is followed, and their length in voxels."""
NOISE, GOOD, RATIO = 0.025, 0.09, 2.0
"""Difference of colours (of 1) that says nothing; what the best depth of a ray may have at most to have a vote; how much worse
(squared) than the best a depth may be that is taken for the surface."""
VOTES = 0.8
"""How many cameras more must see air than matter, as a mean over a voxel's neighbourhood."""


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
    body: Volume, views: Windows, v: int, others: list[int], points: Tensor, met: Tensor
) -> Tensor:
    """Mean squared difference of colours (K, H, W) between view v and the others that agree best, at points (K, H, W, 3) along its
    rays, the first where they meet the body. met: (H, W) rays that do."""
    inside = (at(body, points) > 0.5) & met
    inside[0] = met
    own = views.images[v].permute(2, 0, 1)[:, None]
    costs, masked = [], views.masked()
    for u in others:
        pixels = _pixels(points, views.cameras.K[u], views.cameras.w2c[u])
        found = _at_pixels(masked[u], pixels)
        difference = (found[:3] / found[3:].clamp(min=0.05) - own).square().mean(0).clamp(max=0.09)
        weight = ((found[3] > 0.9) & inside & (views.mattes[v] > 0.95)).to(own)
        share = _window_mean(weight)
        cost = _window_mean(difference * weight) / share.clamp(min=1e-6)
        costs.append(torch.where(share > 0.35, cost, UNSEEN))
    best = torch.stack(costs).sort(0).values[:AGREEING].mean(0)
    return torch.where(inside, best, UNSEEN)


def _partners(centres: Tensor, middle: Tensor) -> list[list[int]]:
    """For each camera the nearest others by direction from the body, none farther than `DEGREES`."""
    towards = F.normalize(centres - middle, dim=-1)
    cosine = (towards @ towards.T).fill_diagonal_(-2.0)
    value, index = cosine.topk(min(NEIGHBOURS, len(cosine) - 1), 1)
    near = value > math.cos(math.radians(DEGREES))
    return [row[good].tolist() for row, good in zip(index, near)]


def votes(body: Volume, views: Windows) -> Tensor:
    """Cameras that see air minus cameras that see matter, for each voxel of a body (values 0 or 1); 0 outside of it."""
    centres, directions = rays(views.cameras)
    inside = body.values > 0.5
    points = body.points()[inside]
    partners = _partners(centres, points.mean(0))
    signed = replace(body, values=0.5 - body.values)
    steps = STEP * body.pitch * torch.arange(DEPTH, device=points.device)
    tally = torch.zeros(len(points), device=points.device)
    height, width = views.mattes.shape[1:]
    for v, others in enumerate(partners):
        if len(others) < AGREEING:
            continue
        seen = views.mattes[v] > 0.5
        begin = torch.full_like(views.mattes[v], float("inf"))
        ray = directions[v][seen]
        begin[seen] = first_crossing(signed, centres[v].expand_as(ray), ray)
        met = begin.isfinite()
        begin = torch.where(met, begin, 0.0)
        along = centres[v] + (begin + steps[:, None, None])[..., None] * directions[v]
        cost = _disagreement(body, views, v, others, along, met)
        least, best = cost.min(0)
        first = (cost <= RATIO * least + NOISE**2).to(torch.uint8).argmax(0)
        sure = (least < GOOD**2) & met
        pixel = _pixels(points, views.cameras.K[v], views.cameras.w2c[v]).long()
        column, row = pixel[:, 0].clamp(0, width - 1), pixel[:, 1].clamp(0, height - 1)
        way, margin = (points - centres[v]).norm(dim=-1), 0.5 * body.pitch
        surface = (begin + steps[first])[row, column] - margin
        end = (begin + steps[best])[row, column] + 1.5 * body.pitch
        told = sure[row, column].to(tally)
        tally += told * (way < surface) - told * ((way >= surface) & (way < end))
    grid = torch.zeros_like(body.values)
    grid[inside] = tally
    return grid


def keep_silhouettes(kept: Tensor, body: Volume, views: Windows) -> Tensor:
    """`kept` with the body's voxels given back on rays of the mattes that nothing kept covers any more: no part is ever lost.

    A bin beside a covered one counts as covered: a surface may move by the width of one, a limb cannot vanish."""
    inside = body.values > 0.5
    points, held = body.points()[inside], kept[inside]
    missing = torch.zeros_like(held)
    for K, w2c, matte in zip(views.cameras.K, views.cameras.w2c, views.mattes):
        # bins as wide as a voxel and a half is seen: a column of voxels leaves no hole
        depth = float((points @ w2c[2, :3] + w2c[2, 3]).mean())
        size = max(1.0, 1.5 * body.pitch * float(K[0, 0]) / depth)
        columns, rows = int(views.cameras.width / size) + 1, int(views.cameras.height / size) + 1
        pixel = _pixels(points, K, w2c)
        seen = _at_pixels(matte[None], pixel)[0] > 0.5
        column, row = (pixel / size).long().unbind(1)
        ray = row.clamp(0, rows - 1) * columns + column.clamp(0, columns - 1)
        covered = torch.zeros(rows * columns, device=kept.device)
        covered[ray[held]] = 1.0
        beside = dilation(covered.reshape(1, 1, rows, columns), covered.new_ones(3, 3))
        missing |= seen & (beside.reshape(-1) < 0.5)[ray]
    result = kept.clone()
    result[inside] = held | missing
    return result


def carve(body: Volume, views: Windows) -> Volume:
    """The body (values 0 or 1) without the voxels that the colours show to be air; views: windows of one pose of the body.

    Ends before `PASSES` rounds where one changes less than a thousandth of the body."""
    for _ in range(PASSES):
        inside = body.values > 0.5
        air = smooth(votes(body, views), 1.0) >= VOTES
        kept = keep_silhouettes(inside & ~air, body, views)
        body = replace(body, values=kept.to(body.values))
        if int(kept.sum()) > 0.999 * int(inside.sum()):
            break
    return body

"""The surface of a body between its silhouettes: moved to where colours agree and outlines fit, with how surely it is known.

The body is a distance on a grid, negative inside. Each round looks at one frame of free flight from all its cameras:
- Colours. A point of the surface is looked at by every camera that sees it. Moved by d along its normal, its colour in camera u
  changes by g_u d; the d that makes the colours agree best solves sum w |g_u - g|^2 d = -sum w (g_u - g)(c_u - c) (Lucas and
  Kanade's step, with the common colour c eliminated). Both sides are sums of information: divided by the variance of a colour
  they are added up.
- Outlines. The smallest distance that the ray of an outline's pixel meets is half a pixel less the matte's share, times the
  pixel's width.

Both are added up over a neighbourhood of the surface, which then moves by its mean, as far as the information goes. Where there is
little of it, the surface is made smooth: by (1 - G)^2, which flattens ridges and leaves a ball's curvature alone, unlike a motion
by mean curvature.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from kornia.morphology import dilation, erosion
from scipy import ndimage
from torch import Tensor

from mosa.data.hull import Volume
from mosa.reconstruction.geometry import field
from mosa.reconstruction.motion.observed import Windows
from mosa.rendering.cameras import centers, rays, sample_images

LOCAL = 0.3
"""Length on which a ray may touch a surface that it is to place, in radii of the grid: a ball's outline touches on 0.25 of them."""
BORDER = 4
"""Cells added around a hull, so that its surface is nowhere at the grid's border."""


PATCH = 2.0
"""Standard deviation of a neighbourhood [voxels]."""
NOISE, MISPLACED = 0.03, 0.3
"""Noise of a colour (of 1), and the pixels times its slope that it may be misplaced by."""
OUTLINE = 0.2
"""[px] noise of an outline."""
STEP = 1.0
"""[mm] of the surface per round."""
FACING = 0.3
"""Smallest cosine between a surface and the direction to a camera that counts."""
BEND = 1.0
"""How much smoothness counts against information of 1 per (0.5 mm)^2."""
SLACK = 0.25
"""[px] that the body may reach beyond the hull's surface."""


def signed_distance(inside: Volume) -> Volume:
    """Distance [m] to the surface of voxels (values 0 or 1), negative inside, on a grid wider by BORDER cells."""
    solid = F.pad(inside.values > 0.5, (BORDER,) * 6).cpu().numpy()
    cells = ndimage.distance_transform_edt(~solid) - ndimage.distance_transform_edt(solid)
    values = inside.pitch * torch.as_tensor(cells, dtype=torch.float32, device=inside.values.device)
    return Volume(field.smooth(values, 0.7), inside.origin - BORDER * inside.pitch, inside.pitch)


def voxels(distance: Volume, like: Volume) -> Volume:
    """Values 0 or 1 of a distance on the grid that it was made from."""
    inner = slice(BORDER, -BORDER)
    return replace(like, values=(distance.values[inner, inner, inner] < 0).to(like.values))


def blurred(views: Windows, sigma: float) -> Tensor:
    """Colour, its slopes along columns and rows [1/px] and matte, (B, 10, h, w); colours are means inside of the matte alone."""
    stacked = field.smooth(views.masked(), sigma, (-2, -1))
    color = stacked[:, :3] / stacked[:, 3:].clamp(min=0.05)
    rows, columns = torch.gradient(color, dim=(2, 3))
    return torch.cat([color, columns, rows, stacked[:, 3:]], 1)


@dataclass
class _Group:
    """The windows of one frame with what is kept of them from round to round. start: ways (B, h, w) to the surface."""

    views: Windows
    centres: Tensor
    directions: Tensor
    outline: Tensor
    start: Tensor


def edges(mattes: Tensor) -> Tensor:
    """Pixels (B, H, W) bool of mattes beside their outlines."""
    around, box = mattes[:, None], mattes.new_ones(3, 3)
    return ((dilation(around, box) > 0.02) & (erosion(around, box) < 0.98))[:, 0]


def _group(views: Windows) -> _Group:
    start = torch.full_like(views.mattes, float("nan"))
    return _Group(views, *rays(views.cameras), edges(views.mattes), start)


def _surface(distance: Volume, group: _Group) -> tuple[Tensor, Tensor]:
    """Ways (B, h, w) to the surface, infinite where a ray misses it, and the points (N, 3) [m] where the others meet it."""
    seen = group.views.mattes > 0.5
    window = seen.nonzero()[:, 0]
    way = torch.full_like(group.views.mattes, float("inf"))
    centres, directions = group.centres[window], group.directions[seen]
    way[seen] = field.first_crossing(distance, centres, directions, group.start[seen])
    met = way.isfinite()
    # the next round looks from a little before this one's surface: it moves by less than a voxel
    group.start = torch.where(met, way - 3 * distance.pitch, float("nan"))
    return way, group.centres[met.nonzero()[:, 0]] + way[met][:, None] * group.directions[met]


def color_information(
    distance: Volume, group: _Group, images: Tensor, points: Tensor, ways: Tensor, *, doubt: bool = False,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Information [1/m^2] and information times displacement [1/m] along the outward normal, (N,) each, of surface points (N, 3).

    doubt: divided by the square of the residual's chi^2, where that is larger than 1."""
    cameras = group.views.cameras
    slopes = field.gradient(distance.values, distance.pitch)
    normal = F.normalize(field.sample(slopes, (points - distance.origin) / distance.pitch), dim=-1)
    height, width = ways.shape[1:]
    reach = F.max_pool2d(torch.where(ways.isfinite(), ways, 0.0)[:, None], 3, 1, 1)[:, 0]
    weights, colors, changes, variances = [], [], [], []
    for u in range(len(cameras)):
        R, focal = cameras.w2c[u, :3, :3], cameras.K[u].diagonal()[:2]
        seen = points @ R.T + cameras.w2c[u, :3, 3]
        flat = seen[:, :2] / seen[:, 2:]
        pixel = flat * focal + cameras.K[u, :2, 2]
        turned = normal @ R.T
        moved = focal * (turned[:, :2] - flat * turned[:, 2:]) / seen[:, 2:]
        found = sample_images(images[u][None], pixel[None])[0].T
        column, row = (
            pixel[:, 0].long().clamp(0, width - 1),
            pixel[:, 1].long().clamp(0, height - 1),
        )
        arm = points - group.centres[u]
        facing = -(normal * F.normalize(arm, dim=-1)).sum(-1)
        visible = arm.norm(dim=-1) <= reach[u, row, column] + 0.5 * distance.pitch
        visible &= facing > FACING
        weights.append((visible & (found[:, 9] > 0.9)) * facing.clamp(min=0).square())
        colors.append(found[:, :3])
        changes.append(found[:, 3:6] * moved[:, :1] + found[:, 6:9] * moved[:, 1:])
        variances.append(NOISE**2 + MISPLACED**2 * (found[:, 3:9].square().sum(1) / 3))
    weight, color, change = torch.stack(weights), torch.stack(colors), torch.stack(changes)
    robust = weight
    for _ in range(2):
        mean = (robust[..., None] * color).sum(0) / robust.sum(0).clamp(min=1e-6)[:, None]
        robust = weight / (1 + (color - mean).square().sum(-1) / (27 * NOISE**2))
    total = robust.sum(0).clamp(min=1e-6)[:, None]
    residual = color - (robust[..., None] * color).sum(0) / total
    change = change - (robust[..., None] * change).sum(0) / total
    # a point of the surface is met by the ray of every camera that sees it: its share of the information
    each = (robust / torch.stack(variances) / (weight > 0).sum(0).clamp(min=1))[..., None]
    if doubt:
        mean = (weight[..., None] * color).sum(0) / weight.sum(0).clamp(min=1e-6)[:, None]
        squares = weight * (color - mean).square().mean(-1) / torch.stack(variances)
        squares = squares.sum(0) / weight.sum(0).clamp(min=1e-6)
        each = each / squares.clamp(min=1).square()[:, None]
    return (each * change.square()).sum((0, 2)), -(each * change * residual).sum((0, 2))


def outline_information(
    distance: Volume, group: _Group, width: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Points (M, 3) where rays of an outline's pixels pass nearest, information [1/m^2], information times displacement [1/m].

    width: of a pixel at the body [m]."""
    origin = group.centres[group.outline.nonzero()[:, 0]]
    direction, matte = group.directions[group.outline], group.views.mattes[group.outline]
    best, way = field.nearest_passing(distance, origin, direction)
    share = (0.5 - best / width).clamp(0, 1)
    told = ((share > 0) | (matte > 0.02)) & ((share < 1) | (matte < 0.98))
    information = (told & (best < 4 * distance.pitch)) / (OUTLINE * width) ** 2
    return origin + way[:, None] * direction, information, information * (matte - share) * width


def pixel_width(distance: Volume, views: Windows) -> float:
    """Width [m] of a pixel at the middle of a grid, mean over the cameras."""
    middle, _ = field.span(distance)
    return float(((middle - centers(views.cameras)).norm(dim=1) / views.cameras.K[:, 0, 0]).mean())


def refine(
    distance: Volume, hull: Volume, frames: list[Windows], schedule: Sequence[tuple[int, float]]
) -> Volume:
    """The refined distance [m].

    distance: of where to start, hull: of what it has to stay within, both on one grid (`signed_distance`); frames: windows of each
    frame of free flight, with cameras that see the body where it is in frame 0: rounds take turns. schedule: rounds and blur [px].
    """
    pitch, groups = distance.pitch, [_group(views) for views in frames]
    width = pixel_width(distance, frames[0])
    floor = hull.values - SLACK * width
    shape, area = tuple(distance.values.shape), 2 * math.pi * PATCH**2
    turn = 0
    for rounds, sigma in schedule:
        images = [blurred(views, sigma) for views in frames]
        for _ in range(rounds):
            group, image = groups[turn % len(groups)], images[turn % len(groups)]
            ways, points = _surface(distance, group)
            about, pull = color_information(distance, group, image, points, ways)
            edges, edge_about, edge_pull = outline_information(distance, group, width)
            # in units of voxels
            values = torch.stack(
                [torch.cat([about, edge_about]) * pitch**2, torch.cat([pull, edge_pull]) * pitch], 1
            )
            index = (torch.cat([points, edges]) - distance.origin) / pitch
            known, pulled = area * field.smooth(field.scatter(shape, index, values), PATCH)
            step = pulled / (known + (pitch / (1e-3 * STEP)) ** 2)
            values = distance.values - pitch * step.clamp(-0.6, 0.6)
            once = field.smooth(values, 1.5)
            flat = 2 * once - field.smooth(once, 1.5)
            share = BEND / (BEND + known * (0.5e-3 / pitch) ** 2)
            values = torch.maximum(values + share * (flat - values), floor)
            turn += 1
            if turn % 3 == 0:  # keep it a distance near the surface
                slope = field.gradient(values, pitch).norm(dim=0).clamp(0.5, 2)
                values = torch.where(values.abs() < 3 * pitch, values / slope, values)
            distance = replace(distance, values=values)
    return distance


def surface_information(distance: Volume, frames: list[Windows], blur: float) -> Tensor:
    """Information [1/m^2] on the place of the surface, (X, Y, Z), of all frames together: what is not told is 0.

    Colours that do not agree at the surface tell little, by the square of their chi^2. A ray of an outline tells where the
    surface is only where it touches it in one place: along a flat side, or over a hollow that it spans, it tells how high and not
    where."""
    width, total = pixel_width(distance, frames[0]), torch.zeros_like(distance.values)
    _, radius = field.span(distance)
    # half: nothing is said of what lies far from a rim
    patch, shape = 0.5 * PATCH, tuple(distance.values.shape)
    area = 2 * math.pi * patch**2
    for views in frames:
        group = _group(views)
        ways, points = _surface(distance, group)
        images = blurred(views, blur)
        about, _ = color_information(distance, group, images, points, ways, doubt=True)
        edges, edge_about, _ = outline_information(distance, group, width)
        origin = group.centres[group.outline.nonzero()[:, 0]]
        direction = group.directions[group.outline]
        touching = _touching(distance, origin, direction, edges, 0.5 * width)
        edge_about = edge_about * (touching < LOCAL * radius)
        index = (torch.cat([points, edges]) - distance.origin) / distance.pitch
        values = torch.cat([about, edge_about])[:, None] * distance.pitch**2
        total += area * field.smooth(field.scatter(shape, index, values), patch)[0]
    return total / distance.pitch**2


def _touching(
    distance: Volume, origin: Tensor, direction: Tensor, nearest: Tensor, within: float
) -> Tensor:
    """Length [m] of rays (M, 3) on which the distance is less than `within` [m] above the one at their nearest points (M, 3)."""
    limit = field.at(distance, nearest) + within
    count = torch.zeros_like(limit)
    for _, found in field.marched(distance, origin, direction):
        count += (found < limit[:, None]).sum(1)
    return count * distance.pitch

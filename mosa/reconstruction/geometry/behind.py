"""GIC's filling: the body is what lies behind the depth that static Gaussians show in every view (Cai et al. 2024).

Between levels of a grid, density is interpolated, averaged over 3 x 3 x 3 voxels, cut at one half and set to 1 again where a
Gaussian or a point behind the depth is. Points are tried at the voxels themselves, where GIC tries eight times as many.
"""

from __future__ import annotations

from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from mosa.data.hull import Volume
from mosa.errors import DataError
from mosa.reconstruction.motion.observed import Windows
from mosa.rendering.cameras import project, sample_images
from mosa.rendering.covariance import covariance_from
from mosa.rendering.rasterizer import rasterize
from mosa.types import Splats

LEVELS, ROUNDS = 3, 20
"""Halvings of the spacing from the coarsest grid to the voxels, and rounds of averaging there."""
OPAQUE, DENSE = 0.005, 0.5
"""Opacity from which a Gaussian counts, and density from which a voxel is of the body."""


def rendered_depth(splats: Splats, views: Windows) -> tuple[Tensor, Tensor]:
    """Depth [m] and alpha (V, h, w) of Gaussians in the windows of one frame."""
    depth = project(splats.means, views.cameras)[1]
    state = torch.zeros(len(views), dtype=torch.long, device=splats.means.device)
    image, alpha = rasterize(
        splats.means[None], covariance_from(splats.scales, splats.rotations)[None],
        splats.opacities, depth[..., None], views.cameras, state,
    )  # fmt: skip
    return image[..., 0] / alpha.clamp(min=1e-6), alpha


def behind(points: Tensor, splats: Splats, views: Windows) -> Tensor:
    """Those of the points (M, 3) [m] that every view sees inside of matte and render, behind the depth."""
    depth, alpha = rendered_depth(splats, views)
    seen = torch.stack([depth, torch.minimum(alpha, views.mattes)], 1)
    for v in range(len(views)):
        camera = views.cameras.select([v])
        pixels, away = project(points, camera)
        found, within = sample_images(seen[v : v + 1], pixels)[0]
        points = points[(within > 0.5) & (away[0] > found)]
    return points


def fill_behind(splats: Splats, views: Windows, hull: Volume) -> Volume:
    """The body, values 0 or 1 on the hull's grid. splats: fitted to the views, windows of one frame.

    Errors: DataError where nothing is left."""
    shape = hull.values.shape
    origin = hull.origin.to(splats.means)
    grid = replace(hull, values=hull.values.to(splats.means), origin=origin)
    filled = behind(grid.points().reshape(-1, 3), splats, views)
    marked = torch.cat([splats.means[splats.opacities > OPAQUE], filled])
    place = (marked - origin) / hull.pitch
    size = [-(-(n - 1) // 2**LEVELS) + 1 for n in shape]
    density = splats.means.new_zeros(size)
    for level in range(LEVELS, -1, -1):
        index = (place / 2**level).round().long()
        limit = torch.tensor(density.shape, device=index.device)
        index = index[((index >= 0) & (index < limit)).all(1)]
        if level < LEVELS:
            density = averaged(density)
        for _ in range(ROUNDS if level == 0 else 0):
            density[tuple(index.T)] = 1.0
            density = averaged(density)
        density[tuple(index.T)] = 1.0
        if level:
            finer = [2 * n - 1 for n in density.shape]
            density = F.interpolate(density[None, None], finer, mode="trilinear", align_corners=True)[0, 0]  # fmt: skip
    body = (mean_around(density) >= DENSE)[: shape[0], : shape[1], : shape[2]].float()
    if not bool(body.any()):
        raise DataError(
            f"filling: expected a body behind the {len(splats.means)} static Gaussians, found none: take more steps "
            "(reconstruction.static.iterations), or reconstruction.geometry.source=hull"
        )
    return Volume(body.cpu(), hull.origin.cpu(), hull.pitch)


def mean_around(density: Tensor) -> Tensor:
    """Mean over 3 x 3 x 3 voxels, 0 outside of the grid."""
    return F.avg_pool3d(density[None, None], 3, stride=1, padding=1)[0, 0]


def averaged(density: Tensor) -> Tensor:
    """`mean_around`, 0 where it is less than one half."""
    mean = mean_around(density)
    return torch.where(mean < 0.5, torch.zeros_like(mean), mean)

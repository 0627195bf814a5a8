"""How a known solid fits outlines: its distance to the rays of the mattes' edges, and steps of its
similarities that lower it.

The ray through a pixel of an outline passes the solid at half a pixel less the matte's share. A
similarity takes the solid to the world, x = s R X + c; one residual a pixel, in pixels, with its
derivative in closed form: the point of the nearest passing moves along the surface's normal.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from mosa.reconstruction.geometry.field import sample
from mosa.reconstruction.geometry.known import Solid
from mosa.reconstruction.geometry.refinement import edges
from mosa.reconstruction.pose.rigid import descend_each, rotation_exp
from mosa.rendering.cameras import rays as camera_rays
from mosa.types import Cameras

SAMPLES = 28
"""Of a ray across the solid's ball, before the nearest is refined."""
FULL = 0.02
"""Of a pixel: a matte that is nearer to 0 or 1 says on which side the surface is, not how far."""
STILL = 3e-5
"""Of a body's radius: a shorter step is the last one."""
AT_ONCE = 4_000_000
"""Points whose distance is looked up together."""


@dataclass(frozen=True)
class Similarities:
    """K of them. rotation: (K, 3, 3); center: (K, 3) [m] of the solid; size: (K,) [m] of its unit."""

    rotation: Tensor
    center: Tensor
    size: Tensor

    def take(self, index: Tensor) -> Similarities:
        return Similarities(*(getattr(self, f.name)[index] for f in fields(self)))

    def moved(self, step: Tensor, reach: float) -> Similarities:
        """By steps (K, 7) [m]: of the centre, the angles times size and reach, the logarithm of the
        size times both."""
        arm = (self.size * reach)[:, None]
        rotation = rotation_exp(step[:, 3:6] / arm) @ self.rotation
        size = self.size * (step[:, 6] / arm[:, 0]).exp()
        return Similarities(rotation, self.center + step[:, :3], size)

    def turned(self, rotation: Tensor, center: Tensor, about: Tensor) -> Similarities:
        """Turned by `rotation` (3, 3) about a point (3,), which comes to lie at `center` (3,) [m]."""
        moved = (self.center - about) @ rotation.T + center
        return Similarities(rotation @ self.rotation, moved, self.size)


@dataclass(frozen=True)
class Rays:
    """M rays of one frame. origin: (M, 3) [m]; direction: (M, 3); matte: (M,); pixel: (M,) width of
    a pixel at a distance of 1 m [m]; view: (M,)."""

    origin: Tensor
    direction: Tensor
    matte: Tensor
    pixel: Tensor
    view: Tensor

    def some(self, count: int) -> Rays:
        """Every so many-th, about `count` of each view."""
        kept = []
        for view in self.view.unique():
            own = (self.view == view).nonzero()[:, 0]
            kept.append(own[:: max(1, len(own) // count)])
        return Rays(*(getattr(self, f.name)[torch.cat(kept)] for f in fields(self)))


def rays_of(mattes: Tensor, cameras: Cameras, chosen: Tensor) -> Rays:
    """Through the chosen pixels (V, H, W) bool of mattes (V, H, W)."""
    centres, directions = camera_rays(cameras)
    view = chosen.nonzero()[:, 0]
    focal = cameras.K[:, [0, 1], [0, 1]].mean(1)
    return Rays(centres[view], directions[chosen], mattes[chosen], 1 / focal[view], view)


def outline_rays(mattes: Tensor, cameras: Cameras) -> Rays:
    """Through the pixels beside the outlines of mattes (V, H, W)."""
    return rays_of(mattes, cameras, edges(mattes))


def passing(solid: Solid, at: Similarities, rays: Rays) -> tuple[Tensor, Tensor]:
    """Smallest distances (K, M) [m] of rays from the solid in K places, negative where one crosses
    it, and the points of the solid (K, M, 3), in its units, that are nearest."""
    arm = (rays.origin[None] - at.center[:, None]) / at.size[:, None, None]
    origin = arm @ at.rotation  # rows: R^T arm
    direction = rays.direction[None] @ at.rotation
    middle = -(origin * direction).sum(-1)
    reach = solid.reach
    steps = torch.linspace(-reach, reach, SAMPLES).to(middle)
    best = torch.full_like(middle, torch.inf)
    way = middle
    for step in steps.tolist():
        found = solid.at(origin + (middle + step)[..., None] * direction)
        nearer = found < best
        best, way = torch.where(nearer, found, best), torch.where(nearer, middle + step, way)
    width = 2 * reach / (SAMPLES - 1)
    for _ in range(5):
        width /= 2
        centre = way
        for step in (-width, width):
            found = solid.at(origin + (centre + step)[..., None] * direction)
            nearer = found < best
            best, way = torch.where(nearer, found, best), torch.where(nearer, centre + step, way)
    return best * at.size[:, None], origin + way[..., None] * direction


def pieces(count: int, rays: Rays) -> list[Tensor]:
    """Numbers of similarities that are looked at together."""
    return list(torch.arange(count).split(max(1, AT_ONCE // max(1, len(rays.origin)))))


def misses(solid: Solid, at: Similarities, rays: Rays) -> tuple[Tensor, Tensor]:
    """Residuals (K, M) [px] and their derivatives (K, M, 7) [px/m] in the steps of `moved`."""
    distance, points = passing(solid, at, rays)
    sight = at.center[:, None] - rays.origin[None]
    width = rays.pixel * sight.norm(dim=-1)
    residual = distance / width - (0.5 - rays.matte)
    empty, full = rays.matte < FULL, rays.matte > 1 - FULL
    told = ~((empty & (residual > 0)) | (full & (residual < 0)))
    grid = solid.distance
    normal = sample(solid.slopes, (points - grid.origin) / grid.pitch)
    beyond = distance / at.size[:, None] > 0.1  # where the grid may have ended: towards its middle
    normal = torch.where(beyond[..., None], points, normal)
    # where a ray is nearest the distance does not change along it: what differences over cells leave
    # of that would tell a single camera how far the solid is
    along = rays.direction[None] @ at.rotation
    normal = normal - (normal * along).sum(-1, keepdim=True) * along
    normal = normal / normal.norm(dim=-1, keepdim=True).clamp(min=1e-9)
    turned = normal @ at.rotation.transpose(1, 2)
    arm = points @ at.rotation.transpose(1, 2)
    reach = solid.reach
    around = -torch.linalg.cross(arm, turned) / reach
    grows = (distance / at.size[:, None] - (points * normal).sum(-1)) / reach
    widens = (distance / sight.square().sum(-1))[..., None] * sight
    J = torch.cat([-turned - widens, around, grows[..., None]], -1) / width[..., None]
    return residual * told, J * told[..., None]


def equations(solid: Solid, at: Similarities, rays: Rays) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cost (K,) [px^2] per ray, gradient (K, 7) and Gauss-Newton matrix (K, 7, 7) of Huber's rule
    from twice the median on, at least one pixel; and the root mean square (K,) [px]."""
    parts = []
    for some in pieces(len(at.size), rays):
        residual, J = misses(solid, at.take(some), rays)
        size = residual.abs()
        limit = (2 * size.median(1, keepdim=True).values).clamp(min=1.0)
        weight = limit / torch.maximum(size, limit)
        weighted = J * weight[..., None]
        cost = (weight * residual.square()).mean(1)
        turned, count = weighted.transpose(1, 2), residual.shape[1]
        vector = (turned @ residual[..., None])[..., 0] / count
        parts.append((cost, vector, turned @ J / count, residual.square().mean(1).sqrt()))
    cost, vector, matrix, off = (torch.cat(part) for part in zip(*parts))
    return cost, vector, matrix, off


def fitted(
    solid: Solid, at: Similarities, rays: Rays, iterations: int, *, sized: bool
) -> tuple[Similarities, Tensor]:
    """Each of K similarities after Levenberg-Marquardt steps, with its cost (K,) [px^2]. sized:
    whether the size is fitted too."""
    return descend_each(
        lambda trial: equations(solid, trial, rays)[:3], lambda at, step: at.moved(step, solid.reach), at,
        iterations=iterations + 1, most=lambda at: 0.4 * at.size * solid.reach, free=slice(0, 7 if sized else 6),
        small=lambda step, most: float((step.norm(dim=-1) / most).max()) < STILL,
    )  # fmt: skip


def overlaps(solid: Solid, at: Similarities, mattes: Tensor, cameras: Cameras) -> list[float]:
    """Intersection over union of each matte (V, H, W) and the solid's silhouette, shares of pixels
    counted as such. at: one similarity."""
    shares = []
    for v in range(len(mattes)):
        view, rows = cameras.select([v]), (mattes[v] > FULL).nonzero()
        near = torch.zeros_like(mattes[v : v + 1], dtype=torch.bool)
        (top, left), (bottom, right) = rows.amin(0).tolist(), rows.amax(0).tolist()
        room = (bottom - top + right - left) // 4 + 2
        near[0, max(0, top - room) : bottom + room, max(0, left - room) : right + room] = True
        rays = rays_of(mattes[v : v + 1], view, near)
        width = rays.pixel * (rays.origin - at.center).norm(dim=-1)
        shown = (0.5 - passing(solid, at, rays)[0][0] / width).clamp(0, 1)
        both, either = torch.minimum(shown, rays.matte), torch.maximum(shown, rays.matte)
        shares.append(float(both.sum() / either.sum()))
    return shares

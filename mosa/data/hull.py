"""Visual hull: where every matte sees the object. An upper bound of the body, exact on silhouettes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from scipy import ndimage
from torch import Tensor

from mosa.errors import DataError
from mosa.rendering.cameras import project, sample_images
from mosa.system.limits import counted
from mosa.types import Cameras, metres

voxel_counts = partial(
    counted, "voxels of the object", remedy="take fewer and larger ones", each=40, error=DataError
)


@dataclass(frozen=True)
class Volume:
    """Scalar field on a regular grid of points: values (X, Y, Z) at origin + pitch * index. origin: (3,) [m]; pitch [m]."""

    values: Tensor
    origin: Tensor
    pitch: float

    def points(self) -> Tensor:
        """Grid points, (X, Y, Z, 3) [m]."""
        axes = [
            self.origin[a] + self.pitch * torch.arange(n, device=self.values.device)
            for a, n in enumerate(self.values.shape)
        ]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)

    def occupied_volume(self, threshold: float = 0.5) -> float:
        """Volume [m^3] of the region above `threshold`; the value near the boundary gives the fraction of a cell."""
        return float((self.values > threshold).sum()) * self.pitch**3


def at_border(mattes: Tensor) -> Tensor:
    """Largest value (...) along the border of mattes (..., H, W)."""
    rows, columns = mattes[..., [0, -1], :].amax((-2, -1)), mattes[..., [0, -1]].amax((-2, -1))
    return torch.maximum(rows, columns)


def matte_values(points: Tensor, mattes: Tensor, cameras: Cameras) -> Tensor:
    """Bilinear matte at the projections of world points, (V, M) from (M, 3) and (V, H, W).

    Outside an image it is 0; where the matte itself runs over the image's border the view says nothing there: 1. Behind the
    camera: 0."""
    pixel, depth = project(points, cameras)
    size = pixel.new_tensor([cameras.width, cameras.height])
    values = sample_images(mattes[:, None], pixel, beyond="border")[:, 0]
    border = at_border(mattes) > 0.5
    inside = ((pixel >= 0) & (pixel <= size)).all(-1)
    values = torch.where(inside, values, border[:, None].to(values))
    return torch.where(depth > 1e-3, values, 0.0)


def occupancy(points: Tensor, mattes: Tensor, cameras: Cameras, *, chunk: int = 400_000) -> Tensor:
    """Smallest matte value over all views, in [0, 1], shape of `points` without its last axis; 0.5 is the hull's surface."""
    flat = points.reshape(-1, 3)
    parts = [_smallest(flat[i : i + chunk], mattes, cameras) for i in range(0, len(flat), chunk)]
    return torch.cat(parts).reshape(points.shape[:-1])


def _smallest(points: Tensor, mattes: Tensor, cameras: Cameras) -> Tensor:
    """Smallest matte value (M,) of points (M, 3), view by view: of most points the first views already say that it is 0."""
    smallest = torch.zeros(len(points), dtype=points.dtype, device=points.device)
    left, best = torch.arange(len(points), device=points.device), torch.ones_like(smallest)
    for v in range(len(cameras)):
        best = best.minimum(matte_values(points, mattes[v : v + 1], cameras.select([v]))[0])
        seen = (best > 0).nonzero()[:, 0]
        left, points, best = left[seen], points[seen], best[seen]
    smallest[left] = best
    return smallest


def _grow(mattes: Tensor, radius: int) -> Tensor:
    if radius <= 0:
        return mattes
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    grown = np.stack([cv2.dilate(m, kernel) for m in mattes.cpu().numpy()])
    return torch.as_tensor(grown, device=mattes.device)


def _grown_views(mattes: Tensor, cameras: Cameras, radius: int) -> tuple[Tensor, Cameras]:
    """Mattes grown by `radius` [px], in images that are wider by more than that: a matte that growing alone brings to the border
    would read as one that runs over it, and its view would hide nothing any more."""
    border = radius + 1
    wide = F.pad(mattes[:, None], (border,) * 4, mode="replicate")[:, 0]
    K = cameras.K.clone()
    K[:, :2, 2] += border
    size = {"width": cameras.width + 2 * border, "height": cameras.height + 2 * border}
    return _grow(wide, radius), replace(cameras, K=K, **size)


def hull_bounds(mattes: Tensor, cameras: Cameras, box: Tensor, *, resolution: int = 48) -> Tensor:
    """Bounds of the object, (2, 3) [m], found in two passes of a coarse grid over `box` with mattes grown by half a cell.

    Raises DataError where no point of the box is inside every matte (wrong cameras, wrong box, an empty matte).
    """
    bounds = box.to(mattes)
    for _ in range(3):
        extent = bounds[1] - bounds[0]
        pitch = float(extent.max()) / resolution
        counts = (extent / pitch).ceil().long() + 1
        grid = Volume(torch.empty(tuple(counts.tolist()), device=mattes.device), bounds[0], pitch)
        points = grid.points()
        depth = project(points.reshape(-1, 3).mean(0, keepdim=True), cameras)[1][:, 0]
        radius = float((0.9 * pitch * cameras.K[:, 0, 0] / depth.clamp(min=1e-3)).max())
        radius = max(1, min(int(radius + 1), min(cameras.width, cameras.height) // 4))
        inside = points[occupancy(points, *_grown_views(mattes, cameras, radius)) > 0.5]
        if len(inside) == 0:
            raise DataError(
                f"visual hull: no point of the box {metres(bounds)} m lies inside all "
                f"{len(cameras)} mattes; check scene.box, the cameras' axes and the mattes (the smallest matte covers "
                f"{float(mattes.mean((1, 2)).min()):.2%} of its image)"
            )
        bounds = torch.stack([inside.amin(0) - pitch, inside.amax(0) + pitch])
    return bounds


def visual_hull(
    mattes: Tensor, cameras: Cameras, box: Tensor, *, pitch: float = 0.0, resolution: int = 40
) -> Volume:
    """Occupancy in [0, 1] on a grid around the object. mattes: (V, H, W); box: (2, 3) [m]; pitch [m], without which the longest
    side has `resolution` voxels."""
    bounds = hull_bounds(mattes, cameras, box)
    pitch = pitch or float((bounds[1] - bounds[0]).max()) / resolution
    counts = voxel_counts(((bounds[1] - bounds[0]) / pitch).ceil() + 1)
    grid = Volume(torch.empty(counts, device=mattes.device), bounds[0], pitch)
    return Volume(occupancy(grid.points(), mattes, cameras), bounds[0], pitch)


def hull_centroid(mattes: Tensor, cameras: Cameras, box: Tensor) -> Tensor:
    """Centre of mass of the visual hull, (3,) [m]."""
    hull = visual_hull(mattes, cameras, box)
    return hull.points()[hull.values > 0.5].mean(0)


def shave_ridges(volume: Volume, cameras: Cameras, *, passes=24, sigma=2.0) -> Volume:
    """The hull with its ridges rounded where no silhouette asks for them; returns 0 or 1 per voxel.

    A hull of few views sticks out where the cones of two silhouettes meet: by 3 to 10 % of the volume for 8 to 12 cameras,
    of which this takes a third to all (measured). Each pass moves the surface by its mean curvature (Gaussian of `sigma`
    voxels, threshold 0.5), never outwards of the hull, and then gives back the hull's voxels on every ray of a silhouette
    that nothing covers any more: the silhouettes stay what they are."""
    hull = (volume.values > 0.5).cpu().numpy()
    index = np.argwhere(hull)
    points = volume.origin.double().cpu() + volume.pitch * torch.from_numpy(index)
    rays = []
    for K, w2c in zip(cameras.K.double().cpu(), cameras.w2c.double().cpu()):
        seen = points @ w2c[:3, :3].T + w2c[:3, 3]
        pixel = seen @ K.T
        # bins of 0.75 voxels: fine enough not to lose a skin of the silhouette, coarse enough that a column of voxels
        # leaves no hole
        bin = 0.75 * volume.pitch * K[0, 0] / seen[:, 2].mean()
        column, row = (pixel[:, :2] / pixel[:, 2:] / bin).long().unbind(1)
        rays.append(np.unique((row * (column.max() + 1) + column).numpy(), return_inverse=True)[1])
    current, flat = hull.astype(np.float32), np.ravel_multi_index(index.T, hull.shape)
    for _ in range(passes):
        kept = ((ndimage.gaussian_filter(current, sigma, mode="constant") > 0.5) & hull).ravel()
        inside = kept[flat]
        missing = np.zeros(len(flat), bool)
        for ray in rays:
            missing |= (np.bincount(ray[inside], minlength=ray.max() + 1) == 0)[ray]
        kept[flat[missing]] = True
        current = kept.reshape(hull.shape).astype(np.float32)
    return replace(volume, values=torch.as_tensor(current, device=volume.values.device))

"""Pinhole cameras: projection, rays, cropping, scaling and placing. OpenCV axes, pixel centres at half integers."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from mosa.errors import ConfigError, DataError
from mosa.types import Cameras


def project(points: Tensor, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Pixels (V, N, 2) and depths (V, N) [m] of world points (N, 3) or, one set a camera, (V, N, 3).

    A point nearer than 1e-6 m or behind the camera has a pixel without meaning: look at the depth first."""
    w2c, K = cameras.w2c.to(points), cameras.K.to(points)
    seen = points @ w2c[:, :3, :3].transpose(1, 2) + w2c[:, None, :3, 3]
    pixels = seen @ K.transpose(1, 2)
    return pixels[..., :2] / pixels[..., 2:].clamp(min=1e-6), seen[..., 2]


def centers(cameras: Cameras) -> Tensor:
    """Where the cameras are, (V, 3) [m]."""
    return -(cameras.w2c[:, :3, :3].transpose(1, 2) @ cameras.w2c[:, :3, 3:])[..., 0]


def rays(cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Origins (V, 3) [m] and unit directions (V, H, W, 3), in world axes, of the rays through all pixel centres."""
    x, y = (
        torch.arange(size, dtype=cameras.K.dtype, device=cameras.K.device) + 0.5
        for size in (cameras.width, cameras.height)
    )
    u, v = torch.meshgrid(x, y, indexing="xy")
    inverse = torch.linalg.inv(cameras.K).transpose(1, 2)[:, None]
    directions = (
        torch.stack((u, v, torch.ones_like(u)), -1) @ inverse @ cameras.w2c[:, None, :3, :3]
    )
    return centers(cameras), F.normalize(directions, dim=-1)


def sample_images(images: Tensor, pixels: Tensor, *, beyond: str = "zeros") -> Tensor:
    """Bilinear values (V, C, N) of images (V, C, H, W) at pixels (V, N, 2). beyond: an image: zeros | border (its values)."""
    size = pixels.new_tensor([images.shape[3], images.shape[2]])
    grid = (2 * pixels / size - 1)[:, None]
    return F.grid_sample(images, grid, padding_mode=beyond, align_corners=False)[:, :, 0]


def look_at(eye: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """World-to-camera matrices (..., 4, 4) of cameras at `eye` looking at `target`, all (..., 3); image y points
    against `up`.

    Raises ConfigError where the line of sight is zero or parallel to `up`."""
    forward = target - eye
    right = torch.linalg.cross(forward, up.to(forward).expand_as(forward))
    if bool((right.norm(dim=-1) <= 1e-9 * forward.norm(dim=-1)).any()):
        raise ConfigError(
            "look_at: eye and target coincide or the line of sight is parallel to up; choose another eye or up"
        )
    forward = forward / forward.norm(dim=-1, keepdim=True)
    right = right / right.norm(dim=-1, keepdim=True)
    R = torch.stack((right, torch.linalg.cross(forward, right), forward), -2)
    w2c = torch.eye(4).to(R).repeat(*R.shape[:-2], 1, 1)
    w2c[..., :3, :3] = R
    w2c[..., :3, 3] = -(R @ eye[..., None])[..., 0]
    return w2c


def scale_cameras(cameras: Cameras, factor: float) -> Cameras:
    """The same views with images `factor` times as large, sizes rounded to whole pixels. ConfigError below one
    pixel."""
    width, height = round(cameras.width * factor), round(cameras.height * factor)
    if width < 1 or height < 1:
        raise ConfigError(
            f"scale_cameras: factor {factor} makes images of {cameras.width}x{cameras.height} px vanish"
        )
    K = cameras.K.clone()
    K[:, 0] *= width / cameras.width
    K[:, 1] *= height / cameras.height
    return replace(cameras, K=K, width=width, height=height)


def crop_cameras(cameras: Cameras, x0: Tensor, y0: Tensor, width: int, height: int) -> Cameras:
    """Cameras of the windows that start at pixel (x0, y0), both (V,), and are width x height large."""
    K = cameras.K.clone()
    K[:, 0, 2] -= x0.to(K)
    K[:, 1, 2] -= y0.to(K)
    return replace(cameras, K=K, width=width, height=height)


def crop_images(
    images: Tensor, x0: Tensor, y0: Tensor, width: int, height: int, *, axis: int = 1
) -> Tensor:
    """The windows of `crop_cameras` cut from images (V, ..., H, W, ...) whose rows are dimension `axis` and columns
    the next."""
    places = zip(images, x0.tolist(), y0.tolist())
    cut = [image.narrow(axis - 1, y, height).narrow(axis, x, width) for image, x, y in places]
    return torch.stack(cut)


def crop_boxes(
    mattes: Tensor, margin: int = 8, multiple: int = 1
) -> tuple[Tensor, Tensor, int, int]:
    """Windows around the object: x0, y0 (V,) and one width and height [px] for all views.

    mattes: (V, T, H, W). The size is the largest over the views of the box of all pixels above 0 in any
    frame, plus `margin` on each side, rounded up to `multiple`, at most the image; windows are centred on their box
    and moved inside the image. A view that never sees the object gets a window in the middle.
    Raises DataError where no view sees it."""
    views, _, H, W = mattes.shape
    seen = (mattes > 0).any(1)
    empty = ~seen.flatten(1).any(1)
    if bool(empty.all()):
        raise DataError(f"crop_boxes: none of {views} mattes has a pixel above 0")
    starts, sizes = [], []
    for axis, limit in ((1, W), (2, H)):  # columns are occupied where any row is, and so on
        occupied, index = seen.any(axis), torch.arange(limit, device=mattes.device)
        low = torch.where(occupied, index, limit).amin(1)
        high = torch.where(occupied, index + 1, 0).amax(1)
        size = int((high - low)[~empty].max()) + 2 * margin
        size = min(multiple * math.ceil(size / multiple), limit)
        middle = torch.where(empty, torch.full_like(low, limit), low + high)
        starts.append(((middle - size) // 2).clamp(0, limit - size))
        sizes.append(size)
    return starts[0], starts[1], sizes[0], sizes[1]

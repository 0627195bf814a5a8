"""Differentiable rasterisation of 3D Gaussians, on CPU and CUDA, in float32 and float64.

Conventions, gsplat's: pixel centres at j + 0.5; J at slopes clamped to the image and 0.3 half fields of view around
it; 0.3 px^2 added to projected covariances; front to back by depth; alpha = min(cap, o exp(-q/2)), skipped below
1/255; a Gaussian that would bring the transmittance to 1e-4 or below ends the pixel and is not added.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mosa.errors import ConfigError, DataError
from mosa.physics.launching import SCALARS
from mosa.rendering.records import SIDE_MAX
from mosa.rendering.splatting import Geometry, Splat
from mosa.system.limits import counted
from mosa.system.warp_start import start_warp
from mosa.types import Cameras


def _check(
    means: Tensor, covariances: Tensor, opacities: Tensor, features: Tensor, cameras: Cameras,
    state_index: Tensor,
) -> None:  # fmt: skip
    """Shapes, types and devices of `rasterize`; ConfigError names the first that is off."""
    states, count = means.shape[:2] if means.dim() == 3 else (-1, -1)
    images, channels = len(cameras), features.shape[-1]
    numbers = {"means": means, "covariances": covariances, "opacities": opacities, "features": features}  # fmt: skip
    wanted = {
        "means": [(states, count, 3)],
        "covariances": [(states, count, 3, 3)],
        "opacities": [(count,), (states, count)],
        "features": [(images, count, channels), (1, count, channels)],
        "state_index": [(images,)],
    }
    for name, shapes in wanted.items():
        value = numbers.get(name, state_index)
        if tuple(value.shape) not in shapes or 0 in value.shape:
            raise ConfigError(
                f"rasterize: {name} has shape {tuple(value.shape)}, expected one of {shapes}, none empty"
            )
        if value.device != means.device:
            raise ConfigError(
                f"rasterize: {name} is on {value.device}, means on {means.device}; move all to one device"
            )
        if name in numbers and (value.dtype != means.dtype or value.dtype not in SCALARS):
            raise ConfigError(
                f"rasterize: {name} is {value.dtype}, means {means.dtype}; use one of float32, float64 for all"
            )
    # largest magnitudes: nan and inf come through, in one pass over each and one wait for the GPU
    sizes = [torch.linalg.vector_norm(value.detach(), torch.inf) for value in numbers.values()]
    for (name, value), size in zip(numbers.items(), torch.stack(sizes).tolist()):
        if not math.isfinite(size):
            where = (~value.detach().isfinite()).nonzero()[0].tolist()
            raise DataError(f"rasterize: {name}{where} is not finite; the image would lack it")
    for name, value, size in (("K", cameras.K, 3), ("w2c", cameras.w2c, 4)):
        if tuple(value.shape) != (images, size, size):
            raise ConfigError(
                f"rasterize: cameras.{name} has shape {tuple(value.shape)}, expected {(images, size, size)}"
            )
    if max(cameras.width, cameras.height) > SIDE_MAX:
        raise ConfigError(
            f"rasterize: images of {cameras.width} x {cameras.height} px; no side may be longer than {SIDE_MAX}"
        )
    pixels = (images, cameras.height, cameras.width, channels + 1)
    counted("rasterize: numbers", pixels, "render fewer or smaller images")
    if not means.is_cuda and (int(state_index.min()) < 0 or int(state_index.max()) >= states):
        raise ConfigError(f"rasterize: state_index reaches outside the {states} states")


def rasterize(
    means: Tensor, covariances: Tensor, opacities: Tensor, features: Tensor, cameras: Cameras,
    state_index: Tensor, background: Tensor | None = None, *, scan: str | None = None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Composite N Gaussians in S states into B images of any number C of channels.

    means: (S, N, 3) [m]; covariances: (S, N, 3, 3) [m^2], only the symmetric part counts (`covariance_from` makes
    them of scales and rotations); opacities: (N,) or (S, N) in [0, 1]; features: (B, N, C) or (1, N, C) shared by
    all images; cameras: B of them; state_index: (B,) state that image b shows; background: (C,), (B, H, W, C) or None for zeros;
    scan: gaussian (default on CPU) | tile (default on CUDA, and what a CPU test compares with). The dtype of the
    inputs, float32 or float64, is that of the computation.

    Returns image (B, H, W, C) = sum_i w_i c_i + (1 - alpha) background and alpha (B, H, W), with gradients to the
    first four. Errors: ConfigError naming the argument of wrong shape, dtype or device.
    Source: Kerbl et al. 2023; conventions of gsplat (Ye et al. 2024)."""
    if scan not in (None, "gaussian", "tile"):
        raise ConfigError(f"rasterize: unknown scan '{scan}', expected gaussian or tile")
    _check(means, covariances, opacities, features, cameras, state_index)
    start_warp()
    order = scan or ("tile" if means.is_cuda else "gaussian")
    index = state_index.to(torch.int32).contiguous()
    geometry = Geometry(index, cameras.width, cameras.height, order)
    views = cameras.K.to(means), cameras.w2c.to(means)
    image, alpha = Splat.apply(means, covariances, opacities, features, *views, geometry)
    if background is not None:
        image = image + (1 - alpha)[..., None] * background.to(image)
    return image, alpha

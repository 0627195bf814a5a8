"""Differentiable rasterisation of 3D Gaussians: one call for both backends.

`warp` (mosa/rendering/splatting.py) runs everywhere in float32 and float64; `gsplat` (gsplat_backend.py) is a
CUDA package that one may choose instead.

Conventions, gsplat's: pixel centres at j + 0.5; J at slopes clamped to the image and 0.3 half fields of view around
it; 0.3 px^2 added to projected covariances; front to back by depth; alpha = min(cap, o exp(-q/2)), skipped below
1/255; a Gaussian that would bring the transmittance to 1e-4 or below ends the pixel and is not added. Near plane,
extent and cap are those of `preset` (`splatting.PRESETS`).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mosa.errors import ConfigError, DataError
from mosa.rendering import gsplat_backend
from mosa.rendering.records import SIDE_MAX
from mosa.rendering.splatting import PRESETS, SCALARS, Geometry, Splat
from mosa.system.limits import counted
from mosa.system.warp_start import start_warp
from mosa.types import Cameras

BACKENDS = ("warp", "gsplat")

_backend = "warp"


def use_backend(name: str, *, required: bool = True) -> None:
    """Choose the backend of all later calls of `rasterize` in this process that do not name one.

    gsplat then serves the calls it has kernels for (CUDA, float32, preset gsplat, no gradient to K), warp the others.
    required: whether gsplat has to run here; else warp does all where it cannot. Errors: ConfigError for an unknown name, and for
    gsplat where it is required and cannot run, with the reason.
    """
    global _backend
    if name not in BACKENDS:
        raise ConfigError(
            f"rendering.backend: expected one of {', '.join(BACKENDS)}, found {name!r}"
        )
    if name == "gsplat":
        reason = gsplat_backend.why_unavailable()
        if reason and not required:
            name = "warp"
        elif reason:
            raise ConfigError(
                f"rendering.backend: gsplat cannot be used here: {reason}; choose rendering=warp"
            )
    _backend = name


def _check(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    features: Tensor,
    cameras: Cameras,
    state_index: Tensor,
) -> None:
    """Shapes, types and devices of `rasterize`; ConfigError names the first that is off."""
    states, count = (means.shape[0], means.shape[1]) if means.dim() == 3 else (-1, -1)
    images = len(cameras)
    wanted = {
        "means": (means, [(states, count, 3)]),
        "covariances": (covariances, [(states, count, 3, 3)]),
        "opacities": (opacities, [(count,), (states, count)]),
        "features": (
            features,
            [(images, count, features.shape[-1]), (1, count, features.shape[-1])],
        ),
        "state_index": (state_index, [(images,)]),
    }
    for name, (value, shapes) in wanted.items():
        if tuple(value.shape) not in shapes or 0 in value.shape:
            raise ConfigError(
                f"rasterize: {name} has shape {tuple(value.shape)}, expected one of {shapes}, none empty"
            )
        if value.device != means.device:
            raise ConfigError(
                f"rasterize: {name} is on {value.device}, means on {means.device}; move all to one device"
            )
        if name != "state_index" and (value.dtype != means.dtype or value.dtype not in SCALARS):
            raise ConfigError(
                f"rasterize: {name} is {value.dtype}, means {means.dtype}; use one of float32, float64 for all"
            )
    numbers = {
        "means": means,
        "covariances": covariances,
        "opacities": opacities,
        "features": features,
    }
    # largest magnitudes: nan and inf come through, in one pass over each and one wait for the GPU
    largest = torch.stack(
        [torch.linalg.vector_norm(value.detach(), torch.inf) for value in numbers.values()]
    ).tolist()
    if not all(map(math.isfinite, largest)):
        name = next(name for name, size in zip(numbers, largest) if not math.isfinite(size))
        where = (~numbers[name].detach().isfinite()).nonzero()[0].tolist()
        raise DataError(
            f"rasterize: {name}{where} is not finite; it would silently vanish from the image"
        )
    for name, value, size in (("K", cameras.K, 3), ("w2c", cameras.w2c, 4)):
        if tuple(value.shape) != (images, size, size):
            raise ConfigError(
                f"rasterize: cameras.{name} has shape {tuple(value.shape)}, expected {(images, size, size)}"
            )
    if max(cameras.width, cameras.height) > SIDE_MAX:
        raise ConfigError(
            f"rasterize: images of {cameras.width} x {cameras.height} px; no side may be longer than {SIDE_MAX}"
        )
    counted(
        "rasterize: numbers",
        (images, cameras.height, cameras.width, features.shape[-1] + 1),
        "render fewer or smaller images",
    )
    if not means.is_cuda and (int(state_index.min()) < 0 or int(state_index.max()) >= states):
        raise ConfigError(f"rasterize: state_index reaches outside the {states} states")


def rasterize(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    features: Tensor,
    cameras: Cameras,
    state_index: Tensor,
    background: Tensor | None = None,
    preset: str = "gsplat",
    *,
    scan: str | None = None,
    backend: str | None = None,
) -> tuple[Tensor, Tensor]:
    """Composite N Gaussians in S states into B images of any number C of channels.

    means: (S, N, 3) [m]; covariances: (S, N, 3, 3) [m^2], only the symmetric part counts (`covariance_from` makes
    them of scales and rotations); opacities: (N,) or (S, N) in [0, 1]; features: (B, N, C) or (1, N, C) shared by
    all images (`view_colors` makes colours of spherical harmonics); cameras: B of them; state_index: (B,) state
    that image b shows; background: (C,) or None for zeros; preset: gsplat | inria (`PRESETS`); scan: gaussian
    (default on CPU) | tile (default on CUDA, and what a CPU test compares with); backend: warp | gsplat, None for
    that of `use_backend`. The dtype of the inputs, float32 or float64, is that of the computation.

    Returns image (B, H, W, C) = sum_i w_i c_i + (1 - alpha) background and alpha (B, H, W), with gradients to the
    first four and to the cameras' w2c (its upper 3 x 4 entries, each for itself) and K.
    Errors: ConfigError naming the argument of wrong shape, dtype, device, for an unknown preset, and for a backend
    that cannot do what is asked. Source: Kerbl et al. 2023; conventions of gsplat (Ye et al. 2024).
    """
    if preset not in PRESETS:
        raise ConfigError(
            f"rasterize: unknown preset '{preset}', expected one of {sorted(PRESETS)}"
        )
    if scan not in (None, "gaussian", "tile"):
        raise ConfigError(f"rasterize: unknown scan '{scan}', expected gaussian or tile")
    if backend not in (None, *BACKENDS):
        raise ConfigError(
            f"rasterize: unknown backend '{backend}', expected one of {', '.join(BACKENDS)}"
        )
    _check(means, covariances, opacities, features, cameras, state_index)
    if (backend or _backend) == "gsplat":
        obstacle = gsplat_backend.obstacle(means, cameras, preset, scan)
        if obstacle is None:
            image, alpha = gsplat_backend.splat(
                means, covariances, opacities, features, cameras, state_index
            )
            return _over(image, alpha, background), alpha
        if backend is not None:
            raise ConfigError(
                f"rasterize: the gsplat backend cannot be used for this call: {obstacle}; use backend='warp'"
            )
    start_warp()
    geometry = Geometry(
        state_index.to(torch.int32).contiguous(),
        cameras.width,
        cameras.height,
        PRESETS[preset],
        scan or ("tile" if means.is_cuda else "gaussian"),
    )
    image, alpha = Splat.apply(
        means,
        covariances,
        opacities,
        features,
        cameras.K.to(means),
        cameras.w2c.to(means),
        geometry,
    )
    return _over(image, alpha, background), alpha


def _over(image: Tensor, alpha: Tensor, background: Tensor | None) -> Tensor:
    return image if background is None else image + (1 - alpha)[..., None] * background.to(image)

"""gsplat (Ye et al. 2024, https://github.com/nerfstudio-project/gsplat) behind the arguments of `rasterize`: CUDA only, float32.

Imported inside the functions that need it. It compiles its kernels on first use, which takes minutes and nvcc.
"""

from __future__ import annotations

import functools
import importlib.util

import torch
from torch import Tensor

from mosa.types import Cameras

NEAR, LOW_PASS = 0.01, 0.3
"""Near plane [m] and low-pass [px^2] of `mosa.rendering`."""


@functools.cache
def why_unavailable() -> str | None:
    """Why gsplat cannot run on this machine; None where it can."""
    if importlib.util.find_spec("gsplat") is None:
        return "the package gsplat is not installed (pip install gsplat)"
    if not torch.cuda.is_available():
        return "there is no CUDA device"
    try:
        from gsplat.cuda._backend import (
            _C,
        )  # gsplat's own check of its installation; builds the kernels where needed
    except Exception as error:  # a failed build ends in anything from ImportError to RuntimeError
        return f"the package gsplat does not import ({error})"
    return "its kernels are not compiled and nvcc is not there to do it" if _C is None else None


def splat(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    features: Tensor,
    cameras: Cameras,
    state_index: Tensor,
    background: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Image (B, H, W, C) and alpha (B, H, W); arguments as `mosa.rendering.rasterizer.rasterize`.

    One call of gsplat per state, with all cameras that see it. Not packed: an object in the middle of all images is
    visible nearly everywhere.
    """
    from gsplat import rasterization

    # gsplat reads the upper triangle only; of the symmetric part, gradients are symmetric as ours
    symmetric = 0.5 * (covariances + covariances.transpose(-1, -2))
    K, w2c = cameras.K.to(means), cameras.w2c.to(means)
    images, alphas, members = [], [], []
    for state in state_index.unique().tolist():
        chosen = (state_index == state).nonzero()[:, 0]
        image, alpha, _ = rasterization(
            means=means[state],
            quats=None,
            scales=None,
            covars=symmetric[state],
            opacities=opacities[state] if opacities.dim() == 2 else opacities,
            colors=features[0] if features.shape[0] == 1 else features[chosen],
            viewmats=w2c[chosen],
            Ks=K[chosen],
            width=cameras.width,
            height=cameras.height,
            near_plane=NEAR,
            eps2d=LOW_PASS,
            packed=False,
        )
        images.append(image)
        alphas.append(alpha[..., 0])
        members.append(chosen)
    back = torch.cat(members).argsort()
    image, alpha = torch.cat(images)[back], torch.cat(alphas)[back]
    if background is not None:
        image = image + (1 - alpha)[..., None] * background.to(image)
    return image, alpha

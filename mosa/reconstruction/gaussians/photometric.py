"""How rendered windows are compared with the real ones: L1, structural similarity, alpha against the mattes."""

from __future__ import annotations

import functools
from collections.abc import Callable

import torch
from kornia.filters import filter2d_separable, get_gaussian_kernel1d
from torch import Tensor

from mosa.system.cuda_graphs import Graphed

SSIM_SIGMA = 1.5


@functools.cache
@torch.inference_mode(False)  # who asks first may not want gradients, and others do
def _window(device: torch.device, dtype: torch.dtype) -> Tensor:
    """(1, 11), made once: a copy from the host cannot be part of a CUDA graph."""
    return get_gaussian_kernel1d(11, SSIM_SIGMA, device=device, dtype=dtype)


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Mean structural similarity of images (B, H, W, C) in [0, 1]: 11 x 11 Gaussian window, sigma 1.5 (Wang et al. 2004)."""
    window = _window(a.device, a.dtype)
    x, y = a.permute(0, 3, 1, 2), b.permute(0, 3, 1, 2)
    products = torch.cat([x, y, x * x, y * y, x * y], 1)
    moments = filter2d_separable(products, window, window, padding="valid").split(a.shape[-1], 1)
    mx, my, xx, yy, xy = moments
    vx, vy, vxy = xx - mx * mx, yy - my * my, xy - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return (
        ((2 * mx * my + c1) * (2 * vxy + c2)) / ((mx * mx + my * my + c1) * (vx + vy + c2))
    ).mean()


def image_loss(ssim_weight: float, matte_weight: float) -> Callable[..., Tensor]:
    """loss(image, alpha, images, mattes): (1 - w) L1 + w (1 - SSIM) of rendered colours (B, h, w, 3) against real ones, plus L1 of
    alpha (B, h, w) against the mattes."""

    def loss(image: Tensor, alpha: Tensor, images: Tensor, mattes: Tensor) -> Tensor:
        off = (1 - ssim_weight) * (image - images).abs().mean()
        if ssim_weight > 0:
            off = off + ssim_weight * (1 - ssim(image, images))
        return off + matte_weight * (alpha - mattes).abs().mean()

    return Graphed(loss)

"""How rendered windows are compared with the real ones: L1, structural similarity, alpha against the mattes."""

from __future__ import annotations

import torch
from kornia.filters import filter2d_separable, get_gaussian_kernel1d
from torch import Tensor

from mosa.reconstruction.motion.observed import Windows

SSIM_SIGMA = 1.5


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Mean structural similarity of images (B, H, W, C) in [0, 1]: 11 x 11 Gaussian window, sigma 1.5 (Wang et al. 2004)."""
    window = get_gaussian_kernel1d(11, SSIM_SIGMA, device=a.device, dtype=a.dtype)
    x, y = a.permute(0, 3, 1, 2), b.permute(0, 3, 1, 2)
    products = torch.cat([x, y, x * x, y * y, x * y], 1)
    moments = filter2d_separable(products, window, window, padding="valid").split(a.shape[-1], 1)
    mx, my, xx, yy, xy = moments
    vx, vy, vxy = xx - mx * mx, yy - my * my, xy - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return (
        ((2 * mx * my + c1) * (2 * vxy + c2)) / ((mx * mx + my * my + c1) * (vx + vy + c2))
    ).mean()


def image_loss(
    image: Tensor, alpha: Tensor, windows: Windows, *, ssim_weight: float, matte_weight: float
) -> Tensor:
    """(1 - w) L1 + w (1 - SSIM) of colours, plus L1 of alpha against the mattes."""
    loss = (1 - ssim_weight) * (image - windows.images).abs().mean()
    if ssim_weight > 0:
        loss = loss + ssim_weight * (1 - ssim(image, windows.images))
    return loss + matte_weight * (alpha - windows.mattes).abs().mean()

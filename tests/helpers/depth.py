"""Depth as one more channel of a picture."""

import torch
from torch import Tensor

from mosa.rendering.rasterizer import rasterize
from mosa.types import Cameras


def depth_channel(means: Tensor, cameras: Cameras, state_index: Tensor) -> Tensor:
    """Depth of every Gaussian's centre along the line of sight of every image as a feature (B, N, 1) [m]."""
    w2c = cameras.w2c.to(means)
    return (means[state_index] * w2c[:, None, 2, :3]).sum(-1, keepdim=True) + w2c[:, None, 2, 3:]


def rasterize_with_depth(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    features: Tensor,
    cameras: Cameras,
    state_index: Tensor,
    background: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """`rasterize` with depth in the same pass: image (B, H, W, C), alpha (B, H, W), depth sum_i w_i z_i (B, H, W) [m].

    Depth over alpha is the expected depth. Gradients and errors as of `rasterize`; depth has gradients to means,
    covariances and opacities.
    """
    depths = depth_channel(means, cameras, state_index)
    stacked = torch.cat((features.expand(len(cameras), -1, -1), depths), -1)
    image, alpha = rasterize(means, covariances, opacities, stacked, cameras, state_index)
    over = 0 if background is None else (1 - alpha)[..., None] * background.to(image)
    return image[..., :-1] + over, alpha, image[..., -1]


def expected_depth(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    cameras: Cameras,
    state_index: Tensor,
) -> tuple[Tensor, Tensor]:
    """Mean depth sum_i w_i z_i / alpha [m] per pixel, infinite where nothing is seen, and alpha; both (B, H, W).

    Gradients to means, covariances and opacities where something is seen.
    """
    depths = depth_channel(means, cameras, state_index)
    image, alpha = rasterize(means, covariances, opacities, depths, cameras, state_index)
    seen = alpha > 0
    return torch.where(
        seen, image[..., 0] / torch.where(seen, alpha, torch.ones_like(alpha)), torch.inf
    ), alpha

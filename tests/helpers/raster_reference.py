"""The rasteriser once more, slow and obvious, in plain torch: what the kernels are tested against.

Every pixel looks at every Gaussian; gradients come from autograd. Memory grows with pixels x Gaussians: for small
cases only.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mosa.types import Cameras


def visible_covariance(
    mean: Tensor, covariance: Tensor, K: Tensor, w2c: Tensor, width: int, height: int
):
    """Centre (N, 2) [px], covariance (N, 2, 2) [px^2] and depth (N,) [m] of Gaussians (N, 3), (N, 3, 3) in one
    camera."""
    p = mean @ w2c[:3, :3].T + w2c[:3, 3]
    z = p[:, 2]
    fx, skew, fy, cx, cy = K[0, 0], K[0, 1], K[1, 1], K[0, 2], K[1, 2]
    tan_x, tan_y = 0.5 * width / fx, 0.5 * height / fy
    tx = z * torch.clamp(p[:, 0] / z, -cx / fx - 0.3 * tan_x, (width - cx) / fx + 0.3 * tan_x)
    ty = z * torch.clamp(p[:, 1] / z, -cy / fy - 0.3 * tan_y, (height - cy) / fy + 0.3 * tan_y)
    zero = torch.zeros_like(z)
    first = torch.stack((fx / z, skew / z, -(fx * tx + skew * ty) / z**2), -1)
    J = torch.stack((first, torch.stack((zero, fy / z, -fy * ty / z**2), -1)), -2)
    T = J @ w2c[:3, :3]
    symmetric = 0.5 * (covariance + covariance.transpose(-1, -2))
    center = torch.stack(((fx * p[:, 0] + skew * p[:, 1]) / z + cx, fy * p[:, 1] / z + cy), -1)
    return center, T @ symmetric @ T.transpose(-1, -2) + 0.3 * torch.eye(2).to(T), z


def composite(alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Weights (P, N) and final transmittance (P,) of alphas (P, N) in depth order: alpha below 1/255 skipped, stop
    at 1e-4."""
    alpha = torch.where(alpha >= 1 / 255, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1 - alpha, 1)
    stopped = ((after <= 1e-4) & (alpha > 0)).cumsum(1) > 0
    alpha = torch.where(stopped, torch.zeros_like(alpha), alpha)
    after = torch.cumprod(1 - alpha, 1)
    before = torch.cat((torch.ones_like(after[:, :1]), after[:, :-1]), 1)
    return alpha * before, after[:, -1]


def alphas(center: Tensor, M: Tensor, opacity: Tensor, width: int, height: int) -> Tensor:
    """Alpha (H W, N) of Gaussians at every pixel centre, gsplat preset: capped at 0.999, zero outside the extent."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    d = torch.stack((x, y), -1).reshape(-1, 1, 2).to(center) - center
    q = (d[..., None, :] @ torch.linalg.inv(M) @ d[..., None])[..., 0, 0]
    extent = torch.minimum(
        torch.full_like(opacity, 3.33), torch.sqrt(2 * torch.log((255 * opacity).clamp(min=1)))
    )
    reach = torch.ceil(extent[:, None] * torch.stack((M[:, 0, 0], M[:, 1, 1]), -1).sqrt())
    inside = (d.abs() <= reach).all(-1)
    alpha = torch.clamp(opacity * torch.exp(-0.5 * q), max=0.999)
    return torch.where(inside, alpha, torch.zeros_like(alpha))


def rasterize_reference(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    features: Tensor,
    cameras: Cameras,
    state_index: Tensor,
    background: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Image (B, H, W, C) and alpha (B, H, W); arguments as `mosa.rendering.rasterizer.rasterize`, gsplat preset."""
    width, height = cameras.width, cameras.height
    images, mattes = [], []
    for b, s in enumerate(state_index.tolist()):
        K, w2c = cameras.K[b].to(means), cameras.w2c[b].to(means)
        opacity = opacities[s] if opacities.dim() == 2 else opacities
        color = features[b] if features.shape[0] > 1 else features[0]
        visible = (means[s] @ w2c[2, :3] + w2c[2, 3]).detach() > 0.01
        index = visible.nonzero()[:, 0]
        center, M, depth = visible_covariance(
            means[s][index], covariances[s][index], K, w2c, width, height
        )
        near_first = depth.detach().argsort(stable=True)
        alpha = alphas(center[near_first], M[near_first], opacity[index][near_first], width, height)
        weights, left = composite(alpha)
        image = weights @ color[index][near_first]
        if background is not None:
            image = image + left[:, None] * background
        images.append(image.view(height, width, -1))
        mattes.append((1 - left).view(height, width))
    return torch.stack(images), torch.stack(mattes)

"""What the cameras see of a rollout: colour, alpha and Gaussian flow of every frame and view in one batched pass."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mosa.rendering.flow import flow_features, flow_from_features
from mosa.rendering.rasterizer import rasterize
from mosa.types import Cameras


@dataclass(frozen=True)
class Views:
    """images: (V, T, H, W, 3); mattes: (V, T, H, W); flow: (V, T - 1, H, W, 2) [px] or None."""

    images: Tensor
    mattes: Tensor
    flow: Tensor | None


def repeat_cameras(cameras: Cameras, frames: int) -> Cameras:
    """Each of V cameras `frames` times in a row: image b = view * frames + frame."""
    K, w2c = (t.repeat_interleave(frames, 0) for t in (cameras.K, cameras.w2c))
    names = tuple(name for name in cameras.names for _ in range(frames))
    return Cameras(K, w2c, cameras.width, cameras.height, names)


def observe(
    means: Tensor, covariances: Tensor, opacities: Tensor, colors: Tensor, cameras: Cameras,
    background: Tensor, *, flow: bool = False,
) -> Views:  # fmt: skip
    """Render T states from V cameras. means: (T, N, 3); covariances: (T, N, 3, 3); opacities: (N,); colors: (N, 3).

    With `flow`, six more channels carry the Gaussian flow from each frame to the next (`rendering.flow`); the last frame has none.
    """
    frames, views = means.shape[0], len(cameras)
    batch = repeat_cameras(cameras, frames)
    index = torch.arange(frames, device=means.device).repeat(views)
    features = colors[None]
    backdrop = background
    if flow:
        following = (index + 1).clamp(max=frames - 1)
        states = means[index], covariances[index], means[following], covariances[following]
        motion = flow_features(*states, batch)
        features = torch.cat([colors[None].expand(len(index), -1, -1), motion], -1)
        backdrop = torch.cat([background, background.new_zeros(6)])
    image, alpha = rasterize(means, covariances, opacities, features, batch, index, backdrop)
    shape = (views, frames, *image.shape[1:3])
    maps = None
    if flow:
        maps = flow_from_features(image[..., 3:], batch).reshape(*shape, 2)[:, : frames - 1]
    return Views(image[..., :3].reshape(*shape, 3), alpha.reshape(shape), maps)


def deformed_covariances(F_tot: Tensor, covariances: Tensor) -> Tensor:
    """A_t = F_tot A_0 F_tot^T (paper, eq. 10): (T, N, 3, 3) from (T, N, 3, 3) and (N, 3, 3)."""
    return F_tot @ covariances @ F_tot.transpose(-1, -2)

"""Gaussian flow: how the image of moving, deforming Gaussians moves from one frame to the next, as a map in pixels.

flow(u) = sum_i w_i [B_i2 B_i1^-1 (u - m_i1) + m_i2 - u] with w_i = alpha_i T_i of the first frame and B the
principal square root of the projected covariance (GaussianFlow, Gao et al. 2024, eq. 6-8). It is
linear in u, so six feature channels composited like colours give it exactly, over all contributors.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mosa.rendering.covariance import project_gaussians, square_root
from mosa.types import Cameras


def flow_features(
    means_a: Tensor, covariances_a: Tensor, means_b: Tensor, covariances_b: Tensor,
    cameras: Cameras, *, detach_first: bool = True,
) -> Tensor:  # fmt: skip
    """Six channels per Gaussian, (B, N, 6): A - I row by row (4), then m_b - A m_a [px from the image centre], A =
    B_b B_a^-1.

    means: (B, N, 3) [m] and covariances: (B, N, 3, 3) [m^2] at the first (a) and second (b) frame, one camera per
    batch entry. With `detach_first` the first frame is a constant: the loss then asks where things go, not where
    they were."""
    if detach_first:
        means_a, covariances_a = means_a.detach(), covariances_a.detach()
    middle = means_a.new_tensor([cameras.width / 2, cameras.height / 2])
    center_a, M_a = project_gaussians(means_a, covariances_a, cameras)
    center_b, M_b = project_gaussians(means_b, covariances_b, cameras)
    axx, axy, ayy = square_root(M_a).unbind(-1)
    bxx, bxy, byy = square_root(M_b).unbind(-1)
    det = axx * ayy - axy * axy
    A00, A01 = (bxx * ayy - bxy * axy) / det, (bxy * axx - bxx * axy) / det
    A10, A11 = (bxy * ayy - byy * axy) / det, (byy * axx - bxy * axy) / det
    x, y = (center_a - middle).unbind(-1)
    u, v = (center_b - middle).unbind(-1)
    rest = u - A00 * x - A01 * y, v - A10 * x - A11 * y
    return torch.stack((A00 - 1, A01, A10, A11 - 1, *rest), -1)


def flow_from_features(image: Tensor, cameras: Cameras) -> Tensor:
    """Flow map (B, H, W, 2) [px] from the composited channels (B, H, W, 6) of `flow_features`. Not divided by
    alpha."""
    x, y = (
        torch.arange(side, dtype=image.dtype, device=image.device) + (0.5 - side / 2)
        for side in (cameras.width, cameras.height)
    )
    y = y[:, None]
    a, b, c, d, e, f = image.unbind(-1)
    return torch.stack((a * x + b * y + e, c * x + d * y + f), -1)

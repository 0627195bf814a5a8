"""The loss terms of method.md, section 8, each a pure function; weights and switches live in the configuration."""

from __future__ import annotations

import torch
from torch import Tensor

TINY = 1e-8


def image_loss(rendered: Tensor, real: Tensor) -> Tensor:
    """L_img: mean L1 over views, frames, pixels and channels of images (V, T, H, W, 3)."""
    return (rendered - real).abs().mean()


def mask_loss(alpha: Tensor, mattes: Tensor) -> Tensor:
    """L_msk: mean L1 over views, frames and pixels of (V, T, H, W)."""
    return (alpha - mattes).abs().mean()


def flow_loss(simulated: Tensor, seen: Tensor, image_width: int) -> Tensor:
    """L_flow: mean L1 of flow maps (V, T - 1, H, W, 2) [px], in image widths."""
    return (simulated - seen).abs().mean() / image_width


def polar_rotation(F: Tensor) -> Tensor:
    """Polar rotations of F (..., 3, 3) by six Newton steps on the inverse transpose: no singular vectors, so no gradient that
    blows up at equal singular values. For det F > 0."""
    R = F
    for _ in range(6):
        cofactor = torch.stack([torch.linalg.cross(R[..., 1, :], R[..., 2, :]), torch.linalg.cross(R[..., 2, :], R[..., 0, :]),
                                torch.linalg.cross(R[..., 0, :], R[..., 1, :])], -2)
        det = (R[..., 0, :] * cofactor[..., 0, :]).sum(-1)
        R = 0.5 * (R + cofactor / det[..., None, None])
    return R


def rotation_loss(F_tot: Tensor, cue: Tensor, weight: Tensor, start: Tensor) -> Tensor:
    """L_r: mean over particles and frames of |R_cue - R(F_tot) Q^T|_F^2. F_tot, cue: (T, N, 3, 3); weight: (T, N); start: Q (3, 3).

    Frame 0 and inverted particles have no weight.
    """
    positive = torch.linalg.det(F_tot.detach()) > 1e-3
    weight = weight * positive
    eye = torch.eye(3, dtype=F_tot.dtype, device=F_tot.device)
    R = polar_rotation(torch.where(positive[..., None, None], F_tot, eye))  # replaced before, or 0 x NaN would pass through
    squared = (cue - R @ start.transpose(-1, -2).to(R)).square().sum((-1, -2))
    return (weight * squared)[1:].sum() / weight[1:].sum().clamp(min=TINY)


def singular_values(F: Tensor) -> Tensor:
    """Descending singular values (..., 3) of F (..., 3, 3); finite gradients also where they coincide."""
    return torch.linalg.svdvals(F)


def stretch_loss(F_tot: Tensor, cue: Tensor, weight: Tensor, floor: float = 1e-3) -> Tensor:
    """L_s: mean squared difference of the directions of (Lambda - 1) of cue and simulation, sorted.

    F_tot: (T, N, 3, 3); cue: (T, N, 3) descending stretches; weight: (T, N). No weight where the cue's largest |Lambda - 1| is
    below `floor`.
    """
    seen = cue - 1
    weight = weight * (seen.abs().amax(-1) > floor)
    strain = singular_values(F_tot) - 1
    def unit(a: Tensor) -> Tensor:
        return a / (torch.sqrt(a.square().sum(-1, keepdim=True) + 1e-12) + 1e-6)
    squared = (unit(seen) - unit(strain)).square().mean(-1)
    return (weight * squared)[1:].sum() / weight[1:].sum().clamp(min=TINY)


def heterogeneity_loss(eta: Tensor, lambda_mu: float = 1.0, lambda_var: float = 1.0) -> Tensor:
    """L_het: lambda_mu (mean eta)^2 + lambda_var max(0, var eta - 0.25), eta: (N,)."""
    return lambda_mu * eta.mean().square() + lambda_var * (eta.var(unbiased=False) - 0.25).clamp(min=0)


def position_loss(x: Tensor, seen: Tensor, size: float) -> Tensor:
    """Mean distance of particles (T, N, 3) [m] to those of the reconstruction, over the object's size [m]. Not in the paper."""
    return torch.sqrt((x - seen)[1:].square().sum(-1) + (1e-4 * size) ** 2).mean() / size

"""The loss terms of the paper (eq. 11 to 15) and one more, each a pure function; weights and switches live in the configuration."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mosa.physics.constitutive.singular_values import singular_value_decomposition
from mosa.physics.rotations import axial, skew

TINY = 1e-8
STRAIN_FLOOR = 1e-3
"""e of the stretch term: strains below it have no direction to compare (and would give gradients like 1/strain)."""
FLAT = 1e-3
"""Rotation term: det F below which a particle has no weight."""


def weighted_mean(values: Tensor, weight: Tensor) -> Tensor:
    """Mean of `values`, weighted by `weight` of the same shape (0 where all weights are 0)."""
    return (weight * values).sum() / weight.sum().clamp(min=TINY)


def image_loss(rendered: Tensor, real: Tensor) -> Tensor:
    """L_img: mean L1 over views, frames, pixels and channels. Images (V, T, H, W, 3) in [0, 1]."""
    return (rendered - real).abs().mean(-1).mean()


def mask_loss(alpha: Tensor, mattes: Tensor) -> Tensor:
    """L_msk: mean L1 over views, frames and pixels of (V, T, H, W) in [0, 1]."""
    return (alpha - mattes).abs().mean()


def flow_loss(simulated: Tensor, seen: Tensor, image_width: int) -> Tensor:
    """L_flow: mean L1 of flow maps (V, T - 1, H, W, 2) [px], in image widths.

    In pixels the term would drown the others and grow with the resolution. image_width: of the whole image, not of a crop."""
    return (simulated - seen).abs().mean(-1).mean() / image_width


def cofactors(F: Tensor) -> Tensor:
    """det(F) F^-T of (..., 3, 3)."""
    a, b, c = F.unbind(-2)
    return torch.stack(
        [torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], -2
    )


class _Polar(torch.autograd.Function):
    """R of F = R W, det F > 0. dR = R [omega]_x, (tr(W) I - W) omega = axial(R^T dF): regular at equal stretches."""

    @staticmethod
    def forward(ctx, F: Tensor) -> Tensor:
        R = F
        for step in range(14):
            cofactor = cofactors(R)
            det = (R[..., 0, :] * cofactor[..., 0, :]).sum(-1)[..., None, None]
            # Newton's iteration; the first steps are scaled (Higham), or a flat F would need one step per factor of two
            scale = (size(cofactor) / (det * size(R))).sqrt() if step < 5 else 1.0
            following = 0.5 * (scale * R + cofactor / (det * scale))
            change = (following - R).abs().amax() if R.numel() else 0.0
            R = following
            if step >= 5 and change < 10 * torch.finfo(F.dtype).eps:
                break
        ctx.save_for_backward(F, R)
        return R

    @staticmethod
    @once_differentiable
    def backward(ctx, seed: Tensor) -> Tensor:
        F, R = ctx.saved_tensors
        W = R.mT @ F
        trace = W.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
        M = trace * torch.eye(3, dtype=F.dtype, device=F.device) - 0.5 * (W + W.mT)
        cofactor = cofactors(M)
        det = (M[..., 0, :] * cofactor[..., 0, :]).sum(-1)
        # M is symmetric
        omega = (cofactor @ axial(R.mT @ seed)[..., None])[..., 0] / det[..., None]
        return R @ skew(omega)


def size(A: Tensor) -> Tensor:
    """Frobenius norm (..., 1, 1) of (..., 3, 3)."""
    return A.norm(dim=(-2, -1), keepdim=True)


def polar_rotation(F: Tensor) -> Tensor:
    """Polar rotations of F (..., 3, 3) with det F > 0; exact gradient, also where stretches are equal."""
    return _Polar.apply(F)


def rotation_loss(F_tot: Tensor, cue: Tensor, weight: Tensor, start: Tensor) -> Tensor:
    """L_r: mean over particles and frames of |R_cue - R(F_tot) Q^T|_F^2, in [0, 8].

    F_tot, cue: (T, N, 3, 3), frame 0 first; weight: (T, N); start: Q (3, 3), the rotation the sequence started with.
    Frame 0 and inverted particles have no weight."""
    # a NaN stays in, so that the loss shows it
    positive = ~(torch.linalg.det(F_tot.detach()) <= FLAT)
    eye = torch.eye(3, dtype=F_tot.dtype, device=F_tot.device)
    # replaced before, or 0 x NaN would pass through
    R = polar_rotation(torch.where(positive[..., None, None], F_tot, eye))
    squared = (cue - R @ start.mT.to(R)).square().sum((-1, -2))
    return weighted_mean(squared[1:], (weight * positive)[1:])


class _Stretches(torch.autograd.Function):
    """Singular values of F (..., 3, 3): dS_i = u_i . dF v_i."""

    @staticmethod
    def forward(ctx, F: Tensor) -> Tensor:
        if not torch.isfinite(F).all():  # a NaN loss is reported
            ctx.save_for_backward(F, F[..., 0], F)
            return torch.full_like(F[..., 0], torch.nan)
        factors = singular_value_decomposition(F)
        ctx.save_for_backward(*factors)
        return factors[1]

    @staticmethod
    @once_differentiable
    def backward(ctx, seed: Tensor) -> Tensor:
        U, S, V = ctx.saved_tensors
        seed = shared_where_equal(seed, S, 100 * torch.finfo(S.dtype).eps)
        return (U * seed[..., None, :]) @ V.mT


def shared_where_equal(seed: Tensor, values: Tensor, tolerance: float) -> Tensor:
    """Gradients (..., 3) by sorted `values`, averaged over those that coincide.

    Their axes are then arbitrary: the average is the one choice that does not depend on them (and the shortest subgradient)."""
    first, second = (
        (values[..., i] - values[..., i + 1]).abs() <= tolerance * values[..., 0].abs()
        for i in (0, 1)
    )
    a, b, c = seed.unbind(-1)
    all_three, ab, bc = first & second, (a + b) / 2, (b + c) / 2
    mean = (a + b + c) / 3
    shared = (
        torch.where(first, ab, a), torch.where(first, ab, torch.where(second, bc, b)), torch.where(second, bc, c)
    )  # fmt: skip
    return torch.stack([torch.where(all_three, mean, x) for x in shared], -1)


def stretches(F: Tensor) -> Tensor:
    """Descending singular values (..., 3) of F (..., 3, 3), the smallest with the sign of det F.

    Where values coincide the gradient is that of their sum, shared among them."""
    return _Stretches.apply(F)


def stretch_loss(F_tot: Tensor, cue: Tensor, weight: Tensor, floor: float = STRAIN_FLOOR) -> Tensor:
    """L_s: mean squared difference of norm(Lambda_cue - 1) and norm(Lambda - 1), sorted, norm(a) = a/(|a| + floor).

    F_tot: (T, N, 3, 3), frame 0 first; cue: (T, N, 3) stretches dS/S_0 + 1, descending; weight: (T, N). No weight at
    frame 0 and where the cue's largest |Lambda - 1| is below `floor`."""
    seen = cue - 1
    weight = weight * (seen.abs().amax(-1) > floor)

    def direction(a: Tensor) -> Tensor:
        # smooth at 0: the simulation starts there
        return a / (torch.sqrt(a.square().sum(-1, keepdim=True) + floor**2 / 100) + floor)

    squared = (direction(seen) - direction(stretches(F_tot) - 1)).square().mean(-1)
    return weighted_mean(squared[1:], weight[1:])


def heterogeneity_loss(eta: Tensor, lambda_mu: float = 1.0, lambda_var: float = 1.0) -> Tensor:
    """L_het: lambda_mu (mean eta)^2 + lambda_var max(0, var eta - 0.25), eta: (N,)."""
    return lambda_mu * eta.mean().square() + lambda_var * (eta.var(unbiased=False) - 0.25).clamp(
        min=0
    )


def position_loss(x: Tensor, seen: Tensor, size: float) -> Tensor:
    """Mean distance of particles (T, N, 3) [m] to those of the reconstruction, over the object's size [m]. Not in the paper."""
    return torch.sqrt((x - seen)[1:].square().sum(-1) + (1e-4 * size) ** 2).mean() / size

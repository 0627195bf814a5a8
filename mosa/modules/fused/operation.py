"""The fused networks as one torch operation: what `ProgressiveOperator` computes, with nothing stored but inputs and weights.

Sources of the kernels: network_kernels.py (forward), assembly_kernels.py, adjoint_kernels.py. Their torch twin is
mosa/modules/progressive.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mosa.modules.fused import adjoint_kernels as adjoint
from mosa.modules.fused.assembly_kernels import assemble, assemble_adjoint
from mosa.modules.fused.network_kernels import phi_forward, psi1_forward, psi2_forward, theta_forward

LANES = 128
"""Particles a program of the assembly; rows are padded to a multiple, so that arrays stored by column need no mask."""
INTERPRETED_PROGRAMS = 2


class Settings(NamedTuple):
    """alpha, l_max, scale: as `ProgressiveOperator`; precision: of products, tf32x3 | tf32; block: rows a program takes at once."""

    alpha: float
    l_max: float | None
    scale: float
    precision: str = "tf32x3"
    block: int = 64


class _Buffers(NamedTuple):
    """What the kernels leave for one another, by column, M = N + 1 rows each: s1, pre, s2, moved = (I + G) pre (6, M); l1, l2
    (H, M); t (48, M), the bounded numbers of C_x, C_y, C_z, C_xyz."""

    pre: Tensor
    s1: Tensor
    l1: Tensor
    t: Tensor
    l2: Tensor
    s2: Tensor
    moved: Tensor


def _rows(n: int) -> int:
    """M: the particles, the state at rest, and as many more of these as fill the last program."""
    return -(-(n + 1) // LANES) * LANES


def _programs(device: torch.device, tiles: int) -> int:
    """Programs of a backward kernel, each with its own sums of weight gradients: one a multiprocessor."""
    if device.type != "cuda":
        return min(tiles, INTERPRETED_PROGRAMS)
    return min(tiles, torch.cuda.get_device_properties(device).multi_processor_count)


def _evaluate(w: Tensor, s: Tensor, settings: Settings, weights: Sequence[Tensor], G: Tensor | None) -> _Buffers:
    """Steps 1 to 4, and G (N, 6, 6) where it is given to be filled."""
    n, hidden = len(w), weights[0].shape[0]
    m = _rows(n)
    buffers = _Buffers(*(w.new_empty(k, m) for k in (6, 6, hidden, 48, hidden, 6, 6)))
    phi, psi1, psi2 = weights[:6], weights[6:14], weights[14:20]
    bound, scale, alpha = settings.l_max or 0.0, settings.scale, settings.alpha
    size = {"H": hidden, "BLOCK": settings.block, "P": settings.precision}
    tiles = (m // settings.block,)
    b = buffers
    phi_forward[tiles](w, s, *phi, b.pre, b.s1, n, m, scale, bound, BOUNDED=settings.l_max is not None, **size)
    psi1_forward[tiles](w, b.s1, *psi1, b.l1, b.t, n, m, scale, alpha, **size)
    psi2_forward[tiles](b.l1, b.t, b.s1, *psi2, b.l2, n, m, scale, alpha, **size)
    lanes = (m // LANES,)
    operator = G is not None
    assemble[lanes](b.t, b.s1, b.pre, G if operator else b.t, b.s2, b.moved, n, m, OPERATOR=operator, BLOCK=LANES)
    return buffers


class _FusedOperator(torch.autograd.Function):
    @staticmethod
    def forward(ctx, settings: Settings, w: Tensor, s: Tensor, *weights: Tensor):
        w, s = w.contiguous(), s.contiguous()
        weights = tuple(weight.contiguous() for weight in weights)
        n = len(w)
        G, b = w.new_empty(n, 6, 6), w.new_empty(n + 1, 6)
        buffers = _evaluate(w, s, settings, weights, G)
        post = torch.empty_like(buffers.pre)
        theta_forward[(_rows(n) // settings.block,)](
            buffers.l2, w, buffers.s2, buffers.moved, *weights[20:], post, b, n, _rows(n), settings.scale, settings.l_max or 0.0,
            BOUNDED=settings.l_max is not None, H=weights[0].shape[0], BLOCK=settings.block, P=settings.precision,
        )  # fmt: skip
        ctx.settings = settings
        ctx.save_for_backward(w, s, *weights)
        ctx.set_materialize_grads(False)
        return G, b, buffers.t.T[:n], buffers.pre.T[:n], post.T[:n]

    @staticmethod
    @once_differentiable
    def backward(ctx, gG, gb, gt, gpre, gpost):
        w, s, *weights = ctx.saved_tensors
        settings, n, hidden = ctx.settings, len(w), weights[0].shape[0]
        m = _rows(n)
        extra = any(g is not None for g in (gt, gpre, gpost))
        shapes = {"G": (n, 36), "b": (n + 1, 6), "t": (n, 48), "pre": (n, 6), "post": (n, 6)}
        seeds = {}
        for (name, shape), seed in zip(shapes.items(), (gG, gb, gt, gpre, gpost)):
            if seed is None and (extra or name in "Gb"):
                seed = w.new_zeros(shape)
            seeds[name] = w if seed is None else seed.contiguous()  # w: never read
        buffers = _evaluate(w, s, settings, weights, None)
        needs = ctx.needs_input_grad[3:]
        tiles = m // settings.block
        programs = _programs(w.device, tiles)
        partials = []

        def launch(kernel, inputs, parameters, outputs, bound, **flags):
            length = sum(p.numel() for p in parameters)
            partials.append(w.new_empty(programs, length) if any(needs) else w)
            kernel[(programs,)](
                *inputs, *parameters, *outputs, partials[-1], length, n, m, settings.scale, bound,
                WEIGHTS=any(needs), H=hidden, BLOCK=settings.block, P=settings.precision, **flags, num_warps=8, num_stages=1,
            )  # fmt: skip

        def six():
            return w.new_empty(6, m)

        b, bound = buffers, settings.l_max or 0.0
        flags = {"BOUNDED": settings.l_max is not None, "EXTRA": extra}
        gl2, gw_theta, gs2 = torch.empty_like(b.l2), six(), six()
        launch(
            adjoint.theta_backward, (b.l2, w, b.s2, seeds["b"], seeds["post"]), weights[20:], (gl2, gw_theta, gs2), bound, **flags
        )
        gt, gs1, gmoved = torch.empty_like(b.t), six(), six()
        assemble_adjoint[(m // LANES,)](
            b.t, b.s1, b.pre, seeds["G"], seeds["b"], gs2, seeds["t"], gt, gs1, gmoved, n, m, EXTRA=extra, BLOCK=LANES
        )
        gl1, gt_normals, gs_normals = torch.empty_like(b.l1), w.new_empty(12, m), six()
        inputs = (b.l1, b.t, b.s1, b.l2, gt, gl2)
        launch(adjoint.psi2_backward, inputs, weights[14:20], (gl1, gt_normals, gs_normals), settings.alpha)
        gw_psi, gs_psi = six(), six()
        inputs = (w, b.s1, b.l1, b.t, gt, gt_normals, gl1)
        launch(adjoint.psi1_backward, inputs, weights[6:14], (gw_psi, gs_psi), settings.alpha)
        gw, gs = torch.empty_like(w), torch.empty_like(s)
        inputs = (w, s, b.pre, gmoved, seeds["pre"], gs1, gs_normals, gs_psi, gw_psi, gw_theta)
        launch(adjoint.phi_backward, inputs, weights[:6], (gw, gs), bound, **flags)
        gradients = [None] * len(weights)
        if any(needs):
            groups = (weights[20:], weights[14:20], weights[6:14], weights[:6])  # in the order of the launches
            ordered = []
            for partial, group in zip(partials, groups, strict=True):
                parts = partial.sum(0).split([p.numel() for p in group])
                ordered = [part.view_as(p) for part, p in zip(parts, group, strict=True)] + ordered
            gradients = [g if need else None for g, need in zip(ordered, needs, strict=True)]
        return None, gw, gs, *gradients


def fused_operator(w: Tensor, s: Tensor, settings: Settings, weights: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """(G (N, 6, 6), b (N + 1, 6), numbers (N, 48), pre (N, 6), post (N, 6)) of w and s, each (N, 6) float32.

    b = (I + G) L_pre + L_post, its last row that of the state at rest; numbers: what `microplane.correction` takes, 12 for each of
    C_x, C_y, C_z, C_xyz. weights: weight and bias of the layers of Phi, Psi1, the planes, Psi2 and Theta (26 tensors), all of one
    hidden width, a power of two from 16.
    """
    return _FusedOperator.apply(settings, w, s, *weights)

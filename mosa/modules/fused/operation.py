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

from mosa.modules.fused.adjoint_kernels import phi_backward, psi1_backward, psi2_backward, theta_backward, weight_gradients
from mosa.modules.fused.assembly_kernels import assemble, assemble_adjoint
from mosa.modules.fused.network_kernels import phi_forward, psi1_forward, psi2_forward, theta_forward
from mosa.physics.activations import backward_at_hand

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
    """What the kernels leave for one another, by column, M rows each. s1, pre, s2, moved = (I + G) pre: (6, M); l1 (H + 3, M) and
    l2 (H + 12, M), with room for what else the next network reads; t (48, M): the bounded numbers of C_x, C_y, C_z, C_xyz."""

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


def _warps(hidden: int) -> int:
    """A warp group for 64 rows of 64 columns."""
    return 8 if hidden > 64 else 4


def _programs(device: torch.device, tiles: int) -> int:
    """Programs of a backward kernel, each with its own sums of weight gradients: one a multiprocessor."""
    if device.type != "cuda":
        return min(tiles, INTERPRETED_PROGRAMS)
    return min(tiles, torch.cuda.get_device_properties(device).multi_processor_count)


def _evaluate(w: Tensor, s: Tensor, settings: Settings, weights: Sequence[Tensor], G: Tensor | None) -> _Buffers:
    """Steps 1 to 4, and G (N, 6, 6) where it is given to be filled."""
    n, hidden = len(w), weights[0].shape[0]
    m = _rows(n)
    buffers = _Buffers(*(w.new_empty(k, m) for k in (6, 6, hidden + 3, 48, hidden + 12, 6, 6)))
    phi, psi1, psi2 = weights[:6], weights[6:14], weights[14:20]
    bound, scale, alpha = settings.l_max or 0.0, settings.scale, settings.alpha
    size = {"H": hidden, "BLOCK": settings.block, "P": settings.precision, "num_warps": _warps(hidden)}
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
        with torch.cuda.device_of(w):
            buffers = _evaluate(w, s, settings, weights, G)
            post = torch.empty_like(buffers.pre)
            theta_forward[(post.shape[1] // settings.block,)](
                buffers.l2, w, buffers.s2, buffers.moved, *weights[20:], post, b, n, post.shape[1], settings.scale,
                settings.l_max or 0.0, BOUNDED=settings.l_max is not None, H=weights[0].shape[0], BLOCK=settings.block,
                P=settings.precision, num_warps=_warps(weights[0].shape[0]),
            )  # fmt: skip
        ctx.settings = settings
        ctx.buffers = buffers if backward_at_hand() else None
        ctx.save_for_backward(w, s, post, *weights)
        ctx.set_materialize_grads(False)
        return G, b, buffers.t.T[:n], buffers.pre.T[:n], post.T[:n]

    @staticmethod
    @once_differentiable
    def backward(ctx, gG, gb, gt, gpre, gpost):
        w, s, post, *weights = ctx.saved_tensors
        settings, n = ctx.settings, len(w)
        extra = any(g is not None for g in (gt, gpre, gpost))
        shapes = {"G": (n, 36), "b": (n + 1, 6), "t": (n, 48), "pre": (n, 6), "post": (n, 6)}
        seeds = {}
        for (name, shape), seed in zip(shapes.items(), (gG, gb, gt, gpre, gpost)):
            if seed is None and (extra or name in "Gb"):
                seed = w.new_zeros(shape)
            seeds[name] = w if seed is None else seed.contiguous()  # w: never read
        needs = ctx.needs_input_grad[3:]
        with torch.cuda.device_of(w):
            gw, gs, gradients = _backward(w, s, post, settings, weights, seeds, extra, any(needs), ctx.buffers)
        gradients = [g if need else None for g, need in zip(gradients, needs, strict=True)]
        return None, gw, gs, *gradients


def _backward(
    w: Tensor, s: Tensor, post: Tensor, settings: Settings, weights: Sequence[Tensor], seeds: dict[str, Tensor], extra: bool,
    wanted: bool, buffers: _Buffers | None,
) -> tuple[Tensor, Tensor, Sequence[Tensor | None]]:  # fmt: skip
    """Adjoints of w, s (N, 6) and, where wanted, of the weights. post: (6, M) of the forward pass; seeds: adjoints of the outputs;
    extra: of the last three too; buffers: of the forward pass, None where they are to be computed again."""
    n, hidden = len(w), weights[0].shape[0]
    m = _rows(n)
    b = _evaluate(w, s, settings, weights, None) if buffers is None else buffers
    h1, h2, g1, g2 = (w.new_empty(hidden if wanted else 0, m) for _ in range(4))  # of one network after the other
    grid = (m // settings.block,)
    scale, bound, alpha = settings.scale, settings.l_max or 0.0, settings.alpha
    size = {"H": hidden, "BLOCK": settings.block, "P": settings.precision, "num_warps": _warps(hidden)}
    flags = {"BOUNDED": settings.l_max is not None, "EXTRA": extra, "WEIGHTS": wanted}
    programs = _programs(w.device, m // settings.block)
    partial = w.new_empty(programs, sum(p.numel() for p in weights) if wanted else 0)
    tile = max(64, hidden)

    def empty(rows: int) -> Tensor:
        return w.new_empty(rows, m)

    def sums(first: int, inputs: Tensor, outputs: Tensor, more: tuple[Tensor, Tensor] | None = None) -> None:
        """Gradients of the network whose first weight is weights[first]."""
        if wanted:
            start = sum(p.numel() for p in weights[:first])
            g4, x4 = more or (g1, h1)
            weight_gradients[(programs, 5)](
                g1, inputs, g2, h1, outputs, h2, g4, x4, partial, start, partial.shape[1], m, IN1=weights[first].shape[1],
                OUT3=weights[first + 4].shape[0], OUT4=len(g4) if more else 0, H=hidden, TILE=tile, BLOCK=settings.block // 2,
                P=settings.precision, num_warps=_warps(hidden),
            )  # fmt: skip

    gl2, gw_theta, gs2, out = empty(hidden), empty(6), empty(6), empty(6)
    theta_backward[grid](
        b.l2, w, b.s2, post, seeds["b"], seeds["post"], *weights[20:], h1, h2, g1, g2, out, gl2, gw_theta, gs2, n, m, scale, bound,
        **flags, **size,
    )  # fmt: skip
    sums(20, b.l2, out)
    gt, gs1, gmoved = torch.empty_like(b.t), empty(6), empty(6)
    assemble_adjoint[(m // LANES,)](
        b.t, b.s1, b.pre, seeds["G"], seeds["b"], gs2, seeds["t"], gt, gs1, gmoved, n, m, EXTRA=extra, BLOCK=LANES
    )
    gl1, gt_normals, gs_normals, out = empty(hidden), empty(12), empty(6), empty(12 + hidden)
    psi2_backward[grid](
        b.l1, b.t, b.s1, b.l2, gt, gl2, *weights[14:20], h1, h2, g1, g2, out, gl1, gt_normals, gs_normals, n, m, scale, alpha,
        WEIGHTS=wanted, **size,
    )  # fmt: skip
    sums(14, b.l1, out)
    x, gplanes, out, gw_psi, gs_psi = empty(12), empty(36), empty(hidden), empty(6), empty(6)
    psi1_backward[grid](
        w, b.s1, b.t, gt, gt_normals, gl1, *weights[6:14], h1, h2, g1, g2, x, gplanes, out, gw_psi, gs_psi, n, m, scale, alpha,
        WEIGHTS=wanted, **size,
    )  # fmt: skip
    sums(6, x, out, (gplanes, b.l1))
    gw, gs, out = torch.empty_like(w), torch.empty_like(s), empty(6)
    phi_backward[grid](
        w, s, b.pre, gmoved, seeds["pre"], gs1, gs_normals, gs_psi, gw_psi, gw_theta, *weights[:6], h1, h2, g1, g2, x, out, gw, gs,
        n, m, scale, bound, **flags, **size,
    )  # fmt: skip
    sums(0, x, out)
    if not wanted:
        return gw, gs, [None] * len(weights)
    parts = partial.sum(0).split([p.numel() for p in weights])
    return gw, gs, [part.view_as(p) for part, p in zip(parts, weights, strict=True)]


def fused_operator(w: Tensor, s: Tensor, settings: Settings, weights: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """(G (N, 6, 6), b (N + 1, 6), numbers (N, 48), pre (N, 6), post (N, 6)) of w and s, each (N, 6) float32.

    b = (I + G) L_pre + L_post, its last row that of the state at rest; numbers: what `microplane.correction` takes, 12 for each of
    C_x, C_y, C_z, C_xyz. weights: weight and bias of the layers of Phi, Psi1, the planes, Psi2 and Theta (26 tensors), all of one
    hidden width, a power of two from 16.
    """
    return _FusedOperator.apply(settings, w, s, *weights)

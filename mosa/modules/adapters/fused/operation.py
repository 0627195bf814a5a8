"""The fused networks as one torch operation: what `ProgressiveOperator` computes, with nothing stored but inputs and weights.

Sources of the kernels: network_kernels.py (forward), assembly_kernels.py, adjoint_kernels.py, sum_kernels.py.
Their torch twin is mosa/modules/adapters/progressive.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mosa.modules.adapters.fused import adjoint_kernels, assembly_kernels, network_kernels
from mosa.modules.adapters.fused.sum_kernels import weight_gradients
from mosa.physics.adapters.network_evaluation import backward_at_hand

LANES = 128
"""Particles a program of the assembly; rows are padded to a multiple, so that arrays stored by column need no mask."""
BLOCK = 64
"""Rows a program takes at once."""
INTERPRETED_PROGRAMS = 2
REGISTERS = 168
"""Of a thread in the forward kernels: three programs a multiprocessor have room."""


class Settings(NamedTuple):
    """alpha, alpha_normal, l_max, scale: as `ProgressiveOperator`; diagonal: what both factors of its matrices start from (D of
    assembly_kernels.py); rest_free: as `StressAdapter`."""

    alpha: float
    alpha_normal: float
    diagonal: float
    l_max: float | None
    scale: float
    rest_free: bool


class _Buffers(NamedTuple):
    """What the kernels leave for one another, by column, M rows each. s1, pre, s2, moved = (I + G) pre: (6, M); l1 (H + 3, M), its
    last rows the scaled normals; l2 (H + 12, M), with room for what else Theta reads; t (48, M): the bounded numbers of C_x, C_y,
    C_z, C_xyz."""

    pre: Tensor
    s1: Tensor
    l1: Tensor
    t: Tensor
    l2: Tensor
    s2: Tensor
    moved: Tensor


class _Launch:
    """How the kernels of networks of one width are launched for one number of particles."""

    def __init__(self, n: int, hidden: int, device: torch.device) -> None:
        self.n, self.hidden, self.device = n, hidden, device
        # the particles, the state at rest, and as many more of these as fill the last one
        self.rows = -(-(n + 1) // LANES) * LANES
        self.lanes = (self.rows // LANES,)
        self.warps = 8 if hidden > 64 else 4  # a warp group for 64 rows of 64 columns
        self.grid = (self.rows // BLOCK,)
        self.size = {"H": hidden, "BLOCK": BLOCK, "num_warps": self.warps, "num_stages": 1}
        self.forward = self.size | ({"maxnreg": REGISTERS} if hidden <= 64 else {})

    @property
    def programs(self) -> int:
        """Of the sums, one a multiprocessor, which go through all tiles."""
        if self.device.type != "cuda":
            return min(self.grid[0], INTERPRETED_PROGRAMS)
        found = torch.cuda.get_device_properties(self.device).multi_processor_count
        return min(self.grid[0], found)


def _evaluate(
    launch: _Launch, w: Tensor, s: Tensor, unit: Tensor, settings: Settings, weights: Sequence[Tensor], G: Tensor | None
) -> _Buffers:  # fmt: skip
    """Steps 1 to 4, and G (N, 6, 6) where it is given to be filled."""
    n, m, hidden = launch.n, launch.rows, launch.hidden
    b = _Buffers(*(w.new_empty(k, m) for k in (6, 6, hidden + 3, 48, hidden + 12, 6, 6)))
    bound, scale, D = settings.l_max or 0.0, settings.scale, settings.diagonal
    grid, size = launch.grid, launch.forward
    network_kernels.phi_forward[grid](
        w, s, unit, *weights[:6], b.pre, b.s1, n, m, scale, bound, BOUNDED=settings.l_max is not None, **size
    )  # fmt: skip
    network_kernels.psi1_forward[grid](
        w, b.s1, *weights[6:14], b.l1, b.t, n, m, scale, settings.alpha, **size
    )
    assembly_kernels.normals[launch.lanes](b.t, b.s1, b.l1[hidden:], m, scale, D=D, BLOCK=LANES)
    network_kernels.psi2_forward[grid](
        b.l1, *weights[14:20], b.t, b.l2, n, m, settings.alpha_normal, **size
    )
    assembly_kernels.assemble[launch.lanes](
        b.t, b.s1, b.pre, b.t if G is None else G, b.s2, b.moved, n, m, OPERATOR=G is not None, D=D, BLOCK=LANES
    )  # fmt: skip
    return b


class _FusedOperator(torch.autograd.Function):
    @staticmethod
    def forward(ctx, settings: Settings, unit: Tensor, w: Tensor, s: Tensor, *weights: Tensor):
        w, s = w.contiguous(), s.contiguous()
        weights = tuple(weight.contiguous() for weight in weights)
        n = len(w)
        launch = _Launch(n, weights[0].shape[0], w.device)
        G, h = w.new_empty(n, 6, 6), w.new_empty(n, 6)
        stored = backward_at_hand()
        with torch.cuda.device_of(w):
            buffers = _evaluate(launch, w, s, unit, settings, weights, G)
            post, sums = torch.empty_like(buffers.pre), torch.empty_like(buffers.pre)
            m = launch.rows
            network_kernels.theta_forward[launch.grid](
                buffers.l2, w, buffers.s2, buffers.moved, *weights[20:], post, sums, n, m, settings.scale, settings.l_max or 0.0,
                BOUNDED=settings.l_max is not None, **launch.forward,
            )  # fmt: skip
            assembly_kernels.finish[launch.lanes](
                sums, w, s, unit, h, n, m, RESTED=settings.rest_free, BLOCK=LANES
            )
        ctx.settings, ctx.launch = settings, launch
        ctx.buffers = buffers if stored else None
        ctx.save_for_backward(unit, w, s, post, *weights)
        ctx.set_materialize_grads(False)
        return G, h, buffers.t.T[:n], buffers.pre.T[:n], post.T[:n]

    @staticmethod
    @once_differentiable
    def backward(ctx, gG, gh, gt, gpre, gpost):
        unit, w, s, post, *weights = ctx.saved_tensors
        n = len(w)
        extra = any(g is not None for g in (gt, gpre, gpost))
        shapes = {"G": (n, 36), "h": (n, 6), "t": (n, 48), "pre": (n, 6), "post": (n, 6)}
        seeds = {}
        for (name, shape), seed in zip(shapes.items(), (gG, gh, gt, gpre, gpost)):
            if seed is None and (extra or name in "Gh"):
                seed = w.new_zeros(shape)
            seeds[name] = w if seed is None else seed.contiguous()  # w: never read
        needs = ctx.needs_input_grad[4:]
        with torch.cuda.device_of(w):
            buffers, inputs = ctx.buffers, (ctx.launch, w, s, unit, ctx.settings)
            if buffers is None:
                buffers = _evaluate(*inputs, weights, None)
            gw, gs, gradients = _backward(*inputs, weights, post, seeds, extra, any(needs), buffers)
        gradients = [g if need else None for g, need in zip(gradients, needs, strict=True)]
        return None, None, gw, gs, *gradients


def _backward(
    launch: _Launch, w: Tensor, s: Tensor, unit: Tensor, settings: Settings, weights: Sequence[Tensor], post: Tensor,
    seeds: dict[str, Tensor], extra: bool, wanted: bool, b: _Buffers,
) -> tuple[Tensor, Tensor, Sequence[Tensor | None]]:  # fmt: skip
    """Adjoints of w, s (N, 6) and, where wanted, of the weights. post (6, M), b: of the forward pass; seeds: adjoints of the
    outputs; extra: of the last three too."""
    n, m, hidden = launch.n, launch.rows, launch.hidden
    grid, size = launch.grid, launch.size | {"WANTED": wanted}
    # of one network after the other
    h1, h2, g1, g2 = (w.new_empty(hidden if wanted else 0, m) for _ in range(4))
    scale, bound, D = settings.scale, settings.l_max or 0.0, settings.diagonal
    flags = {"BOUNDED": settings.l_max is not None, "EXTRA": extra}
    partial = w.new_empty(launch.programs, sum(p.numel() for p in weights) if wanted else 0)
    first = [sum(p.numel() for p in weights[:k]) for k in range(len(weights))]

    def empty(rows: int) -> Tensor:
        return w.new_empty(rows, m)

    def sums(layer: int, inputs: Tensor, outputs: Tensor, more: tuple | None = None) -> None:
        """Gradients of the network whose first weight is weights[layer]."""
        g4, x4 = more or (outputs, inputs)
        weight_gradients[(launch.programs, 5)](
            g1, inputs, g2, h1, outputs, h2, g4, x4, partial, first[layer], partial.shape[1], m, IN1=weights[layer].shape[1],
            OUT3=weights[layer + 4].shape[0], OUT4=len(g4) if more else 0, H=hidden, TILE=max(64, hidden), BLOCK=BLOCK // 2,
            num_warps=launch.warps,
        )  # fmt: skip

    rest = seeds["h"].sum(0) if settings.rest_free else seeds["h"]
    gl2, gw_theta, gs2, out = empty(hidden), empty(6), empty(6), empty(6)
    adjoint_kernels.theta_backward[grid](
        b.l2, w, b.s2, post, seeds["h"], rest, unit, seeds["post"], *weights[20:], h1, h2, g1, g2, out, gl2, gw_theta, gs2,
        n, m, scale, bound, RESTED=settings.rest_free, **flags, **size,
    )  # fmt: skip
    if wanted:
        sums(20, b.l2, out)
    gt, gs1, gmoved = torch.empty_like(b.t), empty(6), empty(6)
    assembly_kernels.assemble_adjoint[launch.lanes](
        b.t, b.s1, b.pre, seeds["G"], seeds["h"], rest, unit, gs2, seeds["t"], gt, gs1, gmoved, n, m, RESTED=settings.rest_free,
        EXTRA=extra, D=D, BLOCK=LANES,
    )  # fmt: skip
    gl1, out = empty(hidden + 3), empty(12 + hidden)
    adjoint_kernels.psi2_backward[grid](
        b.l1, b.t, b.l2, gt, gl2, *weights[14:20], h1, h2, g1, g2, out, gl1, n, m, settings.alpha_normal, **size,
    )  # fmt: skip
    if wanted:
        sums(14, b.l1, out)
    del gl2  # what the rest needs goes where this was
    assembly_kernels.normals_adjoint[launch.lanes](
        b.t, b.s1, gl1[hidden:], gt, gs1, m, scale, D=D, BLOCK=LANES
    )
    x, gplanes, out = (empty(rows if wanted else 0) for rows in (12, 36, hidden))
    gw_psi, gs_psi = empty(6), empty(6)
    adjoint_kernels.psi1_backward[grid](
        w, b.s1, b.t, gt, gl1, b.l1, *weights[6:14], h1, h2, g1, g2, x, gplanes, out, gw_psi, gs_psi,
        n, m, scale, settings.alpha, **size,
    )  # fmt: skip
    if wanted:
        sums(6, x, out, (gplanes, b.l1))
    gw, gs, out = torch.empty_like(w), torch.empty_like(s), empty(6)
    adjoint_kernels.phi_backward[grid](
        w, s, unit, b.pre, gmoved, seeds["pre"], gs1, gs_psi, gw_psi, gw_theta, *weights[:6], h1, h2, g1, g2, x, out, gw,
        gs, n, m, scale, bound, **flags, **size,
    )  # fmt: skip
    if not wanted:
        return gw, gs, [None] * len(weights)
    sums(0, x, out)
    parts = partial.sum(0).split([p.numel() for p in weights])
    return gw, gs, [part.view_as(p) for part, p in zip(parts, weights, strict=True)]


def fused_operator(
    w: Tensor, s: Tensor, unit: Tensor, settings: Settings, weights: Sequence[Tensor]
) -> tuple[Tensor, ...]:
    """(G (N, 6, 6), h (N, 6), numbers (N, 48), pre (N, 6), post (N, 6)) of w and s, each (N, 6) float32.

    s and h are in multiples of unit (1,), which gets no gradient: h = unit (b - b at rest), without the second where not rest_free,
    b = (I + G) L_pre + L_post of s / unit. numbers: what `microplane.correction` takes, 12 for each of C_x, C_y, C_z, C_xyz.
    weights: weight and bias of the layers of Phi, Psi1, the planes, Psi2 and Theta (26 tensors), all of one hidden width, a power
    of two from 16."""
    return _FusedOperator.apply(settings, unit, w, s, *weights)

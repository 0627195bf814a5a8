"""Triton kernel for sums over the rows: the gradients of the networks' weights, of what adjoint_kernels.py leaves."""

import triton
import triton.language as tl

from mosa.modules.adapters.fused.network_kernels import by_column, product


@triton.jit
def layer_gradient(
    g, x, at, M, OUT: tl.constexpr, IN: tl.constexpr, ROW: tl.constexpr, COLUMN: tl.constexpr,
    TILE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The tile (TILE, TILE) from (ROW, COLUMN) of g x^T, to a weight (OUT, IN) at `at`, and of the bias behind it."""
    out, into, k = ROW + tl.arange(0, TILE), COLUMN + tl.arange(0, TILE), tl.arange(0, BLOCK)
    weight, bias = tl.zeros((TILE, TILE), tl.float32), tl.zeros((TILE,), tl.float32)
    for tile in range(tl.program_id(0), M // BLOCK, tl.num_programs(0)):
        r = tile * BLOCK + k
        e = tl.load(g + out[:, None] * M + r[None, :], mask=out[:, None] < OUT, other=0.0)
        weight += product(e, by_column(x, r, into, M, IN))
        bias += tl.sum(e, 1)
    inside = (out[:, None] < OUT) & (into[None, :] < IN)
    tl.store(at + out[:, None] * IN + into[None, :], weight, mask=inside)
    if COLUMN == 0:
        tl.store(at + OUT * IN + out, bias, mask=out < OUT)


@triton.jit(do_not_specialize=["start"])
def weight_gradients(
    g1, x1, g2, h1, g3, h2, g4, x4, partial, start, size, M, IN1: tl.constexpr, OUT3: tl.constexpr, OUT4: tl.constexpr,
    H: tl.constexpr, TILE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Three layers of a network and, where OUT4 > 0, one more that reads x4 (H, M): weights and biases in order, from `start` of
    the program's row of `partial` (programs, size). Tiles of weights are spread over the second axis of the grid."""
    which = tl.program_id(1)
    at = partial + tl.program_id(0) * size + start
    at2 = at + H * IN1 + H
    at3 = at2 + H * H + H
    if which == 0:
        layer_gradient(g3, h2, at3, M, OUT3, H, 0, 0, TILE, BLOCK)
    elif which == 1:
        if OUT3 > TILE:
            layer_gradient(g3, h2, at3, M, OUT3, H, TILE, 0, TILE, BLOCK)
    elif which == 2:
        layer_gradient(g2, h1, at2, M, H, H, 0, 0, TILE, BLOCK)
    elif which == 3:
        layer_gradient(g1, x1, at, M, H, IN1, 0, 0, TILE, BLOCK)
    elif which == 4:
        if IN1 > TILE:
            layer_gradient(g1, x1, at, M, H, IN1, 0, TILE, TILE, BLOCK)
        if OUT4 > 0:
            layer_gradient(g4, x4, at3 + OUT3 * H + OUT3, M, OUT4, H, 0, 0, TILE, BLOCK)

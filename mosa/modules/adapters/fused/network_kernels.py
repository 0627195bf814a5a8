"""Triton kernels of the four networks of `ProgressiveOperator`, forward (paper, eq. 4, 7 and 8).

A program takes tiles of BLOCK rows through one network; nothing hidden leaves it. There are M > N rows: row N is the state at
rest, which the loads of w and s fill with zeros, and so are those after it. w and s are (N, 6) as the simulator hands them over, s
in multiples of `unit` (1,); everything that one kernel leaves for another is stored by column, (columns, M), so that the kernels
with one lane per particle read it in order.

H: hidden width, a power of two. Weights are those of torch's linear layers: (out, in). Products are
three of tf32 with the rounding errors carried along, as exact as float32.
"""

import os

import triton
import triton.language as tl
from triton.language.extra import libdevice

if os.environ.get("TRITON_INTERPRET") == "1":  # the interpreter calls no device functions

    @triton.jit
    def exp(z):
        return tl.exp(tl.minimum(z, 88.0))

    @triton.jit
    def quotient(y, z):
        return y / z

else:

    @triton.jit
    def exp(z):
        """To two units in the last place, subnormal results cut to 0: a third of the instructions of tl.exp."""
        return libdevice.fast_expf(z)

    @triton.jit
    def quotient(y, z):
        """To two units in the last place; 0 for z from 2^126 to infinity."""
        return libdevice.fast_dividef(y, z)


@triton.jit
def tanh(z):
    """Exactly 0 at 0, whatever the rounding of the division."""
    e = exp(-2.0 * tl.abs(z))
    t = quotient(1.0 - e, 1.0 + e)
    return tl.where(z < 0.0, -t, t)


@triton.jit
def silu(z):
    """(silu(z), its derivative)."""
    g = quotient(1.0, 1.0 + exp(-z))  # far below 0 the exponential is infinite, and g is 0
    return z * g, g * (1.0 + z * (1.0 - g))


@triton.jit
def matrix(p, rows, columns, stride, row_count, column_count):
    """Tile of a row-major matrix, 0 beyond (row_count, column_count)."""
    inside = (rows[:, None] < row_count) & (columns[None, :] < column_count)
    return tl.load(p + rows[:, None] * stride + columns[None, :], mask=inside, other=0.0)


@triton.jit
def vector(p, i, count):
    return tl.load(p + i, mask=i < count, other=0.0)


@triton.jit
def by_column(p, r, c, M, count):
    """(BLOCK, columns) tile of an array stored by column, 0 beyond."""
    return tl.load(p + c[None, :] * M + r[:, None], mask=(c[None, :] < count), other=0.0)


@triton.jit
def store_by_column(p, value, r, c, M, count):
    tl.store(p + c[None, :] * M + r[:, None], value, mask=(c[None, :] < count))


@triton.jit
def product(x, y):
    return tl.dot(x, y, input_precision="tf32x3")


@triton.jit
def network_input(w, s, unit, r, N, M, scale, ROWS: tl.constexpr):
    """(BLOCK, 16): scale (w, s) and four zeros. ROWS: s is (N, 6) in multiples of unit, else stored by column."""
    c = tl.arange(0, 16)[None, :]
    row = r[:, None]
    first = tl.load(w + row * 6 + c, mask=(row < N) & (c < 6), other=0.0)
    of_s = (c >= 6) & (c < 12)
    if ROWS:
        second = tl.load(s + row * 6 + c - 6, mask=(row < N) & of_s, other=0.0) / tl.load(unit)
    else:
        second = tl.load(s + (c - 6) * M + row, mask=of_s, other=0.0)
    return scale * (first + second)


@triton.jit
def tile_of(W, OUT: tl.constexpr, IN: tl.constexpr, STRIDE: tl.constexpr):
    """A weight (OUT, IN), or a part of one with rows of STRIDE numbers, padded with zeros to 16, 64 or more."""
    rows: tl.constexpr = 16 if OUT <= 16 else (64 if OUT == 36 else OUT)
    columns: tl.constexpr = 16 if IN <= 16 else IN
    return matrix(W, tl.arange(0, rows), tl.arange(0, columns), STRIDE, OUT, IN)


@triton.jit
def times(x, W, OUT: tl.constexpr, IN: tl.constexpr, STRIDE: tl.constexpr):
    """x W^T, padded as `tile_of`."""
    return product(x, tl.trans(tile_of(W, OUT, IN, STRIDE)))


@triton.jit
def layer(x, W, b, OUT: tl.constexpr, IN: tl.constexpr, STRIDE: tl.constexpr):
    """x W^T + b."""
    y = times(x, W, OUT, IN, STRIDE)
    if OUT == 6 or OUT == 12:
        bias = vector(b, tl.arange(0, 16), OUT)
    elif OUT == 36:
        bias = vector(b, tl.arange(0, 64), OUT)
    else:
        bias = tl.load(b + tl.arange(0, OUT))
    return y + bias[None, :]


@triton.jit(do_not_specialize=["N"])
def phi_forward(
    w, s, unit, W1, b1, W2, b2, W3, b3, pre, s1, N, M, scale, bound,
    BOUNDED: tl.constexpr, H: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Step 1: pre (6, M) and s1 = s / unit + pre (6, M)."""
    c = tl.arange(0, 16)
    for tile in range(tl.program_id(0), M // BLOCK, tl.num_programs(0)):
        r = tile * BLOCK + tl.arange(0, BLOCK)
        x = network_input(w, s, unit, r, N, M, scale, True)
        z, _ = silu(layer(x, W1, b1, H, 12, 12))
        z, _ = silu(layer(z, W2, b2, H, H, H))
        y = layer(z, W3, b3, 6, H, H)
        if BOUNDED:
            y = bound * tanh(y)
        store_by_column(pre, y, r, c, M, 6)
        own = tl.load(
            s + r[:, None] * 6 + c[None, :], mask=(r[:, None] < N) & (c[None, :] < 6), other=0.0
        )
        store_by_column(s1, own / tl.load(unit) + y, r, c, M, 6)


@triton.jit(do_not_specialize=["N"])
def psi1_forward(
    w, s1, W1, b1, W2, b2, W3, b3, Wp, bp, l1, t, N, M, scale, alpha,
    H: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Step 2: l1 (H, M) and the 36 numbers of the planes, rows 0 to 35 of t (48, M)."""
    h, planes = tl.arange(0, H), tl.arange(0, 64)
    for tile in range(tl.program_id(0), M // BLOCK, tl.num_programs(0)):
        r = tile * BLOCK + tl.arange(0, BLOCK)
        x = network_input(w, s1, w, r, N, M, scale, False)
        z, _ = silu(layer(x, W1, b1, H, 12, 12))
        z, _ = silu(layer(z, W2, b2, H, H, H))
        y = layer(z, W3, b3, H, H, H)
        store_by_column(l1, y, r, h, M, H)
        numbers = alpha * tanh(layer(y, Wp, bp, 36, H, H))
        store_by_column(t, numbers, r, planes, M, 36)


@triton.jit(do_not_specialize=["N"])
def psi2_forward(
    l1, W1, b1, W2, b2, W3, b3, t, l2, N, M, alpha, H: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Step 4: the 12 numbers of C_xyz, rows 36 to 47 of t, and l2 (H, M), from l1 (H + 3, M), its last rows the normals."""
    h, c = tl.arange(0, H), tl.arange(0, 16)
    for tile in range(tl.program_id(0), M // BLOCK, tl.num_programs(0)):
        r = tile * BLOCK + tl.arange(0, BLOCK)
        z = layer(by_column(l1, r, h, M, H), W1, b1, H, H, H + 3)
        x = by_column(l1 + H * M, r, c, M, 3)
        z, _ = silu(z + times(x, W1 + H, H, 3, H + 3))
        z, _ = silu(layer(z, W2, b2, H, H, H))
        y = layer(z, W3, b3, 12, H, H)
        store_by_column(t + 36 * M, alpha * tanh(y), r, c, M, 12)
        y = layer(z, W3 + 12 * H, b3 + 12, H, H, H)
        store_by_column(l2, alpha * tanh(y), r, h, M, H)


@triton.jit(do_not_specialize=["N"])
def theta_forward(
    l2, w, s2, moved, W1, b1, W2, b2, W3, b3, post, b, N, M, scale, bound,
    BOUNDED: tl.constexpr, H: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Step 5: post (6, M); b (6, M) = moved + post."""
    h, c = tl.arange(0, H), tl.arange(0, 16)
    for tile in range(tl.program_id(0), M // BLOCK, tl.num_programs(0)):
        r = tile * BLOCK + tl.arange(0, BLOCK)
        z = layer(by_column(l2, r, h, M, H), W1, b1, H, H, H + 12)
        x = network_input(w, s2, w, r, N, M, scale, False)
        z, _ = silu(z + times(x, W1 + H, H, 12, H + 12))
        z, _ = silu(layer(z, W2, b2, H, H, H))
        y = layer(z, W3, b3, 6, H, H)
        if BOUNDED:
            y = bound * tanh(y)
        store_by_column(post, y, r, c, M, 6)
        store_by_column(b, y + by_column(moved, r, c, M, 6), r, c, M, 6)

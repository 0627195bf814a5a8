"""Triton kernels of the four networks of `ProgressiveOperator`, forward (paper, eq. 4, 7 and 8).

A program takes BLOCK rows through one network; nothing hidden leaves it. There are M = N + 1 rows: row N is the state at rest,
which the loads of w and s fill with zeros. w and s are (N, 6) as the simulator hands them over; everything that one kernel leaves
for another is stored by column, (columns, M), so that the kernels with one lane per particle read it in order.

H: hidden width, a power of two; P: precision of products (tf32x3 | tf32). Weights are those of torch's linear layers: (out, in).
"""

import triton
import triton.language as tl


@triton.jit
def tanh(z):
    """Exactly 0 at 0, whatever the rounding of the division."""
    e = tl.exp(-2.0 * tl.abs(z))
    t = (1.0 - e) / (1.0 + e)
    return tl.where(z < 0.0, -t, t)


@triton.jit
def silu(z):
    """(silu(z), its derivative)."""
    e = tl.exp(-tl.abs(z))
    g = tl.where(z < 0.0, e, 1.0) / (1.0 + e)
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
def to_tf32(x):
    """x to 10 bits after the point, to the nearest. The tensor cores cut instead, always towards zero: over 20 products in a row
    that bias adds up to ten times the error of rounding."""
    return ((x.to(tl.int32, bitcast=True) + 0x1000) & -0x2000).to(tl.float32, bitcast=True)


@triton.jit
def product(x, y, P: tl.constexpr):
    """x y, both factors rounded first where P is tf32."""
    if P == "tf32":
        x, y = to_tf32(x), to_tf32(y)
    return tl.dot(x, y, input_precision=P)


@triton.jit
def dense(x, W, b, P: tl.constexpr):
    return product(x, tl.trans(W), P) + b[None, :]


@triton.jit
def network_input(w, s, r, N, M, scale, ROWS: tl.constexpr):
    """(BLOCK, 16): scale (w, s) and four zeros. ROWS: s is (N, 6), else stored by column."""
    c = tl.arange(0, 16)[None, :]
    row = r[:, None]
    first = tl.load(w + row * 6 + c, mask=(row < N) & (c < 6), other=0.0)
    of_s = (c >= 6) & (c < 12)
    if ROWS:
        second = tl.load(s + row * 6 + c - 6, mask=(row < N) & of_s, other=0.0)
    else:
        second = tl.load(s + (c - 6) * M + row, mask=of_s, other=0.0)
    return scale * (first + second)


@triton.jit
def normal(t, s1, r, M, plane: tl.constexpr, c1: tl.constexpr, c2: tl.constexpr):
    """(BLOCK,) parts (v0, v1, v2, u00, u01, u02, l00) of n = (1 + l00) ((1 + u00) v0 + u01 v1 + u02 v2), the normal traction
    on a plane after its correction: row 0 of (I + L)(I + U) on its components v of s1."""
    first = t + 12 * plane * M + r
    return (
        tl.load(s1 + plane * M + r),
        tl.load(s1 + c1 * M + r),
        tl.load(s1 + c2 * M + r),
        tl.load(first),
        tl.load(first + M),
        tl.load(first + 2 * M),
        tl.load(first + 6 * M),
    )


@triton.jit
def normal_traction(t, s1, r, M, plane: tl.constexpr, c1: tl.constexpr, c2: tl.constexpr):
    v0, v1, v2, u00, u01, u02, l00 = normal(t, s1, r, M, plane, c1, c2)
    return (1.0 + l00) * (v0 + u00 * v0 + u01 * v1 + u02 * v2)


@triton.jit(do_not_specialize=["N"])
def phi_forward(
    w, s, W1, b1, W2, b2, W3, b3, pre, s1, N, M, scale, bound,
    BOUNDED: tl.constexpr, H: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """Step 1: pre (6, M) and s1 = s + pre (6, M)."""
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    h, c = tl.arange(0, H), tl.arange(0, 16)
    x = network_input(w, s, r, N, M, scale, True)
    a, _ = silu(dense(x, matrix(W1, h, c, 12, H, 12), tl.load(b1 + h), P))
    a, _ = silu(dense(a, matrix(W2, h, h, H, H, H), tl.load(b2 + h), P))
    y = dense(a, matrix(W3, c, h, H, 6, H), vector(b3, c, 6), P)
    if BOUNDED:
        y = bound * tanh(y)
    store_by_column(pre, y, r, c, M, 6)
    own = tl.load(s + r[:, None] * 6 + c[None, :], mask=(r[:, None] < N) & (c[None, :] < 6), other=0.0)
    store_by_column(s1, own + y, r, c, M, 6)


@triton.jit(do_not_specialize=["N"])
def psi1_forward(
    w, s1, W1, b1, W2, b2, W3, b3, Wp, bp, l1, t, N, M, scale, alpha,
    H: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """Step 2: l1 (H, M) and the 36 numbers of the planes, rows 0 to 35 of t (48, M)."""
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    h, c, planes = tl.arange(0, H), tl.arange(0, 16), tl.arange(0, 64)
    x = network_input(w, s1, r, N, M, scale, False)
    a, _ = silu(dense(x, matrix(W1, h, c, 12, H, 12), tl.load(b1 + h), P))
    a, _ = silu(dense(a, matrix(W2, h, h, H, H, H), tl.load(b2 + h), P))
    y = dense(a, matrix(W3, h, h, H, H, H), tl.load(b3 + h), P)
    store_by_column(l1, y, r, h, M, H)
    numbers = alpha * tanh(dense(y, matrix(Wp, planes, h, H, 36, H), vector(bp, planes, 36), P))
    store_by_column(t, numbers, r, planes, M, 36)


@triton.jit
def psi2_hidden(l1, t, s1, W1, b1, r, M, scale, H: tl.constexpr, P: tl.constexpr):
    """(l1 (BLOCK, H), scaled normals (BLOCK,) three times, first pre-activations (BLOCK, H))."""
    h = tl.arange(0, H)
    x = by_column(l1, r, h, M, H)
    nx = scale * normal_traction(t, s1, r, M, 0, 5, 4)
    ny = scale * normal_traction(t, s1, r, M, 1, 3, 5)
    nz = scale * normal_traction(t, s1, r, M, 2, 4, 3)
    z = dense(x, matrix(W1, h, h, H + 3, H, H), tl.load(b1 + h), P)
    # the three last columns by hand: a product of 3 would be padded to 16
    z += nx[:, None] * tl.load(W1 + h * (H + 3) + H)[None, :]
    z += ny[:, None] * tl.load(W1 + h * (H + 3) + H + 1)[None, :]
    z += nz[:, None] * tl.load(W1 + h * (H + 3) + H + 2)[None, :]
    return x, nx, ny, nz, z


@triton.jit(do_not_specialize=["N"])
def psi2_forward(
    l1, t, s1, W1, b1, W2, b2, W3, b3, l2, N, M, scale, alpha,
    H: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """Step 4: the 12 numbers of C_xyz, rows 36 to 47 of t, and l2 (H, M)."""
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    h, c = tl.arange(0, H), tl.arange(0, 16)
    _, _, _, _, z = psi2_hidden(l1, t, s1, W1, b1, r, M, scale, H, P)
    a, _ = silu(z)
    a, _ = silu(dense(a, matrix(W2, h, h, H, H, H), tl.load(b2 + h), P))
    numbers = alpha * tanh(dense(a, matrix(W3, c, h, H, 12, H), vector(b3, c, 12), P))
    store_by_column(t + 36 * M, numbers, r, c, M, 12)
    y = alpha * tanh(dense(a, matrix(W3 + 12 * H, h, h, H, H, H), tl.load(b3 + 12 + h), P))
    store_by_column(l2, y, r, h, M, H)


@triton.jit
def theta_hidden(l2, w, s2, W1, b1, r, N, M, scale, H: tl.constexpr, P: tl.constexpr):
    """(l2 (BLOCK, H), scaled (w, s2) (BLOCK, 16), first pre-activations (BLOCK, H))."""
    h, c = tl.arange(0, H), tl.arange(0, 16)
    x = by_column(l2, r, h, M, H)
    rest = network_input(w, s2, r, N, M, scale, False)
    z = dense(x, matrix(W1, h, h, H + 12, H, H), tl.load(b1 + h), P)
    z += product(rest, tl.trans(matrix(W1 + H, h, c, H + 12, H, 12)), P)
    return x, rest, z


@triton.jit(do_not_specialize=["N"])
def theta_forward(
    l2, w, s2, moved, W1, b1, W2, b2, W3, b3, post, b, N, M, scale, bound,
    BOUNDED: tl.constexpr, H: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """Step 5: post (6, M); b (M, 6) = moved + post."""
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    h, c = tl.arange(0, H), tl.arange(0, 16)
    _, _, z = theta_hidden(l2, w, s2, W1, b1, r, N, M, scale, H, P)
    a, _ = silu(z)
    a, _ = silu(dense(a, matrix(W2, h, h, H, H, H), tl.load(b2 + h), P))
    y = dense(a, matrix(W3, c, h, H, 6, H), vector(b3, c, 6), P)
    if BOUNDED:
        y = bound * tanh(y)
    store_by_column(post, y, r, c, M, 6)
    y += by_column(moved, r, c, M, 6)
    tl.store(b + r[:, None] * 6 + c[None, :], y, mask=(r[:, None] <= N) & (c[None, :] < 6))

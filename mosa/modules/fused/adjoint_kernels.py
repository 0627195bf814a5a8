"""Triton kernels of the backward pass of the four networks: hidden layers recomputed, weight gradients kept per program.

A program walks over tiles of BLOCK rows and adds its weight gradients up in registers; at the end it writes them to its own row of
`partial`, in the order of the arguments, and torch sums the rows once: no atomics, the same result every time. g..: adjoints.
"""

import triton
import triton.language as tl

from mosa.modules.fused.network_kernels import (
    by_column,
    dense,
    matrix,
    network_input,
    normal,
    psi2_hidden,
    silu,
    store_by_column,
    tanh,
    theta_hidden,
    vector,
)


@triton.jit
def store_matrix(p, value, rows, columns, stride, row_count, column_count):
    inside = (rows[:, None] < row_count) & (columns[None, :] < column_count)
    tl.store(p + rows[:, None] * stride + columns[None, :], value, mask=inside)


@triton.jit
def by_row(p, r, c, rows):
    """(BLOCK, 16) tile of (rows, 6)."""
    return tl.load(p + r[:, None] * 6 + c[None, :], mask=(r[:, None] < rows) & (c[None, :] < 6), other=0.0)


@triton.jit
def outer(g, x, P: tl.constexpr):
    """Gradient of a weight: g^T x."""
    return tl.dot(tl.trans(g), x, input_precision=P)


@triton.jit
def store_input_adjoint(gw, gs, g, r, M):
    """(6, M) adjoints of w and s from that of a network's input (BLOCK, 16)."""
    c = tl.arange(0, 16)
    store_by_column(gw, g, r, c, M, 6)
    row, column = r[:, None], c[None, :]
    tl.store(gs + (column - 6) * M + row, g, mask=(column >= 6) & (column < 12))


@triton.jit
def theta_backward(
    l2, w, s2, gb, extra, W1, b1, W2, b2, W3, b3, gl2, gw, gs2, partial, size, N, M, scale, bound,
    BOUNDED: tl.constexpr, EXTRA: tl.constexpr, WEIGHTS: tl.constexpr, H: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """gl2 (H, M), gw, gs2 (6, M) from the adjoints gb (M, 6) of b and extra (N, 6) of post."""
    h, c = tl.arange(0, H), tl.arange(0, 16)
    A1, A2, A3 = tl.zeros((H, H), tl.float32), tl.zeros((H, H), tl.float32), tl.zeros((16, H), tl.float32)
    A1b = tl.zeros((H, 16), tl.float32)
    a1, a2, a3 = tl.zeros((H,), tl.float32), tl.zeros((H,), tl.float32), tl.zeros((16,), tl.float32)
    for tile in range(tl.program_id(0), tl.cdiv(M, BLOCK), tl.num_programs(0)):
        r = tile * BLOCK + tl.arange(0, BLOCK)
        x, rest, z1 = theta_hidden(l2, w, s2, W1, b1, r, N, M, scale, H, P)
        h1, d1 = silu(z1)
        h2, d2 = silu(dense(h1, matrix(W2, h, h, H, H, H), tl.load(b2 + h), P))
        g = by_row(gb, r, c, N + 1)
        if EXTRA:
            g += by_row(extra, r, c, N)
        if BOUNDED:
            y = tanh(dense(h2, matrix(W3, c, h, H, 6, H), vector(b3, c, 6), P))
            g *= bound * (1.0 - y * y)
        g2 = tl.dot(g, matrix(W3, c, h, H, 6, H), input_precision=P) * d2
        g1 = tl.dot(g2, matrix(W2, h, h, H, H, H), input_precision=P) * d1
        if WEIGHTS:
            A3 += outer(g, h2, P)
            A2 += outer(g2, h1, P)
            A1 += outer(g1, x, P)
            A1b += outer(g1, rest, P)
            a3 += tl.sum(g, 0)
            a2 += tl.sum(g2, 0)
            a1 += tl.sum(g1, 0)
        store_by_column(gl2, tl.dot(g1, matrix(W1, h, h, H + 12, H, H), input_precision=P), r, h, M, H)
        gx = scale * tl.dot(g1, matrix(W1 + H, h, c, H + 12, H, 12), input_precision=P)
        store_input_adjoint(gw, gs2, gx, r, M)
    if WEIGHTS:
        at = partial + tl.program_id(0) * size
        store_matrix(at, A1, h, h, H + 12, H, H)
        store_matrix(at + H, A1b, h, c, H + 12, H, 12)
        at += H * (H + 12)
        tl.store(at + h, a1)
        store_matrix(at + H, A2, h, h, H, H, H)
        at += H + H * H
        tl.store(at + h, a2)
        store_matrix(at + H, A3, c, h, H, 6, H)
        tl.store(at + 7 * H + c, a3, mask=c < 6)


@triton.jit
def normal_adjoint(gt, t, s1, g, r, M, plane: tl.constexpr, c1: tl.constexpr, c2: tl.constexpr):
    """Stores the adjoints of u00, u01, u02, l00 of a plane, rows 4 plane to 4 plane + 3 of gt (12, M); returns those of the three
    components of s1. g: adjoint of the normal traction."""
    v0, v1, v2, u00, u01, u02, l00 = normal(t, s1, r, M, plane, c1, c2)
    k = g * (1.0 + l00)
    first = gt + 4 * plane * M + r
    tl.store(first, k * v0)
    tl.store(first + M, k * v1)
    tl.store(first + 2 * M, k * v2)
    tl.store(first + 3 * M, g * (v0 + u00 * v0 + u01 * v1 + u02 * v2))
    return k * (1.0 + u00), k * u01, k * u02


@triton.jit
def psi2_backward(
    l1, t, s1, l2, gt, gl2, W1, b1, W2, b2, W3, b3, gl1, gtn, gsn, partial, size, N, M, scale, alpha,
    WEIGHTS: tl.constexpr, H: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """gl1 (H, M) and, through the normals, gtn (12, M) and gsn (6, M), from gt (48, M), its last 12 rows, and gl2 (H, M)."""
    h, c = tl.arange(0, H), tl.arange(0, 16)
    A1, A2, A3b = tl.zeros((H, H), tl.float32), tl.zeros((H, H), tl.float32), tl.zeros((H, H), tl.float32)
    A3 = tl.zeros((16, H), tl.float32)
    a1, a2, a3b = tl.zeros((H,), tl.float32), tl.zeros((H,), tl.float32), tl.zeros((H,), tl.float32)
    ax, ay, az = tl.zeros((H,), tl.float32), tl.zeros((H,), tl.float32), tl.zeros((H,), tl.float32)
    a3 = tl.zeros((16,), tl.float32)
    for tile in range(tl.program_id(0), tl.cdiv(M, BLOCK), tl.num_programs(0)):
        r = tile * BLOCK + tl.arange(0, BLOCK)
        x, nx, ny, nz, z1 = psi2_hidden(l1, t, s1, W1, b1, r, M, scale, H, P)
        h1, d1 = silu(z1)
        h2, d2 = silu(dense(h1, matrix(W2, h, h, H, H, H), tl.load(b2 + h), P))
        y = by_column(t + 36 * M, r, c, M, 12)
        g = by_column(gt + 36 * M, r, c, M, 12) * (alpha - y * y / alpha)
        yb = by_column(l2, r, h, M, H)
        gb = by_column(gl2, r, h, M, H) * (alpha - yb * yb / alpha)
        g2 = (
            tl.dot(g, matrix(W3, c, h, H, 12, H), input_precision=P)
            + tl.dot(gb, matrix(W3 + 12 * H, h, h, H, H, H), input_precision=P)
        ) * d2
        g1 = tl.dot(g2, matrix(W2, h, h, H, H, H), input_precision=P) * d1
        if WEIGHTS:
            A3 += outer(g, h2, P)
            A3b += outer(gb, h2, P)
            A2 += outer(g2, h1, P)
            A1 += outer(g1, x, P)
            ax += tl.sum(g1 * nx[:, None], 0)
            ay += tl.sum(g1 * ny[:, None], 0)
            az += tl.sum(g1 * nz[:, None], 0)
            a3 += tl.sum(g, 0)
            a3b += tl.sum(gb, 0)
            a2 += tl.sum(g2, 0)
            a1 += tl.sum(g1, 0)
        store_by_column(gl1, tl.dot(g1, matrix(W1, h, h, H + 3, H, H), input_precision=P), r, h, M, H)
        kx = scale * tl.sum(g1 * tl.load(W1 + h * (H + 3) + H)[None, :], 1)
        ky = scale * tl.sum(g1 * tl.load(W1 + h * (H + 3) + H + 1)[None, :], 1)
        kz = scale * tl.sum(g1 * tl.load(W1 + h * (H + 3) + H + 2)[None, :], 1)
        xa, xb, xc = normal_adjoint(gtn, t, s1, kx, r, M, 0, 5, 4)
        ya, yb_, yc = normal_adjoint(gtn, t, s1, ky, r, M, 1, 3, 5)
        za, zb, zc = normal_adjoint(gtn, t, s1, kz, r, M, 2, 4, 3)
        tl.store(gsn + r, xa)
        tl.store(gsn + M + r, ya)
        tl.store(gsn + 2 * M + r, za)
        tl.store(gsn + 3 * M + r, yb_ + zc)
        tl.store(gsn + 4 * M + r, zb + xc)
        tl.store(gsn + 5 * M + r, xb + yc)
    if WEIGHTS:
        at = partial + tl.program_id(0) * size
        store_matrix(at, A1, h, h, H + 3, H, H)
        tl.store(at + h * (H + 3) + H, ax)
        tl.store(at + h * (H + 3) + H + 1, ay)
        tl.store(at + h * (H + 3) + H + 2, az)
        at += H * (H + 3)
        tl.store(at + h, a1)
        store_matrix(at + H, A2, h, h, H, H, H)
        at += H + H * H
        tl.store(at + h, a2)
        store_matrix(at + H, A3, c, h, H, 12, H)
        store_matrix(at + 13 * H, A3b, h, h, H, H, H)
        at += H + (12 + H) * H
        tl.store(at + c, a3, mask=c < 12)
        tl.store(at + 12 + h, a3b)


@triton.jit
def psi1_backward(
    w, s1, l1, t, gt, gtn, gl1, W1, b1, W2, b2, W3, b3, Wp, bp, gw, gs, partial, size, N, M, scale, alpha,
    WEIGHTS: tl.constexpr, H: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """gw, gs (6, M) of w and s1 from gt (48, M), its first 36 rows, gtn (12, M) of `psi2_backward`, and gl1 (H, M)."""
    h, c, planes = tl.arange(0, H), tl.arange(0, 16), tl.arange(0, 64)
    place = planes % 12
    through_normals = (planes < 36) & ((place < 3) | (place == 6))
    source = 4 * (planes // 12) + tl.where(place == 6, 3, place)
    A1, A2, A3 = tl.zeros((H, 16), tl.float32), tl.zeros((H, H), tl.float32), tl.zeros((H, H), tl.float32)
    Ap = tl.zeros((64, H), tl.float32)
    a1, a2, a3 = tl.zeros((H,), tl.float32), tl.zeros((H,), tl.float32), tl.zeros((H,), tl.float32)
    ap = tl.zeros((64,), tl.float32)
    for tile in range(tl.program_id(0), tl.cdiv(M, BLOCK), tl.num_programs(0)):
        r = tile * BLOCK + tl.arange(0, BLOCK)
        x = network_input(w, s1, r, N, M, scale, False)
        h1, d1 = silu(dense(x, matrix(W1, h, c, 12, H, 12), tl.load(b1 + h), P))
        h2, d2 = silu(dense(h1, matrix(W2, h, h, H, H, H), tl.load(b2 + h), P))
        y = by_column(t, r, planes, M, 36)
        gp = by_column(gt, r, planes, M, 36)
        gp += tl.load(gtn + source[None, :] * M + r[:, None], mask=through_normals[None, :], other=0.0)
        gp *= alpha - y * y / alpha
        g = by_column(gl1, r, h, M, H) + tl.dot(gp, matrix(Wp, planes, h, H, 36, H), input_precision=P)
        g2 = tl.dot(g, matrix(W3, h, h, H, H, H), input_precision=P) * d2
        g1 = tl.dot(g2, matrix(W2, h, h, H, H, H), input_precision=P) * d1
        if WEIGHTS:
            Ap += outer(gp, by_column(l1, r, h, M, H), P)
            A3 += outer(g, h2, P)
            A2 += outer(g2, h1, P)
            A1 += outer(g1, x, P)
            ap += tl.sum(gp, 0)
            a3 += tl.sum(g, 0)
            a2 += tl.sum(g2, 0)
            a1 += tl.sum(g1, 0)
        store_input_adjoint(gw, gs, scale * tl.dot(g1, matrix(W1, h, c, 12, H, 12), input_precision=P), r, M)
    if WEIGHTS:
        at = partial + tl.program_id(0) * size
        store_matrix(at, A1, h, c, 12, H, 12)
        at += 12 * H
        tl.store(at + h, a1)
        store_matrix(at + H, A2, h, h, H, H, H)
        at += H + H * H
        tl.store(at + h, a2)
        store_matrix(at + H, A3, h, h, H, H, H)
        at += H + H * H
        tl.store(at + h, a3)
        store_matrix(at + H, Ap, planes, h, H, 36, H)
        tl.store(at + 37 * H + planes, ap, mask=planes < 36)


@triton.jit
def phi_backward(
    w, s, pre, gpre, extra, gs1, gsn, gsx, gwx, gwt, W1, b1, W2, b2, W3, b3, gw, gs, partial, size, N, M, scale, bound,
    BOUNDED: tl.constexpr, EXTRA: tl.constexpr, WEIGHTS: tl.constexpr, H: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """gw, gs (N, 6), everything added up: gs1, gsn, gsx (6, M) reach s1 from the assembly, the normals and Psi1; gpre (6, M) and
    extra (N, 6) reach pre, as s1 does; gwx, gwt (6, M) reach w from Psi1 and Theta."""
    h, c = tl.arange(0, H), tl.arange(0, 16)
    A1, A2, A3 = tl.zeros((H, 16), tl.float32), tl.zeros((H, H), tl.float32), tl.zeros((16, H), tl.float32)
    a1, a2, a3 = tl.zeros((H,), tl.float32), tl.zeros((H,), tl.float32), tl.zeros((16,), tl.float32)
    for tile in range(tl.program_id(0), tl.cdiv(M, BLOCK), tl.num_programs(0)):
        r = tile * BLOCK + tl.arange(0, BLOCK)
        x = network_input(w, s, r, N, M, scale, True)
        h1, d1 = silu(dense(x, matrix(W1, h, c, 12, H, 12), tl.load(b1 + h), P))
        h2, d2 = silu(dense(h1, matrix(W2, h, h, H, H, H), tl.load(b2 + h), P))
        g = by_column(gs1, r, c, M, 6) + by_column(gsn, r, c, M, 6) + by_column(gsx, r, c, M, 6) + by_column(gpre, r, c, M, 6)
        if EXTRA:
            g += by_row(extra, r, c, N)
        if BOUNDED:
            y = by_column(pre, r, c, M, 6)
            g *= bound - y * y / bound
        g2 = tl.dot(g, matrix(W3, c, h, H, 6, H), input_precision=P) * d2
        g1 = tl.dot(g2, matrix(W2, h, h, H, H, H), input_precision=P) * d1
        if WEIGHTS:
            A3 += outer(g, h2, P)
            A2 += outer(g2, h1, P)
            A1 += outer(g1, x, P)
            a3 += tl.sum(g, 0)
            a2 += tl.sum(g2, 0)
            a1 += tl.sum(g1, 0)
        gx = scale * tl.dot(g1, matrix(W1, h, c, 12, H, 12), input_precision=P)
        row, column = r[:, None], c[None, :]
        direct = by_column(gwx, r, c, M, 6) + by_column(gwt, r, c, M, 6)
        tl.store(gw + row * 6 + column, gx + direct, mask=(row < N) & (column < 6))
        of_s = (row < N) & (column >= 6) & (column < 12)
        at = (column - 6) * M + row
        direct = tl.load(gs1 + at, mask=of_s, other=0.0) + tl.load(gsn + at, mask=of_s, other=0.0)
        direct += tl.load(gsx + at, mask=of_s, other=0.0)
        tl.store(gs + row * 6 + column - 6, gx + direct, mask=of_s)
    if WEIGHTS:
        at = partial + tl.program_id(0) * size
        store_matrix(at, A1, h, c, 12, H, 12)
        at += 12 * H
        tl.store(at + h, a1)
        store_matrix(at + H, A2, h, h, H, H, H)
        at += H + H * H
        tl.store(at + h, a2)
        store_matrix(at + H, A3, c, h, H, 6, H)
        tl.store(at + 7 * H + c, a3, mask=c < 6)

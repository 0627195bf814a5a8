"""Triton kernels of the backward pass of the four networks: hidden layers recomputed, weight gradients summed per program.

`*_backward` take one tile of BLOCK rows through the adjoint of a network and leave, by column, what its weight gradients are made
of: h1, h2 activations and g1, g2 adjoints of the two hidden layers (H, M), x inputs, g adjoints of the outputs. `weight_gradients`
sums the products: each program over its share of the rows, into its own row of `partial`, and torch adds these rows once: no
atomics, the same result every time. In one kernel the sums would push everything else out of the registers. g..: adjoints.
"""

import triton
import triton.language as tl

from mosa.modules.fused.network_kernels import (
    by_column,
    dense,
    matrix,
    network_input,
    normal,
    product,
    psi2_hidden,
    silu,
    store_by_column,
    theta_hidden,
)


@triton.jit
def by_row(p, r, c, rows):
    """(BLOCK, 16) tile of (rows, 6)."""
    return tl.load(p + r[:, None] * 6 + c[None, :], mask=(r[:, None] < rows) & (c[None, :] < 6), other=0.0)


@triton.jit
def store_input_adjoint(gw, gs, g, r, M):
    """(6, M) adjoints of w and s from that of a network's input (BLOCK, 16)."""
    c = tl.arange(0, 16)
    store_by_column(gw, g, r, c, M, 6)
    column = c[None, :]
    tl.store(gs + (column - 6) * M + r[:, None], g, mask=(column >= 6) & (column < 12))


@triton.jit
def hidden_adjoint(
    g, z1, W2, b2, h1, h2, g1, g2, r, M, WEIGHTS: tl.constexpr, H: tl.constexpr, P: tl.constexpr
):  # fmt: skip
    """(BLOCK, H) adjoint of z1 from g, that of the second activations; with WEIGHTS all four hidden arrays are stored."""
    h = tl.arange(0, H)
    a1, _ = silu(z1)
    if WEIGHTS:
        store_by_column(h1, a1, r, h, M, H)
    a2, d2 = silu(dense(a1, matrix(W2, h, h, H, H, H), tl.load(b2 + h), P))
    e2 = g * d2
    if WEIGHTS:
        store_by_column(h2, a2, r, h, M, H)
        store_by_column(g2, e2, r, h, M, H)
    _, d1 = silu(z1)
    e1 = product(e2, matrix(W2, h, h, H, H, H), P) * d1
    if WEIGHTS:
        store_by_column(g1, e1, r, h, M, H)
    return e1


@triton.jit(do_not_specialize=["N"])
def theta_backward(
    l2, w, s2, post, gb, extra, W1, b1, W2, b2, W3, b3, h1, h2, g1, g2, gout, gl2, gw, gs2, N, M, scale, bound,
    BOUNDED: tl.constexpr, EXTRA: tl.constexpr, WEIGHTS: tl.constexpr, H: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """gl2 (H, M), gw, gs2 (6, M) from the adjoints gb (N + 1, 6) of b and extra (N, 6) of post; gout (6, M). The scaled (w, s2)
    becomes rows H to H + 11 of l2."""
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    h, c = tl.arange(0, H), tl.arange(0, 16)
    _, rest, z1 = theta_hidden(l2, w, s2, W1, b1, r, N, M, scale, H, P)
    g = by_row(gb, r, c, N + 1)
    if EXTRA:
        g += by_row(extra, r, c, N)
    if BOUNDED:
        y = by_column(post, r, c, M, 6)
        g *= bound - y * y / bound
    if WEIGHTS:
        store_by_column(l2 + H * M, rest, r, c, M, 12)
        store_by_column(gout, g, r, c, M, 6)
    g = product(g, matrix(W3, c, h, H, 6, H), P)
    e1 = hidden_adjoint(g, z1, W2, b2, h1, h2, g1, g2, r, M, WEIGHTS, H, P)
    store_by_column(gl2, product(e1, matrix(W1, h, h, H + 12, H, H), P), r, h, M, H)
    gx = scale * product(e1, matrix(W1 + H, h, c, H + 12, H, 12), P)
    store_input_adjoint(gw, gs2, gx, r, M)


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


@triton.jit(do_not_specialize=["N"])
def psi2_backward(
    l1, t, s1, l2, gt, gl2, W1, b1, W2, b2, W3, b3, h1, h2, g1, g2, gout, gl1, gtn, gsn, N, M, scale, alpha,
    WEIGHTS: tl.constexpr, H: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """gl1 (H, M) and, through the normals, gtn (12, M) and gsn (6, M), from gt (48, M), its last 12 rows, and gl2 (H, M); gout
    (12 + H, M). The scaled normals become rows H to H + 2 of l1."""
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    h, c = tl.arange(0, H), tl.arange(0, 16)
    y = by_column(t + 36 * M, r, c, M, 12)
    e = by_column(gt + 36 * M, r, c, M, 12) * (alpha - y * y / alpha)
    yb = by_column(l2, r, h, M, H)
    eb = by_column(gl2, r, h, M, H) * (alpha - yb * yb / alpha)
    if WEIGHTS:
        store_by_column(gout, e, r, c, M, 12)
        store_by_column(gout + 12 * M, eb, r, h, M, H)
    g = product(e, matrix(W3, c, h, H, 12, H), P)
    g += product(eb, matrix(W3 + 12 * H, h, h, H, H, H), P)
    _, nx, ny, nz, z1 = psi2_hidden(l1, t, s1, W1, b1, r, M, scale, H, P)
    if WEIGHTS:
        tl.store(l1 + H * M + r, nx)
        tl.store(l1 + (H + 1) * M + r, ny)
        tl.store(l1 + (H + 2) * M + r, nz)
    e1 = hidden_adjoint(g, z1, W2, b2, h1, h2, g1, g2, r, M, WEIGHTS, H, P)
    store_by_column(gl1, product(e1, matrix(W1, h, h, H + 3, H, H), P), r, h, M, H)
    kx = scale * tl.sum(e1 * tl.load(W1 + h * (H + 3) + H)[None, :], 1)
    ky = scale * tl.sum(e1 * tl.load(W1 + h * (H + 3) + H + 1)[None, :], 1)
    kz = scale * tl.sum(e1 * tl.load(W1 + h * (H + 3) + H + 2)[None, :], 1)
    xa, xb, xc = normal_adjoint(gtn, t, s1, kx, r, M, 0, 5, 4)
    ya, yb_, yc = normal_adjoint(gtn, t, s1, ky, r, M, 1, 3, 5)
    za, zb, zc = normal_adjoint(gtn, t, s1, kz, r, M, 2, 4, 3)
    tl.store(gsn + r, xa)
    tl.store(gsn + M + r, ya)
    tl.store(gsn + 2 * M + r, za)
    tl.store(gsn + 3 * M + r, yb_ + zc)
    tl.store(gsn + 4 * M + r, zb + xc)
    tl.store(gsn + 5 * M + r, xb + yc)


@triton.jit(do_not_specialize=["N"])
def psi1_backward(
    w, s1, t, gt, gtn, gl1, W1, b1, W2, b2, W3, b3, Wp, bp, h1, h2, g1, g2, x, gplanes, gout, gw, gs, N, M, scale, alpha,
    WEIGHTS: tl.constexpr, H: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """gw, gs (6, M) of w and s1 from gt (48, M), its first 36 rows, gtn (12, M) of `psi2_backward`, and gl1 (H, M); x (12, M),
    gplanes (36, M), gout (H, M)."""
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    h, c, planes = tl.arange(0, H), tl.arange(0, 16), tl.arange(0, 64)
    place = planes % 12
    through_normals = (planes < 36) & ((place < 3) | (place == 6))
    source = 4 * (planes // 12) + tl.where(place == 6, 3, place)
    y = by_column(t, r, planes, M, 36)
    e = by_column(gt, r, planes, M, 36)
    e += tl.load(gtn + source[None, :] * M + r[:, None], mask=through_normals[None, :], other=0.0)
    e *= alpha - y * y / alpha
    g = by_column(gl1, r, h, M, H) + product(e, matrix(Wp, planes, h, H, 36, H), P)
    inputs = network_input(w, s1, r, N, M, scale, False)
    if WEIGHTS:
        store_by_column(gplanes, e, r, planes, M, 36)
        store_by_column(gout, g, r, h, M, H)
        store_by_column(x, inputs, r, c, M, 12)
    g = product(g, matrix(W3, h, h, H, H, H), P)
    z1 = dense(inputs, matrix(W1, h, c, 12, H, 12), tl.load(b1 + h), P)
    e1 = hidden_adjoint(g, z1, W2, b2, h1, h2, g1, g2, r, M, WEIGHTS, H, P)
    store_input_adjoint(gw, gs, scale * product(e1, matrix(W1, h, c, 12, H, 12), P), r, M)


@triton.jit(do_not_specialize=["N"])
def phi_backward(
    w, s, pre, gpre, extra, gs1, gsn, gsx, gwx, gwt, W1, b1, W2, b2, W3, b3, h1, h2, g1, g2, x, gout, gw, gs, N, M, scale, bound,
    BOUNDED: tl.constexpr, EXTRA: tl.constexpr, WEIGHTS: tl.constexpr, H: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """gw, gs (N, 6), everything added up: gs1, gsn, gsx (6, M) reach s1 from the assembly, the normals and Psi1; gpre (6, M) and
    extra (N, 6) reach pre, as s1 does; gwx, gwt (6, M) reach w from Psi1 and Theta. x (12, M), gout (6, M)."""
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    h, c = tl.arange(0, H), tl.arange(0, 16)
    inputs = network_input(w, s, r, N, M, scale, True)
    g = by_column(gs1, r, c, M, 6) + by_column(gsn, r, c, M, 6) + by_column(gsx, r, c, M, 6) + by_column(gpre, r, c, M, 6)
    if EXTRA:
        g += by_row(extra, r, c, N)
    if BOUNDED:
        y = by_column(pre, r, c, M, 6)
        g *= bound - y * y / bound
    if WEIGHTS:
        store_by_column(gout, g, r, c, M, 6)
        store_by_column(x, inputs, r, c, M, 12)
    g = product(g, matrix(W3, c, h, H, 6, H), P)
    z1 = dense(inputs, matrix(W1, h, c, 12, H, 12), tl.load(b1 + h), P)
    e1 = hidden_adjoint(g, z1, W2, b2, h1, h2, g1, g2, r, M, WEIGHTS, H, P)
    gx = scale * product(e1, matrix(W1, h, c, 12, H, 12), P)
    row, column = r[:, None], c[None, :]
    direct = by_column(gwx, r, c, M, 6) + by_column(gwt, r, c, M, 6)
    tl.store(gw + row * 6 + column, gx + direct, mask=(row < N) & (column < 6))
    of_s = (row < N) & (column >= 6) & (column < 12)
    at = (column - 6) * M + row
    direct = tl.load(gs1 + at, mask=of_s, other=0.0) + tl.load(gsn + at, mask=of_s, other=0.0)
    direct += tl.load(gsx + at, mask=of_s, other=0.0)
    tl.store(gs + row * 6 + column - 6, gx + direct, mask=of_s)


@triton.jit
def layer_gradient(
    g, x, at, M, OUT: tl.constexpr, IN: tl.constexpr, ROW: tl.constexpr, COLUMN: tl.constexpr,
    TILE: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """The tile (TILE, TILE) from (ROW, COLUMN) of g x^T, to a weight (OUT, IN) at `at`, and of the bias behind it."""
    out, into, k = ROW + tl.arange(0, TILE), COLUMN + tl.arange(0, TILE), tl.arange(0, BLOCK)
    weight, bias = tl.zeros((TILE, TILE), tl.float32), tl.zeros((TILE,), tl.float32)
    for tile in range(tl.program_id(0), M // BLOCK, tl.num_programs(0)):
        r = tile * BLOCK + k
        e = tl.load(g + out[:, None] * M + r[None, :], mask=out[:, None] < OUT, other=0.0)
        weight += product(e, by_column(x, r, into, M, IN), P)
        bias += tl.sum(e, 1)
    inside = (out[:, None] < OUT) & (into[None, :] < IN)
    tl.store(at + out[:, None] * IN + into[None, :], weight, mask=inside)
    if COLUMN == 0:
        tl.store(at + OUT * IN + out, bias, mask=out < OUT)


@triton.jit(do_not_specialize=["start"])
def weight_gradients(
    g1, x1, g2, h1, g3, h2, g4, x4, partial, start, size, M, IN1: tl.constexpr, OUT3: tl.constexpr, OUT4: tl.constexpr,
    H: tl.constexpr, TILE: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """Three layers of a network and, where OUT4 > 0, one more that reads x4 (H, M): weights and biases in order, from `start` of
    the program's row of `partial` (programs, size). Tiles of weights are spread over the second axis of the grid."""
    which = tl.program_id(1)
    at = partial + tl.program_id(0) * size + start
    at2 = at + H * IN1 + H
    at3 = at2 + H * H + H
    if which == 0:
        layer_gradient(g1, x1, at, M, H, IN1, 0, 0, TILE, BLOCK, P)
    elif which == 1:
        layer_gradient(g2, h1, at2, M, H, H, 0, 0, TILE, BLOCK, P)
    elif which == 2:
        layer_gradient(g3, h2, at3, M, OUT3, H, 0, 0, TILE, BLOCK, P)
    elif which == 3:
        if IN1 > TILE:
            layer_gradient(g1, x1, at, M, H, IN1, 0, TILE, TILE, BLOCK, P)
        if OUT4 > 0:
            layer_gradient(g4, x4, at3 + OUT3 * H + OUT3, M, OUT4, H, 0, 0, TILE, BLOCK, P)
    elif which == 4:
        if OUT3 > TILE:
            layer_gradient(g3, h2, at3, M, OUT3, H, TILE, 0, TILE, BLOCK, P)

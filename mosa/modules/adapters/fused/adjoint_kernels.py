"""Triton kernels of the backward pass of the four networks, hidden layers recomputed.

`*_backward` take tiles of BLOCK rows through the adjoint of a network. Gradients of its weights are sums of products over the rows,
a program's share of them in its own row of `partial` (programs, size), which torch adds up: no atomics, the same result every
time. SUMS says where they are made:
inside: in the same kernel, sums in registers. It saves 10 kB of memory traffic a row over the four networks, where weights and sums
    fit on a multiprocessor: single tf32 products, 64 columns.
outside: the kernel leaves, by column, what they are made of: h1, h2 activations and g1, g2 adjoints of the two hidden layers
    (H, M), x inputs, gout adjoints of the outputs; `sum_kernels.weight_gradients` multiplies them.
none: nobody wants them.
g..: adjoints. D., d.: sums of a weight's and a bias's gradient; a bias has a column of ones as its input.
"""

import triton
import triton.language as tl

from mosa.modules.adapters.fused.network_kernels import (
    by_column,
    factor,
    kept,
    layer,
    network_input,
    product,
    silu,
    store_by_column,
    tile_of,
    times,
)
from mosa.modules.adapters.fused.sum_kernels import (
    ones_column,
    outer,
    store_columns,
    store_hidden,
    store_square,
    with_ones,
)


@triton.jit
def by_row(p, r, c, rows):
    """(BLOCK, 16) tile of (rows, 6)."""
    return tl.load(
        p + r[:, None] * 6 + c[None, :], mask=(r[:, None] < rows) & (c[None, :] < 6), other=0.0
    )


@triton.jit
def seeds_of_b(gh, rest, unit, r, c, N, RESTED: tl.constexpr):
    """(BLOCK, 16) adjoints of b from those of h (N, 6) and their sum."""
    g = by_row(gh, r, c, N)
    if RESTED:
        g -= tl.where(r[:, None] == N, tl.load(rest + c, mask=c < 6, other=0.0)[None, :], 0.0)
    return tl.load(unit) * g


@triton.jit
def store_input_adjoint(gw, gs, g, r, M):
    """(6, M) adjoints of w and s from that of a network's input (BLOCK, 16)."""
    c = tl.arange(0, 16)
    store_by_column(gw, g, r, c, M, 6)
    column = c[None, :]
    tl.store(gs + (column - 6) * M + r[:, None], g, mask=(column >= 6) & (column < 12))


@triton.jit
def backward(W, OUT: tl.constexpr, IN: tl.constexpr, STRIDE: tl.constexpr, P: tl.constexpr):
    return factor(tile_of(W, OUT, IN, STRIDE), P)


@triton.jit
def kept_back(
    W, OUT: tl.constexpr, IN: tl.constexpr, STRIDE: tl.constexpr, KEEP: tl.constexpr, P: tl.constexpr
):  # fmt: skip
    """As `kept`, of the transposed product."""
    return backward(W, OUT, IN, STRIDE, P) if KEEP else W


@triton.jit
def back(
    g, U, OUT: tl.constexpr, IN: tl.constexpr, STRIDE: tl.constexpr, KEEP: tl.constexpr, P: tl.constexpr
):  # fmt: skip
    """Adjoint of what a layer reads from that of what it gives, g; U: its weight, `kept_back`."""
    return product(g, U if KEEP else backward(U, OUT, IN, STRIDE, P), P)


@triton.jit
def hidden_adjoint(
    g, z1, a1, k2, U2, D2, d2, h1, g1, g2, r, M, SUMS: tl.constexpr, H: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """(adjoint of z1, D2, d2) from g, that of the second layer's activations, whose slope is k2."""
    h = tl.arange(0, H)
    e2 = g * k2
    if SUMS == "inside":
        D2 += outer(e2, a1, P)
        d2 += outer(e2, ones_column(BLOCK), P)
    elif SUMS == "outside":
        store_by_column(h1, a1, r, h, M, H)
        store_by_column(g2, e2, r, h, M, H)
    _, k1 = silu(z1)
    e1 = back(e2, U2, H, H, H, SUMS == "inside", P) * k1
    if SUMS == "outside":
        store_by_column(g1, e1, r, h, M, H)
    return e1, D2, d2


@triton.jit(do_not_specialize=["N", "start"])
def theta_backward(
    l2, w, s2, post, gh, rest, unit, extra, W1, b1, W2, b2, W3, b3, h1, h2, g1, g2, gout, partial, gl2, gw, gs2, start, size, N, M,
    scale, bound, BOUNDED: tl.constexpr, RESTED: tl.constexpr, EXTRA: tl.constexpr, SUMS: tl.constexpr, H: tl.constexpr,
    BLOCK: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """gl2 (H, M), gw, gs2 (6, M) from the adjoints gh (N, 6) of h and extra (N, 6) of post; gout (6, M). Outside, the scaled
    (w, s2) becomes rows H to H + 11 of l2."""
    h, c = tl.arange(0, H), tl.arange(0, 16)
    KEEP: tl.constexpr = SUMS == "inside"
    V1, Vx = kept(W1, H, H, H + 12, KEEP, P), kept(W1 + H, H, 12, H + 12, KEEP, P)
    U1, Ux = kept_back(W1, H, H, H + 12, KEEP, P), kept_back(W1 + H, H, 12, H + 12, KEEP, P)
    V2, U2 = kept(W2, H, H, H, KEEP, P), kept_back(W2, H, H, H, KEEP, P)
    U3 = kept_back(W3, 6, H, H, KEEP, P)
    D1, D2 = tl.zeros((H, H), tl.float32), tl.zeros((H, H), tl.float32)
    Dx, d2, D3 = (
        tl.zeros((H, 16), tl.float32),
        tl.zeros((H, 16), tl.float32),
        tl.zeros((H, 16), tl.float32),
    )
    d3 = tl.zeros((BLOCK, 16), tl.float32)
    for tile in range(tl.program_id(0), M // BLOCK, tl.num_programs(0)):
        r = tile * BLOCK + tl.arange(0, BLOCK)
        x, of_state = by_column(l2, r, h, M, H), network_input(w, s2, w, r, N, M, scale, False)
        z1 = layer(x, V1, b1, H, H, H + 12, KEEP, P)
        z1 += times(of_state, Vx, H, 12, H + 12, KEEP, P)
        a1, _ = silu(z1)
        a2, k2 = silu(layer(a1, V2, b2, H, H, H, KEEP, P))
        g = seeds_of_b(gh, rest, unit, r, c, N, RESTED)
        if EXTRA:
            g += by_row(extra, r, c, N)
        if BOUNDED:
            y = by_column(post, r, c, M, 6)
            g *= bound - y * y / bound
        if SUMS == "inside":
            d3 += g
            D3 += outer(a2, g, P)
        elif SUMS == "outside":
            store_by_column(gout, g, r, c, M, 6)
            store_by_column(h2, a2, r, h, M, H)
            store_by_column(l2 + H * M, of_state, r, c, M, 12)
        g = back(g, U3, 6, H, H, KEEP, P)
        e1, D2, d2 = hidden_adjoint(g, z1, a1, k2, U2, D2, d2, h1, g1, g2, r, M, SUMS, H, BLOCK, P)
        if SUMS == "inside":
            D1 += outer(e1, x, P)
            Dx += outer(e1, with_ones(of_state, 12), P)
        store_by_column(
            gl2,
            back(e1, U1, H, H, H + 12, KEEP, P),
            r,
            h,
            M,
            H,
        )
        store_input_adjoint(
            gw,
            gs2,
            scale * back(e1, Ux, H, 12, H + 12, KEEP, P),
            r,
            M,
        )
    if SUMS == "inside":
        at = partial + tl.program_id(0) * size + start
        store_square(at, D1, H + 12, H)
        at = store_hidden(at, Dx, D2, d2, H + 12, 12, H)
        store_columns(at, D3, 1, H, 0, 6, H)
        tl.store(at + 6 * H + c, tl.sum(d3, 0), mask=c < 6)


@triton.jit(do_not_specialize=["N", "start"])
def psi2_backward(
    l1, t, l2, gt, gl2, W1, b1, W2, b2, W3, b3, h1, h2, g1, g2, gout, partial, gl1, start, size, N, M, alpha,
    SUMS: tl.constexpr, H: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """gl1 (H + 3, M), its last rows those of the scaled normals, from gt (48, M), its last 12 rows, and gl2 (H, M). Sums of the
    last layer are always made outside, from h2 (H, M) and gout (12 + H, M)."""
    h, c = tl.arange(0, H), tl.arange(0, 16)
    KEEP: tl.constexpr = SUMS == "inside"
    V1, Vx = kept(W1, H, H, H + 3, KEEP, P), kept(W1 + H, H, 3, H + 3, KEEP, P)
    U1, Ux = kept_back(W1, H, H, H + 3, KEEP, P), kept_back(W1 + H, H, 3, H + 3, KEEP, P)
    V2, U2 = kept(W2, H, H, H, KEEP, P), kept_back(W2, H, H, H, KEEP, P)
    U3, U4 = kept_back(W3, 12, H, H, KEEP, P), kept_back(W3 + 12 * H, H, H, H, KEEP, P)
    D1, D2 = tl.zeros((H, H), tl.float32), tl.zeros((H, H), tl.float32)
    Dx, d2 = tl.zeros((H, 16), tl.float32), tl.zeros((H, 16), tl.float32)
    for tile in range(tl.program_id(0), M // BLOCK, tl.num_programs(0)):
        r = tile * BLOCK + tl.arange(0, BLOCK)
        x, normals = by_column(l1, r, h, M, H), by_column(l1 + H * M, r, c, M, 3)
        z1 = layer(x, V1, b1, H, H, H + 3, KEEP, P)
        z1 += times(normals, Vx, H, 3, H + 3, KEEP, P)
        a1, _ = silu(z1)
        a2, k2 = silu(layer(a1, V2, b2, H, H, H, KEEP, P))
        y = by_column(t + 36 * M, r, c, M, 12)
        e = by_column(gt + 36 * M, r, c, M, 12) * (alpha - y * y / alpha)
        yb = by_column(l2, r, h, M, H)
        eb = by_column(gl2, r, h, M, H) * (alpha - yb * yb / alpha)
        if SUMS != "none":
            store_by_column(h2, a2, r, h, M, H)
            store_by_column(gout, e, r, c, M, 12)
            store_by_column(gout + 12 * M, eb, r, h, M, H)
        g = back(e, U3, 12, H, H, KEEP, P)
        g += back(eb, U4, H, H, H, KEEP, P)
        e1, D2, d2 = hidden_adjoint(g, z1, a1, k2, U2, D2, d2, h1, g1, g2, r, M, SUMS, H, BLOCK, P)
        if SUMS == "inside":
            D1 += outer(e1, x, P)
            Dx += outer(e1, with_ones(normals, 3), P)
        store_by_column(
            gl1,
            back(e1, U1, H, H, H + 3, KEEP, P),
            r,
            h,
            M,
            H,
        )
        store_by_column(
            gl1 + H * M,
            back(e1, Ux, H, 3, H + 3, KEEP, P),
            r,
            c,
            M,
            3,
        )
    if SUMS == "inside":
        at = partial + tl.program_id(0) * size + start
        store_square(at, D1, H + 3, H)
        store_hidden(at, Dx, D2, d2, H + 3, 3, H)


@triton.jit(do_not_specialize=["N", "start"])
def psi1_backward(
    w, s1, t, gt, gl1, l1, W1, b1, W2, b2, W3, b3, Wp, bp, h1, h2, g1, g2, x, gplanes, gout, partial, gw, gs, start, size, N,
    M, scale, alpha, SUMS: tl.constexpr, H: tl.constexpr, BLOCK: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """gw, gs (6, M) of w and s1 from gt (48, M), its first 36 rows, and gl1 (H, M); x (12, M), gplanes (36, M), gout (H, M)."""
    h, c, planes = tl.arange(0, H), tl.arange(0, 16), tl.arange(0, 64)
    KEEP: tl.constexpr = SUMS == "inside"
    V1, U1 = kept(W1, H, 12, 12, KEEP, P), kept_back(W1, H, 12, 12, KEEP, P)
    V2, U2 = kept(W2, H, H, H, KEEP, P), kept_back(W2, H, H, H, KEEP, P)
    U3, Up = kept_back(W3, H, H, H, KEEP, P), kept_back(Wp, 36, H, H, KEEP, P)
    D2, D3, Dp = (
        tl.zeros((H, H), tl.float32),
        tl.zeros((H, H), tl.float32),
        tl.zeros((64, H), tl.float32),
    )
    D1, d2, d3 = (
        tl.zeros((H, 16), tl.float32),
        tl.zeros((H, 16), tl.float32),
        tl.zeros((H, 16), tl.float32),
    )
    dp = tl.zeros((64, 16), tl.float32)
    for tile in range(tl.program_id(0), M // BLOCK, tl.num_programs(0)):
        r = tile * BLOCK + tl.arange(0, BLOCK)
        y = by_column(t, r, planes, M, 36)
        e = by_column(gt, r, planes, M, 36) * (alpha - y * y / alpha)
        g = by_column(gl1, r, h, M, H) + back(e, Up, 36, H, H, KEEP, P)
        if SUMS == "inside":
            Dp += outer(e, by_column(l1, r, h, M, H), P)
            dp += outer(e, ones_column(BLOCK), P)
        inputs = network_input(w, s1, w, r, N, M, scale, False)
        z1 = layer(inputs, V1, b1, H, 12, 12, KEEP, P)
        a1, _ = silu(z1)
        a2, k2 = silu(layer(a1, V2, b2, H, H, H, KEEP, P))
        if SUMS == "inside":
            D3 += outer(g, a2, P)
            d3 += outer(g, ones_column(BLOCK), P)
        elif SUMS == "outside":
            store_by_column(gplanes, e, r, planes, M, 36)
            store_by_column(gout, g, r, h, M, H)
            store_by_column(x, inputs, r, c, M, 12)
            store_by_column(h2, a2, r, h, M, H)
        g = back(g, U3, H, H, H, KEEP, P)
        e1, D2, d2 = hidden_adjoint(g, z1, a1, k2, U2, D2, d2, h1, g1, g2, r, M, SUMS, H, BLOCK, P)
        if SUMS == "inside":
            D1 += outer(e1, with_ones(inputs, 12), P)
        store_input_adjoint(
            gw,
            gs,
            scale * back(e1, U1, H, 12, 12, KEEP, P),
            r,
            M,
        )
    if SUMS == "inside":
        at = partial + tl.program_id(0) * size + start
        at = store_hidden(at, D1, D2, d2, 12, 12, H)
        store_square(at, D3, H, H)
        at += H * H
        store_columns(at, d3, 1, 0, 0, 1, H)
        at += H
        tl.store(at + planes[:, None] * H + h[None, :], Dp, mask=planes[:, None] < 36)
        at += 36 * H
        tl.store(
            at + planes[:, None] + 0 * c[None, :],
            dp,
            mask=(c[None, :] == 0) & (planes[:, None] < 36),
        )


@triton.jit(do_not_specialize=["N", "start"])
def phi_backward(
    w, s, unit, pre, gpre, extra, gs1, gsx, gwx, gwt, W1, b1, W2, b2, W3, b3, h1, h2, g1, g2, x, gout, partial, gw, gs, start, size,
    N, M, scale, bound, BOUNDED: tl.constexpr, EXTRA: tl.constexpr, SUMS: tl.constexpr, H: tl.constexpr, BLOCK: tl.constexpr,
    P: tl.constexpr,
):  # fmt: skip
    """gw, gs (N, 6), everything added up: gs1, gsx (6, M) reach s1 from the assembly with the normals, and from Psi1; gpre (6, M)
    and extra (N, 6) reach pre, as s1 does; gwx, gwt (6, M) reach w from Psi1 and Theta. x (12, M), gout (6, M)."""
    h, c = tl.arange(0, H), tl.arange(0, 16)
    KEEP: tl.constexpr = SUMS == "inside"
    V1, U1 = kept(W1, H, 12, 12, KEEP, P), kept_back(W1, H, 12, 12, KEEP, P)
    V2, U2 = kept(W2, H, H, H, KEEP, P), kept_back(W2, H, H, H, KEEP, P)
    U3 = kept_back(W3, 6, H, H, KEEP, P)
    D2 = tl.zeros((H, H), tl.float32)
    D1, d2, D3 = (
        tl.zeros((H, 16), tl.float32),
        tl.zeros((H, 16), tl.float32),
        tl.zeros((H, 16), tl.float32),
    )
    d3 = tl.zeros((BLOCK, 16), tl.float32)
    column = c[None, :]
    for tile in range(tl.program_id(0), M // BLOCK, tl.num_programs(0)):
        r = tile * BLOCK + tl.arange(0, BLOCK)
        row = r[:, None]
        inputs = network_input(w, s, unit, r, N, M, scale, True)
        g = by_column(gs1, r, c, M, 6) + by_column(gsx, r, c, M, 6) + by_column(gpre, r, c, M, 6)
        if EXTRA:
            g += by_row(extra, r, c, N)
        if BOUNDED:
            y = by_column(pre, r, c, M, 6)
            g *= bound - y * y / bound
        z1 = layer(inputs, V1, b1, H, 12, 12, KEEP, P)
        a1, _ = silu(z1)
        a2, k2 = silu(layer(a1, V2, b2, H, H, H, KEEP, P))
        if SUMS == "inside":
            d3 += g
            D3 += outer(a2, g, P)
        elif SUMS == "outside":
            store_by_column(gout, g, r, c, M, 6)
            store_by_column(x, inputs, r, c, M, 12)
            store_by_column(h2, a2, r, h, M, H)
        g = back(g, U3, 6, H, H, KEEP, P)
        e1, D2, d2 = hidden_adjoint(g, z1, a1, k2, U2, D2, d2, h1, g1, g2, r, M, SUMS, H, BLOCK, P)
        if SUMS == "inside":
            D1 += outer(e1, with_ones(inputs, 12), P)
        gx = scale * back(e1, U1, H, 12, 12, KEEP, P)
        direct = by_column(gwx, r, c, M, 6) + by_column(gwt, r, c, M, 6)
        tl.store(gw + row * 6 + column, gx + direct, mask=(row < N) & (column < 6))
        of_s = (row < N) & (column >= 6) & (column < 12)
        at = (column - 6) * M + row
        direct = tl.load(gs1 + at, mask=of_s, other=0.0) + tl.load(gsx + at, mask=of_s, other=0.0)
        tl.store(gs + row * 6 + column - 6, (gx + direct) / tl.load(unit), mask=of_s)
    if SUMS == "inside":
        at = partial + tl.program_id(0) * size + start
        at = store_hidden(at, D1, D2, d2, 12, 12, H)
        store_columns(at, D3, 1, H, 0, 6, H)
        tl.store(at + 6 * H + c, tl.sum(d3, 0), mask=c < 6)

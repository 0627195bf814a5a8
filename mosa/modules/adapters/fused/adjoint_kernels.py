"""Triton kernels of the backward pass of the four networks, hidden layers recomputed.

Gradients of a network's weights are sums of products over the rows: with WANTED a kernel leaves, by
column, what they are made of: h1, h2 activations and g1, g2 adjoints of the hidden layers (H, M), x
inputs, gout adjoints of the outputs; `sum_kernels.weight_gradients` multiplies them. g..: adjoints.
"""

import triton
import triton.language as tl

from mosa.modules.adapters.fused.network_kernels import (
    by_column,
    layer,
    network_input,
    product,
    silu,
    store_by_column,
    tile_of,
    times,
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
def back(g, W, OUT: tl.constexpr, IN: tl.constexpr, STRIDE: tl.constexpr):
    """Adjoint of what a layer reads from that of what it gives, g."""
    return product(g, tile_of(W, OUT, IN, STRIDE))


@triton.jit
def hidden_adjoint(g, z1, a1, k2, W2, h1, g1, g2, r, M, WANTED: tl.constexpr, H: tl.constexpr):
    """Adjoint of z1 from g, that of the second layer's activations, whose slope is k2."""
    h = tl.arange(0, H)
    e2 = g * k2
    if WANTED:
        store_by_column(h1, a1, r, h, M, H)
        store_by_column(g2, e2, r, h, M, H)
    _, k1 = silu(z1)
    e1 = back(e2, W2, H, H, H) * k1
    if WANTED:
        store_by_column(g1, e1, r, h, M, H)
    return e1


@triton.jit(do_not_specialize=["N"])
def theta_backward(
    l2, w, s2, post, gh, rest, unit, extra, W1, b1, W2, b2, W3, b3, h1, h2, g1, g2, gout, gl2, gw, gs2, N, M,
    scale, bound, BOUNDED: tl.constexpr, RESTED: tl.constexpr, EXTRA: tl.constexpr, WANTED: tl.constexpr, H: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """gl2 (H, M), gw, gs2 (6, M) from the adjoints gh (N, 6) of h and extra (N, 6) of post; gout (6, M). With WANTED the
    scaled (w, s2) becomes rows H to H + 11 of l2."""
    h, c = tl.arange(0, H), tl.arange(0, 16)
    for tile in range(tl.program_id(0), M // BLOCK, tl.num_programs(0)):
        r = tile * BLOCK + tl.arange(0, BLOCK)
        x, of_state = by_column(l2, r, h, M, H), network_input(w, s2, w, r, N, M, scale, False)
        z1 = layer(x, W1, b1, H, H, H + 12)
        z1 += times(of_state, W1 + H, H, 12, H + 12)
        a1, _ = silu(z1)
        a2, k2 = silu(layer(a1, W2, b2, H, H, H))
        g = seeds_of_b(gh, rest, unit, r, c, N, RESTED)
        if EXTRA:
            g += by_row(extra, r, c, N)
        if BOUNDED:
            y = by_column(post, r, c, M, 6)
            g *= bound - y * y / bound
        if WANTED:
            store_by_column(gout, g, r, c, M, 6)
            store_by_column(h2, a2, r, h, M, H)
            store_by_column(l2 + H * M, of_state, r, c, M, 12)
        g = back(g, W3, 6, H, H)
        e1 = hidden_adjoint(g, z1, a1, k2, W2, h1, g1, g2, r, M, WANTED, H)
        store_by_column(gl2, back(e1, W1, H, H, H + 12), r, h, M, H)
        store_input_adjoint(gw, gs2, scale * back(e1, W1 + H, H, 12, H + 12), r, M)


@triton.jit(do_not_specialize=["N"])
def psi2_backward(
    l1, t, l2, gt, gl2, W1, b1, W2, b2, W3, b3, h1, h2, g1, g2, gout, gl1, N, M, alpha,
    WANTED: tl.constexpr, H: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """gl1 (H + 3, M), its last rows those of the scaled normals, from gt (48, M), its last 12 rows, and gl2 (H, M);
    gout (12 + H, M)."""
    h, c = tl.arange(0, H), tl.arange(0, 16)
    for tile in range(tl.program_id(0), M // BLOCK, tl.num_programs(0)):
        r = tile * BLOCK + tl.arange(0, BLOCK)
        x, normals = by_column(l1, r, h, M, H), by_column(l1 + H * M, r, c, M, 3)
        z1 = layer(x, W1, b1, H, H, H + 3)
        z1 += times(normals, W1 + H, H, 3, H + 3)
        a1, _ = silu(z1)
        a2, k2 = silu(layer(a1, W2, b2, H, H, H))
        y = by_column(t + 36 * M, r, c, M, 12)
        e = by_column(gt + 36 * M, r, c, M, 12) * (alpha - y * y / alpha)
        yb = by_column(l2, r, h, M, H)
        eb = by_column(gl2, r, h, M, H) * (alpha - yb * yb / alpha)
        if WANTED:
            store_by_column(h2, a2, r, h, M, H)
            store_by_column(gout, e, r, c, M, 12)
            store_by_column(gout + 12 * M, eb, r, h, M, H)
        g = back(e, W3, 12, H, H)
        g += back(eb, W3 + 12 * H, H, H, H)
        e1 = hidden_adjoint(g, z1, a1, k2, W2, h1, g1, g2, r, M, WANTED, H)
        store_by_column(gl1, back(e1, W1, H, H, H + 3), r, h, M, H)
        store_by_column(gl1 + H * M, back(e1, W1 + H, H, 3, H + 3), r, c, M, 3)


@triton.jit(do_not_specialize=["N"])
def psi1_backward(
    w, s1, t, gt, gl1, l1, W1, b1, W2, b2, W3, b3, Wp, bp, h1, h2, g1, g2, x, gplanes, gout, gw, gs, N,
    M, scale, alpha, WANTED: tl.constexpr, H: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """gw, gs (6, M) of w and s1 from gt (48, M), its first 36 rows, and gl1 (H, M); x (12, M), gplanes (36, M), gout (H, M)."""
    h, c, planes = tl.arange(0, H), tl.arange(0, 16), tl.arange(0, 64)
    for tile in range(tl.program_id(0), M // BLOCK, tl.num_programs(0)):
        r = tile * BLOCK + tl.arange(0, BLOCK)
        y = by_column(t, r, planes, M, 36)
        e = by_column(gt, r, planes, M, 36) * (alpha - y * y / alpha)
        g = by_column(gl1, r, h, M, H) + back(e, Wp, 36, H, H)
        inputs = network_input(w, s1, w, r, N, M, scale, False)
        z1 = layer(inputs, W1, b1, H, 12, 12)
        a1, _ = silu(z1)
        a2, k2 = silu(layer(a1, W2, b2, H, H, H))
        if WANTED:
            store_by_column(gplanes, e, r, planes, M, 36)
            store_by_column(gout, g, r, h, M, H)
            store_by_column(x, inputs, r, c, M, 12)
            store_by_column(h2, a2, r, h, M, H)
        g = back(g, W3, H, H, H)
        e1 = hidden_adjoint(g, z1, a1, k2, W2, h1, g1, g2, r, M, WANTED, H)
        store_input_adjoint(gw, gs, scale * back(e1, W1, H, 12, 12), r, M)


@triton.jit(do_not_specialize=["N"])
def phi_backward(
    w, s, unit, pre, gpre, extra, gs1, gsx, gwx, gwt, W1, b1, W2, b2, W3, b3, h1, h2, g1, g2, x, gout, gw, gs,
    N, M, scale, bound, BOUNDED: tl.constexpr, EXTRA: tl.constexpr, WANTED: tl.constexpr, H: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """gw, gs (N, 6), everything added up: gs1, gsx (6, M) reach s1 from the assembly with the normals, and from Psi1; gpre (6, M)
    and extra (N, 6) reach pre, as s1 does; gwx, gwt (6, M) reach w from Psi1 and Theta. x (12, M), gout (6, M)."""
    h, c = tl.arange(0, H), tl.arange(0, 16)
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
        z1 = layer(inputs, W1, b1, H, 12, 12)
        a1, _ = silu(z1)
        a2, k2 = silu(layer(a1, W2, b2, H, H, H))
        if WANTED:
            store_by_column(gout, g, r, c, M, 6)
            store_by_column(x, inputs, r, c, M, 12)
            store_by_column(h2, a2, r, h, M, H)
        g = back(g, W3, 6, H, H)
        e1 = hidden_adjoint(g, z1, a1, k2, W2, h1, g1, g2, r, M, WANTED, H)
        gx = scale * back(e1, W1, H, 12, 12)
        direct = by_column(gwx, r, c, M, 6) + by_column(gwt, r, c, M, 6)
        tl.store(gw + row * 6 + column, gx + direct, mask=(row < N) & (column < 6))
        of_s = (row < N) & (column >= 6) & (column < 12)
        at = (column - 6) * M + row
        direct = tl.load(gs1 + at, mask=of_s, other=0.0) + tl.load(gsx + at, mask=of_s, other=0.0)
        tl.store(gs + row * 6 + column - 6, (gx + direct) / tl.load(unit), mask=of_s)

"""Triton kernels of the assembly (paper, eq. 5 to 7; `microplane`), one lane per particle, with hand-written adjoints.

Plane p has the components (p, c1, c2) of vech: (xx, xy, zx), (yy, yz, xy), (zz, zx, yz). Each shear is the second component of one
plane and the third of the next, and their mean; so with planes in cyclic order all three are treated alike.
t: (48, M) bounded numbers, 12 a matrix, C_x, C_y, C_z, C_xyz; s1, pre: (6, M). The 6x6 operator G = A - I and its action on s1 and
on pre are made in one pass.
"""

import triton
import triton.language as tl


@triton.jit
def numbers(t, r, M, first: tl.constexpr):
    """The 12 numbers of a matrix: upper triangle row by row, then lower."""
    p = t + first * M + r
    return (
        tl.load(p), tl.load(p + M), tl.load(p + 2 * M),
        tl.load(p + 3 * M), tl.load(p + 4 * M), tl.load(p + 5 * M),
        tl.load(p + 6 * M), tl.load(p + 7 * M), tl.load(p + 8 * M),
        tl.load(p + 9 * M), tl.load(p + 10 * M), tl.load(p + 11 * M),
    )  # fmt: skip


@triton.jit
def correction(t, r, M, first: tl.constexpr):
    """The nine entries of C = (I + L)(I + U) - I, row by row."""
    u00, u01, u02, u11, u12, u22, l00, l10, l11, l20, l21, l22 = numbers(t, r, M, first)
    return (
        l00 + u00 + l00 * u00, u01 + l00 * u01, u02 + l00 * u02,
        l10 + l10 * u00, l11 + u11 + l10 * u01 + l11 * u11, u12 + l10 * u02 + l11 * u12,
        l20 + l20 * u00, l21 + l20 * u01 + l21 * u11, l22 + u22 + l20 * u02 + l21 * u12 + l22 * u22,
    )  # fmt: skip


@triton.jit
def correction_adjoint(
    t, gt, extra, r, N, M, first: tl.constexpr, EXTRA: tl.constexpr, a00, a01, a02, a10, a11, a12, a20, a21, a22
):
    """Store the adjoints of the 12 numbers of a matrix, from those of its entries; extra: (N, 48) adjoints from elsewhere."""
    u00, u01, u02, u11, u12, u22, l00, l10, l11, l20, l21, l22 = numbers(t, r, M, first)
    adjoint(gt, extra, r, N, M, first, EXTRA, a00 * (1.0 + l00) + a10 * l10 + a20 * l20)
    adjoint(gt, extra, r, N, M, first + 1, EXTRA, a01 * (1.0 + l00) + a11 * l10 + a21 * l20)
    adjoint(gt, extra, r, N, M, first + 2, EXTRA, a02 * (1.0 + l00) + a12 * l10 + a22 * l20)
    adjoint(gt, extra, r, N, M, first + 3, EXTRA, a11 * (1.0 + l11) + a21 * l21)
    adjoint(gt, extra, r, N, M, first + 4, EXTRA, a12 * (1.0 + l11) + a22 * l21)
    adjoint(gt, extra, r, N, M, first + 5, EXTRA, a22 * (1.0 + l22))
    adjoint(gt, extra, r, N, M, first + 6, EXTRA, a00 * (1.0 + u00) + a01 * u01 + a02 * u02)
    adjoint(gt, extra, r, N, M, first + 7, EXTRA, a10 * (1.0 + u00) + a11 * u01 + a12 * u02)
    adjoint(gt, extra, r, N, M, first + 8, EXTRA, a11 * (1.0 + u11) + a12 * u12)
    adjoint(gt, extra, r, N, M, first + 9, EXTRA, a20 * (1.0 + u00) + a21 * u01 + a22 * u02)
    adjoint(gt, extra, r, N, M, first + 10, EXTRA, a21 * (1.0 + u11) + a22 * u12)
    adjoint(gt, extra, r, N, M, first + 11, EXTRA, a22 * (1.0 + u22))


@triton.jit
def adjoint(gt, extra, r, N, M, row: tl.constexpr, EXTRA: tl.constexpr, value):
    if EXTRA:
        value += tl.load(extra + r * 48 + row, mask=r < N, other=0.0)
    tl.store(gt + row * M + r, value)


@triton.jit
def components(v, r, M, plane: tl.constexpr, c1: tl.constexpr, c2: tl.constexpr):
    return (
        tl.load(v + plane * M + r),
        tl.load(v + c1 * M + r),
        tl.load(v + c2 * M + r),
    )


@triton.jit
def on_plane(v, r, M, plane: tl.constexpr, c1: tl.constexpr, c2: tl.constexpr, C):
    """(I + C) on the components of v (6, M) on a plane."""
    a, b, c = components(v, r, M, plane, c1, c2)
    return a + C[0] * a + C[1] * b + C[2] * c, b + C[3] * a + C[4] * b + C[5] * c, c + C[6] * a + C[7] * b + C[8] * c


@triton.jit
def store_moved(out, r, M, K, x, y, z):
    """(I + G) v (6, M) from (I + C) of v on the three planes; K: entries of C_xyz."""
    tl.store(out + r, x[0] + K[0] * x[0] + K[1] * y[0] + K[2] * z[0])
    tl.store(out + M + r, y[0] + K[3] * x[0] + K[4] * y[0] + K[5] * z[0])
    tl.store(out + 2 * M + r, z[0] + K[6] * x[0] + K[7] * y[0] + K[8] * z[0])
    tl.store(out + 3 * M + r, 0.5 * (y[1] + z[2]))
    tl.store(out + 4 * M + r, 0.5 * (z[1] + x[2]))
    tl.store(out + 5 * M + r, 0.5 * (x[1] + y[2]))


@triton.jit
def entry(G, r, N, row: tl.constexpr, column: tl.constexpr, value):
    tl.store(G + r * 36 + row * 6 + column, value, mask=r < N)


@triton.jit
def store_operator(
    G, r, N, p: tl.constexpr, q: tl.constexpr, third: tl.constexpr, sp: tl.constexpr, sq: tl.constexpr, s3: tl.constexpr,
    C, D, k0, k1, k2, m0, m1, m2,
):  # fmt: skip
    """Columns p and sp of the normal rows and the row sp of G. Planes p and q = p + 1 have the corrections C and D; sp, sq, s3: the
    shears that are the second components of p, q and the third plane; k, m: columns p and q of C_xyz."""
    entry(G, r, N, 0, p, k0 * (1.0 + C[0]) + (C[0] if p == 0 else 0.0))
    entry(G, r, N, 1, p, k1 * (1.0 + C[0]) + (C[0] if p == 1 else 0.0))
    entry(G, r, N, 2, p, k2 * (1.0 + C[0]) + (C[0] if p == 2 else 0.0))
    entry(G, r, N, 0, sp, k0 * C[1] + m0 * D[2] + (C[1] if p == 0 else 0.0) + (D[2] if q == 0 else 0.0))
    entry(G, r, N, 1, sp, k1 * C[1] + m1 * D[2] + (C[1] if p == 1 else 0.0) + (D[2] if q == 1 else 0.0))
    entry(G, r, N, 2, sp, k2 * C[1] + m2 * D[2] + (C[1] if p == 2 else 0.0) + (D[2] if q == 2 else 0.0))
    entry(G, r, N, sp, p, 0.5 * C[3])
    entry(G, r, N, sp, sp, 0.5 * (C[4] + D[8]))
    entry(G, r, N, sp, s3, 0.5 * C[5])
    entry(G, r, N, sp, q, 0.5 * D[6])
    entry(G, r, N, sp, sq, 0.5 * D[7])
    entry(G, r, N, sp, third, 0.0 * C[0])  # no plane holds both


@triton.jit(do_not_specialize=["N"])
def assemble(t, s1, pre, G, s2, moved, N, M, OPERATOR: tl.constexpr, BLOCK: tl.constexpr):
    """s2 = (I + G) s1 and moved = (I + G) pre, each (6, M); OPERATOR: also G (N, 6, 6)."""
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    X, Y, Z, K = correction(t, r, M, 0), correction(t, r, M, 12), correction(t, r, M, 24), correction(t, r, M, 36)
    store_moved(s2, r, M, K, on_plane(s1, r, M, 0, 5, 4, X), on_plane(s1, r, M, 1, 3, 5, Y), on_plane(s1, r, M, 2, 4, 3, Z))
    if OPERATOR:
        store_moved(
            moved, r, M, K, on_plane(pre, r, M, 0, 5, 4, X), on_plane(pre, r, M, 1, 3, 5, Y), on_plane(pre, r, M, 2, 4, 3, Z)
        )
        store_operator(G, r, N, 0, 1, 2, 5, 3, 4, X, Y, K[0], K[3], K[6], K[1], K[4], K[7])
        store_operator(G, r, N, 1, 2, 0, 3, 4, 5, Y, Z, K[1], K[4], K[7], K[2], K[5], K[8])
        store_operator(G, r, N, 2, 0, 1, 4, 5, 3, Z, X, K[2], K[5], K[8], K[0], K[3], K[6])


@triton.jit
def moved_adjoint(v, seed, r, N, M, p: tl.constexpr, c1: tl.constexpr, c2: tl.constexpr, C, k0, k1, k2, ROWS: tl.constexpr):
    """Of out = (I + G) v, seen from plane p. seed: adjoint of out, (N + 1, 6) where ROWS, else (6, M); k: column p of C_xyz.

    Returns the normal traction n, the seeds of the three normals, those of the plane's tractions, its components of v, and the
    adjoints of these components.
    """
    row = 1 if ROWS else M
    at = seed + (r * 6 if ROWS else r)
    known = (r <= N) if ROWS else (r >= 0)
    g0 = tl.load(at, mask=known, other=0.0)
    g1 = tl.load(at + row, mask=known, other=0.0)
    g2 = tl.load(at + 2 * row, mask=known, other=0.0)
    own = g0 if p == 0 else (g1 if p == 1 else g2)
    y0 = own + k0 * g0 + k1 * g1 + k2 * g2
    y1 = 0.5 * tl.load(at + c1 * row, mask=known, other=0.0)
    y2 = 0.5 * tl.load(at + c2 * row, mask=known, other=0.0)
    a, b, c = components(v, r, M, p, c1, c2)
    n = a + C[0] * a + C[1] * b + C[2] * c
    return (
        n, g0, g1, g2, y0, y1, y2, a, b, c,
        y0 + C[0] * y0 + C[3] * y1 + C[6] * y2, y1 + C[1] * y0 + C[4] * y1 + C[7] * y2, y2 + C[2] * y0 + C[5] * y1 + C[8] * y2,
    )  # fmt: skip


@triton.jit
def seed_of(gG, r, N, row: tl.constexpr, column: tl.constexpr):
    return tl.load(gG + r * 36 + row * 6 + column, mask=r < N, other=0.0)


@triton.jit
def plane_adjoint(
    t, s1, pre, gG, gb, gs2, gt, extra, r, N, M, p: tl.constexpr, c1: tl.constexpr, c2: tl.constexpr, k0, k1, k2,
    EXTRA: tl.constexpr,
):  # fmt: skip
    """Stores the adjoints of the plane's numbers; returns those of column p of C_xyz (3), of the plane's components of s1 (3) and
    of pre (3)."""
    C = correction(t, r, M, 12 * p)
    n, g0, g1, g2, y0, y1, y2, a, b, c, v0, v1, v2 = moved_adjoint(s1, gs2, r, N, M, p, c1, c2, C, k0, k1, k2, False)
    j, f0, f1, f2, x0, x1, x2, d, e, f, p0, p1, p2 = moved_adjoint(pre, gb, r, N, M, p, c1, c2, C, k0, k1, k2, True)
    q00, q01, q02 = seed_of(gG, r, N, 0, p), seed_of(gG, r, N, 0, c1), seed_of(gG, r, N, 0, c2)
    q10, q11, q12 = seed_of(gG, r, N, 1, p), seed_of(gG, r, N, 1, c1), seed_of(gG, r, N, 1, c2)
    q20, q21, q22 = seed_of(gG, r, N, 2, p), seed_of(gG, r, N, 2, c1), seed_of(gG, r, N, 2, c2)
    h0 = g0 * n + f0 * j + q00 + q00 * C[0] + q01 * C[1] + q02 * C[2]
    h1 = g1 * n + f1 * j + q10 + q10 * C[0] + q11 * C[1] + q12 * C[2]
    h2 = g2 * n + f2 * j + q20 + q20 * C[0] + q21 * C[1] + q22 * C[2]
    o0 = q00 if p == 0 else (q10 if p == 1 else q20)
    o1 = q01 if p == 0 else (q11 if p == 1 else q21)
    o2 = q02 if p == 0 else (q12 if p == 1 else q22)
    correction_adjoint(
        t, gt, extra, r, N, M, 12 * p, EXTRA,
        y0 * a + x0 * d + o0 + k0 * q00 + k1 * q10 + k2 * q20,
        y0 * b + x0 * e + o1 + k0 * q01 + k1 * q11 + k2 * q21,
        y0 * c + x0 * f + o2 + k0 * q02 + k1 * q12 + k2 * q22,
        y1 * a + x1 * d + 0.5 * seed_of(gG, r, N, c1, p),
        y1 * b + x1 * e + 0.5 * seed_of(gG, r, N, c1, c1),
        y1 * c + x1 * f + 0.5 * seed_of(gG, r, N, c1, c2),
        y2 * a + x2 * d + 0.5 * seed_of(gG, r, N, c2, p),
        y2 * b + x2 * e + 0.5 * seed_of(gG, r, N, c2, c1),
        y2 * c + x2 * f + 0.5 * seed_of(gG, r, N, c2, c2),
    )  # fmt: skip
    return h0, h1, h2, v0, v1, v2, p0, p1, p2


@triton.jit
def store_six(out, r, M, a, b, c, d, e, f):
    tl.store(out + r, a)
    tl.store(out + M + r, b)
    tl.store(out + 2 * M + r, c)
    tl.store(out + 3 * M + r, d)
    tl.store(out + 4 * M + r, e)
    tl.store(out + 5 * M + r, f)


@triton.jit(do_not_specialize=["N"])
def assemble_adjoint(
    t, s1, pre, gG, gb, gs2, extra, gt, gs1, gpre, N, M, EXTRA: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    """From the adjoints gG (N, 6, 6) of G, gb (M, 6) of moved and gs2 (6, M) of s2: gt (48, M), gs1 and gpre (6, M)."""
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    K = correction(t, r, M, 36)
    x0, x1, x2, xa, xb, xc, xd, xe, xf = plane_adjoint(
        t, s1, pre, gG, gb, gs2, gt, extra, r, N, M, 0, 5, 4, K[0], K[3], K[6], EXTRA
    )
    y0, y1, y2, ya, yb, yc, yd, ye, yf = plane_adjoint(
        t, s1, pre, gG, gb, gs2, gt, extra, r, N, M, 1, 3, 5, K[1], K[4], K[7], EXTRA
    )
    z0, z1, z2, za, zb, zc, zd, ze, zf = plane_adjoint(
        t, s1, pre, gG, gb, gs2, gt, extra, r, N, M, 2, 4, 3, K[2], K[5], K[8], EXTRA
    )
    correction_adjoint(t, gt, extra, r, N, M, 36, EXTRA, x0, y0, z0, x1, y1, z1, x2, y2, z2)
    store_six(gs1, r, M, xa, ya, za, yb + zc, zb + xc, xb + yc)
    store_six(gpre, r, M, xd, yd, zd, ye + zf, ze + xf, xe + yf)

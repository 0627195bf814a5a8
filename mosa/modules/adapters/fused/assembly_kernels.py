"""Triton kernels between the networks (paper, eq. 5 to 7; `microplane`), one lane per particle, with hand-written adjoints.

Plane p has the components (p, c1, c2) of vech: (xx, xy, zx), (yy, yz, xy), (zz, zx, yz). Each shear is the second component of one
plane and the third of the next, and their mean; so with planes in cyclic order all three are treated alike.
t: (48, M) bounded numbers, 12 a matrix, C_x, C_y, C_z, C_xyz; s1, pre: (6, M). The 6x6 operator G = A - I and its action on s1 and
on pre are made in one pass. D: the diagonal that both factors of a matrix start from, 1 where C = (I + L)(I + U) - I, the offset e
where C is (e I + L)(e I + U) itself. `finish` turns b (6, M), row N the state at rest, into h = unit (b - b at rest); gh (N, 6):
adjoint of h, rest (6,): its sum over the particles.
"""

import os

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
def correction(t, r, M, first: tl.constexpr, D: tl.constexpr):
    """The nine entries of C, row by row."""
    own: tl.constexpr = 0.0 if D == 1.0 else D * D
    u00, u01, u02, u11, u12, u22, l00, l10, l11, l20, l21, l22 = numbers(t, r, M, first)
    return (
        own + D * (l00 + u00) + l00 * u00, D * u01 + l00 * u01, D * u02 + l00 * u02,
        D * l10 + l10 * u00, own + D * (l11 + u11) + l10 * u01 + l11 * u11, D * u12 + l10 * u02 + l11 * u12,
        D * l20 + l20 * u00, D * l21 + l20 * u01 + l21 * u11, own + D * (l22 + u22) + l20 * u02 + l21 * u12 + l22 * u22,
    )  # fmt: skip


@triton.jit
def correction_adjoint(
    t, gt, extra, r, N, M, first: tl.constexpr, EXTRA: tl.constexpr, D: tl.constexpr,
    a00, a01, a02, a10, a11, a12, a20, a21, a22,
):  # fmt: skip
    """Store the adjoints of the 12 numbers of a matrix, from those of its entries; extra: (N, 48) adjoints from elsewhere."""
    u00, u01, u02, u11, u12, u22, l00, l10, l11, l20, l21, l22 = numbers(t, r, M, first)
    adjoint(gt, extra, r, N, M, first, EXTRA, a00 * (D + l00) + a10 * l10 + a20 * l20)
    adjoint(gt, extra, r, N, M, first + 1, EXTRA, a01 * (D + l00) + a11 * l10 + a21 * l20)
    adjoint(gt, extra, r, N, M, first + 2, EXTRA, a02 * (D + l00) + a12 * l10 + a22 * l20)
    adjoint(gt, extra, r, N, M, first + 3, EXTRA, a11 * (D + l11) + a21 * l21)
    adjoint(gt, extra, r, N, M, first + 4, EXTRA, a12 * (D + l11) + a22 * l21)
    adjoint(gt, extra, r, N, M, first + 5, EXTRA, a22 * (D + l22))
    adjoint(gt, extra, r, N, M, first + 6, EXTRA, a00 * (D + u00) + a01 * u01 + a02 * u02)
    adjoint(gt, extra, r, N, M, first + 7, EXTRA, a10 * (D + u00) + a11 * u01 + a12 * u02)
    adjoint(gt, extra, r, N, M, first + 8, EXTRA, a11 * (D + u11) + a12 * u12)
    adjoint(gt, extra, r, N, M, first + 9, EXTRA, a20 * (D + u00) + a21 * u01 + a22 * u02)
    adjoint(gt, extra, r, N, M, first + 10, EXTRA, a21 * (D + u11) + a22 * u12)
    adjoint(gt, extra, r, N, M, first + 11, EXTRA, a22 * (D + u22))


@triton.jit
def adjoint(gt, extra, r, N, M, row: tl.constexpr, EXTRA: tl.constexpr, value):
    if EXTRA:
        value += tl.load(extra + r * 48 + row, mask=r < N, other=0.0)
    tl.store(gt + row * M + r, value)


@triton.jit
def components(v, r, M, plane: tl.constexpr, c1: tl.constexpr, c2: tl.constexpr):
    return (tl.load(v + plane * M + r), tl.load(v + c1 * M + r), tl.load(v + c2 * M + r))


@triton.jit
def on_plane(v, r, M, plane: tl.constexpr, c1: tl.constexpr, c2: tl.constexpr, C):
    """(I + C) on the components of v (6, M) on a plane."""
    a, b, c = components(v, r, M, plane, c1, c2)
    return (
        a + C[0] * a + C[1] * b + C[2] * c,
        b + C[3] * a + C[4] * b + C[5] * c,
        c + C[6] * a + C[7] * b + C[8] * c,
    )


@triton.jit
def store_moved(v, out, r, M, X, Y, Z, K, mine):
    """Rows r of (I + G) v (6, M) where `mine`. X, Y, Z: corrections of the planes, K: entries of C_xyz."""
    x, y, z = (
        on_plane(v, r, M, 0, 5, 4, X),
        on_plane(v, r, M, 1, 3, 5, Y),
        on_plane(v, r, M, 2, 4, 3, Z),
    )
    tl.store(out + r, x[0] + K[0] * x[0] + K[1] * y[0] + K[2] * z[0], mask=mine)
    tl.store(out + M + r, y[0] + K[3] * x[0] + K[4] * y[0] + K[5] * z[0], mask=mine)
    tl.store(out + 2 * M + r, z[0] + K[6] * x[0] + K[7] * y[0] + K[8] * z[0], mask=mine)
    tl.store(out + 3 * M + r, 0.5 * (y[1] + z[2]), mask=mine)
    tl.store(out + 4 * M + r, 0.5 * (z[1] + x[2]), mask=mine)
    tl.store(out + 5 * M + r, 0.5 * (x[1] + y[2]), mask=mine)


@triton.jit
def normal_columns(X, p: tl.constexpr, k0, k1, k2):
    """Column p of the normal rows of G; X: correction of plane p, k: column p of C_xyz."""
    x = 1.0 + X[0]
    return (
        k0 * x + (X[0] if p == 0 else 0.0),
        k1 * x + (X[0] if p == 1 else 0.0),
        k2 * x + (X[0] if p == 2 else 0.0),
    )


@triton.jit
def shear_columns(C, D, p: tl.constexpr, k0, k1, k2, m0, m1, m2):
    """The column of the normal rows of G at the shear that is the second component of plane p (correction C, column k of C_xyz) and
    the third of plane p + 1 (D, m)."""
    c, d = C[1], D[2]
    own0 = c if p == 0 else (d if p == 2 else 0.0)
    own1 = c if p == 1 else (d if p == 0 else 0.0)
    own2 = c if p == 2 else (d if p == 1 else 0.0)
    return k0 * c + m0 * d + own0, k1 * c + m1 * d + own1, k2 * c + m2 * d + own2


if os.environ.get("TRITON_INTERPRET") == "1":

    @triton.jit
    def store_four(G, r, first: tl.constexpr, a, b, c, d, mine):
        p = G + r * 36 + first
        tl.store(p, a, mask=mine)
        tl.store(p + 1, b, mask=mine)
        tl.store(p + 2, c, mask=mine)
        tl.store(p + 3, d, mask=mine)

else:

    @triton.jit
    def store_four(G, r, first: tl.constexpr, a, b, c, d, mine):
        """Entries first to first + 3 of rows r of G (N, 36), where `mine`: in one access, of which each alone would be one."""
        tl.inline_asm_elementwise(
            "{ .reg .pred p; setp.ne.s32 p, $6, 0; @p st.global.v4.f32 [$1], {$2, $3, $4, $5}; mov.b32 $0, 0; }",
            "=r,l,f,f,f,f,r",
            [(G + r * 36 + first).to(tl.uint64), a, b, c, d, mine.to(tl.int32)],
            dtype=tl.int32, is_pure=False, pack=1,
        )  # fmt: skip


@triton.jit
def store_operator(G, r, X, Y, Z, K, mine, others):
    """Rows r of G (N, 6, 6): of the nine groups of four entries the odd ones where `mine`, the rest where `others`."""
    a00, a10, a20 = normal_columns(X, 0, K[0], K[3], K[6])
    a01, a11, a21 = normal_columns(Y, 1, K[1], K[4], K[7])
    a02, a12, a22 = normal_columns(Z, 2, K[2], K[5], K[8])
    a05, a15, a25 = shear_columns(X, Y, 0, K[0], K[3], K[6], K[1], K[4], K[7])
    a03, a13, a23 = shear_columns(Y, Z, 1, K[1], K[4], K[7], K[2], K[5], K[8])
    a04, a14, a24 = shear_columns(Z, X, 2, K[2], K[5], K[8], K[0], K[3], K[6])
    none = tl.zeros_like(a00)  # no plane holds both
    store_four(G, r, 0, a00, a01, a02, a03, mine)
    store_four(G, r, 4, a04, a05, a10, a11, others)
    store_four(G, r, 8, a12, a13, a14, a15, mine)
    store_four(G, r, 12, a20, a21, a22, a23, others)
    store_four(G, r, 16, a24, a25, none, 0.5 * Y[3], mine)
    store_four(G, r, 20, 0.5 * Z[6], 0.5 * (Y[4] + Z[8]), 0.5 * Z[7], 0.5 * Y[5], others)
    store_four(G, r, 24, 0.5 * X[6], none, 0.5 * Z[3], 0.5 * Z[5], mine)
    store_four(G, r, 28, 0.5 * (Z[4] + X[8]), 0.5 * X[7], 0.5 * X[3], 0.5 * Y[6], others)
    store_four(G, r, 32, none, 0.5 * Y[7], 0.5 * X[5], 0.5 * (X[4] + Y[8]), mine)


@triton.jit
def corrections(t, r, M, D: tl.constexpr):
    """Entries of C_x, C_y, C_z and C_xyz."""
    return (
        correction(t, r, M, 0, D),
        correction(t, r, M, 12, D),
        correction(t, r, M, 24, D),
        correction(t, r, M, 36, D),
    )


@triton.jit(do_not_specialize=["N"])
def assemble(
    t, s1, pre, G, s2, moved, N, M, OPERATOR: tl.constexpr, D: tl.constexpr, BLOCK: tl.constexpr
):
    """s2 = (I + G) s1 (6, M); OPERATOR: also moved = (I + G) pre (6, M), and G (N, 6, 6)."""
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    X, Y, Z, K = corrections(t, r, M, D)
    store_moved(s1, s2, r, M, X, Y, Z, K, r < M)
    if OPERATOR:
        store_moved(pre, moved, r, M, X, Y, Z, K, r < M)
        store_operator(G, r, X, Y, Z, K, r < N, r < N)


@triton.jit
def normal(t, s1, r, M, plane: tl.constexpr, c1: tl.constexpr, c2: tl.constexpr):
    """(v0, v1, v2, u00, u01, u02, l00) of n = (D + l00) ((D + u00) v0 + u01 v1 + u02 v2), beside v0 itself where D is not 1: the
    normal traction on a plane after its correction, row 0 of I + C on its components v of s1."""
    first = t + 12 * plane * M + r
    v0, v1, v2 = components(s1, r, M, plane, c1, c2)
    u00, u01, u02 = tl.load(first), tl.load(first + M), tl.load(first + 2 * M)
    return v0, v1, v2, u00, u01, u02, tl.load(first + 6 * M)


@triton.jit
def store_normal(
    t, s1, out, r, M, scale, plane: tl.constexpr, c1: tl.constexpr, c2: tl.constexpr, D: tl.constexpr
):  # fmt: skip
    v0, v1, v2, u00, u01, u02, l00 = normal(t, s1, r, M, plane, c1, c2)
    n = (D + l00) * (D * v0 + u00 * v0 + u01 * v1 + u02 * v2)
    tl.store(out + plane * M + r, scale * (n if D == 1.0 else v0 + n))


@triton.jit
def store_normals(t, s1, out, r, M, scale, D: tl.constexpr):
    """Rows r of the last three inputs of Psi2 (3, M): scaled normal tractions on the corrected planes."""
    store_normal(t, s1, out, r, M, scale, 0, 5, 4, D)
    store_normal(t, s1, out, r, M, scale, 1, 3, 5, D)
    store_normal(t, s1, out, r, M, scale, 2, 4, 3, D)


@triton.jit
def normals(t, s1, out, M, scale, D: tl.constexpr, BLOCK: tl.constexpr):
    store_normals(t, s1, out, tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), M, scale, D)


@triton.jit
def add(p, value):
    tl.store(p, tl.load(p) + value)


@triton.jit
def normal_adjoint(
    t, s1, gn, gt, r, M, scale, plane: tl.constexpr, c1: tl.constexpr, c2: tl.constexpr, D: tl.constexpr
):  # fmt: skip
    """Adds to gt; returns the adjoints of the three components of s1."""
    v0, v1, v2, u00, u01, u02, l00 = normal(t, s1, r, M, plane, c1, c2)
    g = scale * tl.load(gn + plane * M + r)
    k = g * (D + l00)
    first = gt + 12 * plane * M + r
    add(first, k * v0)
    add(first + M, k * v1)
    add(first + 2 * M, k * v2)
    add(first + 6 * M, g * (D * v0 + u00 * v0 + u01 * v1 + u02 * v2))
    own = k * (D + u00)
    return own if D == 1.0 else g + own, k * u01, k * u02


@triton.jit
def normals_adjoint(t, s1, gn, gt, gs1, M, scale, D: tl.constexpr, BLOCK: tl.constexpr):
    """Adds the adjoints from those of the scaled normals, gn (3, M), to gt (48, M) and gs1 (6, M)."""
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    xa, xb, xc = normal_adjoint(t, s1, gn, gt, r, M, scale, 0, 5, 4, D)
    ya, yb, yc = normal_adjoint(t, s1, gn, gt, r, M, scale, 1, 3, 5, D)
    za, zb, zc = normal_adjoint(t, s1, gn, gt, r, M, scale, 2, 4, 3, D)
    add(gs1 + r, xa)
    add(gs1 + M + r, ya)
    add(gs1 + 2 * M + r, za)
    add(gs1 + 3 * M + r, yb + zc)
    add(gs1 + 4 * M + r, zb + xc)
    add(gs1 + 5 * M + r, xb + yc)


@triton.jit(do_not_specialize=["N"])
def finish(b, w, s, unit, h, N, M, RESTED: tl.constexpr, BLOCK: tl.constexpr):
    """h (N, 6) = unit (b - b at rest), exactly 0 at w = s = 0: a product may round one of its rows differently from another."""
    r = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK))[:, None]
    c = tl.arange(0, 8)[None, :]
    inside = (r < N) & (c < 6)
    y = tl.load(b + c * M + r, mask=inside, other=0.0)
    if RESTED:
        state = tl.abs(tl.load(w + r * 6 + c, mask=inside, other=0.0)) + tl.abs(
            tl.load(s + r * 6 + c, mask=inside, other=0.0)
        )
        y -= tl.load(b + c * M + N, mask=c < 6, other=0.0)
        y = tl.where(tl.max(state, 1)[:, None] == 0.0, 0.0, y)
    tl.store(h + r * 6 + c, tl.load(unit) * y, mask=inside)


@triton.jit
def seed_of_b(gh, rest, unit, r, N, i: tl.constexpr, RESTED: tl.constexpr):
    """Adjoint of component i of b (BLOCK,)."""
    g = tl.load(gh + r * 6 + i, mask=r < N, other=0.0)
    if RESTED:
        g = tl.where(r == N, -tl.load(rest + i), g)
    return tl.load(unit) * g


@triton.jit
def moved_adjoint(v, r, M, p: tl.constexpr, c1: tl.constexpr, c2: tl.constexpr, C, k0, k1, k2, g):
    """Of out = (I + G) v, seen from plane p. g: adjoint of out; k: column p of C_xyz.

    Returns the normal traction n, the seeds of the plane's tractions, its components of v, and the adjoints of these components."""
    y0 = g[p] + k0 * g[0] + k1 * g[1] + k2 * g[2]
    y1, y2 = 0.5 * g[c1], 0.5 * g[c2]
    a, b, c = components(v, r, M, p, c1, c2)
    n = a + C[0] * a + C[1] * b + C[2] * c
    return (
        n, y0, y1, y2, a, b, c,
        y0 + C[0] * y0 + C[3] * y1 + C[6] * y2, y1 + C[1] * y0 + C[4] * y1 + C[7] * y2, y2 + C[2] * y0 + C[5] * y1 + C[8] * y2,
    )  # fmt: skip


@triton.jit
def six(p, r, M):
    return (
        tl.load(p + r), tl.load(p + M + r), tl.load(p + 2 * M + r),
        tl.load(p + 3 * M + r), tl.load(p + 4 * M + r), tl.load(p + 5 * M + r),
    )  # fmt: skip


@triton.jit
def seed_of(gG, r, N, row: tl.constexpr, column: tl.constexpr):
    return tl.load(gG + r * 36 + row * 6 + column, mask=r < N, other=0.0)


@triton.jit
def plane_adjoint(
    t, s1, pre, gG, S, B, gt, extra, r, N, M, p: tl.constexpr, c1: tl.constexpr, c2: tl.constexpr, k0, k1, k2,
    EXTRA: tl.constexpr, D: tl.constexpr,
):  # fmt: skip
    """Stores the adjoints of the plane's numbers; returns those of column p of C_xyz (3), of the plane's components of s1 (3) and
    of pre (3). S, B: adjoints of s2 and moved (6)."""
    C = correction(t, r, M, 12 * p, D)
    n, y0, y1, y2, a, b, c, v0, v1, v2 = moved_adjoint(s1, r, M, p, c1, c2, C, k0, k1, k2, S)
    j, x0, x1, x2, d, e, f, p0, p1, p2 = moved_adjoint(pre, r, M, p, c1, c2, C, k0, k1, k2, B)
    q00, q01, q02 = seed_of(gG, r, N, 0, p), seed_of(gG, r, N, 0, c1), seed_of(gG, r, N, 0, c2)
    q10, q11, q12 = seed_of(gG, r, N, 1, p), seed_of(gG, r, N, 1, c1), seed_of(gG, r, N, 1, c2)
    q20, q21, q22 = seed_of(gG, r, N, 2, p), seed_of(gG, r, N, 2, c1), seed_of(gG, r, N, 2, c2)
    h0 = S[0] * n + B[0] * j + q00 + q00 * C[0] + q01 * C[1] + q02 * C[2]
    h1 = S[1] * n + B[1] * j + q10 + q10 * C[0] + q11 * C[1] + q12 * C[2]
    h2 = S[2] * n + B[2] * j + q20 + q20 * C[0] + q21 * C[1] + q22 * C[2]
    o0 = q00 if p == 0 else (q10 if p == 1 else q20)
    o1 = q01 if p == 0 else (q11 if p == 1 else q21)
    o2 = q02 if p == 0 else (q12 if p == 1 else q22)
    correction_adjoint(
        t, gt, extra, r, N, M, 12 * p, EXTRA, D,
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
    t, s1, pre, gG, gh, rest, unit, gs2, extra, gt, gs1, gpre, N, M,
    RESTED: tl.constexpr, EXTRA: tl.constexpr, D: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """From the adjoints gG (N, 6, 6) of G, gh (N, 6) of h and gs2 (6, M) of s2: gt (48, M), gs1 and gpre (6, M)."""
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    K = correction(t, r, M, 36, D)
    S = six(gs2, r, M)
    B = (
        seed_of_b(gh, rest, unit, r, N, 0, RESTED), seed_of_b(gh, rest, unit, r, N, 1, RESTED),
        seed_of_b(gh, rest, unit, r, N, 2, RESTED), seed_of_b(gh, rest, unit, r, N, 3, RESTED),
        seed_of_b(gh, rest, unit, r, N, 4, RESTED), seed_of_b(gh, rest, unit, r, N, 5, RESTED),
    )  # fmt: skip
    x0, x1, x2, xa, xb, xc, xd, xe, xf = plane_adjoint(
        t, s1, pre, gG, S, B, gt, extra, r, N, M, 0, 5, 4, K[0], K[3], K[6], EXTRA, D
    )
    y0, y1, y2, ya, yb, yc, yd, ye, yf = plane_adjoint(
        t, s1, pre, gG, S, B, gt, extra, r, N, M, 1, 3, 5, K[1], K[4], K[7], EXTRA, D
    )
    z0, z1, z2, za, zb, zc, zd, ze, zf = plane_adjoint(
        t, s1, pre, gG, S, B, gt, extra, r, N, M, 2, 4, 3, K[2], K[5], K[8], EXTRA, D
    )
    correction_adjoint(t, gt, extra, r, N, M, 36, EXTRA, D, x0, y0, z0, x1, y1, z1, x2, y2, z2)
    store_six(gs1, r, M, xa, ya, za, yb + zc, zb + xc, xb + yc)
    store_six(gpre, r, M, xd, yd, zd, ye + zf, ze + xf, xe + yf)

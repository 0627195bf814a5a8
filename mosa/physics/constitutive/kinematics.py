"""Polar rotation, Hencky strain and return-mapped gradients of one 3x3 matrix, with exact hand-written differentials.

A generic SVD must not be differentiated: it divides by S_i^2 - S_j^2 and blows up at rest, where all singular values are 1.
Each primitive here therefore comes in two parts: a *factorisation* without gradient (`svd`, `rotation_of`), and functions
that take the factors along with F and return the value with its closed differential with respect to F.
The factors are so computed once per particle and kernel, in the backward pass too.

Everything is float64, whatever the precision of the fields: float32 factorisations are off by up to 8e-3.
Convention: F = U diag(S) V^T, det U = det V = +1, S descending, the last one carries the sign of det F.
"""

# ruff: noqa: UP018, RUF046, RUF059
# (Warp: `int(0)` makes a variable that a dynamic loop or branch may change, and results are unpacked whole)

import warp as wp

STRAIN_CLAMP = wp.constant(wp.float64(0.05))
"""Singular values enter logarithms as max(S, STRAIN_CLAMP)."""

ROTATION_FLOOR = wp.constant(wp.float64(1.0e-3))
"""Smallest S_i + S_j that a rotation's differential divides by: zero only at det F <= 0, a true singularity."""

# angles below it leave products of 1e-16 behind: the sweep that only has such is the last
_TURN = wp.constant(wp.float64(1.0e-8))
_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))


@wp.func
def column(A: wp.mat33d, j: int):
    return wp.vec3d(A[0, j], A[1, j], A[2, j])


@wp.func
def from_columns(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    return wp.mat33d(a[0], b[0], c[0], a[1], b[1], c[1], a[2], b[2], c[2])


@wp.func
def jacobi_angle(a: wp.vec3d, b: wp.vec3d):
    """(cos, sin) of the plane rotation that makes the columns a and b orthogonal; (1, 0) if they are, to rounding."""
    aa = wp.dot(a, a)
    bb = wp.dot(b, b)
    ab = wp.dot(a, b)
    c = _ONE
    s = _ZERO
    if ab * ab > wp.float64(1.0e-32) * aa * bb:
        z = (bb - aa) / (_TWO * ab)
        t = wp.where(z >= _ZERO, _ONE, -_ONE) / (wp.abs(z) + wp.sqrt(_ONE + z * z))
        c = _ONE / wp.sqrt(_ONE + t * t)
        s = c * t
    return c, s


@wp.func
def made_orthogonal(a: wp.vec3d, b: wp.vec3d, p: wp.vec3d, q: wp.vec3d):
    """Columns a, b of F V and p, q of V after the turn that makes a and b orthogonal, and whether there was one."""
    co, si = jacobi_angle(a, b)
    turning = int(0)
    a1 = a
    b1 = b
    p1 = p
    q1 = q
    if si != _ZERO:
        if wp.abs(si) > _TURN:
            turning = int(1)
        a1 = co * a - si * b
        b1 = si * a + co * b
        p1 = co * p - si * q
        q1 = si * p + co * q
    return a1, b1, p1, q1, turning


@wp.func
def in_order(a: wp.vec3d, b: wp.vec3d, p: wp.vec3d, q: wp.vec3d):
    """The longer one of a and b first, by a swap that keeps det V."""
    a1 = a
    b1 = b
    p1 = p
    q1 = q
    if wp.dot(a, a) < wp.dot(b, b):
        a1 = b
        b1 = -a
        p1 = q
        q1 = -p
    return a1, b1, p1, q1


@wp.func
def svd_value(F: wp.mat33d):
    """One-sided Jacobi: accurate to rounding also for close and for small singular values, one sweep near rest."""
    a = column(F, 0)
    b = column(F, 1)
    c = column(F, 2)
    p = wp.vec3d(_ONE, _ZERO, _ZERO)
    q = wp.vec3d(_ZERO, _ONE, _ZERO)
    r = wp.vec3d(_ZERO, _ZERO, _ONE)
    sweep = int(0)
    turning = int(1)
    while sweep < 12 and turning > 0:
        a, b, p, q, first = made_orthogonal(a, b, p, q)
        a, c, p, r, second = made_orthogonal(a, c, p, r)
        b, c, q, r, third = made_orthogonal(b, c, q, r)
        turning = first + second + third
        sweep = sweep + 1
    a, b, p, q = in_order(a, b, p, q)
    b, c, q, r = in_order(b, c, q, r)
    a, b, p, q = in_order(a, b, p, q)
    s0 = wp.length(a)
    u0 = wp.vec3d(_ONE, _ZERO, _ZERO)
    if s0 > _ZERO:
        u0 = a / s0
    s1 = wp.length(b)
    u1 = b
    if s1 > wp.float64(1.0e-150) and s1 > wp.float64(1.0e-14) * s0:
        u1 = b / s1
        # the columns are orthogonal to rounding of their product: one step of Gram-Schmidt makes U so too
        u1 = wp.normalize(u1 - wp.dot(u0, u1) * u0)
    else:
        axis = wp.vec3d(_ONE, _ZERO, _ZERO)
        if wp.abs(u0[0]) > wp.float64(0.7):
            axis = wp.vec3d(_ZERO, _ONE, _ZERO)
        u1 = wp.normalize(wp.cross(u0, axis))
        s1 = wp.dot(u1, b)
    u2 = wp.cross(u0, u1)
    s2 = wp.dot(u2, c)
    return from_columns(u0, u1, u2), wp.vec3d(s0, s1, s2), from_columns(p, q, r)


@wp.func
def svd(F: wp.mat33d):
    """U, S, V of F, *without gradient*: hand them on together with F to the functions below."""
    U, S, V = svd_value(F)
    return U, S, V


@wp.func_grad(svd)
def adj_svd(F: wp.mat33d, adj_U: wp.mat33d, adj_S: wp.vec3d, adj_V: wp.mat33d):
    pass


@wp.func
def polar_value(F: wp.mat33d):
    """Rotation of F: Newton's iteration X <- (X + X^-T)/2; the SVD where two stretches vanish, or det F is far below zero.

    Cofactors of X have its singular vectors, the largest value where X has the smallest: at a small det X a step takes both at one
    size, on either side of 0, and a body that lies flat costs no more than one that does not."""
    X = F
    converged = int(0)
    if wp.ddot(F, F) < wp.float64(100.0):
        step = int(0)
        while step < 20 and converged == 0:
            a = wp.vec3d(X[0, 0], X[0, 1], X[0, 2])
            b = wp.vec3d(X[1, 0], X[1, 1], X[1, 2])
            c = wp.vec3d(X[2, 0], X[2, 1], X[2, 2])
            bc = wp.cross(b, c)
            ca = wp.cross(c, a)
            ab = wp.cross(a, b)
            d = wp.dot(a, bc)
            e = _HALF
            f = _ZERO
            if d > wp.float64(0.02):
                f = _HALF / d
            else:
                x = wp.sqrt(wp.ddot(X, X))
                y = wp.sqrt(wp.dot(bc, bc) + wp.dot(ca, ca) + wp.dot(ab, ab))
                if y > wp.float64(1.0e-5) * x * x and d * x * x * x > -wp.float64(0.1) * y * y * y:
                    # all singular values are positive after the step: y/x is about the second one
                    e = _ONE / x
                    f = _ONE / y
                else:
                    step = 20
            a1 = e * a + f * bc
            b1 = e * b + f * ca
            c1 = e * c + f * ab
            da = a1 - a
            db = b1 - b
            dc = c1 - c
            X = wp.mat33d(a1[0], a1[1], a1[2], b1[0], b1[1], b1[2], c1[0], c1[1], c1[2])
            # quadratic convergence: a change of 1e-9 leaves an error of 1e-18
            if (
                e == _HALF
                and f > _ZERO
                and wp.dot(da, da) + wp.dot(db, db) + wp.dot(dc, dc) < wp.float64(1.0e-18)
            ):
                converged = int(1)
            step = step + 1
    if converged == 0:
        U, S, V = svd_value(F)
        X = U * wp.transpose(V)
    return X


@wp.func
def rotation_of(F: wp.mat33d):
    """Polar rotation R of F, *without gradient*: see `rotation`."""
    return polar_value(F)


@wp.func_grad(rotation_of)
def adj_rotation_of(F: wp.mat33d, adj_R: wp.mat33d):
    pass


@wp.func
def rotation(F: wp.mat33d, R: wp.mat33d):
    """Polar rotation with its differential; R = rotation_of(F)."""
    return R


@wp.func_grad(rotation)
def adj_rotation(F: wp.mat33d, R: wp.mat33d, adj_ret: wp.mat33d):
    # dR = R [w]_x with (tr(W) I - W) w = axial(R^T dF - dF^T R): the adjoint solves the same symmetric system, whose
    # eigenvalues are S_i + S_j
    W = wp.transpose(R) * F
    Y = wp.transpose(R) * adj_ret
    y = wp.vec3d(Y[2, 1] - Y[1, 2], Y[0, 2] - Y[2, 0], Y[1, 0] - Y[0, 1])
    t = wp.trace(W)
    xy = -_HALF * (W[0, 1] + W[1, 0])
    xz = -_HALF * (W[0, 2] + W[2, 0])
    yz = -_HALF * (W[1, 2] + W[2, 1])
    G = wp.mat33d(t - W[0, 0], xy, xz, xy, t - W[1, 1], yz, xz, yz, t - W[2, 2])
    # det G / (tr W)^2 is a lower bound of the smallest eigenvalue when all are positive
    if t > _ZERO and wp.determinant(G) > wp.float64(0.1) * t * t and wp.determinant(F) > _ZERO:
        w = wp.inverse(G) * y
        L = wp.mat33d(_ZERO, -w[2], w[1], w[2], _ZERO, -w[0], -w[1], w[0], _ZERO)
        wp.adjoint[F] += R * L
    else:
        U, S, V = svd_value(F)
        K = wp.transpose(U) * adj_ret * V
        k01 = (K[0, 1] - K[1, 0]) / wp.max(S[0] + S[1], ROTATION_FLOOR)
        k02 = (K[0, 2] - K[2, 0]) / wp.max(S[0] + S[2], ROTATION_FLOOR)
        k12 = (K[1, 2] - K[2, 1]) / wp.max(S[1] + S[2], ROTATION_FLOOR)
        P = wp.mat33d(_ZERO, k01, k02, -k01, _ZERO, k12, -k02, -k12, _ZERO)
        wp.adjoint[F] += U * P * wp.transpose(V)


@wp.func
def log_clamped(s: wp.float64):
    return wp.log(wp.max(s, STRAIN_CLAMP))


@wp.func
def hencky(S: wp.vec3d):
    """Principal logarithmic strains log max(S, 0.05); no gradient needed, its callers carry their own."""
    return wp.vec3d(log_clamped(S[0]), log_clamped(S[1]), log_clamped(S[2]))


@wp.func
def log_slope(s: wp.float64):
    return wp.where(s > STRAIN_CLAMP, _ONE / wp.max(s, STRAIN_CLAMP), _ZERO)


@wp.func
def log_quotient(a: wp.float64, b: wp.float64):
    """Divided difference (log a - log b)/(a - b) of the clamped logarithm, with its limit for a -> b."""
    d = a - b
    q = _ZERO
    if a > STRAIN_CLAMP and b > STRAIN_CLAMP:
        z = d / (a + b)
        if wp.abs(z) < wp.float64(1.0e-2):
            z2 = z * z
            series = (
                _ONE
                + z2 / wp.float64(3.0)
                + z2 * z2 / wp.float64(5.0)
                + z2 * z2 * z2 / wp.float64(7.0)
            )
            q = _TWO * (series + z2 * z2 * z2 * z2 / wp.float64(9.0)) / (a + b)
        else:
            q = wp.log(a / b) / d
    elif wp.abs(d) > wp.float64(1.0e-12):
        q = (log_clamped(a) - log_clamped(b)) / d
    return q


@wp.func
def floored_sum(a: wp.float64, b: wp.float64):
    return wp.max(a + b, ROTATION_FLOOR)


@wp.func
def hencky_spatial(F: wp.mat33d, U: wp.mat33d, S: wp.vec3d, V: wp.mat33d):
    """Left (spatial) Hencky strain U diag(log max(S, 0.05)) U^T; U, S, V = svd(F)."""
    return U * wp.diag(hencky(S)) * wp.transpose(U)


@wp.func_grad(hencky_spatial)
def adj_hencky_spatial(F: wp.mat33d, U: wp.mat33d, S: wp.vec3d, V: wp.mat33d, adj_ret: wp.mat33d):
    A = wp.transpose(U) * adj_ret * U
    q01 = (A[0, 1] + A[1, 0]) * log_quotient(S[0], S[1]) / floored_sum(S[0], S[1])
    q02 = (A[0, 2] + A[2, 0]) * log_quotient(S[0], S[2]) / floored_sum(S[0], S[2])
    q12 = (A[1, 2] + A[2, 1]) * log_quotient(S[1], S[2]) / floored_sum(S[1], S[2])
    P = wp.mat33d(
        A[0, 0] * log_slope(S[0]), q01 * S[1], q02 * S[2],
        q01 * S[0], A[1, 1] * log_slope(S[1]), q12 * S[2],
        q02 * S[0], q12 * S[1], A[2, 2] * log_slope(S[2]),
    )  # fmt: skip
    wp.adjoint[F] += U * P * wp.transpose(V)


@wp.func
def hencky_material(F: wp.mat33d, U: wp.mat33d, S: wp.vec3d, V: wp.mat33d):
    """Right (material) Hencky strain V diag(log max(S, 0.05)) V^T = log W; U, S, V = svd(F)."""
    return V * wp.diag(hencky(S)) * wp.transpose(V)


@wp.func_grad(hencky_material)
def adj_hencky_material(F: wp.mat33d, U: wp.mat33d, S: wp.vec3d, V: wp.mat33d, adj_ret: wp.mat33d):
    A = wp.transpose(V) * adj_ret * V
    q01 = (A[0, 1] + A[1, 0]) * log_quotient(S[0], S[1]) / floored_sum(S[0], S[1])
    q02 = (A[0, 2] + A[2, 0]) * log_quotient(S[0], S[2]) / floored_sum(S[0], S[2])
    q12 = (A[1, 2] + A[2, 1]) * log_quotient(S[1], S[2]) / floored_sum(S[1], S[2])
    P = wp.mat33d(
        A[0, 0] * log_slope(S[0]), q01 * S[0], q02 * S[0],
        q01 * S[1], A[1, 1] * log_slope(S[1]), q12 * S[1],
        q02 * S[2], q12 * S[2], A[2, 2] * log_slope(S[2]),
    )  # fmt: skip
    wp.adjoint[F] += U * P * wp.transpose(V)


@wp.func
def growth(z: wp.float64):
    """(exp(z) - 1)/z."""
    r = _ONE
    if wp.abs(z) < wp.float64(1.0e-2):
        z2 = z * z
        r = (
            _ONE
            + z / _TWO
            + z2 / wp.float64(6.0)
            + z2 * z / wp.float64(24.0)
            + z2 * z2 / wp.float64(120.0)
        )
        r = r + z2 * z2 * z / wp.float64(720.0) + z2 * z2 * z2 / wp.float64(5040.0)
    else:
        r = (wp.exp(z) - _ONE) / z
    return r


@wp.func
def contracted_stretch(S: wp.vec3d, c: wp.float64):
    e = hencky(S)
    m = (e[0] + e[1] + e[2]) / wp.float64(3.0)
    return wp.vec3d(
        wp.exp(m + c * (e[0] - m)), wp.exp(m + c * (e[1] - m)), wp.exp(m + c * (e[2] - m))
    )


@wp.func
def contract(F: wp.mat33d, U: wp.mat33d, S: wp.vec3d, V: wp.mat33d, c: wp.float64):
    """U diag(exp(m + c (eps - m))) V^T, m the mean of eps: F with its deviatoric Hencky strain scaled by c."""
    return U * wp.diag(contracted_stretch(S, c)) * wp.transpose(V)


@wp.func
def contract_pair(kij: wp.float64, kji: wp.float64, gi: wp.float64, gj: wp.float64, si: wp.float64, sj: wp.float64,
                  c: wp.float64):  # fmt: skip
    """Adjoints of P_ij and P_ji for g_i = exp(m + c (eps_i - m)), from those of the matrix in the frames of U and V."""
    z = c * (log_clamped(si) - log_clamped(sj))
    even = gj * growth(z) * c * log_quotient(si, sj)
    odd = (gi + gj) / floored_sum(si, sj)
    pij = _HALF * (kij * (even + odd) + kji * (even - odd))
    pji = _HALF * (kji * (even + odd) + kij * (even - odd))
    return pij, pji


@wp.func_grad(contract)
def adj_contract(
    F: wp.mat33d, U: wp.mat33d, S: wp.vec3d, V: wp.mat33d, c: wp.float64, adj_ret: wp.mat33d
):
    K = wp.transpose(U) * adj_ret * V
    g = contracted_stretch(S, c)
    e = hencky(S)
    third = _ONE / wp.float64(3.0)
    m = third * (e[0] + e[1] + e[2])
    kg = wp.vec3d(K[0, 0] * g[0], K[1, 1] * g[1], K[2, 2] * g[2])
    shared = third * (_ONE - c) * (kg[0] + kg[1] + kg[2])
    p01, p10 = contract_pair(K[0, 1], K[1, 0], g[0], g[1], S[0], S[1], c)
    p02, p20 = contract_pair(K[0, 2], K[2, 0], g[0], g[2], S[0], S[2], c)
    p12, p21 = contract_pair(K[1, 2], K[2, 1], g[1], g[2], S[1], S[2], c)
    P = wp.mat33d(
        (shared + c * kg[0]) * log_slope(S[0]), p01, p02,
        p10, (shared + c * kg[1]) * log_slope(S[1]), p12,
        p20, p21, (shared + c * kg[2]) * log_slope(S[2]),
    )  # fmt: skip
    wp.adjoint[F] += U * P * wp.transpose(V)
    wp.adjoint[c] += kg[0] * (e[0] - m) + kg[1] * (e[1] - m) + kg[2] * (e[2] - m)

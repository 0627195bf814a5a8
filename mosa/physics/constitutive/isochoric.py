"""Gradients of F that keep its determinant: the return of laws in b_bar = J^(-2/3) F F^T, with its exact differential.

Companion of `kinematics`, same conventions: factors come in without gradient, closed differentials go out.
"""

# ruff: noqa: UP018, RUF046
# (Warp: `int(0)` makes a variable that a dynamic loop or branch may change)

import warp as wp

from mosa.physics.constitutive.kinematics import STRAIN_CLAMP

_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_THIRD = wp.constant(wp.float64(1.0 / 3.0))


@wp.func
def isochoric_squares(S: wp.vec3d, c: wp.float64):
    """Squared singular values q_i = c S_i^2 + a with q_0 q_1 q_2 = (S_0 S_1 S_2)^2; S > 0, 0 <= c <= 1.

    With b_i = J^(-2/3) S_i^2 and d_i = c (b_i - mean b), q_i = J^(2/3) (d_i + beta), beta the largest real root of
    (d_0 + beta)(d_1 + beta)(d_2 + beta) = 1. It lies below 1 - min d, from where Newton's iteration descends to it: the product
    is increasing and convex there."""
    volume = wp.pow(S[0] * S[1] * S[2], _TWO * _THIRD)
    b = wp.vec3d(S[0] * S[0], S[1] * S[1], S[2] * S[2]) / volume
    m = _THIRD * (b[0] + b[1] + b[2])
    d0 = c * (b[0] - m)
    d1 = c * (b[1] - m)
    d2 = c * (b[2] - m)
    beta = _ONE - wp.min(d0, wp.min(d1, d2))
    step = int(0)
    converged = int(0)
    while step < 100 and converged == 0:
        x0 = d0 + beta
        x1 = d1 + beta
        x2 = d2 + beta
        change = (x0 * x1 * x2 - _ONE) / (x0 * x1 + x1 * x2 + x2 * x0)
        beta = beta - change
        if wp.abs(change) < wp.float64(1.0e-15) * beta:
            converged = int(1)
        step = step + 1
    return volume * wp.vec3d(d0 + beta, d1 + beta, d2 + beta)


@wp.func
def isochoric_stretch(S: wp.vec3d, c: wp.float64):
    q = isochoric_squares(S, c)
    return wp.vec3d(wp.sqrt(q[0]), wp.sqrt(q[1]), wp.sqrt(q[2]))


@wp.func
def isochoric_contract(F: wp.mat33d, U: wp.mat33d, S: wp.vec3d, V: wp.mat33d, c: wp.float64):
    """A = U diag(g) V^T with det A = det F and dev(A A^T) = c dev(F F^T); det F > 0, 0 <= c <= 1; U, S, V = svd(F)."""
    return U * wp.diag(isochoric_stretch(S, c)) * wp.transpose(V)


@wp.func
def isochoric_pair(kij: wp.float64, kji: wp.float64, gi: wp.float64, gj: wp.float64, si: wp.float64, sj: wp.float64,
                   c: wp.float64):  # fmt: skip
    """Adjoints of P_ij and P_ji; g_i^2 - g_j^2 = c (S_i^2 - S_j^2), so the divided difference has no cancellation."""
    even = c * (si + sj) / (gi + gj)
    odd = (gi + gj) / (si + sj)
    pij = _HALF * (kij * (even + odd) + kji * (even - odd))
    pji = _HALF * (kji * (even + odd) + kij * (even - odd))
    return pij, pji


@wp.func_grad(isochoric_contract)
def adj_isochoric_contract(
    F: wp.mat33d, U: wp.mat33d, S: wp.vec3d, V: wp.mat33d, c: wp.float64, adj_ret: wp.mat33d
):
    # from sum log q_i = 2 sum log S_i: da = (sum (2/S_i - 2 c S_i/q_i) dS_i - sum S_i^2/q_i dc)/sum 1/q_i
    K = wp.transpose(U) * adj_ret * V
    q = isochoric_squares(S, c)
    g = wp.vec3d(wp.sqrt(q[0]), wp.sqrt(q[1]), wp.sqrt(q[2]))
    k = wp.vec3d(_HALF * K[0, 0] / g[0], _HALF * K[1, 1] / g[1], _HALF * K[2, 2] / g[2])
    shift = (k[0] + k[1] + k[2]) / (_ONE / q[0] + _ONE / q[1] + _ONE / q[2])
    p00 = _TWO * (c * S[0] * k[0] + shift * (_ONE / S[0] - c * S[0] / q[0]))
    p11 = _TWO * (c * S[1] * k[1] + shift * (_ONE / S[1] - c * S[1] / q[1]))
    p22 = _TWO * (c * S[2] * k[2] + shift * (_ONE / S[2] - c * S[2] / q[2]))
    p01, p10 = isochoric_pair(K[0, 1], K[1, 0], g[0], g[1], S[0], S[1], c)
    p02, p20 = isochoric_pair(K[0, 2], K[2, 0], g[0], g[2], S[0], S[2], c)
    p12, p21 = isochoric_pair(K[1, 2], K[2, 1], g[1], g[2], S[1], S[2], c)
    P = wp.mat33d(p00, p01, p02, p10, p11, p12, p20, p21, p22)
    wp.adjoint[F] += U * P * wp.transpose(V)
    squares = wp.vec3d(S[0] * S[0], S[1] * S[1], S[2] * S[2])
    wp.adjoint[c] += wp.dot(k, squares) - shift * (
        squares[0] / q[0] + squares[1] / q[1] + squares[2] / q[2]
    )


@wp.func
def clamped_squares(F: wp.mat33d, U: wp.mat33d, S: wp.vec3d, V: wp.mat33d):
    """sum of max(S_i, 0.05)^2; U, S, V = svd(F)."""
    a = wp.max(S[0], STRAIN_CLAMP)
    b = wp.max(S[1], STRAIN_CLAMP)
    c = wp.max(S[2], STRAIN_CLAMP)
    return a * a + b * b + c * c


@wp.func_grad(clamped_squares)
def adj_clamped_squares(F: wp.mat33d, U: wp.mat33d, S: wp.vec3d, V: wp.mat33d, adj_ret: wp.float64):
    a = wp.where(S[0] > STRAIN_CLAMP, _TWO * S[0], _ZERO)
    b = wp.where(S[1] > STRAIN_CLAMP, _TWO * S[1], _ZERO)
    c = wp.where(S[2] > STRAIN_CLAMP, _TWO * S[2], _ZERO)
    wp.adjoint[F] += adj_ret * (U * wp.diag(wp.vec3d(a, b, c)) * wp.transpose(V))

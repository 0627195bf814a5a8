"""Finite strain measures of one 3x3 deformation gradient and the stress that is conjugate to each, with closed differentials.

A measure is E(C) = V diag(e(lambda)) V^T of the right Cauchy-Green tensor C = F^T F = V diag(lambda) V^T (Seth 1964, Hill 1968):
Green's
e = (lambda - 1)/2, Biot's sqrt(lambda) - 1, Hencky's log(lambda)/2; all are lambda/2 - 1/2 to first order. An energy psi(E) has the
Kirchhoff stress tau = 2 F (DE(C)[T]) F^T with T = dpsi/dE (Ogden, Non-linear Elastic Deformations, section 4.2). In the frame of V
the derivative is T_ij e[lambda_i, lambda_j] with divided differences, and its own differential needs those of second order
(Daleckii and Krein). Both are evaluated so that they stay exact for equal stretches.

Green's needs no factorisation: E = (C - I)/2, tau = F T F^T (`green_strain`, `green_stress`), which Warp differentiates itself.

Written as functions of C all measures know nothing of a reflection: a particle with det F <= 0 has the strain of its mirror image.
Everything is float64. `S` below are the singular values of F, lambda their squares.
"""

import warp as wp

from mosa.physics.constitutive.kinematics import STRAIN_CLAMP

STRAINS = ("hencky", "biot", "green")
"""Names of the measures; a kernel is compiled for one of them."""

FACTORISED = ("hencky", "biot")
"""Those that need the singular values of F."""

_HENCKY, _BIOT = wp.constant(0), wp.constant(1)
_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_CLOSE = wp.constant(wp.float64(0.02))


@wp.func
def principal(measure: int, s: wp.float64):
    """e(s^2); Hencky's holds |s| above `STRAIN_CLAMP`."""
    a = wp.abs(s)
    r = a - _ONE
    if measure == _HENCKY:
        r = wp.log(wp.max(a, STRAIN_CLAMP))
    return r


@wp.func
def log_ratio(z: wp.float64):
    """atanh(z)/z."""
    r = _ONE
    if wp.abs(z) < _CLOSE:
        y = z * z
        r = _ONE + y * (
            _ONE / wp.float64(3.0)
            + y * (_ONE / wp.float64(5.0) + y * (_ONE / wp.float64(7.0) + y / wp.float64(9.0)))
        )
    else:
        r = _HALF * wp.log((_ONE + z) / (_ONE - z)) / z
    return r


@wp.func
def first_difference(measure: int, s: wp.float64, t: wp.float64):
    """e[s^2, t^2], first divided difference."""
    a = wp.abs(s)
    b = wp.abs(t)
    r = _ZERO
    if measure == _HENCKY:
        if a > STRAIN_CLAMP and b > STRAIN_CLAMP:
            l = a * a
            m = b * b
            r = log_ratio((l - m) / (l + m)) / (l + m)
        else:
            gap = a * a - b * b
            if wp.abs(gap) > wp.float64(1.0e-12):
                r = (wp.log(wp.max(a, STRAIN_CLAMP)) - wp.log(wp.max(b, STRAIN_CLAMP))) / gap
    else:
        r = _ONE / wp.max(a + b, STRAIN_CLAMP)
    return r


@wp.func
def second_difference(measure: int, s: wp.float64, t: wp.float64, u: wp.float64):
    """e[s^2, t^2, u^2], second divided difference, symmetric in its arguments."""
    a = wp.abs(s)
    b = wp.abs(t)
    c = wp.abs(u)
    r = _ZERO
    if measure == _BIOT:
        r = -_ONE / (
            wp.max(a + b, STRAIN_CLAMP) * wp.max(b + c, STRAIN_CLAMP) * wp.max(c + a, STRAIN_CLAMP)
        )
    else:
        low = wp.min(a, wp.min(b, c))
        high = wp.max(a, wp.max(b, c))
        middle = a + b + c - low - high
        if low > STRAIN_CLAMP:
            m = (a * a + b * b + c * c) / wp.float64(3.0)
            x = a * a / m - _ONE
            y = b * b / m - _ONE
            z = c * c / m - _ONE
            if high * high - low * low < _CLOSE * m:
                # the divided difference of x^n over three points is the complete symmetric polynomial h_(n-2) of them; h_1 = 0
                # at the mean, and h_k = h_(k-2) p + h_(k-3) q with p = -(xy + yz + zx), q = xyz
                p = -(x * y + y * z + z * x)
                q = x * y * z
                series = (
                    -_HALF - p / wp.float64(4.0) + q / wp.float64(5.0) - p * p / wp.float64(6.0)
                )
                series = (
                    series + _TWO * p * q / wp.float64(7.0) - (p * p * p + q * q) / wp.float64(8.0)
                )
                r = _HALF * series / (m * m)
            else:
                r = (
                    first_difference(measure, low, middle) - first_difference(measure, middle, high)
                ) / (low * low - high * high)
        elif high > STRAIN_CLAMP and high * high - low * low > wp.float64(1.0e-12):
            r = (
                first_difference(measure, low, middle) - first_difference(measure, middle, high)
            ) / (low * low - high * high)
    return r


@wp.func
def green_strain(F: wp.mat33d):
    """(F^T F - I)/2."""
    return _HALF * (wp.transpose(F) * F - wp.identity(n=3, dtype=wp.float64))


@wp.func
def green_stress(F: wp.mat33d, T: wp.mat33d):
    """Kirchhoff stress F T F^T of T = dpsi/dE."""
    return F * T * wp.transpose(F)


@wp.func
def in_frame(measure: int, K: wp.mat33d, S: wp.vec3d):
    """DE(C)[T] in the frame of V from K = V^T T V: K_ij e[lambda_i, lambda_j]."""
    d01 = first_difference(measure, S[0], S[1])
    d02 = first_difference(measure, S[0], S[2])
    d12 = first_difference(measure, S[1], S[2])
    return wp.mat33d(
        K[0, 0] * first_difference(measure, S[0], S[0]), K[0, 1] * d01, K[0, 2] * d02,
        K[1, 0] * d01, K[1, 1] * first_difference(measure, S[1], S[1]), K[1, 2] * d12,
        K[2, 0] * d02, K[2, 1] * d12, K[2, 2] * first_difference(measure, S[2], S[2]),
    )  # fmt: skip


@wp.func
def second_entry(measure: int, K: wp.mat33d, B: wp.mat33d, S: wp.vec3d, i: int, k: int):
    """Entry of D^2 E(C)[T, B] in the frame of V: sum over j of e[i, j, k] (K_ij B_jk + B_ij K_jk)."""
    r = _ZERO
    for j in range(3):
        r = r + second_difference(measure, S[i], S[j], S[k]) * (
            K[i, j] * B[j, k] + B[i, j] * K[j, k]
        )
    return r


@wp.func
def material_strain(measure: int, F: wp.mat33d, S: wp.vec3d, V: wp.mat33d):
    """E(F^T F), symmetric, in the material frame; (U, S, V) = svd(F)."""
    e = wp.vec3d(principal(measure, S[0]), principal(measure, S[1]), principal(measure, S[2]))
    return V * wp.diag(e) * wp.transpose(V)


@wp.func_grad(material_strain)
def adj_material_strain(measure: int, F: wp.mat33d, S: wp.vec3d, V: wp.mat33d, adj_ret: wp.mat33d):
    A = _HALF * (wp.transpose(V) * (adj_ret + wp.transpose(adj_ret)) * V)
    wp.adjoint[F] += _TWO * (F * (V * in_frame(measure, A, S) * wp.transpose(V)))


@wp.func
def conjugate_stress(measure: int, F: wp.mat33d, S: wp.vec3d, V: wp.mat33d, T: wp.mat33d):
    """Kirchhoff stress 2 F (DE(C)[T]) F^T of T = dpsi/dE, symmetric, in the unit of T; (U, S, V) = svd(F)."""
    Z = V * in_frame(measure, wp.transpose(V) * T * V, S) * wp.transpose(V)
    return _TWO * (F * Z * wp.transpose(F))


@wp.func_grad(conjugate_stress)
def adj_conjugate_stress(
    measure: int, F: wp.mat33d, S: wp.vec3d, V: wp.mat33d, T: wp.mat33d, adj_ret: wp.mat33d
):
    # with A the symmetric part of the seed and B = F^T A F: T's adjoint is 2 DE(C)[B], F's 4 (A F Z + F D^2 E(C)[T, B])
    A = _HALF * (adj_ret + wp.transpose(adj_ret))
    Vt = wp.transpose(V)
    K = Vt * T * V
    B = Vt * (wp.transpose(F) * A * F) * V
    wp.adjoint[T] += _TWO * (V * in_frame(measure, B, S) * Vt)
    q01 = second_entry(measure, K, B, S, 0, 1)
    q02 = second_entry(measure, K, B, S, 0, 2)
    q12 = second_entry(measure, K, B, S, 1, 2)
    Q = wp.mat33d(
        second_entry(measure, K, B, S, 0, 0), q01, q02,
        q01, second_entry(measure, K, B, S, 1, 1), q12,
        q02, q12, second_entry(measure, K, B, S, 2, 2),
    )  # fmt: skip
    Z = V * in_frame(measure, K, S) * Vt
    wp.adjoint[F] += wp.float64(4.0) * (A * F * Z + F * (V * Q * Vt))

"""A truth that yields in directions: Hill's quadratic criterion in axes fixed to the material, with its associated flow.

For reference data; not a learner's prior. The elastic part is the isotropic `stvk`."""

# ruff: noqa: UP018, RUF046, RUF059
# (Warp: `int(0)` makes a variable that a dynamic loop or branch may change, and results are unpacked whole)

import warp as wp

from mosa.data.synthetic.materials.axes import axes_rotation
from mosa.physics.constitutive.elasticity import stvk
from mosa.physics.constitutive.kinematics import growth, svd_value
from mosa.physics.constitutive.laws import LawParameters, register_law
from mosa.physics.constitutive.material_kernels import deviator

HILL = "hill"
COEFFICIENTS = ("f", "g", "h", "l", "m", "n")
"""s_eq^2 = (f (s22 - s33)^2 + g (s33 - s11)^2 + h (s11 - s22)^2)/3 + 2 (l s23^2 + m s13^2 + n s12^2): |dev s|^2 if all are 1."""

vec6 = wp.types.vector(length=6, dtype=wp.float64)

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_THIRD = wp.constant(wp.float64(1.0 / 3.0))


@wp.func
def hill_normal(k: vec6):
    """M on the normal components, k = (f, g, h, l, m, n)."""
    return _THIRD * wp.mat33d(
        k[1] + k[2], -k[2], -k[1], -k[2], k[2] + k[0], -k[0], -k[1], -k[0], k[0] + k[1]
    )


@wp.func
def hill_relaxed(e: wp.mat33d, k: vec6, gamma: wp.float64):
    """(I + gamma M)^-1 e for a symmetric e in the material axes."""
    A = wp.identity(n=3, dtype=wp.float64) + gamma * hill_normal(k)
    d = wp.inverse(A) * wp.vec3d(e[0, 0], e[1, 1], e[2, 2])
    yz = e[1, 2] / (_ONE + gamma * k[3])
    zx = e[0, 2] / (_ONE + gamma * k[4])
    xy = e[0, 1] / (_ONE + gamma * k[5])
    return wp.mat33d(d[0], xy, zx, xy, d[1], yz, zx, yz, d[2])


@wp.func
def hill_square(e: wp.mat33d, k: vec6):
    """e : M : e, homogeneous of degree 2; |dev e|^2 if all coefficients are 1."""
    a = e[1, 1] - e[2, 2]
    b = e[2, 2] - e[0, 0]
    c = e[0, 0] - e[1, 1]
    shear = k[3] * e[1, 2] * e[1, 2] + k[4] * e[0, 2] * e[0, 2] + k[5] * e[0, 1] * e[0, 1]
    return _THIRD * (k[0] * a * a + k[1] * b * b + k[2] * c * c) + _TWO * shear


@wp.func
def hill_slope(e: wp.mat33d, k: vec6, gamma: wp.float64):
    """d(e:M:e)/dgamma of e = hill_relaxed: -2 (M e):(I + gamma M)^-1 (M e), at an e that is relaxed already."""
    d = hill_normal(k) * wp.vec3d(e[0, 0], e[1, 1], e[2, 2])
    yz = k[3] * e[1, 2]
    zx = k[4] * e[0, 2]
    xy = k[5] * e[0, 1]
    Me = wp.mat33d(d[0], xy, zx, xy, d[1], yz, zx, yz, d[2])
    return -_TWO * wp.ddot(Me, hill_relaxed(Me, k, gamma))


@wp.func
def hill_multiplier_value(e: wp.mat33d, k: vec6, radius: wp.float64):
    # Newton on 1/sqrt(e:M:e) - 1/radius, which is nearly linear in gamma (as in trust region methods) and concave: from 0 it
    # approaches the root from one side
    gamma = _ZERO
    step = int(0)
    converged = int(0)
    while step < 100 and converged == 0:
        r = hill_relaxed(e, k, gamma)
        q = hill_square(r, k)
        root = wp.sqrt(q)
        change = (_ONE / root - _ONE / radius) * _TWO * q * root / hill_slope(r, k, gamma)
        gamma = wp.max(gamma + change, _ZERO)
        if wp.abs(change) <= wp.float64(1.0e-12) * gamma:
            converged = int(1)
        step = step + 1
    return gamma


@wp.func
def hill_multiplier(e: wp.mat33d, k: vec6, radius: wp.float64):
    """gamma >= 0 with sqrt(e':M:e') = radius for e' = hill_relaxed(e, k, gamma), *without gradient*."""
    return hill_multiplier_value(e, k, radius)


@wp.func_grad(hill_multiplier)
def adj_hill_multiplier(e: wp.mat33d, k: vec6, radius: wp.float64, adj_ret: wp.float64):
    pass


@wp.func
def symmetric_exponential(H: wp.mat33d):
    """exp of a symmetric matrix."""
    shift = _ONE + wp.sqrt(wp.ddot(H, H))
    U, S, V = svd_value(H + shift * wp.identity(n=3, dtype=wp.float64))
    grown = wp.vec3d(wp.exp(S[0] - shift), wp.exp(S[1] - shift), wp.exp(S[2] - shift))
    return V * wp.diag(grown) * wp.transpose(V)


@wp.func_grad(symmetric_exponential)
def adj_symmetric_exponential(H: wp.mat33d, adj_ret: wp.mat33d):
    # in the eigenframe dA_ij = dH_ij (exp a_i - exp a_j)/(a_i - a_j)
    shift = _ONE + wp.sqrt(wp.ddot(H, H))
    U, S, V = svd_value(H + shift * wp.identity(n=3, dtype=wp.float64))
    K = wp.transpose(V) * adj_ret * V
    a0 = wp.exp(S[0] - shift)
    a1 = wp.exp(S[1] - shift)
    a2 = wp.exp(S[2] - shift)
    q01 = a1 * growth(S[0] - S[1])
    q02 = a2 * growth(S[0] - S[2])
    q12 = a2 * growth(S[1] - S[2])
    P = wp.mat33d(
        K[0, 0] * a0, K[0, 1] * q01, K[0, 2] * q02,
        K[1, 0] * q01, K[1, 1] * a1, K[1, 2] * q12,
        K[2, 0] * q02, K[2, 1] * q12, K[2, 2] * a2,
    )  # fmt: skip
    wp.adjoint[H] += V * P * wp.transpose(V)


@wp.func
def hill_return(F: wp.mat33d, before: wp.mat33d, C_affine: wp.mat33d, R: wp.mat33d, U: wp.mat33d, S: wp.vec3d, V: wp.mat33d,
                H: wp.mat33d, n2: wp.float64, norm_eps: wp.float64, p: LawParameters, dt: wp.float64):  # fmt: skip
    """e = dev H in the material axes; where 2 mu sqrt(e:M:e) > yield_stress, e <- (I + gamma M)^-1 e with gamma >= 0 such that
    equality holds: the closest point in the elastic energy, so the flow is Hill's (1948) associated one. F = R exp(H).

    p: mu, lam, yield_stress [Pa], the six of COEFFICIENTS, r of the axes (3). norm_eps and the adapter's n2 have no part in it.
    """
    A = F
    yielded = int(0)
    k = vec6(p[3], p[4], p[5], p[6], p[7], p[8])
    Q = axes_rotation(wp.vec3d(p[9], p[10], p[11]))
    D = deviator(H)
    e = wp.transpose(Q) * D * Q
    radius = p[2] / (_TWO * p[0])
    if hill_square(e, k) > radius * radius:
        start = hill_multiplier(e, k, radius)
        # one more Newton step, which moves nothing but carries the derivative of the root
        r = hill_relaxed(e, k, start)
        gamma = start - (hill_square(r, k) - radius * radius) / hill_slope(r, k, start)
        mapped = Q * hill_relaxed(e, k, gamma) * wp.transpose(Q)
        A = R * symmetric_exponential(mapped + (H - D))
        yielded = int(1)
    return A, yielded


register_law(
    HILL, stvk, {"mu": 1, "lam": 1, "yield_stress": 1, **dict.fromkeys(COEFFICIENTS, 1), "axes": 3}, return_map=hill_return,
)  # fmt: skip

"""Isotropic laws of rubber and soft tissue: Mooney-Rivlin, Yeoh, Ogden.

All are split: the deviatoric part reads b_bar = J^(-2/3) F F^T, the volumetric part is kappa/2 ((J^2 - 1)/2 - log J) with
kappa = lam + 2 mu/3 (Simo and Hughes 1998, section 9.2). mu and lam [Pa] are the Lamé parameters at rest, so that E and nu keep
their meaning; the other parameters are numbers without unit that shape the curve. J > 0 only.

Stability: at rest every one is positive definite for mu, kappa > 0. Within the ranges of `FORMS` (`mosa/modules/body/material.py`)
Yeoh and Ogden are polyconvex, as is Mooney-Rivlin for second_share = 0; for second_share > 0 its second invariant is not polyconvex
in the split form (Hartmann and Neff 2003), but the Baker-Ericksen inequalities hold.
"""

import warp as wp

from mosa.physics.constitutive.elasticity import eye
from mosa.physics.constitutive.kinematics import contract, svd
from mosa.physics.constitutive.laws import LawParameters, register_law
from mosa.physics.constitutive.material_kernels import deviator

_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_THREE = wp.constant(wp.float64(3.0))
_TWO_THIRDS = wp.constant(wp.float64(2.0 / 3.0))


@wp.func
def volumetric(F: wp.mat33d, p: LawParameters):
    """kappa/2 (J^2 - 1) I, kappa = lam + 2 mu/3 of the first two parameters."""
    J = wp.determinant(F)
    return _HALF * (p[1] + _TWO_THIRDS * p[0]) * (J * J - _ONE) * eye()


@wp.func
def isochoric_left(F: wp.mat33d):
    """b_bar = J^(-2/3) F F^T."""
    return wp.pow(wp.determinant(F), -_TWO_THIRDS) * (F * wp.transpose(F))


@wp.func
def mooney_rivlin(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """mu dev((1 - s) b_bar + s (I1 b_bar - b_bar^2)) and the volumetric part, s = second_share.

    Energy c1 (I1 - 3) + c2 (I2 - 3) of b_bar, c1 = mu (1 - s)/2, c2 = mu s/2 (Mooney 1940, Rivlin 1948)."""
    b = isochoric_left(F)
    second = wp.trace(b) * b - b * b
    return p[0] * deviator((_ONE - p[2]) * b + p[2] * second) + volumetric(F, p)


@wp.func
def yeoh(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """mu (1 + 2 r2 x + 3 r3 x^2) dev(b_bar) and the volumetric part, x = tr b_bar - 3.

    Energy mu/2 (x + r2 x^2 + r3 x^3): Yeoh's (1993) with C20 = r2 C10, C30 = r3 C10; r2, r3: yeoh_2, yeoh_3."""
    b = isochoric_left(F)
    x = wp.trace(b) - _THREE
    return p[0] * (_ONE + _TWO * p[2] * x + _THREE * p[3] * x * x) * deviator(b) + volumetric(F, p)


@wp.func
def ogden_term(
    F: wp.mat33d, U: wp.mat33d, S: wp.vec3d, V: wp.mat33d, mu: wp.float64, a: wp.float64
):
    """2 mu/a dev(b_bar^(a/2)): `contract` gives det A = J and A A^T = J^(2/3) b_bar^(a/2)."""
    return _TWO * mu / a * deviator(isochoric_left(contract(F, U, S, V, _HALF * a)))


@wp.func
def ogden(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """sum over k of 2 mu_k/alpha_k dev(b_bar^(alpha_k/2)) and the volumetric part (Ogden 1972).

    Energy sum of 2 mu_k/alpha_k^2 (sum_i l_i^alpha_k - 3), l_i = J^(-1/3) S_i. mu_2 = s2 mu, mu_3 = s3 (mu - mu_2) and mu_1 the
    rest, with the shares s2 and s3 (share_2, share_3): 0 leaves a term out."""
    U, S, V = svd(F)
    rest = p[0] * (_ONE - p[3])
    T = ogden_term(F, U, S, V, rest * (_ONE - p[5]), p[2]) + volumetric(F, p)
    T = T + ogden_term(F, U, S, V, p[0] * p[3], p[4])
    return T + ogden_term(F, U, S, V, rest * p[5], p[6])


_LAME = {"mu": 1, "lam": 1}
_POWERS = dict.fromkeys(("alpha_1", "share_2", "alpha_2", "share_3", "alpha_3"), 1)
register_law("mooney_rivlin", mooney_rivlin, _LAME | {"second_share": 1}, needs_positive_J=True)
register_law("yeoh", yeoh, _LAME | {"yeoh_2": 1, "yeoh_3": 1}, needs_positive_J=True)
register_law("ogden", ogden, _LAME | _POWERS, needs_positive_J=True)

"""Isotropic laws of rubber and soft tissue: Mooney-Rivlin, Yeoh, Ogden, with their energies per rest volume [J/m^3].

All are split: the deviatoric part reads b_bar = J^(-2/3) F F^T, the volumetric part is kappa/2 ((J^2 - 1)/2 - log J) with
kappa = lam + 2 mu/3 (Simo and Hughes 1998, section 9.2). mu and lam [Pa] are the Lamé parameters at rest, so that E and nu keep
their meaning; the other parameters are numbers without unit that shape the curve. J > 0 only.

Stability: at rest every one is positive definite for mu, kappa > 0. Within the ranges of `FORMS` (`mosa/modules/body/material.py`)
Yeoh and Ogden are polyconvex, as is Mooney-Rivlin for second_share = 0; for second_share > 0 its second invariant is not polyconvex
in the split form (Hartmann and Neff 2003), but the Baker-Ericksen inequalities hold.
"""

import torch
import warp as wp
from torch import Tensor

from mosa.physics.constitutive.elasticity import eye
from mosa.physics.constitutive.energies import signed_singular_values
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


def volumetric_energy(J: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """kappa/2 ((J^2 - 1)/2 - log J), kappa = lam + 2 mu/3."""
    return 0.5 * (lam + 2 * mu / 3) * (0.5 * (J**2 - 1) - torch.log(J))


def isochoric_invariants(F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """J, and the first and second invariant of b_bar, each (...)."""
    C, J = F.mT @ F, torch.linalg.det(F)
    I1, square = C.diagonal(dim1=-2, dim2=-1).sum(-1), (C * C).sum((-2, -1))
    return J, J.pow(-2 / 3) * I1, J.pow(-4 / 3) * 0.5 * (I1**2 - square)


def mooney_rivlin_energy(F: Tensor, mu: Tensor, lam: Tensor, second_share: Tensor) -> Tensor:
    """mu/2 ((1 - s) (I1 - 3) + s (I2 - 3)) and the volumetric part."""
    J, I1, I2 = isochoric_invariants(F)
    shared = (1 - second_share) * (I1 - 3) + second_share * (I2 - 3)
    return 0.5 * mu * shared + volumetric_energy(J, mu, lam)


def yeoh_energy(F: Tensor, mu: Tensor, lam: Tensor, yeoh_2: Tensor, yeoh_3: Tensor) -> Tensor:
    """mu/2 (x + r2 x^2 + r3 x^3), x = I1 - 3, and the volumetric part."""
    J, I1, _ = isochoric_invariants(F)
    x = I1 - 3
    return 0.5 * mu * (x + yeoh_2 * x**2 + yeoh_3 * x**3) + volumetric_energy(J, mu, lam)


def ogden_energy(F: Tensor, mu: Tensor, lam: Tensor, alpha_1: Tensor, share_2: Tensor, alpha_2: Tensor, share_3: Tensor,
                 alpha_3: Tensor) -> Tensor:  # fmt: skip
    """sum of 2 mu_k/alpha_k^2 (sum_i l_i^alpha_k - 3) and the volumetric part."""
    S, J = signed_singular_values(F)
    stretch, rest = J.pow(-1 / 3)[..., None] * S, mu * (1 - share_2)
    terms = ((rest * (1 - share_3), alpha_1), (mu * share_2, alpha_2), (rest * share_3, alpha_3))
    stored = [2 * m / a**2 * (stretch.pow(a).sum(-1) - 3) for m, a in terms]
    return stored[0] + stored[1] + stored[2] + volumetric_energy(J, mu, lam)


_LAME = {"mu": 1, "lam": 1}
_POWERS = dict.fromkeys(("alpha_1", "share_2", "alpha_2", "share_3", "alpha_3"), 1)
register_law(
    "mooney_rivlin", mooney_rivlin, _LAME | {"second_share": 1}, needs_positive_J=True, energy=mooney_rivlin_energy
)  # fmt: skip
register_law(
    "yeoh", yeoh, _LAME | {"yeoh_2": 1, "yeoh_3": 1}, needs_positive_J=True, energy=yeoh_energy
)
register_law("ogden", ogden, _LAME | _POWERS, needs_positive_J=True, energy=ogden_energy)

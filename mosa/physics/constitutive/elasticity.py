"""Hyperelastic laws: Kirchhoff stress tau(F) [Pa] (the paper's appendix on constitutive models).

Every law is a Warp function of F built on `kinematics`, so that its adjoint is exact; R is the polar rotation where it is used.
tau = (dPsi/dF) F^T and tau(I) = 0. Parameters: mu, lam, the Lamé parameters [Pa].
"""

import warp as wp
from torch import Tensor

from mosa.physics.constitutive.kinematics import hencky_spatial, svd
from mosa.physics.constitutive.laws import LawParameters, law_named, register_law

_TWO = wp.constant(wp.float64(2.0))
_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))


def lame(E: Tensor, nu: Tensor) -> tuple[Tensor, Tensor]:
    """(mu, lam) [Pa] from Young's modulus [Pa] and Poisson's ratio, of any one shape.

    mu = E/(2 (1 + nu)), lam = E nu/((1 + nu)(1 - 2 nu))."""
    return E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))


@wp.func
def eye():
    return wp.identity(n=3, dtype=wp.float64)


@wp.func
def linear(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """sym(P G^T), P = mu (G + G^T - 2I) + lam tr(G - I) I with G = F F_0^T, the deformation since the sequence's start.

    Not frame indifferent: for small rotations only. Energy of G: mu |sym(G) - I|^2 + lam/2 tr(G - I)^2; P G^T is its stress
    and not symmetric, of which the symmetric part is taken."""
    F0 = wp.mat33d(p[2], p[3], p[4], p[5], p[6], p[7], p[8], p[9], p[10])
    G = F * wp.transpose(F0)
    P = p[0] * (G + wp.transpose(G) - _TWO * eye()) + p[1] * (wp.trace(G) - wp.float64(3.0)) * eye()
    T = P * wp.transpose(G)
    return _HALF * (T + wp.transpose(T))


@wp.func
def neo_hookean(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """mu (F F^T - I) + lam log(J) I. Energy mu/2 (|F|^2 - 3) - mu log J + lam/2 (log J)^2; J > 0 only."""
    return p[0] * (F * wp.transpose(F) - eye()) + p[1] * wp.log(wp.determinant(F)) * eye()


@wp.func
def corotated(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """2 mu (F - R) F^T + lam (J - 1) J I. Energy mu |F - R|^2 + lam/2 (J - 1)^2 (Stomakhin et al. 2012)."""
    J = wp.determinant(F)
    T = (F - R) * wp.transpose(F)
    return p[0] * (T + wp.transpose(T)) + p[1] * (J - _ONE) * J * eye()


@wp.func
def hencky_stress(F: wp.mat33d, p: LawParameters):
    U, S, V = svd(F)
    H = hencky_spatial(F, U, S, V)
    return _TWO * p[0] * H + p[1] * wp.trace(H) * eye()


@wp.func
def stvk(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """U (2 mu eps + lam tr(eps) 1) U^T, eps = log max(S, 0.05). Energy mu |eps|^2 + lam/2 tr(eps)^2 (Hencky)."""
    return hencky_stress(F, p)


@wp.func
def stvk_paper(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """U (2 mu eps + lam tr(eps) 1) V^T F^T, as the paper prints it: one factor of S more than `stvk`, and no energy."""
    T = hencky_stress(F, p) * (R * wp.transpose(F))
    return _HALF * (T + wp.transpose(T))


def wave_modulus(law: str, parameters: dict[str, Tensor]) -> Tensor:
    """Largest small-strain modulus M [Pa] of the P wave over particles, (). Errors: ConfigError if it does not follow from the
    parameters."""
    return law_named(law).wave_modulus(parameters).max()


_LAME = {"mu": 1, "lam": 1}
register_law("linear", linear, {**_LAME, "reference": 9}, reference="reference")
register_law("neo_hookean", neo_hookean, _LAME, needs_positive_J=True)
register_law("corotated", corotated, _LAME, uses_rotation=True)
register_law("stvk", stvk, _LAME)
register_law("stvk_paper", stvk_paper, _LAME, uses_rotation=True)

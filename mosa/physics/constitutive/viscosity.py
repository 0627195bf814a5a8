"""Laws that flow at a rate: Herschel-Bulkley (exponent 1) in two variants and the Newtonian fluid.

The first variant is that of the paper's appendix on constitutive models, the second and the fluid are those of public simulators.

Parameters: kappa bulk modulus [Pa], of the fluid a seventh of it; mu shear modulus [Pa], of the
fluid twice the viscosity [Pa s]; uniaxial yield_stress [Pa]; viscosity [Pa s], twice Bingham's:
|s| = sqrt(2/3) yield_stress + viscosity |D_p|.
Return mappings have the signature of `plasticity`.
"""

# ruff: noqa: UP018, RUF046
# (Warp: `int(0)` makes a variable that a dynamic loop or branch may change)

import warp as wp
from torch import Tensor

from mosa.physics.constitutive.elasticity import eye
from mosa.physics.constitutive.isochoric import clamped_squares, isochoric_contract
from mosa.physics.constitutive.kinematics import (
    contract,
    hencky_spatial,
    rotation,
    rotation_of,
    svd,
)
from mosa.physics.constitutive.laws import LawParameters, register_law
from mosa.physics.constitutive.material_kernels import deviator

J_MIN = wp.constant(wp.float64(0.05))
"""The fluid's J is held above it, as singular values are in the solids."""

_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_THIRD = wp.constant(wp.float64(1.0 / 3.0))
_SQRT23 = wp.constant(wp.float64((2.0 / 3.0) ** 0.5))


@wp.func
def root(x: wp.float64):
    """sqrt(x), with gradient 0 at x = 0."""
    return wp.where(x > _ZERO, wp.sqrt(wp.where(x > _ZERO, x, _ONE)), _ZERO)


@wp.func
def flow_fraction(
    n: wp.float64, yield_stress: wp.float64, viscosity: wp.float64, modulus: wp.float64, dt: wp.float64
):  # fmt: skip
    """|s|/|s_trial| after a step of flow: |s| = n - y/(1 + viscosity/(2 modulus dt)), y = n - sqrt(2/3) yield_stress > 0."""
    y = n - _SQRT23 * yield_stress
    return _ONE - y / (n * (_ONE + viscosity / (_TWO * modulus * dt)))


@wp.func
def herschel_bulkley(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """kappa/2 (J^2 - 1) I + mu dev(b_bar), b_bar = J^(-2/3) F F^T; J > 0 only. The paper's variant.

    Energy kappa/2 ((J^2 - 1)/2 - log J) + mu/2 (tr b_bar - 3) (Simo, Hughes 1998)."""
    J = wp.determinant(F)
    b = wp.pow(J, -_TWO * _THIRD) * (F * wp.transpose(F))
    return _HALF * p[1] * (J * J - _ONE) * eye() + p[0] * deviator(b)


@wp.func
def herschel_bulkley_return(F: wp.mat33d, before: wp.mat33d, C_affine: wp.mat33d, R: wp.mat33d, U: wp.mat33d, S: wp.vec3d,
                            V: wp.mat33d, H: wp.mat33d, n2: wp.float64, norm_eps: wp.float64, p: LawParameters,
                            dt: wp.float64):  # fmt: skip
    """s_trial = mu dev(b_bar); where |s_trial| > sqrt(2/3) yield_stress the deviator is scaled by `flow_fraction` with modulus
    mu, and b_bar gets the trace with which its determinant stays 1.

    p: mu, kappa, yield_stress, viscosity. An adapter that corrects the strain adds 2 mu (|E'| - |E|) to |s_trial|: dev(b_bar) is
    2 E at small strain, and a factor |E'|/|E| would have no derivative where E vanishes. norm_eps is under the root [Pa^2]."""
    A = F
    yielded = int(0)
    J = wp.determinant(F)
    if J > _ZERO:
        D = deviator(wp.pow(J, -_TWO * _THIRD) * (F * wp.transpose(F)))
        E = deviator(H)
        measure = p[0] * wp.max(
            root(wp.ddot(D, D)) + _TWO * (root(n2) - root(wp.ddot(E, E))), _ZERO
        )
        q = measure * measure + norm_eps
        n = wp.sqrt(wp.where(q > _ZERO, q, _ONE))
        if q > _ZERO and n > _SQRT23 * p[2]:
            A = isochoric_contract(F, U, S, V, flow_fraction(n, p[2], p[3], p[0], dt))
            yielded = int(1)
    return A, yielded


@wp.func
def herschel_bulkley_hencky(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """`stvk` with lam = kappa - 2 mu/3: what public simulators run under the name (Yue et al. 2015, in Hencky strain)."""
    U, S, V = svd(F)
    H = hencky_spatial(F, U, S, V)
    return _TWO * p[0] * H + (p[1] - _TWO * _THIRD * p[0]) * wp.trace(H) * eye()


@wp.func
def herschel_bulkley_hencky_return(
    F: wp.mat33d, before: wp.mat33d, C_affine: wp.mat33d, R: wp.mat33d, U: wp.mat33d, S: wp.vec3d, V: wp.mat33d, H: wp.mat33d,
    n2: wp.float64, norm_eps: wp.float64, p: LawParameters, dt: wp.float64,
):  # fmt: skip
    """s_trial = 2 mu E'; where |s_trial| > sqrt(2/3) yield_stress the deviatoric strain is scaled by `flow_fraction` with modulus
    mu sum(S^2)/3, the trace kept. p: mu, kappa, yield_stress, viscosity; norm_eps is under the root of |s_trial| [Pa^2]."""
    A = F
    yielded = int(0)
    q = wp.float64(4.0) * p[0] * p[0] * n2 + norm_eps
    n = wp.sqrt(wp.where(q > _ZERO, q, _ONE))
    if q > _ZERO and n > _SQRT23 * p[2]:
        modulus = _THIRD * p[0] * clamped_squares(F, U, S, V)
        A = contract(F, U, S, V, flow_fraction(n, p[2], p[3], modulus, dt))
        yielded = int(1)
    return A, yielded


@wp.func
def newtonian(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """kappa (J - J^-6) I + mu sym(C_affine) J: Tait-like pressure p = kappa (J^-7 - 1) and a viscous stress. p: mu, kappa.

    The viscous term is half of the usual 2 mu D, not deviatoric, and takes the last C_affine; kept so that published values of mu
    can be compared. tau(I) = 0 for C_affine = 0."""
    J = wp.determinant(F)
    x = _ONE / J
    x3 = x * x * x
    return p[1] * (J - x3 * x3) * eye() + _HALF * p[0] * J * (C_affine + wp.transpose(C_affine))


@wp.func
def newtonian_return(F: wp.mat33d, before: wp.mat33d, C_affine: wp.mat33d, R: wp.mat33d, U: wp.mat33d, S: wp.vec3d,
                     V: wp.mat33d, H: wp.mat33d, n2: wp.float64, norm_eps: wp.float64, p: LawParameters,
                     dt: wp.float64):  # fmt: skip
    """F = J^(1/3) R: a fluid keeps its volume change J <- max((1 + dt tr C_affine) J, 0.05) and a rotation
    R <- polar((I + dt skew C_affine) R), which gives the adapter its material frame."""
    J = wp.max((_ONE + dt * wp.trace(C_affine)) * wp.determinant(before), J_MIN)
    spin = _HALF * (C_affine - wp.transpose(C_affine))
    # `before` is its rotation times a number, which the polar rotation does not see
    turned = before + dt * (spin * before)
    yielded = int(1)
    return wp.pow(J, _THIRD) * rotation(turned, rotation_of(turned)), yielded


def newtonian_modulus(kappa: Tensor, **unused: Tensor) -> Tensor:
    """d(p J)/dJ at rest: 7 kappa [Pa]."""
    return 7 * kappa


def newtonian_viscosity(mu: Tensor, **unused: Tensor) -> Tensor:
    """mu [Pa s]: its stress takes the last C_affine, which bounds the time step."""
    return mu


_SOLID = {"mu": 1, "kappa": 1, "yield_stress": 1, "viscosity": 1}
register_law(
    "herschel_bulkley", herschel_bulkley, _SOLID, return_map=herschel_bulkley_return, needs_positive_J=True,
)  # fmt: skip
register_law(
    "herschel_bulkley_hencky", herschel_bulkley_hencky, _SOLID, return_map=herschel_bulkley_hencky_return,
)  # fmt: skip
register_law(
    "newtonian", newtonian, {"mu": 1, "kappa": 1}, return_map=newtonian_return,
    modulus=newtonian_modulus, viscosity=newtonian_viscosity,
)  # fmt: skip

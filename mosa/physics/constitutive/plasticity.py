"""Return mappings: what leaves of a trial F once a law has yielded (the paper's appendix on constitutive models; eq. 9).

A mapping gets the trial F = (I + dt C_affine) F_before with its factors, F_before and C_affine themselves (for flows that follow a
rate), the material Hencky strain H = log W, and n2 = |E'|^2, the squared norm that enters the yield function: E' = dev(H) for a
plain law, its corrected form when the adapter has a plastic part. It returns the mapped F and whether the particle yielded. The
flow is coaxial: the deviator is scaled by max(0, 1 - dgamma/|E'|).
Where |E'| can vanish the argument is replaced *before* the root: 0 x NaN is NaN in a backward pass.
"""

# ruff: noqa: UP018, RUF046
# (Warp: `int(0)` makes a variable that a dynamic loop or branch may change, and results are unpacked whole)

import torch
import warp as wp
from torch import Tensor

from mosa.physics.constitutive.elasticity import stvk
from mosa.physics.constitutive.kinematics import contract
from mosa.physics.constitutive.laws import LawParameters, register_law

YIELD_CONVENTIONS = {"paper": 1.0, "sqrt23": (2.0 / 3.0) ** 0.5}
"""Factor on yield_stress: |2 mu dev eps| <= factor * yield_stress."""

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_THREE = wp.constant(wp.float64(3.0))


def friction_alpha(angle: Tensor, cone: str = "klar") -> Tensor:
    """Slope of the Drucker-Prager cone from the friction angle [degrees]: sqrt(2/3) 2 sin/(3 - sin).

    cone: klar (Klar et al. 2016) | printed: the square root over the whole fraction, as the paper
    prints it: a misprint, by which 30 degrees yield as 46 do."""
    s = torch.sin(torch.deg2rad(angle))
    if cone == "printed":
        return (2.0 / 3.0 * 2 * s / (3 - s)) ** 0.5
    return (2.0 / 3.0) ** 0.5 * 2 * s / (3 - s)


@wp.func
def safe_norm(n2: wp.float64, norm_eps: wp.float64):
    """sqrt(n2 + norm_eps), and 1 where that is zero: callers do not yield there."""
    q = n2 + norm_eps
    return wp.sqrt(wp.where(q > _ZERO, q, _ONE))


@wp.func
def von_mises_return(F: wp.mat33d, before: wp.mat33d, C_affine: wp.mat33d, R: wp.mat33d, U: wp.mat33d, S: wp.vec3d,
                     V: wp.mat33d, H: wp.mat33d, n2: wp.float64, norm_eps: wp.float64, p: LawParameters,
                     dt: wp.float64):  # fmt: skip
    """dgamma = |E'| - yield_stress/(2 mu); where positive the deviator shrinks by dgamma. p: mu, lam, yield_stress [Pa]."""
    n = safe_norm(n2, norm_eps)
    dgamma = n - p[2] / (_TWO * p[0])
    A = F
    yielded = int(0)
    if n2 + norm_eps > _ZERO and dgamma > _ZERO:
        A = contract(F, U, S, V, wp.max(_ONE - dgamma / n, _ZERO))
        yielded = int(1)
    return A, yielded


@wp.func
def drucker_prager_return(F: wp.mat33d, before: wp.mat33d, C_affine: wp.mat33d, R: wp.mat33d, U: wp.mat33d, S: wp.vec3d,
                          V: wp.mat33d, H: wp.mat33d, n2: wp.float64, norm_eps: wp.float64, p: LawParameters,
                          dt: wp.float64):  # fmt: skip
    """t = tr(eps) - 3c; t >= 0: the tip exp(c) R. dgamma = |E'| + alpha (3 lam + 2 mu)/(2 mu) t, where positive the deviator
    shrinks by it. p: mu, lam [Pa], friction_alpha, cohesion c (a strain). Klar et al. 2016 without volume correction."""
    t = wp.trace(H) - _THREE * p[3]
    A = F
    yielded = int(0)
    if t >= _ZERO:
        A = wp.exp(p[3]) * R
        # the rest state of a law without cohesion sits on the tip, where the map is the identity
        yielded = int(1)
    else:
        n = safe_norm(n2, norm_eps)
        dgamma = n + p[2] * (_THREE * p[1] + _TWO * p[0]) / (_TWO * p[0]) * t
        if n2 + norm_eps > _ZERO and dgamma > _ZERO:
            A = contract(F, U, S, V, wp.max(_ONE - dgamma / n, _ZERO))
            yielded = int(1)
    return A, yielded


register_law("von_mises", stvk, {"mu": 1, "lam": 1, "yield_stress": 1}, return_map=von_mises_return)
register_law(
    "drucker_prager", stvk, {"mu": 1, "lam": 1, "friction_alpha": 1, "cohesion": 1}, return_map=drucker_prager_return,
)  # fmt: skip

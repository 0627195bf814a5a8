"""A viscous branch beside the stress of any law (Kelvin, Voigt): the law `a~damped` of a law a.

    tau = tau_a + 2 eta dev(D) + zeta tr(D) I,   D = sym(C_affine)

with the shear viscosity eta (`damping`) and the bulk viscosity zeta (`bulk_damping`) [Pa s], per
rest volume. It is objective: D turns with the body, and a rigid motion has none. It is passive:
tau_v : D = 2 eta |dev D|^2 + zeta tr(D)^2 >= 0. The rate is that of the last substep, which bounds
the time step as the viscosity of a fluid does (`time_step`).
"""

from collections.abc import Callable, Sequence

import torch
import warp as wp
from torch import Tensor

from mosa.errors import ConfigError
from mosa.physics.constitutive.laws import Law, LawParameters, register_composition, register_law

DAMPED = "~damped"
DAMPING = ("damping", "bulk_damping")

_HALF = wp.constant(wp.float64(0.5))
_TWO = wp.constant(wp.float64(2.0))
_TWO_THIRDS = wp.constant(wp.float64(2.0 / 3.0))


def register_damped(name: str, laws: Sequence[Law]) -> Law:
    """`name` = a~damped of one law a. Errors: ConfigError for a law that is viscous itself."""
    (law,) = laws
    if law.viscosity is not None:
        raise ConfigError(f"law {name!r}: expected a law without viscosity, found {law.name!r}")
    parameters = law.parameters | dict.fromkeys(DAMPING, 1)
    return register_law(
        name, _stress(law.stress, sum(law.parameters.values())), parameters, return_map=law.return_map,
        uses_rotation=law.uses_rotation, reference=law.reference, needs_positive_J=law.needs_positive_J,
        modulus=lambda **p: law.wave_modulus({k: v for k, v in p.items() if k not in DAMPING}), viscosity=viscosity,
    )  # fmt: skip


def viscosity(damping: Tensor, bulk_damping: Tensor, **unused: Tensor) -> Tensor:
    """[Pa s] of the stress mu sym(C_affine) that bounds the time step as much: 2 eta for shear, 4
    eta/3 + zeta along a wave."""
    damping, bulk_damping = torch.as_tensor(damping), torch.as_tensor(bulk_damping)
    return torch.maximum(2 * damping, 4 / 3 * damping + bulk_damping)


def _stress(law_stress: Callable, slot: int) -> Callable:
    @wp.func
    def stress(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
        D = _HALF * (C_affine + wp.transpose(C_affine))
        volumetric = (p[slot + 1] - _TWO_THIRDS * p[slot]) * wp.trace(D)
        return (
            law_stress(F, R, C_affine, p)
            + (_TWO * p[slot]) * D
            + volumetric * wp.identity(n=3, dtype=wp.float64)
        )

    return stress


register_composition(DAMPED, register_damped)

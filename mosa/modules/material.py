"""Global parameters of a prior law in unconstrained form (method.md, section 5)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from mosa.errors import ConfigError
from mosa.physics.elasticity import lame
from mosa.physics.plasticity import friction_alpha

NU_MAX, ANGLE_MAX = 0.49, 89.0


def _logit(p: float) -> float:
    return math.log(p / (1 - p))


# name -> (to unconstrained, to physical, is inside its open range)
FORMS = {
    "log": (math.log, torch.exp, lambda v: v > 0),
    "softplus": (lambda v: v + math.log(-math.expm1(-v)), nn.functional.softplus, lambda v: v > 0),
    "nu": (lambda v: _logit(v / NU_MAX), lambda u: NU_MAX * torch.sigmoid(u), lambda v: 0 < v < NU_MAX),
    "angle": (lambda v: _logit(v / ANGLE_MAX), lambda u: ANGLE_MAX * torch.sigmoid(u), lambda v: 0 < v < ANGLE_MAX),
}
FORM_OF = {"E": "log", "mu": "log", "kappa": "log", "yield_stress": "log", "viscosity": "softplus", "cohesion": "softplus",
           "nu": "nu", "friction_angle": "angle"}
AT_BOUND = {"cohesion": 0.0, "viscosity": 0.0}
"""Values a parameter may start from that its unconstrained form cannot reach; it is held there."""


class Material(nn.Module):
    """Parameters of one prior law. law: name in `mosa.physics`; parameters: initial physical values (SI, friction_angle in
    degrees); frozen: names that are not learned; modulated: names the heterogeneity factor multiplies (the stiffness).

    Errors: ConfigError naming the parameter, its range and the value found.
    """

    def __init__(
        self, law: str, parameters: Mapping[str, float], frozen: Sequence[str] = (), modulated: Sequence[str] | None = None
    ) -> None:
        super().__init__()
        unknown = sorted(set(parameters) - set(FORM_OF))
        if unknown:
            raise ConfigError(f"prior.parameters: unknown {unknown}; known are {', '.join(FORM_OF)}")
        for name in [*frozen, *(modulated or ())]:
            if name not in parameters:
                raise ConfigError(f"prior: {name!r} is frozen or modulated but not among the parameters {sorted(parameters)}")
        self.law, self.names = law, tuple(parameters)
        self.stiffness = "E" if "E" in parameters else "kappa"
        self.modulated = tuple(modulated) if modulated is not None else tuple(n for n in ("E", "mu", "kappa") if n in parameters)
        self.raw = nn.ParameterDict()
        for name, value in parameters.items():
            value = float(value)
            if name in AT_BOUND and value == AT_BOUND[name]:
                self.register_buffer(f"held_{name}", torch.tensor(value))
                continue
            inverse, _, valid = FORMS[FORM_OF[name]]
            if not valid(value):
                raise ConfigError(f"prior.parameters.{name}: {value} is outside its range")
            self.raw[name] = nn.Parameter(torch.tensor(inverse(value)), requires_grad=name not in frozen)

    def physical(self) -> dict[str, Tensor]:
        """Constrained global values, scalars, in SI units (friction_angle in degrees)."""
        return {n: FORMS[FORM_OF[n]][1](self.raw[n]) if n in self.raw else getattr(self, f"held_{n}") for n in self.names}

    def per_particle(self, factor: Tensor) -> dict[str, Tensor]:
        """Values the simulator takes; factor: (N,) heterogeneity of the modulated parameters."""
        values = {n: v * factor if n in self.modulated else v for n, v in self.physical().items()}
        result = {n: v for n, v in values.items() if n not in ("E", "nu", "friction_angle")}
        if "E" in values:
            result["mu"], result["lam"] = lame(values["E"], values["nu"])
        if "friction_angle" in values:
            result["friction_alpha"] = friction_alpha(values["friction_angle"])
        return result

    def max_modulus(self, factor: Tensor) -> Tensor:
        """Largest M = lam + 2 mu (kappa + 4 mu / 3 where the law has no E) over the particles [Pa], for the time step."""
        p = self.per_particle(factor.detach())
        return (p["lam"] + 2 * p["mu"] if "lam" in p else p["kappa"] + 4 * p["mu"] / 3).detach().max()

    def reference_modulus(self) -> Tensor:
        """E, or kappa where the law has no E [Pa]: what the adapter's stress is measured in."""
        return self.physical()[self.stiffness].detach()

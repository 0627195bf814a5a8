"""What the hidden materials of the built-in scenes share: an elastic part whose stiffness varies over the body."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from mosa.errors import ConfigError
from mosa.physics.constitutive.elasticity import lame
from mosa.physics.engine.law_options import LawOptions


@dataclass(frozen=True, kw_only=True)
class Hidden:
    """E [Pa], nu: elastic part; amplitude and period [m] of the factor 1 + amplitude sin(2 pi X.axis/period) on every modulus over
    rest positions X; density [kg/m^3]. Subclasses have `law`, `isotropic`, `parameters` and `summary`."""

    E: float
    nu: float
    amplitude: float
    period: float
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0)
    density: float = 1000.0

    @property
    def options(self) -> LawOptions:
        return LawOptions()

    def viscosity(self) -> float:
        """Viscosity that bounds the time step [Pa s]."""
        return 0.0

    @property
    def known(self) -> dict[str, float]:
        """What a prior can be compared with."""
        return {"E": self.E, "nu": self.nu}

    def variant(self, kind: str) -> Self:
        """`anisotropic`: this one; `isotropic`: its twin without directions and with one stiffness everywhere.

        Errors: ConfigError for another kind."""
        if kind == "anisotropic":
            return self
        if kind == "isotropic":
            return self.isotropic()
        raise ConfigError(f"scene.material: expected anisotropic or isotropic, found {kind!r}")

    def factor(self, rest: Tensor) -> Tensor:
        """(N,) stiffness factor at rest positions (N, 3) [m]."""
        axis = torch.tensor(self.axis, dtype=rest.dtype)
        return 1 + self.amplitude * torch.sin(2 * math.pi * (rest @ axis) / self.period)

    def elastic(self, factor: Tensor) -> tuple[Tensor, Tensor]:
        """(mu, lam) [Pa] of the elastic part, (N,) each."""
        return lame(self.E * factor, torch.full_like(factor, self.nu))

    def mean_modulus(self) -> float:
        """P wave modulus [Pa], along the stiffest direction, where the stiffness factor is 1."""
        mu, lam = lame(torch.tensor(self.E), torch.tensor(self.nu))
        return float(lam + 2 * mu)

    def wave_modulus(self) -> float:
        """Largest P wave modulus [Pa] in the body."""
        return (1 + abs(self.amplitude)) * self.mean_modulus()

"""The truth of the stand-ins for PAC-NeRF's scenes: a law of the learner's own with published parameters, the same everywhere."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mosa.physics.constitutive.elasticity import wave_modulus
from mosa.physics.constitutive.laws import law_named
from mosa.physics.engine.law_options import LawOptions


@dataclass(frozen=True, kw_only=True)
class PublishedMaterial:
    """law: a prior's name; values: its parameters (SI, degrees) by the names of `Material`, in pairs; held: those that a fit is not
    asked for; convention: of the yield stress; density [kg/m^3]. It has the interface of `Hidden`."""

    law: str
    values: tuple[tuple[str, float], ...]
    held: tuple[str, ...] = ()
    convention: str = "paper"
    density: float = 1000.0

    @property
    def options(self) -> LawOptions:
        return LawOptions(yield_convention=self.convention)

    @property
    def known(self) -> dict[str, float]:
        """What a fit has to find."""
        return {name: value for name, value in self.values if name not in self.held}

    def variant(self, kind: str) -> PublishedMaterial:
        """The same for anisotropic and isotropic: it has no directions."""
        return self

    def factor(self, rest: Tensor) -> Tensor:
        """(N,) ones."""
        return torch.ones_like(rest[:, 0])

    def _one(self) -> dict[str, Tensor]:
        from mosa.modules.body.material import Material

        found = Material(self.law, dict(self.values)).per_particle()
        return {name: value.detach() for name, value in found.items()}

    def parameters(self, rest: Tensor) -> dict[str, Tensor]:
        """What the law takes, per particle; rest: (N, 3) [m]."""
        return {name: value.to(rest).expand(len(rest)) for name, value in self._one().items()}

    def wave_modulus(self) -> float:
        """P wave modulus [Pa]."""
        return float(wave_modulus(self.law, self._one()))

    def viscosity(self) -> float:
        """Viscosity that bounds the time step [Pa s]."""
        return float(law_named(self.law).explicit_viscosity(self._one()).max())

    def summary(self) -> dict[str, float]:
        """Numbers for Truth.parameters."""
        return {**dict(self.values), "ratio": 1.0, "heterogeneity": 0.0}

"""The material of the built-in plastic scenes: it yields in directions, where every prior of the learner yields alike."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from mosa.data.builtin.axes import axes_parameter
from mosa.data.builtin.hill import COEFFICIENTS, HILL
from mosa.errors import ConfigError
from mosa.physics.elasticity import lame


@dataclass(frozen=True)
class HiddenYield:
    """E [Pa], nu: elastic part, isotropic (`stvk`); yield_stress [Pa]: |2 mu dev eps| at which it would yield if all coefficients
    (`hill.COEFFICIENTS`) were 1; turn: rotation vector [rad] of Hill's axes at rest; amplitude and period [m] of the factor
    1 + amplitude sin(2 pi X.axis/period) on E and yield_stress over rest positions."""

    E: float
    nu: float
    yield_stress: float
    coefficients: tuple[float, float, float, float, float, float]
    turn: tuple[float, float, float]
    amplitude: float
    period: float
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0)
    density: float = 1000.0

    @property
    def law(self) -> str:
        return HILL

    @property
    def known(self) -> dict[str, float]:
        """What a prior can be compared with; a yield stress where it is the same in all directions."""
        yields = {"yield_stress": self.yield_stress} if set(self.coefficients) == {1.0} else {}
        return {"E": self.E, "nu": self.nu, **yields}

    def variant(self, kind: str) -> HiddenYield:
        """`anisotropic`: this one; `isotropic`: its twin, von Mises with one stiffness everywhere. ConfigError for another kind."""
        if kind == "anisotropic":
            return self
        if kind == "isotropic":
            return replace(self, coefficients=(1.0,) * 6, amplitude=0.0)
        raise ConfigError(f"scene.material: expected anisotropic or isotropic, found {kind!r}")

    def parameters(self, rest: Tensor) -> dict[str, Tensor]:
        """What the law `hill` takes, per particle; rest: (N, 3) [m]."""
        axis = torch.tensor(self.axis, dtype=rest.dtype)
        factor = 1 + self.amplitude * torch.sin(2 * math.pi * (rest @ axis) / self.period)
        mu, lam = lame(self.E * factor, torch.full_like(factor, self.nu))
        values = {"mu": mu, "lam": lam, "yield_stress": self.yield_stress * factor}
        values |= {name: torch.full_like(factor, c) for name, c in zip(COEFFICIENTS, self.coefficients, strict=True)}
        axes = axes_parameter(torch.as_tensor(Rotation.from_rotvec(self.turn).as_matrix())).to(rest)
        return {**values, "axes": axes.expand(len(rest), 3)}

    def wave_modulus(self) -> float:
        """Largest P wave modulus [Pa], lam + 2 mu where the stiffness is highest."""
        mu, lam = lame(torch.tensor(self.E), torch.tensor(self.nu))
        return (1 + abs(self.amplitude)) * float(lam + 2 * mu)

    def summary(self) -> dict[str, float]:
        """Numbers for Truth.parameters; ratio: of the largest of Hill's coefficients to the smallest."""
        ratio = max(self.coefficients) / min(self.coefficients)
        return {"E": self.E, "nu": self.nu, "yield_stress": self.yield_stress, "ratio": ratio, "heterogeneity": self.amplitude}

"""The material of the built-in plastic scenes: it yields in directions, where every prior of the learner yields alike."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mosa.data.synthetic.materials.hidden import Hidden
from mosa.data.synthetic.materials.hill import COEFFICIENTS, HILL


@dataclass(frozen=True, kw_only=True)
class HiddenYield(Hidden):
    """yield_stress [Pa]: |2 mu dev eps| at which it would yield if all coefficients (`hill.COEFFICIENTS`) were 1, with the same
    factor as the moduli; turn: rotation vector [rad] of Hill's axes at rest. The elastic part is isotropic (`stvk`)."""

    yield_stress: float
    coefficients: tuple[float, float, float, float, float, float]
    turn: tuple[float, float, float]

    @property
    def law(self) -> str:
        return HILL

    @property
    def known(self) -> dict[str, float]:
        """What a prior can be compared with; a yield stress where it is the same in all directions."""
        yields = {"yield_stress": self.yield_stress} if set(self.coefficients) == {1.0} else {}
        return {**super().known, **yields}

    def isotropic(self) -> HiddenYield:
        """Its twin, von Mises with one stiffness everywhere."""
        return replace(self, coefficients=(1.0,) * 6, amplitude=0.0)

    def parameters(self, rest: Tensor) -> dict[str, Tensor]:
        """What the law `hill` takes, per particle; rest: (N, 3) [m]."""
        factor = self.factor(rest)
        mu, lam = self.elastic(factor)
        values = {"mu": mu, "lam": lam, "yield_stress": self.yield_stress * factor}
        pairs = zip(COEFFICIENTS, self.coefficients, strict=True)
        values |= {name: torch.full_like(factor, c) for name, c in pairs}
        turn = torch.tensor(self.turn, dtype=torch.float64)
        angle = turn.norm()
        axes = (turn * (angle / 2).tan() / angle).to(rest)  # as `axes_rotation` takes it
        return {**values, "axes": axes.expand(len(rest), 3)}

    def summary(self) -> dict[str, float]:
        """Numbers for Truth.parameters; ratio: of the largest of Hill's coefficients to the smallest."""
        ratio = max(self.coefficients) / min(self.coefficients)
        elastic = {"E": self.E, "nu": self.nu, "yield_stress": self.yield_stress}
        return {**elastic, "ratio": ratio, "heterogeneity": self.amplitude}

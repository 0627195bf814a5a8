"""Parameters of the law `hill` from the numbers that a table of materials has."""

from dataclasses import dataclass, field

import torch
from orthotropic import axes_parameter
from torch import Tensor

from mosa.data.synthetic.materials.hill import COEFFICIENTS
from mosa.errors import ConfigError
from mosa.physics.constitutive.elasticity import lame


@dataclass(frozen=True)
class HillMaterial:
    """E [Pa], nu: the isotropic elastic part. yield_stress [Pa]: |2 mu dev eps| at which the isotropic criterion would yield;
    coefficients: f, g, h, l, m, n of COEFFICIENTS; axes: rotation matrix (3, 3) whose columns are the axes 1, 2, 3 at rest.

    Errors: ConfigError when a coefficient is not positive.
    """

    E: float
    nu: float
    yield_stress: float
    coefficients: tuple[float, float, float, float, float, float] = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    axes: Tensor = field(default_factory=lambda: torch.eye(3, dtype=torch.float64))

    def __post_init__(self) -> None:
        if len(self.coefficients) != 6 or not all(c > 0 for c in self.coefficients):
            raise ConfigError(
                f"hill material: coefficients: expected six positive numbers, found {self.coefficients}"
            )

    def parameters(self) -> dict[str, Tensor]:
        """What the law `hill` takes, () each, axes (3,)."""
        double = lambda v: torch.tensor(v, dtype=torch.float64)  # noqa: E731
        mu, lam = lame(double(self.E), double(self.nu))
        values = {"mu": mu, "lam": lam, "yield_stress": double(self.yield_stress)}
        values |= {name: double(c) for name, c in zip(COEFFICIENTS, self.coefficients, strict=True)}
        return {**values, "axes": axes_parameter(self.axes)}

"""The material of the built-in scenes, which no prior of the learner can express: fibres, and stiffness that varies."""

import math
from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

from mosa.errors import ConfigError
from mosa.physics.elasticity import lame
from mosa.physics.laws import LawParameters, register_law

LAW = "fibre_neo_hookean"


@wp.func
def fibre_neo_hookean(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """mu (F F^T - I) + lam log(J) I + 2 kf (I4 - 1) (F a)(F a)^T, I4 = |F a|^2, a the fibre's rest direction (unit).

    Energy: the neo-Hookean one plus kf/2 (I4 - 1)^2 (Holzapfel, Nonlinear Solid Mechanics, section 6.7).
    """
    fa = F * wp.vec3d(p[3], p[4], p[5])
    one = wp.float64(1.0)
    matrix = p[0] * (F * wp.transpose(F) - wp.identity(n=3, dtype=wp.float64))
    volumetric = p[1] * wp.log(wp.determinant(F)) * wp.identity(n=3, dtype=wp.float64)
    fibre = wp.float64(2.0) * p[2] * (wp.dot(fa, fa) - one) * wp.outer(fa, fa)
    return matrix + volumetric + fibre


def fibre_energy(F: Tensor, mu: Tensor, lam: Tensor, kf: Tensor, fibre: Tensor) -> Tensor:
    """mu/2 (|F|^2 - 3) - mu log J + lam/2 (log J)^2 + kf/2 (|F a|^2 - 1)^2 [J/m^3]; F: (..., 3, 3), fibre: (..., 3)."""
    log_J = torch.log(torch.linalg.det(F))
    stretch = ((F @ fibre[..., None])[..., 0] ** 2).sum(-1)
    return 0.5 * mu * ((F * F).sum((-2, -1)) - 3) - mu * log_J + 0.5 * lam * log_J**2 + 0.5 * kf * (stretch - 1) ** 2


register_law(
    LAW, fibre_neo_hookean, {"mu": 1, "lam": 1, "kf": 1, "fibre": 3}, needs_positive_J=True, energy=fibre_energy
)


def fibre_stiffness(E: float, nu: float, ratio: float) -> float:
    """kf [Pa] with which Young's modulus along the fibre is `ratio` times the one across it, at small strain.

    With k = 4 kf the fibre's own modulus: E_along = E + k; across, the fibre holds the lateral contraction back,
    E_across = E/(1 - nu^2 k/(E + k)); their ratio is 1 + (1 - nu^2) k/E.
    """
    return 0.25 * (ratio - 1) * E / (1 - nu**2)


@dataclass(frozen=True)
class HiddenMaterial:
    """E [Pa], nu of the matrix; ratio of Young's moduli along the fibre and across; fibre: rest direction, any length;
    amplitude and period [m] of the stiffness factor 1 + amplitude sin(2 pi X.axis/period) over rest positions."""

    E: float
    nu: float
    ratio: float
    fibre: tuple[float, float, float]
    amplitude: float
    period: float
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0)
    density: float = 1000.0

    @property
    def law(self) -> str:
        return LAW

    @property
    def known(self) -> dict[str, float]:
        """What a prior can be compared with."""
        return {"E": self.E, "nu": self.nu}

    def variant(self, kind: str) -> "HiddenMaterial":
        """`anisotropic`: this one; `isotropic`: its twin without fibres and with one stiffness everywhere.

        Errors: ConfigError for another kind.
        """
        if kind == "anisotropic":
            return self
        if kind == "isotropic":
            return HiddenMaterial(self.E, self.nu, 1.0, self.fibre, 0.0, self.period, self.axis, self.density)
        raise ConfigError(f"scene.material: expected anisotropic or isotropic, found {kind!r}")

    def factor(self, rest: Tensor) -> Tensor:
        """(N,) stiffness factor at rest positions (N, 3) [m]."""
        axis = torch.tensor(self.axis, dtype=rest.dtype)
        return 1 + self.amplitude * torch.sin(2 * math.pi * (rest @ axis) / self.period)

    def parameters(self, rest: Tensor) -> dict[str, Tensor]:
        """What the law `fibre_neo_hookean` takes, per particle."""
        factor = self.factor(rest)
        mu, lam = lame(self.E * factor, torch.full_like(factor, self.nu))
        fibre = torch.tensor(self.fibre, dtype=rest.dtype)
        kf = fibre_stiffness(self.E, self.nu, self.ratio) * factor
        return {"mu": mu, "lam": lam, "kf": kf, "fibre": (fibre / fibre.norm()).expand(len(rest), 3)}

    def wave_modulus(self) -> float:
        """Largest P wave modulus [Pa]: lam + 2 mu + 4 kf where the stiffness is highest."""
        mu, lam = lame(torch.tensor(self.E), torch.tensor(self.nu))
        return (1 + abs(self.amplitude)) * (float(lam + 2 * mu) + 4 * fibre_stiffness(self.E, self.nu, self.ratio))

    def summary(self) -> dict[str, float]:
        """Numbers for Truth.parameters: E, nu of the matrix, moduli along and across the fibre [Pa], their ratio."""
        k = 4 * fibre_stiffness(self.E, self.nu, self.ratio)
        across = self.E / (1 - self.nu**2 * k / (self.E + k))
        return {
            "E": self.E,
            "nu": self.nu,
            "E_along": self.E + k,
            "E_across": across,
            "ratio": self.ratio,
            "heterogeneity": self.amplitude,
        }

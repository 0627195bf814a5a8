"""The material of the built-in scenes, which no prior of the learner can express: fibres, and stiffness that varies."""

from dataclasses import dataclass, replace

import torch
import warp as wp
from torch import Tensor

from mosa.data.synthetic.materials.hidden import Hidden
from mosa.physics.constitutive.laws import LawParameters, register_law

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
    return (
        0.5 * mu * ((F * F).sum((-2, -1)) - 3)
        - mu * log_J
        + 0.5 * lam * log_J**2
        + 0.5 * kf * (stretch - 1) ** 2
    )


register_law(
    LAW,
    fibre_neo_hookean,
    {"mu": 1, "lam": 1, "kf": 1, "fibre": 3},
    needs_positive_J=True,
    energy=fibre_energy,
)


def fibre_stiffness(E: float, nu: float, ratio: float) -> float:
    """kf [Pa] with which Young's modulus along the fibre is `ratio` times the one across it, at small strain.

    With k = 4 kf the fibre's own modulus: E_along = E + k; across, the fibre holds the lateral contraction back,
    E_across = E/(1 - nu^2 k/(E + k)); their ratio is 1 + (1 - nu^2) k/E.
    """
    return 0.25 * (ratio - 1) * E / (1 - nu**2)


@dataclass(frozen=True, kw_only=True)
class HiddenMaterial(Hidden):
    """The elastic part is the matrix; ratio of Young's moduli along the fibre and across; fibre: rest direction, any length."""

    ratio: float
    fibre: tuple[float, float, float]

    @property
    def law(self) -> str:
        return LAW

    def isotropic(self) -> "HiddenMaterial":
        """Its twin without fibres and with one stiffness everywhere."""
        return replace(self, ratio=1.0, amplitude=0.0)

    def parameters(self, rest: Tensor) -> dict[str, Tensor]:
        """What the law `fibre_neo_hookean` takes, per particle."""
        factor = self.factor(rest)
        mu, lam = self.elastic(factor)
        fibre = torch.tensor(self.fibre, dtype=rest.dtype)
        kf = fibre_stiffness(self.E, self.nu, self.ratio) * factor
        return {
            "mu": mu,
            "lam": lam,
            "kf": kf,
            "fibre": (fibre / fibre.norm()).expand(len(rest), 3),
        }

    def mean_modulus(self) -> float:
        """lam + 2 mu + 4 kf [Pa]."""
        return super().mean_modulus() + 4 * fibre_stiffness(self.E, self.nu, self.ratio)

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

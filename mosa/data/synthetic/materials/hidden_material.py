"""The material of the built-in scenes, which no prior of the learner can express: fibres, and stiffness that varies."""

from dataclasses import dataclass, field, replace

import torch
import warp as wp
from torch import Tensor

from mosa.data.synthetic.materials.hidden import Hidden
from mosa.physics.constitutive.elasticity import lame
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


@wp.func
def fibre_corotated(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """2 mu sym((F - R) F^T) + lam (J - 1) J I + 2 kf (I4 - 1) exp(2 (I4 - 1)^2) (F a)(F a)^T.

    Energy: the fixed corotated one (Stomakhin et al. 2012) plus kf/4 (exp(2 (I4 - 1)^2) - 1), the
    exponential of Holzapfel, Gasser and Ogden (2000), in compression too. At rest its stiffness is
    that of `fibre_neo_hookean`."""
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    fa = F * wp.vec3d(p[3], p[4], p[5])
    J = wp.determinant(F)
    T = (F - R) * wp.transpose(F)
    matrix = p[0] * (T + wp.transpose(T)) + p[1] * (J - one) * J * wp.identity(
        n=3, dtype=wp.float64
    )
    e = wp.dot(fa, fa) - one
    return matrix + two * p[2] * e * wp.exp(two * e * e) * wp.outer(fa, fa)


NEEDS = {"mu": 1, "lam": 1, "kf": 1, "fibre": 3}
register_law("fibre_corotated", fibre_corotated, NEEDS, uses_rotation=True)
register_law(LAW, fibre_neo_hookean, NEEDS, needs_positive_J=True)
FORMS = {LAW: 1.0, "fibre_corotated": 3.0}  # law -> how much stiffer its fibres get


def fibre_stiffness(E: float, nu: float, ratio: float) -> float:
    """kf [Pa] with which Young's modulus along the fibre is `ratio` times the one across it, at small strain.

    With k = 4 kf the fibre's own modulus: E_along = E + k; across, the fibre holds the lateral contraction back,
    E_across = E/(1 - nu^2 k/(E + k)); their ratio is 1 + (1 - nu^2) k/E."""
    return 0.25 * (ratio - 1) * E / (1 - nu**2)


@dataclass(frozen=True, kw_only=True)
class HiddenMaterial(Hidden):
    """The elastic part is the matrix; ratio of Young's moduli along the fibre and across; fibre: rest direction, any length."""

    ratio: float
    fibre: tuple[float, float, float]
    form: str = field(default=LAW, repr=False)
    """One of `FORMS`."""

    @property
    def law(self) -> str:
        return self.form

    def isotropic(self) -> "HiddenMaterial":
        """Its twin without fibres and with one stiffness everywhere."""
        return replace(self, ratio=1.0, amplitude=0.0)

    @property
    def known(self) -> dict[str, float]:
        """E [Pa] and nu of the isotropic law nearest to this one at small strain, which is what E and
        nu of a law with an operator are; the matrix's own where there are no fibres.

        The logarithm of the 6x6 stiffness is averaged over all turns of it (log-Euclidean; Moakher
        and Norris, Journal of Elasticity 85, 2006)."""
        if self.ratio == 1:
            return super().known
        mu, lam = lame(torch.tensor(self.E).double(), torch.tensor(self.nu).double())
        ones = torch.tensor([1.0, 1, 1, 0, 0, 0]).double()
        stiffness = 2 * mu * torch.eye(6).double() + lam * torch.outer(ones, ones)
        stiffness[0, 0] += 4 * fibre_stiffness(self.E, self.nu, self.ratio)
        moduli, modes = torch.linalg.eigh(stiffness)
        volumetric = (ones @ modes).square() / 3  # share of each mode
        bulk = float((volumetric * moduli.log()).sum().exp() / 3)
        shear = float(((1 - volumetric) * moduli.log()).sum().div(5).exp() / 2)
        return {
            "E": 9 * bulk * shear / (3 * bulk + shear),
            "nu": (3 * bulk - 2 * shear) / (6 * bulk + 2 * shear),
        }

    def parameters(self, rest: Tensor) -> dict[str, Tensor]:
        """What the law `fibre_neo_hookean` takes, per particle."""
        factor = self.factor(rest)
        mu, lam = self.elastic(factor)
        fibre = torch.tensor(self.fibre, dtype=rest.dtype)
        kf = fibre_stiffness(self.E, self.nu, self.ratio) * factor
        turned = (fibre / fibre.norm()).expand(len(rest), 3)
        return {"mu": mu, "lam": lam, "kf": kf, "fibre": turned}

    def mean_modulus(self) -> float:
        """lam + 2 mu + 4 kf [Pa], kf as stiff as the fibres get."""
        fibres = FORMS[self.form] * fibre_stiffness(self.E, self.nu, self.ratio)
        return super().mean_modulus() + 4 * fibres

    def summary(self) -> dict[str, float]:
        """Numbers for Truth.parameters: E, nu of the matrix, moduli along and across the fibre [Pa], their ratio."""
        k = 4 * fibre_stiffness(self.E, self.nu, self.ratio)
        across = self.E / (1 - self.nu**2 * k / (self.E + k))
        moduli = {"E": self.E, "nu": self.nu, "E_along": self.E + k, "E_across": across}
        return {**moduli, "ratio": self.ratio, "heterogeneity": self.amplitude}

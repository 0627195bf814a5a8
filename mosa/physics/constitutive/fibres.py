"""Families of fibres in an isotropic matrix: Holzapfel-Gasser-Ogden, with and without dispersion; the energy [J/m^3].

The matrix is the split neo-Hookean solid (`rubber`). A family of unit rest direction a adds k1/(2 k2) (exp(k2 <e>^2) - 1) with

    e = d tr C + (1 - 3 d) a.C a - 1,      C = F^T F,      <e> = max(e, 0),

so that fibres which are shorter than at rest carry nothing (Holzapfel, Gasser, Ogden 2000; dispersion d: Gasser, Ogden, Holzapfel
2006). C is taken whole, not its isochoric part, so that fibres also resist dilation (Nolan et al. 2014). k1: fibre_stiffness [Pa],
k2: fibre_exponent, d: dispersion, from 0 (all aligned) to 1/3 (isotropic). Polyconvex for mu, kappa, k1, k2 > 0 and d in [0, 1/3]:
e is convex in F, and the energy is convex and increasing in <e> (Balzani et al. 2006).
"""

import warp as wp
from torch import Tensor

from mosa.physics.constitutive.laws import LawParameters, register_law
from mosa.physics.constitutive.material_kernels import deviator
from mosa.physics.constitutive.rubber import isochoric_left, volumetric

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_THREE = wp.constant(wp.float64(3.0))


@wp.func
def family(F: wp.mat33d, a: wp.vec3d, k1: wp.float64, k2: wp.float64, d: wp.float64):
    """2 k1 <e> exp(k2 <e>^2) (d F F^T + (1 - 3 d) F a (F a)^T)."""
    b = F * wp.transpose(F)
    f = F * a
    aligned = _ONE - _THREE * d
    e = wp.max(d * wp.trace(b) + aligned * wp.dot(f, f) - _ONE, _ZERO)
    return _TWO * k1 * e * wp.exp(k2 * e * e) * (d * b + aligned * wp.outer(f, f))


@wp.func
def hgo(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """mu dev(b_bar), the volumetric part and one family."""
    matrix = p[0] * deviator(isochoric_left(F)) + volumetric(F, p)
    return matrix + family(F, wp.vec3d(p[5], p[6], p[7]), p[2], p[3], p[4])


@wp.func
def hgo_two(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """mu dev(b_bar), the volumetric part and two families of one exponent and dispersion, each with its stiffness."""
    matrix = p[0] * deviator(isochoric_left(F)) + volumetric(F, p)
    one = family(F, wp.vec3d(p[6], p[7], p[8]), p[2], p[4], p[5])
    return matrix + one + family(F, wp.vec3d(p[9], p[10], p[11]), p[3], p[4], p[5])


def stretched_modulus(
    mu: Tensor, lam: Tensor, fibre_stiffness: Tensor, dispersion: Tensor, **others: Tensor
) -> Tensor:
    """Bound on the P wave modulus at rest [Pa]: lam + 2 mu + 4 k1 (1 - 2 d)^2, as if all families had one direction."""
    k1 = fibre_stiffness + others.get("second_fibre_stiffness", 0.0)
    return lam + 2 * mu + 4 * k1 * (1 - 2 * dispersion) ** 2


_ONE_FAMILY = dict.fromkeys(("mu", "lam", "fibre_stiffness", "fibre_exponent", "dispersion"), 1)
_TWO_FAMILIES = dict.fromkeys(
    ("mu", "lam", "fibre_stiffness", "second_fibre_stiffness", "fibre_exponent", "dispersion"), 1
)
register_law(
    "hgo", hgo, _ONE_FAMILY | {"fibre": 3}, needs_positive_J=True, modulus=stretched_modulus
)
register_law(
    "hgo_two", hgo_two, _TWO_FAMILIES | {"fibre": 3, "second_fibre": 3}, needs_positive_J=True, modulus=stretched_modulus,
)  # fmt: skip

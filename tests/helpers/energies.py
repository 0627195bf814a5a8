"""Energies per rest volume [J/m^3] of the laws that have one: tau = (dPsi/dF) F^T (the paper's appendix on constitutive models).

Torch functions of F (..., 3, 3) with parameters broadcastable to (...), so one number per particle; meant for float64. Where a law
yields it is the energy stored by its elastic F. Parameters of the law that do not enter the energy (yield stress, friction,
viscosity) are accepted and unused. `stvk_paper` has none: the paper's printed stress carries one stretch too many and is the
gradient of nothing.
"""

from collections.abc import Callable

import torch
from torch import Tensor

STRAIN_CLAMP = 0.05
"""Singular values enter logarithms as max(S, 0.05), as in `kinematics`."""


def neo_hookean_energy(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """mu/2 (|F|^2 - 3) - mu log J + lam/2 (log J)^2; J > 0."""
    log_J = torch.log(torch.linalg.det(F))
    return 0.5 * mu * ((F * F).sum((-2, -1)) - 3) - mu * log_J + 0.5 * lam * log_J**2


def corotated_energy(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """mu sum (S_i - 1)^2 + lam/2 (J - 1)^2, S signed singular values (Stomakhin et al. 2012)."""
    S, J = signed_singular_values(F)
    return mu * ((S - 1) ** 2).sum(-1) + 0.5 * lam * (J - 1) ** 2


def stvk_energy(F: Tensor, mu: Tensor, lam: Tensor, **unused: Tensor) -> Tensor:
    """mu |eps|^2 + lam/2 tr(eps)^2, eps = log max(S, 0.05) (Hencky): of stvk, von_mises and drucker_prager."""
    S, _ = signed_singular_values(F)
    eps = torch.log(S.clamp_min(STRAIN_CLAMP))
    return mu * (eps**2).sum(-1) + 0.5 * lam * eps.sum(-1) ** 2


def linear_energy(F: Tensor, mu: Tensor, lam: Tensor, reference: Tensor | None = None) -> Tensor:
    """mu |sym(G) - I|^2 + lam/2 tr(G - I)^2, G = F F_0^T; reference: F_0 (..., 9), I by default. The law takes the symmetric
    part of (dPsi/dG) G^T, which is not symmetric itself."""
    G = F if reference is None else F @ reference.reshape(*reference.shape[:-1], 3, 3).mT
    strain = 0.5 * (G + G.mT) - torch.eye(3, dtype=F.dtype, device=F.device)
    trace = strain.diagonal(dim1=-2, dim2=-1).sum(-1)
    return mu * (strain**2).sum((-2, -1)) + 0.5 * lam * trace**2


def herschel_bulkley_energy(F: Tensor, mu: Tensor, kappa: Tensor, **unused: Tensor) -> Tensor:
    """kappa/2 ((J^2 - 1)/2 - log J) + mu/2 (J^(-2/3) |F|^2 - 3); J > 0 (Simo, Hughes 1998, section 9.2)."""
    J = torch.linalg.det(F)
    isochoric = J.pow(-2.0 / 3.0) * (F * F).sum((-2, -1))
    return 0.5 * kappa * (0.5 * (J**2 - 1) - torch.log(J)) + 0.5 * mu * (isochoric - 3)


def herschel_bulkley_hencky_energy(
    F: Tensor, mu: Tensor, kappa: Tensor, **unused: Tensor
) -> Tensor:
    """That of stvk with lam = kappa - 2 mu/3."""
    return stvk_energy(F, mu, kappa - 2 * mu / 3)


def newtonian_energy(F: Tensor, kappa: Tensor, **unused: Tensor) -> Tensor:
    """kappa (J + J^-6/6 - 7/6): the pressure's; the viscous stress (mu) stores nothing. J > 0."""
    J = torch.linalg.det(F)
    return kappa * (J + J.pow(-6) / 6 - 7.0 / 6.0)


def signed_singular_values(F: Tensor) -> tuple[Tensor, Tensor]:
    """(S (..., 3) descending with the sign of det F on the last, J (...))."""
    S, J = torch.linalg.svdvals(F), torch.linalg.det(F)
    sign = torch.where(J < 0, -torch.ones_like(J), torch.ones_like(J))
    return torch.cat([S[..., :2], S[..., 2:] * sign[..., None]], -1), J


def volumetric_energy(J: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """kappa/2 ((J^2 - 1)/2 - log J), kappa = lam + 2 mu/3."""
    return 0.5 * (lam + 2 * mu / 3) * (0.5 * (J**2 - 1) - torch.log(J))


def isochoric_invariants(F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """J, and the first and second invariant of b_bar, each (...)."""
    C, J = F.mT @ F, torch.linalg.det(F)
    I1, square = C.diagonal(dim1=-2, dim2=-1).sum(-1), (C * C).sum((-2, -1))
    return J, J.pow(-2 / 3) * I1, J.pow(-4 / 3) * 0.5 * (I1**2 - square)


def mooney_rivlin_energy(F: Tensor, mu: Tensor, lam: Tensor, second_share: Tensor) -> Tensor:
    """mu/2 ((1 - s) (I1 - 3) + s (I2 - 3)) and the volumetric part."""
    J, I1, I2 = isochoric_invariants(F)
    shared = (1 - second_share) * (I1 - 3) + second_share * (I2 - 3)
    return 0.5 * mu * shared + volumetric_energy(J, mu, lam)


def yeoh_energy(F: Tensor, mu: Tensor, lam: Tensor, yeoh_2: Tensor, yeoh_3: Tensor) -> Tensor:
    """mu/2 (x + r2 x^2 + r3 x^3), x = I1 - 3, and the volumetric part."""
    J, I1, _ = isochoric_invariants(F)
    x = I1 - 3
    return 0.5 * mu * (x + yeoh_2 * x**2 + yeoh_3 * x**3) + volumetric_energy(J, mu, lam)


def ogden_energy(F: Tensor, mu: Tensor, lam: Tensor, alpha_1: Tensor, share_2: Tensor, alpha_2: Tensor, share_3: Tensor,
                 alpha_3: Tensor) -> Tensor:  # fmt: skip
    """sum of 2 mu_k/alpha_k^2 (sum_i l_i^alpha_k - 3) and the volumetric part."""
    S, J = signed_singular_values(F)
    stretch, rest = J.pow(-1 / 3)[..., None] * S, mu * (1 - share_2)
    terms = ((rest * (1 - share_3), alpha_1), (mu * share_2, alpha_2), (rest * share_3, alpha_3))
    stored = [2 * m / a**2 * (stretch.pow(a).sum(-1) - 3) for m, a in terms]
    return stored[0] + stored[1] + stored[2] + volumetric_energy(J, mu, lam)


def family_energy(F: Tensor, fibre: Tensor, k1: Tensor, k2: Tensor, d: Tensor) -> Tensor:
    """k1/(2 k2) (exp(k2 <e>^2) - 1)."""
    fibre = torch.as_tensor(fibre).to(F)
    length = (F @ fibre[..., None]).square().sum((-2, -1))
    e = (d * F.square().sum((-2, -1)) + (1 - 3 * d) * length - 1).clamp_min(0)
    return 0.5 * k1 / k2 * torch.expm1(k2 * e**2)


def hgo_energy(F: Tensor, mu: Tensor, lam: Tensor, fibre_stiffness: Tensor, fibre_exponent: Tensor, dispersion: Tensor,
               fibre: Tensor) -> Tensor:  # fmt: skip
    """Of the matrix and one family."""
    J, I1, _ = isochoric_invariants(F)
    fibres = family_energy(F, fibre, fibre_stiffness, fibre_exponent, dispersion)
    return 0.5 * mu * (I1 - 3) + volumetric_energy(J, mu, lam) + fibres


def hgo_two_energy(F: Tensor, mu: Tensor, lam: Tensor, fibre_stiffness: Tensor, second_fibre_stiffness: Tensor,
                   fibre_exponent: Tensor, dispersion: Tensor, fibre: Tensor, second_fibre: Tensor) -> Tensor:  # fmt: skip
    """Of the matrix and two families."""
    one = hgo_energy(F, mu, lam, fibre_stiffness, fibre_exponent, dispersion, fibre)
    return one + family_energy(F, second_fibre, second_fibre_stiffness, fibre_exponent, dispersion)


def fibre_neo_hookean_energy(
    F: Tensor, mu: Tensor, lam: Tensor, kf: Tensor, fibre: Tensor
) -> Tensor:
    """mu/2 (|F|^2 - 3) - mu log J + lam/2 (log J)^2 + kf/2 (|F a|^2 - 1)^2 [J/m^3]; F: (..., 3, 3), fibre: (..., 3)."""
    log_J = torch.log(torch.linalg.det(F))
    stretch = ((F @ fibre[..., None])[..., 0] ** 2).sum(-1)
    matrix = 0.5 * mu * ((F * F).sum((-2, -1)) - 3) - mu * log_J + 0.5 * lam * log_J**2
    return matrix + 0.5 * kf * (stretch - 1) ** 2


def fibre_corotated_energy(F: Tensor, mu: Tensor, lam: Tensor, kf: Tensor, fibre: Tensor) -> Tensor:
    """mu |S - I|^2 + lam/2 (J - 1)^2 + kf/4 (exp(2 (|F a|^2 - 1)^2) - 1) [J/m^3]; (..., 3, 3)."""
    S = torch.linalg.svdvals(F)
    stretch = ((F @ fibre[..., None])[..., 0] ** 2).sum(-1)
    matrix = mu * ((S - 1) ** 2).sum(-1) + 0.5 * lam * (S.prod(-1) - 1) ** 2
    return matrix + 0.25 * kf * (torch.exp(2 * (stretch - 1) ** 2) - 1)


ENERGIES: dict[str, Callable[..., Tensor]] = {
    "linear": linear_energy, "neo_hookean": neo_hookean_energy, "corotated": corotated_energy, "stvk": stvk_energy,
    "von_mises": stvk_energy, "drucker_prager": stvk_energy, "hill": stvk_energy,
    "herschel_bulkley": herschel_bulkley_energy, "herschel_bulkley_hencky": herschel_bulkley_hencky_energy,
    "newtonian": newtonian_energy, "mooney_rivlin": mooney_rivlin_energy, "yeoh": yeoh_energy, "ogden": ogden_energy,
    "hgo": hgo_energy, "hgo_two": hgo_two_energy,
    "fibre_neo_hookean": fibre_neo_hookean_energy, "fibre_corotated": fibre_corotated_energy,
}  # fmt: skip
"""By the name of the law."""

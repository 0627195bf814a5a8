"""Energies per rest volume [J/m^3] of the laws that have one: tau = (dPsi/dF) F^T (the paper's appendix on constitutive models).

Torch functions of F (..., 3, 3) with parameters broadcastable to (...), so one number per particle; meant for float64, in tests
and in reports of how much a body stores. Where a law yields it is the energy stored by its elastic F. Parameters of the law that
do not enter the energy (yield stress, friction, viscosity) are accepted and unused. `stvk_paper` has none: the paper's printed
stress carries one stretch too many and is the gradient of nothing.
"""

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

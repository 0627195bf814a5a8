"""By how much an adapter can stiffen the body, which the time step has to follow (`physics.engine.time_step`)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mosa.modules.adapters.microplane import MANDEL, PAIRS, isotropic_stiffness

ADAPTER_MARGIN = 1.85
"""Adapted modulus over the prior's that every body with an adapter is given, whatever its operator is: a step that jumped with
every iteration of the fit would cost more than it saves. Operators that the default adapter learned are at 1.03 to 1.61
(docs/decisions.md)."""
DIRECTIONS = 1000


def worst_stiffening(alpha: float) -> float:
    """Bound for every operator whose LU factors have entries within alpha, at least `ADAPTER_MARGIN`.

    The modulus of an operator is linear in each of its numbers, so the largest is at a corner of the box, where all are alpha (by
    search; `acoustic_stiffening` of it is exact). (1 + alpha)^6.45 is above that for nu <= 0.38 and alpha from 0.1 to 0.3, and
    below it by at most 6 % of the modulus, 3 % of the step, at nu = 0.49; it is 1.85 at 0.1, 2.46 at 0.15, 3.24 at 0.2."""
    return max(ADAPTER_MARGIN, ADAPTER_MARGIN ** (math.log1p(alpha) / math.log1p(0.1)))


@torch.no_grad()
def acoustic_stiffening(G: Tensor, poisson: Tensor | float) -> float:
    """Largest acoustic modulus n m : (I + G) C0 : n m over unit vectors n, m, in units of the prior's, lam + 2 mu.

    G: (..., 6, 6) A - I on vech; poisson: of the isotropic C0. The symmetric part of (I + G) C0 alone counts: the projection to
    major symmetry changes nothing of it. 1000 directions n: 0.5 % at most below the true maximum."""
    G = G.detach().double().cpu()
    scale = torch.tensor(MANDEL, dtype=torch.float64)
    C0 = isotropic_stiffness(torch.as_tensor(poisson).detach().double().cpu())
    D = (torch.eye(6).double() + scale[:, None] * G / scale) @ C0
    B = strains(spread_directions(DIRECTIONS))
    acoustic = torch.einsum("nja,...ab,nlb->...njl", B, D, B)
    return float(torch.linalg.eigvalsh(0.5 * (acoustic + acoustic.mT)).max() / C0[0, 0])


def spread_directions(count: int) -> Tensor:
    """(count, 3) unit vectors spread evenly over the half sphere, by Fibonacci's spiral."""
    k = torch.arange(count, dtype=torch.float64) + 0.5
    z, turn = 1 - k / count, math.pi * (3 - 5**0.5) * k
    r = (1 - z * z).sqrt()
    return torch.stack((r * turn.cos(), r * turn.sin(), z), -1)


def strains(n: Tensor) -> Tensor:
    """(N, 3, 6) sym(n e_j) of directions n (N, 3), j = 1 to 3, as vectors in Mandel scaling."""
    outer = n[:, None, :, None] * torch.eye(3).double()[:, None, :]
    E = 0.5 * (outer + outer.mT)
    return torch.stack([m * E[..., i, j] for m, (i, j) in zip(MANDEL, PAIRS)], -1)

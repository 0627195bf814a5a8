"""What a small-strain stiffness says: Young's modulus along every direction, the stiffest direction, and how sure both are."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mosa.evaluation.analysis.anisotropy import directions_on_sphere, dyads

DIRECTIONS = 3000  # on a half sphere: 1.5 degrees apart


def directional_moduli(stiffness: Tensor, directions: Tensor) -> Tensor:
    """(..., K) Young's modulus along unit vectors (K, 3) of stiffnesses (..., 6, 6) in Mandel scaling, in their unit: 1/(n n :
    C^-1 : n n)."""
    N = dyads(directions).to(stiffness)
    return 1 / torch.einsum("ka,...ab,kb->...k", N, torch.linalg.inv(stiffness), N)


def stiffest(stiffness: Tensor) -> tuple[Tensor, Tensor]:
    """(unit vectors (..., 3) of the largest modulus, largest over smallest (...,)) of stiffnesses (..., 6, 6), to 1.5 degrees."""
    n = directions_on_sphere(DIRECTIONS).to(stiffness)
    E = directional_moduli(stiffness, n)
    return n[E.argmax(-1)], E.amax(-1) / E.amin(-1)


def angle_between(a: Tensor, b: Tensor) -> Tensor:
    """Degrees between axes (..., 3) without a sense, 0 to 90."""
    cosine = (a * b).sum(-1).abs() / (a.norm(dim=-1) * b.norm(dim=-1))
    return torch.rad2deg(torch.acos(cosine.clamp(max=1)))


def cone(axis: Tensor, drawn: Tensor, share: float = 0.95) -> float:
    """Half angle [degrees] about `axis` (3,) that holds `share` of the drawn axes (D, 3)."""
    angles = angle_between(axis, drawn).sort().values
    return float(angles[min(len(angles) - 1, math.ceil(share * len(angles)) - 1)])

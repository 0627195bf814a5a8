"""Light that stays where it is while a body turns: one factor for a surface's colours, by where its normal points.

What a distant light of any shape makes of a matt surface is, to about a hundredth, a function of the normal in nine spherical
harmonics (Ramamoorthi and Hanrahan 2001). Of these only differences show against the first frame, whose light the colours already
have: a splat of normal n, turned by R, is exp(sum_k l_k (Y_k(R n) - Y_k(n))) times as bright, with the eight l_k of degree 1 and 2
for the whole scene. Shadows and a light's own colour are not in it.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from mosa.rendering.appearance.spherical_harmonics import basis

LIGHT = 8
"""Numbers of a light: the harmonics of degree 1 and 2."""
NEIGHBOURS = 24
"""Particles that tell a normal."""


def surface_normals(points: Tensor, particles: Tensor) -> Tensor:
    """Outward unit normals (M, 3) at points (M, 3) [m] on or near the surface of what particles (N, 3) [m] fill: away from the
    weighted mean of the nearest, with w = 1 - r^2 / r_max^2; along z where that is nowhere else."""
    P, X = particles.detach().cpu().double(), points.detach().cpu().double()
    count = np.arange(1, min(NEIGHBOURS, len(P)) + 1)
    distance, index = map(torch.as_tensor, cKDTree(P.numpy()).query(X.numpy(), k=count))
    share = 1 - (distance / distance[:, -1:].clamp(min=1e-12)).square()
    away = (share[..., None] * (X[:, None] - P[index])).sum(1)
    length = away.norm(dim=1, keepdim=True)
    away = torch.where(length > 1e-9, away / length.clamp(min=1e-9), away.new_tensor([0.0, 0, 1]))
    return away.to(points)


def turned_basis(normals: Tensor, rotations: Tensor) -> Tensor:
    """Y_k(R n) - Y_k(n), (..., M, LIGHT), of normals (M, 3) and rotations (..., M, 3, 3)."""
    turned = (rotations @ normals[..., None])[..., 0]
    return (basis(turned, 2) - basis(normals, 2))[..., 1:]


def shading(light: Tensor, normals: Tensor, rotations: Tensor) -> Tensor:
    """Factors (..., M) of the colours of splats with normals (M, 3) at rest, turned by (..., M, 3, 3). light: (LIGHT,)."""
    return (turned_basis(normals, rotations) @ light).exp()


def moved_shading(light: Tensor, normals: Tensor, deformation: Tensor) -> Tensor:
    """The same (..., M) under deformation gradients (..., M, 3, 3), whose cofactors turn normals; with
    their gradient."""
    a, b, c = deformation.unbind(-1)
    x, y, z = normals[:, 0, None], normals[:, 1, None], normals[:, 2, None]
    cross = torch.linalg.cross
    turned = cross(b, c) * x + cross(c, a) * y + cross(a, b) * z
    return ((basis(turned, 2) - basis(normals, 2))[..., 1:] @ light).exp()

"""The hanging bar of `bar` by Lagrangian finite elements, independent of grid and particles: how far the reference's mesh matters.

Trilinear hexahedra, 2 x 2 x 2 Gauss points, lumped mass, leapfrog in time; the top face is held in y only.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import torch
from bar import BAR_DENSITY, END, GRAVITY, LAM, MU


def elements(per_metre: int, frames: int = 51) -> tuple[np.ndarray, np.ndarray]:
    """(times (T,) [s], displacement of the bottom corner (T,) [m])."""
    n, h = per_metre, 1.0 / per_metre
    axis = torch.arange(n + 1, dtype=torch.float64) * h
    x = torch.stack(torch.meshgrid(axis, axis - 1, axis, indexing="ij"), -1).reshape(-1, 3)
    nodes = torch.arange((n + 1) ** 3).reshape(n + 1, n + 1, n + 1)
    corners = list(itertools.product((0, 1), repeat=3))
    cells = torch.stack(
        [nodes[i : i + n, j : j + n, k : k + n].reshape(-1) for i, j, k in corners], 1
    )
    sign = 2 * torch.tensor(corners, dtype=torch.float64) - 1
    # slopes[q, a, i] = dN_a/dX_i at Gauss point q
    factor = 1 + sign[None] * sign[:, None] / math.sqrt(3)
    others = torch.stack(
        [
            factor[..., 1] * factor[..., 2],
            factor[..., 0] * factor[..., 2],
            factor[..., 0] * factor[..., 1],
        ],
        -1,
    )
    slopes = sign * others / (4 * h)
    mass = torch.zeros(len(x), dtype=torch.float64)
    mass.index_add_(
        0,
        cells.reshape(-1),
        torch.full((cells.numel(),), BAR_DENSITY * h**3 / 8, dtype=torch.float64),
    )
    top = x[:, 1] > -1e-9
    frame_dt = END / (frames - 1)
    substeps = math.ceil(frame_dt * 1.6 * math.sqrt((LAM + 2 * MU) / BAR_DENSITY) / (0.25 * h))
    dt, v, tip = frame_dt / substeps, torch.zeros_like(x), [0.0]
    for step in range((frames - 1) * substeps):
        F = torch.einsum("eai,qaj->eqij", x[cells], slopes)
        J = torch.linalg.det(F)[..., None, None]
        inverse = torch.linalg.inv(F).mT
        P = MU * (F - inverse) + LAM * torch.log(J) * inverse
        force = torch.einsum("eqij,qaj->eai", P, slopes) * (h / 2) ** 3
        a = (
            -torch.zeros_like(x).index_add_(0, cells.reshape(-1), force.reshape(-1, 3))
            / mass[:, None]
        )
        a[:, 1] -= GRAVITY
        v = (
            v + (0.5 if step == 0 else 1.0) * dt * a
        )  # leapfrog: the first velocity is half a step old
        v[top, 1] = 0.0
        x = x + dt * v
        if (step + 1) % substeps == 0:
            tip.append(float(x[nodes[n, 0, 0], 1]) + 1.0)
    return frame_dt * np.arange(frames), np.array(tip)

"""The redistribution operator: four LU-parametrised 3x3 corrections assembled into one 6x6 operator on Voigt stress.

Steps 2 to 4 of method.md, section 4. vech order: xx, yy, zz, yz, zx, xy.
"""

from __future__ import annotations

import torch
from torch import Tensor

XX, YY, ZZ, YZ, ZX, XY = range(6)
PLANES = ((XX, XY, ZX), (YY, YZ, XY), (ZZ, ZX, YZ))
"""Components of the traction on each microplane: normal first."""
UPPER = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
LOWER = [(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)]


def _fill(places: list[tuple[int, int]]) -> Tensor:
    """(6, 9) map from triangle entries to a flat 3x3 matrix."""
    result = torch.zeros(6, 9)
    for k, (i, j) in enumerate(places):
        result[k, 3 * i + j] = 1
    return result


def _scatter() -> Tensor:
    """(27, 36) map from the entries of (I + C_x, I + C_y, I + C_z) to the operator that yields n and the averaged shears."""
    result = torch.zeros(3, 3, 3, 6, 6)
    shear_target = {YZ: 0.5, ZX: 0.5, XY: 0.5}  # each shear appears on two planes and is their mean
    for plane, components in enumerate(PLANES):
        for row, target in enumerate(components):
            weight = shear_target.get(target, 1.0)
            for column, source in enumerate(components):
                result[plane, row, column, target, source] += weight
    return result.reshape(27, 36)


def lu_factors(numbers: Tensor) -> tuple[Tensor, Tensor]:
    """(I + L, I + U), each (..., 3, 3), from (..., 12): upper triangle row by row, then lower."""
    eye = torch.eye(3, dtype=numbers.dtype, device=numbers.device)
    upper = (numbers[..., :6] @ _fill(UPPER).to(numbers)).unflatten(-1, (3, 3))
    lower = (numbers[..., 6:] @ _fill(LOWER).to(numbers)).unflatten(-1, (3, 3))
    return eye + lower, eye + upper


def correction(numbers: Tensor) -> Tensor:
    """I + C = (I + L)(I + U), (..., 3, 3) from (..., 12); det >= (1 - alpha)^6 where all entries are within alpha < 1."""
    lower, upper = lu_factors(numbers)
    return lower @ upper


def plane_operator(planes: Tensor) -> Tensor:
    """(N, 6, 6) operator T of the three planes (N, 3, 3, 3): T s = (n, averaged shears) (step 3)."""
    return (planes.flatten(-3) @ _scatter().to(planes)).unflatten(-1, (6, 6))


def assemble(planes: Tensor, normal: Tensor) -> Tensor:
    """The whole 6x6 operator: plane operator, then (I + C_xyz) on the normal components (step 4)."""
    T = plane_operator(planes)
    return torch.cat([normal @ T[..., :3, :], T[..., 3:, :]], -2)


def stepwise(stress: Tensor, planes: Tensor, normal: Tensor) -> Tensor:
    """The same on stress (N, 6) without assembling: the paper's order of operations, what tests compare `assemble` with."""
    t = [(planes[:, k] @ stress[:, list(c), None])[..., 0] for k, c in enumerate(PLANES)]
    n = (normal @ torch.stack([t[0][:, 0], t[1][:, 0], t[2][:, 0]], -1)[..., None])[..., 0]
    shear = [0.5 * (t[1][:, 1] + t[2][:, 2]), 0.5 * (t[2][:, 1] + t[0][:, 2]), 0.5 * (t[0][:, 1] + t[1][:, 2])]
    return torch.cat([n, torch.stack(shear, -1)], -1)

"""The redistribution operator: four LU-parametrised 3x3 corrections assembled into one 6x6 operator on Voigt stress.

Paper, eq. 5 to 7 and its appendix on the microplane parametrisation; steps 2 to 4 of `progressive`.
vech order: xx, yy, zz, yz, zx, xy.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

XX, YY, ZZ, YZ, ZX, XY = range(6)
PLANES = ((XX, XY, ZX), (YY, YZ, XY), (ZZ, ZX, YZ))
"""Components of the traction on each microplane: normal first."""
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
LOWER = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))
"""Places of the 12 numbers of one matrix: upper triangle row by row, then lower."""


@lru_cache(maxsize=16)
@torch.inference_mode(False)  # who asks first may not want gradients, and others do
def _entries(device: torch.device) -> Tensor:
    """(18,) which of the 12 numbers, or of a zero after them, the entries of the flat lower and upper triangle are."""
    found = torch.full((2, 9), 12)
    for which, places in enumerate((LOWER, UPPER)):
        for k, (i, j) in enumerate(places):
            found[which, 3 * i + j] = k + 6 * (1 - which)
    return found.flatten().to(device)


@lru_cache(maxsize=16)
@torch.inference_mode(False)  # who asks first may not want gradients, and others do
def _placement(dtype: torch.dtype, device: torch.device) -> Tensor:
    """(27, 36) map from the entries of (C_x, C_y, C_z) to the 6x6 matrix that gives the normals and the averaged shears."""
    result = torch.zeros(3, 3, 3, 6, 6, dtype=dtype)
    for plane, components in enumerate(PLANES):
        for row, target in enumerate(components):
            # each shear appears on two planes and is their mean
            weight = 1.0 if target in (XX, YY, ZZ) else 0.5
            for column, source in enumerate(components):
                result[plane, row, column, target, source] += weight
    return result.reshape(27, 36).to(device)


def lu_factors(numbers: Tensor) -> tuple[Tensor, Tensor]:
    """Entries of the factors, (L, U), each (..., 3, 3), from (..., 12): upper triangle row by row, then lower."""
    padded = torch.nn.functional.pad(numbers, (0, 1))
    entries = padded.index_select(-1, _entries(numbers.device)).unflatten(-1, (2, 3, 3))
    return entries[..., 0, :, :], entries[..., 1, :, :]


def correction(numbers: Tensor) -> Tensor:
    """C = (I + L)(I + U) - I, (..., 3, 3) from (..., 12), exactly 0 at 0.

    det(I + C) >= (1 - alpha)^6 where all numbers are within alpha < 1."""
    L, U = lu_factors(numbers)
    return L + U + L @ U


OFFSET = 0.01
"""Diagonal offset of both factors in the printed form. The paper calls it small and gives no number."""


def printed_correction(numbers: Tensor) -> Tensor:
    """C = (L + e I)(U + e I), (..., 3, 3) from (..., 12), e = `OFFSET`: the paper's own form.

    C itself is then invertible, as the paper asks, and no numbers give e^2 I in place of 0. Entries
    of C stay below about 3 alpha^2."""
    offset = OFFSET * torch.eye(3, dtype=numbers.dtype, device=numbers.device)
    L, U = lu_factors(numbers)
    return (L + offset) @ (U + offset)


CORRECTIONS = {"residual": correction, "printed": printed_correction}
"""What makes a matrix C of its 12 numbers."""


def plane_operator(planes: Tensor) -> Tensor:
    """(N, 6, 6) T - I of the corrections (N, 3, 3, 3) of the three planes: T s = (normals, averaged shears) (step 3)."""
    return (planes.flatten(-3) @ _placement(planes.dtype, planes.device)).unflatten(-1, (6, 6))


def redistribution(planes: Tensor, normal: Tensor) -> Tensor:
    """(N, 6, 6) A - I: the planes (N, 3, 3, 3), then I + C_xyz, `normal` (N, 3, 3), on the normal components (step 4)."""
    return with_normal(plane_operator(planes), normal)


def with_normal(T: Tensor, normal: Tensor) -> Tensor:
    """`redistribution` of a plane operator T - I (N, 6, 6)."""
    # C_xyz I, in the columns of the normal components
    block = torch.nn.functional.pad(normal, (0, 3))
    return torch.cat([T[..., :3, :] + block + normal @ T[..., :3, :], T[..., 3:, :]], -2)


PAIRS = ((0, 0), (1, 1), (2, 2), (1, 2), (2, 0), (0, 1))
"""Entries of a tensor that are its six components xx, yy, zz, yz, zx, xy."""
MANDEL = (1.0, 1.0, 1.0, 2**0.5, 2**0.5, 2**0.5)
"""Scaling of vech components that turns the double contraction of symmetric tensors into a dot product of 6-vectors."""


def isotropic_stiffness(poisson: Tensor) -> Tensor:
    """(6, 6) C0 = 2 mu I + lam 1x1 in Mandel scaling and units of 2 mu; poisson: ()."""
    identity, volumetric, *_ = _constants(poisson.dtype, poisson.device)
    return identity + poisson / (1 - 2 * poisson) * volumetric


@lru_cache(maxsize=16)
@torch.inference_mode(False)  # who asks first may not want gradients, and others do
def _constants(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, ...]:
    """I (6, 6), 1x1 (6, 6), `MANDEL` (6,), and the unit matrices (36, 6, 6)."""
    one = torch.tensor([1.0, 1, 1, 0, 0, 0], dtype=dtype)
    parts = torch.eye(6, dtype=dtype), torch.outer(one, one), torch.tensor(MANDEL, dtype=dtype)
    return tuple(t.to(device) for t in (*parts, torch.eye(36, dtype=dtype).unflatten(-1, (6, 6))))


def major_symmetric(G: Tensor, poisson: Tensor) -> Tensor:
    """(G + C0 G^T C0^-1)/2 in Mandel scaling, (..., 6, 6) on vech: then (I + G) C0 is symmetric and the law has an energy."""
    identity, volumetric, scale, basis = _constants(G.dtype, G.device)
    poisson = poisson.to(G)
    C0, inverse = isotropic_stiffness(poisson), identity - poisson / (1 + poisson) * volumetric

    def project(A: Tensor) -> Tensor:
        A = scale[:, None] * A / scale
        A = 0.5 * (A + C0 @ A.mT @ inverse)
        return A / scale[:, None] * scale

    # one linear map on the 36 entries: a matrix product instead of many
    return (G.flatten(-2) @ project(basis).flatten(-2)).unflatten(-1, (6, 6))

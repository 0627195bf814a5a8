"""The softest eigenvectors of a large sparse matrix by Chebyshev-filtered subspace iteration, on any device.

Source: Zhou, Saad, Tiago and Chelikowsky 2006, "Self-consistent-field calculations using Chebyshev-filtered subspace iteration". It
needs products of the matrix with blocks of vectors only: a factorisation of a body of 30,000 particles fills up and its
triangular solves are serial.
"""

from __future__ import annotations

import math
import warnings

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

GUARD = 0.5
"""Vectors beyond those that are asked for, in units of these: they separate the last of them from the rest of the spectrum."""
AMPLIFICATION = 1e4
"""Of the softest vector by one filter, over those that are suppressed: more would drown the others in float32's rounding."""
TOLERANCE = 1e-4
"""Residual |A x - l x| / l_last at which it ends, which leaves 1e-5 of a vector outside of the true ones' span."""
MOST_FILTERS = 30


def cosines(points: Tensor, count: int) -> Tensor:
    """The `count` longest waves in the box of points (N, 3), but the constant one: where the iteration starts. (N, count)."""
    low = points.amin(0)
    size = (points.amax(0) - low).clamp(min=1e-12)
    side = math.ceil((count + 1) ** (1 / 3) * float(size.max() / size.log().mean().exp())) + 1
    side = min(side, count + 1)
    number = torch.cartesian_prod(*[torch.arange(side, device=points.device)] * 3)
    number = number[((number / size) ** 2).sum(1).argsort(stable=True)[1 : count + 1]]
    place = (points - low) / size
    waves = [torch.cos(torch.pi * number[:, a] * place[:, a, None]) for a in range(3)]
    return waves[0] * waves[1] * waves[2]


def _on(matrix: sparse.csr_matrix, like: Tensor, dtype: torch.dtype) -> Tensor:
    places = matrix.indptr, matrix.indices
    parts = (torch.as_tensor(a.astype(np.int64), device=like.device) for a in places)
    values = torch.as_tensor(matrix.data, dtype=dtype, device=like.device)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse (CSR tensor support|invariant checks)")
        return torch.sparse_csr_tensor(*parts, values, size=matrix.shape, check_invariants=False)


def largest_eigenvalue(matrix: Tensor, *, steps: int = 15, block: int = 8) -> float:
    """Of a symmetric (N, N) matrix with eigenvalues >= 0, to a few percent, from below."""
    generator = torch.Generator().manual_seed(0)
    X = torch.randn(len(matrix), block, generator=generator, dtype=torch.float64).to(matrix)
    for _ in range(steps):
        X = matrix @ torch.linalg.qr(X)[0]
    X = torch.linalg.qr(X)[0]
    return float(torch.linalg.eigvalsh(X.T @ (matrix @ X))[-1])


def chebyshev_filter(
    matrix: sparse.csr_matrix, X: Tensor, low: float, high: float, softest: float, amplification: float, dtype: torch.dtype,
) -> Tensor:  # fmt: skip
    """Vectors (N, k) times a polynomial of the matrix that is small from eigenvalue `low` to `high` and 1 at `softest`, of the
    degree that brings the amplification. Computed in dtype, returned as X is."""
    half, middle = (high - low) / 2, (high + low) / 2
    degree = math.ceil(math.acosh(amplification) / math.acosh((middle - softest) / half))
    A = _on((matrix - middle * sparse.eye(len(X))).tocsr() / half, X, dtype)
    first = scale = half / (softest - middle)
    before = X.to(dtype)
    now = scale * (A @ before)
    for _ in range(degree - 1):
        following = 1 / (2 / first - scale)
        before, now = now, torch.addmm(before, A, now, beta=-scale * following, alpha=2 * following)
        scale = following
    return now.to(X)


def softest_vectors(
    matrix: sparse.csr_matrix, points: Tensor, known: Tensor, count: int
) -> tuple[Tensor, Tensor] | None:
    """Eigenvalues (count,) in ascending order and orthonormal eigenvectors (N, count), float64, that are orthogonal to `known`.

    matrix: (N, N) symmetric, no eigenvalue below 0; points: (N, 3), over which the vectors are smooth; known: (N, k) orthonormal
    eigenvectors; its device is where the work is done. None where MOST_FILTERS do not reach TOLERANCE, or where there is no room
    for the guard vectors beside the known ones."""
    points, known = points.to(known), known.double()
    last = count + max(8, round(GUARD * count))
    if last + known.shape[1] > len(points):
        return None
    A = _on(matrix, known, torch.float64)
    high = 1.1 * largest_eigenvalue(A)
    # the very last ones converge slowest: what lies above is suppressed
    limit = count + 2 * (last - count) // 3
    X = cosines(points.double(), last)
    for _ in range(MOST_FILTERS):
        X, _ = torch.linalg.qr(X - known @ (known.T @ X))
        AX = A @ X
        values, turn = torch.linalg.eigh(X.T @ AX)
        X, AX = X @ turn, AX @ turn
        residual = (AX - X * values).norm(dim=0)[:count].amax()
        if residual <= TOLERANCE * values[count - 1]:
            return values[:count], X[:, :count]
        low, softest = min(float(values[limit]), 0.95 * high), float(values[0])
        X = chebyshev_filter(matrix, X, low, high, softest, AMPLIFICATION, torch.float32)
        # rounding left a little of the stiffest vectors, which a few steps of float64 take away
        X = chebyshev_filter(matrix, X, max(low, high / 4), high, softest, 100.0, torch.float64)
    return None

"""Skew matrices and axial vectors: the algebra of rotations, shared by poses, losses and starts."""

from __future__ import annotations

import torch
from torch import Tensor


def skew(w: Tensor) -> Tensor:
    """[w]_x (..., 3, 3) with [w]_x r = w x r, of vectors (..., 3)."""
    x, y, z = w.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))


def axial(A: Tensor) -> Tensor:
    """Axial vector (..., 3) of A - A^T, (..., 3, 3)."""
    return torch.stack(
        [A[..., 2, 1] - A[..., 1, 2], A[..., 0, 2] - A[..., 2, 0], A[..., 1, 0] - A[..., 0, 1]], -1
    )

"""Singular value decomposition of a batch of 3x3 matrices, on the device where they lie: the one of the material kernels.

torch's batched solvers need a quarter of a megabyte of workspace for each 3x3 matrix on CUDA (15 GB for 4000 particles and 15
frames, seen with torch 2.11); a thread per matrix needs none.
"""

import torch
import warp as wp
from torch import Tensor

from mosa.physics.constitutive.kinematics import svd
from mosa.physics.launching import launch, warp_stream

_MATRIX = {torch.float32: wp.mat33f, torch.float64: wp.mat33d}
_VECTOR = {torch.float32: wp.vec3f, torch.float64: wp.vec3d}


def _make(matrix, vector):
    @wp.kernel(module="unique", enable_backward=False)
    def factorise(
        F: wp.array(dtype=matrix), U: wp.array(dtype=matrix), S: wp.array(dtype=vector),
        V: wp.array(dtype=matrix),
    ):  # fmt: skip
        i = wp.tid()
        u, s, v = svd(wp.mat33d(F[i]))
        U[i] = matrix(u)
        S[i] = vector(s)
        V[i] = matrix(v)

    return factorise


_KERNELS = {dtype: _make(_MATRIX[dtype], _VECTOR[dtype]) for dtype in _MATRIX}


@torch.no_grad()
def singular_value_decomposition(F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(U (..., 3, 3), S (..., 3), V (..., 3, 3)) with F = U diag(S) V^T, without gradient; F: finite, float32 or float64.

    det U = det V = 1, S descending, the last one carries the sign of det F (`kinematics`). Computed in float64."""
    flat = F.detach().reshape(-1, 3, 3).contiguous()
    U, V, S = torch.empty_like(flat), torch.empty_like(flat), flat.new_empty(len(flat), 3)
    if len(flat):
        matrix, vector = _MATRIX[F.dtype], _VECTOR[F.dtype]
        with warp_stream(F.device):
            arrays = [wp.from_torch(t, dtype=vector if t is S else matrix) for t in (flat, U, S, V)]
            launch(_KERNELS[F.dtype], len(flat), arrays, arrays[0].device)
    return U.reshape(F.shape), S.reshape(F.shape[:-1]), V.reshape(F.shape)

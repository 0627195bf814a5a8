"""Motion cues: deformation of each particle's rest neighbourhood by weighted least squares, and rotation and stretch from it.

Source: paper, eq. 13 and 14. With isotropic Gaussians their rotation is not identifiable from images (only F F^T is),
so beside the paper's cue (`gaussian`) there is `neighbourhood`, which fits F to the reconstructed displacements of the
nearest rest neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from mosa.errors import DataError
from mosa.rendering.covariance import quaternion_to_matrix
from mosa.system.threads import threaded
from mosa.types import MotionCues, Splats

CONDITION_LIMIT = 1e4
AT_A_TIME = 8192  # decompositions by one thread


@dataclass(frozen=True)
class Neighbourhood:
    """Linear estimate of the deformation gradient from positions: F_i = sum_k (x_j - x_i) (x) gradient_ik, j = index_ik.

    index: (N, k) long; gradient: (N, k, 3) [1/m]; weight: (N,) 1 where the moment matrix is well conditioned, else 0;
    kernel: (N, k) the least-squares weights; offset: (N, k, 3) [m] rest vectors to the neighbours."""

    index: Tensor
    gradient: Tensor
    weight: Tensor
    kernel: Tensor
    offset: Tensor

    def deformation(self, positions: Tensor) -> Tensor:
        """Deformation gradients (..., N, 3, 3) of positions (..., N, 3) [m]; exact for affine motions where weight is 1."""
        difference = positions[..., self.index, :] - positions[..., None, :]
        return torch.einsum("...nki,nkj->...nij", difference, self.gradient)


def neighbourhood(rest: Tensor, *, neighbours: int = 20) -> Neighbourhood:
    """Weighted least squares over the `neighbours` nearest rest particles. rest: (N, 3) [m].

    Minimises sum_k w_k |d_k - F D_k|^2, D rest vector, d deformed vector, w = (1 - r^2/r_max^2)^2 with r_max 1.2 times the
    distance of the farthest neighbour. Where the moment matrix has a condition number above `CONDITION_LIMIT` (neighbours in a
    plane or on a line) the weight is 0 and the gradient that of F = 0: such particles must not be used.
    Raises DataError for fewer than 5 particles."""
    points = rest.detach().cpu().double().numpy()
    if len(points) < 5:
        raise DataError(
            f"neighbourhood: expected at least 5 particles, found {len(points)}; choose a smaller spacing"
        )
    count = min(neighbours, len(points) - 1)
    distance, index = cKDTree(points).query(points, k=count + 1)
    # a particle is its own nearest neighbour unless two coincide: then drop whichever comes first
    distance, index = distance[:, 1:], index[:, 1:]
    offset = points[index] - points[:, None]
    radius = 1.2 * distance[:, -1:].clip(1e-12)
    kernel = np.clip(1 - (distance / radius) ** 2, 0, None) ** 2
    scale = radius[..., None] ** 2
    moment = np.einsum("nk,nki,nkj->nij", kernel, offset, offset) / scale
    values = np.linalg.eigvalsh(moment)
    good = values[:, 0] * CONDITION_LIMIT > values[:, 2].clip(1e-300)
    safe = np.where(good[:, None, None], moment, np.eye(3))
    gradient = np.einsum("nk,nki,nij->nkj", kernel, offset, np.linalg.inv(safe)) / scale
    gradient = np.where(good[:, None, None], gradient, 0.0)
    parts = gradient, good.astype(float), kernel, offset
    index = torch.as_tensor(index, device=rest.device)
    return Neighbourhood(index, *(torch.as_tensor(part).to(rest) for part in parts))


def polar(deformation: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation (..., 3, 3) with det +1 and descending singular values (..., 3) of deformation gradients, not differentiable.

    The smallest singular value carries the sign of the determinant. Computed in float64."""
    # on the host, whose cores are faster at many small decompositions than a GPU
    parts = deformation.detach().double().cpu().reshape(-1, 3, 3).split(AT_A_TIME)
    rotation, values = map(torch.cat, zip(*threaded(_polar, parts)))
    shape = deformation.shape
    return rotation.view(shape).to(deformation), values.view(shape[:-1]).to(deformation)


def _polar(deformation: Tensor) -> tuple[Tensor, Tensor]:
    U, S, Vh = torch.linalg.svd(deformation)
    sign = torch.ones_like(S)
    sign[..., 2] = torch.where(torch.linalg.det(U) * torch.linalg.det(Vh) < 0, -1.0, 1.0)
    return (U * sign[..., None, :]) @ Vh, S * sign


def neighbourhood_cues(positions: Tensor, covariances: Tensor, around: Neighbourhood) -> MotionCues:
    """Cues from displacements alone. positions: (T, N, 3) [m], frame 0 at rest; covariances: (T, N, 3, 3) [m^2]."""
    rotation, stretch = polar(around.deformation(positions))
    weight = around.weight.expand(len(positions), -1) * (stretch[..., 2] > 0.05)
    known = weight > 0
    rotation = torch.where(known[..., None, None], rotation, torch.eye(3).to(positions))
    stretch = torch.where(known[..., None], stretch, 1.0)
    return MotionCues(
        positions.contiguous(), rotation, stretch, weight.contiguous(), covariances.contiguous()
    )


def gaussian_cues(
    positions: Tensor, covariances: Tensor, splats: Splats, scales: Tensor, rotations: Tensor
) -> MotionCues:
    """The paper's cues: change of each Gaussian's own scale and rotation since frame 0.

    scales: (T, N, 3) [m] after activation; rotations: (T, N, 4) wxyz. stretch = S_t / S_0 per axis, sorted; weight 1."""
    rest = quaternion_to_matrix(splats.rotations)
    rotation = quaternion_to_matrix(rotations) @ rest.transpose(-1, -2)
    stretch = (scales / splats.scales).sort(-1, descending=True).values
    weight = torch.ones(positions.shape[:2], dtype=positions.dtype, device=positions.device)
    return MotionCues(
        positions.contiguous(), rotation.contiguous(), stretch, weight, covariances.contiguous()
    )

"""Material axes of the anisotropic truth laws: a rotation per particle in three numbers."""

import torch
import warp as wp
from torch import Tensor

from mosa.errors import ConfigError

_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_ZERO = wp.constant(wp.float64(0.0))


@wp.func
def axes_rotation(r: wp.vec3d):
    """Q = I + 2 ([r]_x + [r]_x^2)/(1 + |r|^2), r = tan(angle/2) times the axis (Cayley): its columns are the material axes."""
    K = wp.mat33d(_ZERO, -r[2], r[1], r[2], _ZERO, -r[0], -r[1], r[0], _ZERO)
    return wp.identity(n=3, dtype=wp.float64) + (_TWO / (_ONE + wp.dot(r, r))) * (K + K * K)


def axes_matrix(r: Tensor) -> Tensor:
    """(..., 3, 3) rotation of r (..., 3), as `axes_rotation`; differentiable."""
    zero = torch.zeros_like(r[..., 0])
    rows = [zero, -r[..., 2], r[..., 1], r[..., 2], zero, -r[..., 0], -r[..., 1], r[..., 0], zero]
    K = torch.stack(rows, -1).reshape(*r.shape[:-1], 3, 3)
    return (
        torch.eye(3, dtype=r.dtype, device=r.device)
        + 2 * (K + K @ K) / (1 + (r * r).sum(-1))[..., None, None]
    )


def axes_parameter(axes: Tensor) -> Tensor:
    """(3,) r of `axes_rotation` for a rotation matrix (3, 3) whose columns are the material axes 1, 2, 3 at rest.

    Where the angle is 180 degrees, r would be infinite: two of the axes are then turned round, which is the same orthotropy.
    Errors: ConfigError if axes is no rotation.
    """
    axes = axes.double()
    eye = torch.eye(3, dtype=torch.float64)
    if (
        axes.shape != (3, 3)
        or (axes.mT @ axes - eye).abs().max() > 1e-6
        or torch.linalg.det(axes) < 0
    ):
        raise ConfigError(f"axes: expected a rotation matrix (3, 3), found {axes.tolist()}")
    # 1 + trace = 4 cos^2(angle/2) is at least 1 for one of the four equivalent choices
    signs = torch.tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=torch.float64)
    choices = axes * signs[:, None, :]
    best = choices[choices.diagonal(dim1=1, dim2=2).sum(1).argmax()]
    skew = torch.stack([best[2, 1] - best[1, 2], best[0, 2] - best[2, 0], best[1, 0] - best[0, 1]])
    return skew / (1 + best.trace())

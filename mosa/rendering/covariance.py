"""Covariances of Gaussians: from scales and rotations, projected into images, and square roots of 2x2 ones.

Written out by components: batches of tiny matrix products are many times slower in torch than the few
multiplications they are.
"""

from __future__ import annotations

import torch
from torch import Tensor

from mosa.rendering.projection_kernels import LOW_PASS
from mosa.types import Cameras

CLAMP_MARGIN = 0.3
"""J is evaluated within the image plus this many half fields of view on each side, as in gsplat."""

NEAR = 0.01
"""Nearest depth [m] that is projected; what lies nearer is culled by the rasteriser."""


def quaternion_to_matrix(quaternions: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), order w x y z, of any non-zero length."""
    w, x, y, z = (quaternions / quaternions.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def quaternion_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product (..., 4), order w x y z: the rotation b followed by a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        -1,
    )


def covariance_from(scales: Tensor, rotations: Tensor) -> Tensor:
    """R diag(s^2) R^T, (..., 3, 3) [m^2], of standard deviations (..., 3) [m] and quaternions (..., 4) wxyz."""
    axes = quaternion_to_matrix(rotations) * scales[..., None, :]
    return (axes[..., :, None, :] * axes[..., None, :, :]).sum(-1)


def carried_covariance(deformation: Tensor, scales: Tensor, rotations: Tensor) -> Tensor:
    """F R diag(s^2) R^T F^T, (..., 3, 3) [m^2], of Gaussians that follow a deformation gradient (..., 3, 3)."""
    axes = deformation @ (quaternion_to_matrix(rotations) * scales[..., None, :])
    return axes @ axes.mT


def project_gaussians(
    means: Tensor, covariances: Tensor, cameras: Cameras
) -> tuple[Tensor, Tensor]:
    """Centres (B, N, 2) [px] and low-passed covariances (B, N, 3) [px^2] as (xx, xy, yy), one camera per batch entry.

    means: (B, N, 3) [m]; covariances: (B, N, 3, 3) [m^2]. The same map as the rasteriser's (`projection_kernels`): J from
    the clamped, the centre from the unclamped direction. Gaussians nearer than 0.01 m, which are never drawn, are
    treated as if at 0.01 m so that everything stays finite."""
    K, w2c = cameras.K.to(means), cameras.w2c.to(means)
    R, t = w2c[:, None, :3, :3], w2c[:, None, :3, 3]
    x, y, z = ((means[..., None, :] * R).sum(-1) + t).unbind(-1)
    z = torch.where(z > NEAR, z, torch.full_like(z, NEAR))
    fx, skew, fy, cx, cy = (K[:, None, i, j] for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2)))
    sx, sy = x / z, y / z
    half_x, half_y = 0.5 * cameras.width / fx, 0.5 * cameras.height / fy
    beyond_x, beyond_y = CLAMP_MARGIN * half_x, CLAMP_MARGIN * half_y
    jx = sx.clamp(-cx / fx - beyond_x, (cameras.width - cx) / fx + beyond_x)
    jy = sy.clamp(-cy / fy - beyond_y, (cameras.height - cy) / fy + beyond_y)
    rows = R.unbind(-2)
    first = (fx / z)[..., None] * rows[0] + (skew / z)[..., None] * rows[1]
    first = first - ((fx * jx + skew * jy) / z)[..., None] * rows[2]
    second = (fy / z)[..., None] * rows[1] - (fy * jy / z)[..., None] * rows[2]
    half_first = (covariances * first[..., None, :]).sum(-1)
    half_second = (covariances * second[..., None, :]).sum(-1)
    xx = (half_first * first).sum(-1) + LOW_PASS
    xy = 0.5 * ((half_first * second).sum(-1) + (half_second * first).sum(-1))
    yy = (half_second * second).sum(-1) + LOW_PASS
    centers = torch.stack((fx * sx + skew * sy + cx, fy * sy + cy), -1)
    return centers, torch.stack((xx, xy, yy), -1)


def square_root(M: Tensor) -> Tensor:
    """Principal square root of symmetric positive definite 2x2 matrices, (..., 3) as (xx, xy, yy).

    Closed form (M + sqrt(det M) I) / sqrt(tr M + 2 sqrt(det M)): its gradient is finite where both eigenvalues are
    equal, unlike that of a root through eigenvectors."""
    xx, xy, yy = M.unbind(-1)
    s = (xx * yy - xy * xy).sqrt()
    t = (xx + yy + 2 * s).sqrt()
    return torch.stack(((xx + s) / t, xy / t, (yy + s) / t), -1)


def matrix_to_quaternion(R: Tensor) -> Tensor:
    """Unit quaternions (..., 4), order w x y z with w >= 0, of rotation matrices (..., 3, 3).

    The largest of the four components is computed from the trace or a diagonal entry, the others by division with it, so
    that no rotation is near a singularity (Shepperd 1978). Not meant to be differentiated."""
    m = [[R[..., i, j] for j in range(3)] for i in range(3)]
    # 4 w^2, 4 x^2, 4 y^2, 4 z^2
    signs = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
    diagonal = [1 + a * m[0][0] + b * m[1][1] + c * m[2][2] for a, b, c in signs]
    squares = torch.stack(diagonal, -1)
    wx, wy, wz = m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]
    xy, xz, yz = m[0][1] + m[1][0], m[0][2] + m[2][0], m[1][2] + m[2][1]
    rows = (
        (squares[..., 0], wx, wy, wz),
        (wx, squares[..., 1], xy, xz),
        (wy, xy, squares[..., 2], yz),
        (wz, xz, yz, squares[..., 3]),
    )
    products = torch.stack([torch.stack(row, -1) for row in rows], -2)  # 4 q q^T
    largest = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    q = products.gather(-2, largest)[..., 0, :]
    q = q / q.norm(dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0, -q, q)


def scales_and_rotations(covariances: Tensor) -> tuple[Tensor, Tensor]:
    """Standard deviations (..., 3) [m], ascending, and quaternions (..., 4) wxyz of covariances (..., 3, 3) [m^2].

    The inverse of `covariance_from` up to the order and sign of the axes; of the symmetric part, eigenvalues below 0
    (rounding) taken as 0. Not meant to be differentiated."""
    values, vectors = torch.linalg.eigh(0.5 * (covariances + covariances.transpose(-1, -2)))
    turn = torch.linalg.det(vectors).sign()
    vectors = torch.cat((vectors[..., :2], vectors[..., 2:] * turn[..., None, None]), -1)
    return values.clamp(min=0).sqrt(), matrix_to_quaternion(vectors)

"""Colours that depend on the line of sight: real spherical harmonics up to degree 3, as 3D Gaussian Splatting uses them.

The basis is the real one with the Condon-Shortley phase, in the order l = 0, 1, ..., and m = -l ... l within each
(Kerbl et al. 2023). All in torch: gradients to coefficients, means and poses are autograd's.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from mosa.errors import ConfigError

DEGREES = {1: 0, 4: 1, 9: 2, 16: 3}
"""Number of coefficients per colour channel -> degree."""

Y0 = math.sqrt(1 / (4 * math.pi))


def degree_of(coefficients: Tensor) -> int:
    """Degree 0 to 3 of coefficients (..., K, 3). Errors: ConfigError where K is not 1, 4, 9 or 16."""
    if coefficients.dim() < 2 or coefficients.shape[-2] not in DEGREES:
        raise ConfigError(
            f"spherical harmonics: expected coefficients (..., K, 3) with K = 1, 4, 9 or 16, found {tuple(coefficients.shape)}"
        )
    return DEGREES[coefficients.shape[-2]]


def basis(directions: Tensor, degree: int) -> Tensor:
    """Values (..., (degree + 1)^2) of the basis in directions (..., 3) of any non-zero length, degree 0 to 3."""
    x, y, z = (directions / directions.norm(dim=-1, keepdim=True)).unbind(-1)
    values = [torch.full_like(x, Y0)]
    if degree >= 1:
        a = math.sqrt(3 / (4 * math.pi))
        values += [-a * y, a * z, -a * x]
    if degree >= 2:
        a, b = math.sqrt(15 / (4 * math.pi)), math.sqrt(5 / (16 * math.pi))
        values += [
            a * x * y,
            -a * y * z,
            b * (3 * z * z - 1),
            -a * x * z,
            0.5 * a * (x * x - y * y),
        ]
    if degree >= 3:
        a, b = math.sqrt(35 / (32 * math.pi)), math.sqrt(105 / (4 * math.pi))
        c, d = math.sqrt(21 / (32 * math.pi)), math.sqrt(7 / (16 * math.pi))
        values += [
            -a * y * (3 * x * x - y * y),
            b * x * y * z,
            -c * y * (5 * z * z - 1),
            d * z * (5 * z * z - 3),
            -c * x * (5 * z * z - 1),
            0.5 * b * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return torch.stack(values, -1)


def colors_in(coefficients: Tensor, directions: Tensor) -> Tensor:
    """Colours max(0, 1/2 + sum_k c_k Y_k) (..., N, 3) of coefficients (N, K, 3) seen along directions (..., N, 3)."""
    values = basis(directions, degree_of(coefficients))
    return (torch.einsum("...nk,nkc->...nc", values, coefficients) + 0.5).clamp(min=0)


def rotated(coefficients: Tensor, rotation: Tensor) -> Tensor:
    """Coefficients (..., K, 3) of the colours of `coefficients` (..., K, 3) turned with their body by R, rotations (..., 3, 3):
    seen along d they have the colour that the given ones have along R^T d. Leading axes broadcast.

    Degree by degree, as a rotation mixes the harmonics of one degree alone. Its matrix (Wigner's, of real harmonics) is found by
    projection, Y(d)^+ Y(R^T d) over `DIRECTIONS` directions d: exact to rounding for every R, as degree l is closed under rotation,
    and without Euler angles or recursion. Gradients to both. Errors: ConfigError for another K."""
    degree = degree_of(coefficients)
    parts = [
        coefficients[..., :1, :].expand(
            *torch.broadcast_shapes(coefficients.shape[:-2], rotation.shape[:-2]), 1, 3
        )
    ]
    if degree:
        spread, inverses = _projections()
        turned = spread.to(rotation) @ rotation  # rows are R^T d
        values = basis(turned, degree)
        for l in range(1, degree + 1):
            matrix = inverses[l].to(rotation) @ values[..., l * l : (l + 1) ** 2]
            parts.append(matrix @ coefficients[..., l * l : (l + 1) ** 2, :])
    return torch.cat(parts, -2)


DIRECTIONS = 24
"""On a spiral: more than the 7 harmonics of degree 3 need, so that the projection is well conditioned for each degree."""


@functools.cache
@torch.inference_mode(False)  # who asks first may not want gradients, and others do
def _projections() -> tuple[Tensor, dict[int, Tensor]]:
    """Directions (n, 3) spread over the sphere and the pseudo-inverse (2 l + 1, n) of the harmonics of each degree there."""
    place = torch.arange(DIRECTIONS, dtype=torch.float64) + 0.5
    z, angle = 1 - 2 * place / DIRECTIONS, math.pi * (1 + math.sqrt(5)) * place
    flat = (1 - z * z).sqrt()
    directions = torch.stack((flat * angle.cos(), flat * angle.sin(), z), -1)
    values = basis(directions, 3)
    return directions, {l: torch.linalg.pinv(values[:, l * l : (l + 1) ** 2]) for l in range(1, 4)}


def constant_coefficients(colors: Tensor) -> Tensor:
    """Coefficients of degree 0, (N, 1, 3), of colours (N, 3) that are the same from everywhere."""
    return ((colors - 0.5) / Y0)[:, None]


def mean_colors(coefficients: Tensor) -> Tensor:
    """Colours (N, 3) in [0, 1] of coefficients (N, K, 3), averaged over all directions (before the clamp at 0)."""
    return (0.5 + Y0 * coefficients[:, 0]).clamp(0, 1)

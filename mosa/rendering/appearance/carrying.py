"""Splats that move: Gaussians bound to the particles of a body at rest, carried by wherever those go.

The motion is interpolated by moving least squares (Lancaster and Salkauskas 1981): around every splat a linear fit to the motion of
the nearest particles, whose value is where its centre goes and whose gradient A is what becomes of its shape: Sigma -> A Sigma A^T.
Both are sums over the neighbours with numbers that the rest shape fixes, so that positions alone carry the splats: those of a
rollout, of an observed motion and of a true one alike. A motion that is affine, a rigid one above all, is followed exactly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from mosa.errors import DataError

NEIGHBOURS = 24
"""Nearest particles that a splat hangs on, the farthest of which no longer counts: about two spacings."""
RIDGE = 1e-4
"""Of the fit's slopes, relative to the neighbourhood's own size: neighbours in a plane leave one open."""
STRETCH_LIMIT = 4.0
"""Largest stretch of a splat: where a body tears or splashes, neighbours at rest part, and what lies between them is no longer
there to be drawn."""


@dataclass(frozen=True)
class Carried:
    """M splats in T states. means: (T, M, 3) [m]; gradients: (T, M, 3, 3), A of the motion at each; rotations: (T, M, 3, 3), those
    nearest to A, without gradient."""

    means: Tensor
    gradients: Tensor
    rotations: Tensor

    def covariances(self, rest: Tensor) -> Tensor:
        """A Sigma A^T, (T, M, 3, 3) [m^2], of covariances at rest (M, 3, 3) [m^2]."""
        return self.gradients @ rest @ self.gradients.transpose(-1, -2)


@dataclass(frozen=True)
class Binding:
    """How M splats hang on N particles. index: (M, k) long, their neighbours; value: (M, k), gradient: (M, k, 3) [1/m], of the
    motion at a splat by those of its neighbours, beyond the affine part; rest: (M, 3) splats and body: (N, 3) particles, less the
    body's middle [m]; affine: (N, 3) [1/m], the gradient of the body's own affine motion is sum_i x_i (x) affine_i. float64 until
    `to`."""

    index: Tensor
    value: Tensor
    gradient: Tensor
    rest: Tensor
    body: Tensor
    affine: Tensor

    def to(self, like: Tensor) -> Binding:
        """On the device and of the type of a tensor."""
        index, *numbers = vars(self).values()
        return Binding(index.to(like.device), *(part.to(like) for part in numbers))

    def states(self, positions: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """(means (M, 3), gradients (M, 3, 3)) for each of positions (T, N, 3) [m]."""
        for x in positions:
            middle = x.mean(0)
            whole = (x - middle).T @ self.affine  # the gradient of the body's affine motion
            left = (x - middle - self.body @ whole.T)[self.index]
            yield (
                middle + self.rest @ whole.T + (self.value[..., None] * left).sum(1),
                whole + left.transpose(1, 2) @ self.gradient,
            )

    def carry(self, positions: Tensor) -> Carried:
        """The splats where particles are at positions (T, N, 3) [m]; gradients to the positions. On their device, of their type."""
        bound = self.to(positions)
        means, gradients = map(torch.stack, zip(*bound.states(positions)))
        with torch.no_grad():
            U, s, Vh = torch.linalg.svd(gradients)
            # the smallest axis is the one that an inverted neighbourhood turned over
            proper = torch.linalg.det(U @ Vh).sign()
            rotations = torch.cat((U[..., :2], U[..., 2:] * proper[..., None, None]), -1) @ Vh
            far = s[..., 0] > STRETCH_LIMIT
        if bool(far.any()):
            gradients = gradients.clone()
            gradients[far] = (U * s.clamp(max=STRETCH_LIMIT)[..., None, :] @ Vh)[far]
        return Carried(means, gradients, rotations)


def bind(splats: Tensor, particles: Tensor) -> Binding:
    """Hang splats (M, 3) [m] on particles (N, 3) [m], both at rest. Errors: DataError for fewer than 8 particles.

    The fit at a splat's rest position X weighs neighbour i with w = (1 - r^2 / r_max^2)^2, r_max the distance of the farthest: a
    neighbour that leaves has no weight, so that the interpolated motion is continuous. Its value is sum_i c_i(X) x_i; the gradients
    of the coefficients are those of the interpolation itself, weights and r_max included, so that A is the derivative of where the
    centre goes."""
    if len(particles) < 8:
        raise DataError(f"bind: expected at least 8 particles, found {len(particles)}")
    X, P = splats.detach().cpu().double(), particles.detach().cpu().double()
    count = min(NEIGHBOURS, len(P))
    index = cKDTree(P.numpy()).query(X.numpy(), k=np.arange(1, count + 1))[1]
    near = P[torch.as_tensor(index)]

    def coefficients(at: Tensor) -> Tensor:
        away = near - at[:, None]
        local = away / away[:, -1:].norm(dim=-1, keepdim=True)
        weight = (1 - local.square().sum(-1)).clamp(min=0).square()
        basis = torch.cat((torch.ones_like(local[..., :1]), local), -1)
        moment = torch.einsum("mk,mki,mkj->mij", weight, basis, basis)
        ridge = RIDGE * weight.sum(1)[:, None] * torch.tensor([0.0, 1, 1, 1], dtype=torch.float64)
        first = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(len(at), 4)
        solved = torch.linalg.solve(moment + torch.diag_embed(ridge), first)
        return weight * torch.einsum("mki,mi->mk", basis, solved)

    axes = torch.eye(3, dtype=torch.float64)
    slopes = [torch.func.jvp(coefficients, (X,), (axis.expand_as(X),))[1] for axis in axes]
    middle = P.mean(0)
    body = P - middle
    affine = body @ torch.linalg.pinv(body.T @ body, hermitian=True)
    values = coefficients(X), torch.stack(slopes, -1)
    return Binding(torch.as_tensor(index), *values, X - middle, body, affine)

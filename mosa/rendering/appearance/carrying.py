"""Splats that move: Gaussians bound to the particles of a body at rest, carried by wherever those go.

Each particle x_k has a linear fit F_k to the motion of the particles around it. A splat at X goes to the sum of w_k (x_k +
F_k (X - X_k)) over its few nearest particles (modified Shepard's method, Franke and Nielson 1980), and the derivative A of that map
is what becomes of its shape: Sigma -> A Sigma A^T. A splat so stays outside of an obstacle that its particles lie on. Positions
alone carry the splats: those of a rollout, of an observed motion and of a true one alike. A motion that is affine, a rigid one
above all, is followed exactly. Particles that part let go of each other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from mosa.errors import DataError

NEAR, AROUND = 12, 24
"""Nearest particles that a splat hangs on, and that a particle's fit looks at, the farthest of which no longer count."""
RIDGE = 1e-4
"""Of the fit's slopes, relative to the neighbourhood's own size: neighbours in a plane leave one open."""
STRETCH_LIMIT = 4.0
"""Largest stretch of a splat, and that at which two particles have parted, from half of it on: where a body tears or splashes, what
lies between them is no longer there to be drawn."""


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
    """How M splats hang on N particles. index: (M, k) long, their neighbours; weight: (M, k) of these, and slope: (M, k, 3) [1/m],
    its derivative; around: (N, n) long, neighbours of each particle, and share: (N, n), their weights in its fit; rest: (M, 3)
    splats and body: (N, 3) particles, less the body's middle [m]; affine: (N, 3) [1/m], the gradient of the body's own affine
    motion is sum_i x_i (x) affine_i. float64 until `to`."""

    index: Tensor
    weight: Tensor
    slope: Tensor
    around: Tensor
    share: Tensor
    rest: Tensor
    body: Tensor
    affine: Tensor

    def to(self, like: Tensor) -> Binding:
        """On the device and of the type of a tensor."""
        parts = vars(self).values()
        return Binding(*(p.to(like if p.is_floating_point() else like.device) for p in parts))

    def states(self, positions: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """(means (M, 3), gradients (M, 3, 3)) for each of positions (T, N, 3) [m]."""
        arms = self.body[self.around] - self.body[:, None]
        away = self.rest[:, None] - self.body[self.index]
        ridge = RIDGE * torch.einsum("nk,nki->n", self.share, arms.square())[:, None, None]
        ridge = ridge * torch.eye(3).to(ridge)
        for x in positions:
            middle = x.mean(0)
            whole = (x - middle).T @ self.affine  # the gradient of the body's affine motion
            left = x - middle - self.body @ whole.T
            share = self.share * self.held(x, self.around)
            moment = torch.einsum("nk,nki,nkj->nij", share, arms, arms) + ridge
            given = torch.einsum("nk,nki,nkj->nij", share, arms, left[self.around] - left[:, None])
            F = torch.linalg.solve(moment, given).mT  # beyond the affine part
            held = self.held(x, self.index)
            total = (held * self.weight).sum(1, keepdim=True)
            weight, slope = held * self.weight / total, (held / total)[..., None] * self.slope
            slope = slope - weight[..., None] * slope.sum(1, keepdim=True)
            near = left[self.index] + (F[self.index] @ away[..., None])[..., 0]
            yield (
                middle + self.rest @ whole.T + (weight[..., None] * near).sum(1),
                whole + torch.einsum("mk,mkij->mij", weight, F[self.index]) + near.mT @ slope,
            )

    def held(self, x: Tensor, near: Tensor) -> Tensor:
        """1 where particles near (K, k) hold to the first of their row at positions x (N, 3), 0 where they have parted from it."""
        rest, now = ((y[near] - y[near[:, :1]]).square().sum(-1) for y in (self.body, x))
        limit = STRETCH_LIMIT**2 * rest
        return ((limit - now) / (0.75 * limit).clamp_min(1e-30)).clamp(0, 1).where(rest > 0, 1.0)

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

    Neighbour i, of a splat or of a particle, has the weight (1 - r^2 / r_max^2)^2, r_max the distance of the farthest: one that
    leaves has none, so that the motion is continuous."""
    if len(particles) < 8:
        raise DataError(f"bind: expected at least 8 particles, found {len(particles)}")
    X, P = splats.detach().cpu().double(), particles.detach().cpu().double()
    tree = cKDTree(P.numpy())
    index, around = (
        torch.as_tensor(tree.query(y.numpy(), k=np.arange(1, min(count, len(P)) + 1))[1])
        for y, count in ((X, NEAR), (P, AROUND))
    )

    def weights(at: Tensor, neighbours: Tensor) -> Tensor:
        far = (P[neighbours] - at[:, None]).square().sum(-1)
        weight = (1 - far / (1.001 * far[:, -1:])).square()  # not all 0 where all are as far
        return weight / weight.sum(1, keepdim=True)

    axes = torch.eye(3).double()[:, None].expand(3, *X.shape)
    slopes = [torch.func.jvp(lambda at: weights(at, index), (X,), (a,))[1] for a in axes]
    middle = P.mean(0)
    body = P - middle
    affine = body @ torch.linalg.pinv(body.T @ body, hermitian=True)
    numbers = weights(X, index), torch.stack(slopes, -1), around, weights(P, around)
    return Binding(index, *numbers, X - middle, body, affine)

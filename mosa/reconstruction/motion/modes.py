"""Smooth deformation modes of a particle set: the softest patterns of a moving-least-squares bending energy.

Displacements u = sum_k mode_k a_k. The energy sum_ij w_ij |u_j - u_i - F_i d_ij|^2 with F_i the least-squares gradient
vanishes exactly for affine motions and grows with wiggles, so the first four modes span affine motion and the next are ever
finer; inside the body, which no camera sees, they continue the motion of the surface smoothly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.linalg import eigsh
from scipy.spatial import cKDTree
from torch import Tensor

from mosa.reconstruction.motion.cues import Neighbourhood
from mosa.reconstruction.motion.softest import softest_vectors

NEAREST = 8
"""Particles from which modes are continued to another point."""
FILTERED_FROM = 6000
"""Number of particles above which a CPU finds the modes by filtering: 31,000 take 17 CPU-seconds, and 84 by a factorisation."""


@dataclass(frozen=True)
class Modes:
    """values: (N, K) orthonormal times sqrt(N); gradient: (N, 3, K) [1/m] their least-squares gradients; energy: (K,) mean
    squared curvature of each, times the body's radius^4; the first four are affine (energy 0)."""

    values: Tensor
    gradient: Tensor
    energy: Tensor

    def displacement(self, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """Displacement (S, N, 3) [m] and its gradient (S, N, 3, 3) under coefficients (S, K, 3) [m]."""
        S, K, _ = coefficients.shape
        N = len(self.values)
        columns = coefficients.permute(1, 0, 2).reshape(K, S * 3)
        shift = (self.values @ columns).reshape(N, S, 3).transpose(0, 1)
        gradient = (self.gradient.reshape(N * 3, K) @ columns).reshape(N, 3, S, 3)
        return shift, gradient.permute(2, 0, 3, 1)

    def at(self, points: Tensor, rest: Tensor) -> Modes:
        """The same modes at other points (M, 3) [m]: first-order expansions around the nearest particles, blended by distance.

        rest: (N, 3) [m] the particles' rest positions. Affine motions stay exact."""
        tree, places = cKDTree(rest.cpu().numpy()), points.detach().cpu().numpy()
        distance, index = tree.query(places, k=min(NEAREST, len(rest)))
        weight = 1 / (distance**2 + (0.3 * distance.max(1, keepdims=True)) ** 2 + 1e-12)
        weight = torch.as_tensor(weight / weight.sum(1, keepdims=True)).to(rest)
        index = torch.as_tensor(index, device=rest.device)
        values = points.new_zeros(len(points), self.values.shape[1])
        gradient = points.new_zeros(len(points), 3, self.values.shape[1])
        for k in range(index.shape[1]):
            j, w = index[:, k], weight[:, k, None]
            slope = self.gradient[j]
            values += w * (self.values[j] + torch.einsum("njm,nj->nm", slope, points - rest[j]))
            gradient += w[..., None] * slope
        return Modes(values, gradient, self.energy)


def coefficients_of(displacement: Tensor, values: Tensor) -> Tensor:
    """(..., K, 3) [m] of the modes `values` (N, K) whose displacement is nearest to the given one (..., N, 3) [m]."""
    # columns of the modes are orthogonal, of squared length N
    return torch.einsum("nk,...nd->...kd", values, displacement) / len(values)


def bending_matrix(around: Neighbourhood) -> sparse.csr_matrix:
    """The bending energy as a sparse symmetric positive semi-definite matrix (N, N), averaged over particles."""
    index = around.index.cpu().numpy()
    kernel = around.kernel.double().cpu().numpy()
    gradient, offset = around.gradient.double().cpu().numpy(), around.offset.double().cpu().numpy()
    particles, count = index.shape
    # residual of pair (i, k): u_j - u_i - sum_l (gradient_il . d_ik) (u_l - u_i)
    coupling = -np.einsum("nlj,nkj->nkl", gradient, offset)
    coupling[:, np.arange(count), np.arange(count)] += 1
    own = -coupling.sum(-1)
    root = np.sqrt(kernel / kernel.sum(1, keepdims=True))
    rows = np.arange(particles * count).reshape(particles, count)
    shape = particles * count, particles
    places = np.repeat(rows.ravel(), count), np.repeat(index, count, 0).ravel()
    entries = sparse.coo_matrix(((root[..., None] * coupling).ravel(), places), shape=shape)
    places = rows.ravel(), np.repeat(np.arange(particles), count)
    diagonal = sparse.coo_matrix(((root * own).ravel(), places), shape=shape)
    residual = (entries + diagonal).tocsr()
    return (residual.T @ residual).tocsr()


def _bending_modes(
    matrix: sparse.csr_matrix, rest: Tensor, affine: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Energies (count,) and orthonormal patterns (N, count) of the softest modes that are not affine, the softest first."""
    # a factorisation runs on the host alone: 4 s of a GPU's run of 4000 particles
    if len(affine) >= FILTERED_FROM or rest.is_cuda:
        known = torch.as_tensor(affine, device=rest.device)
        found = softest_vectors(matrix, rest.detach(), known, count)
        if found is not None:
            return tuple(part.cpu().numpy() for part in found)
    shift = 1e-7 * matrix.diagonal().mean()
    # a fixed start vector: the same modes at every run
    start = np.random.default_rng(0).standard_normal(len(affine))
    values, vectors = eigsh(matrix.tocsc(), k=count + 4, sigma=-shift, which="LM", v0=start)
    vectors = vectors[:, np.argsort(values)]
    rest_of_them = vectors - affine @ (affine.T @ vectors)
    # the four directions nearest to the affine ones are what the projection leaves almost nothing of
    keep = np.sort(np.argsort(-np.linalg.norm(rest_of_them, axis=0), kind="stable")[:count])
    extra, _ = np.linalg.qr(rest_of_them[:, keep])
    energy = np.einsum("nk,nk->k", extra, matrix @ extra)
    order = np.argsort(energy)
    return energy[order], extra[:, order]


def deformation_modes(rest: Tensor, around: Neighbourhood, *, count: int) -> Modes:
    """The affine functions and the `count` - 4 softest other modes. rest: (N, 3) [m]."""
    points = rest.detach().cpu().double().numpy()
    particles = len(points)
    count = max(4, min(count, particles - 2))
    centred = points - points.mean(0)
    affine, _ = np.linalg.qr(np.concatenate([np.ones((particles, 1)), centred], 1))
    modes, energy = affine, np.zeros(4)
    if count > 4:
        matrix = bending_matrix(around)
        energy, extra = _bending_modes(matrix, rest, affine, count - 4)
        modes = np.concatenate([affine, extra], 1)
        # residuals of pairs at distance r are about curvature r^2 / 2: to curvature in units of 1 / size, whatever the spacing
        reach = np.sqrt((centred**2).sum(1).mean())
        distance = np.sqrt((around.offset.double().cpu().numpy() ** 2).sum(-1).mean())
        energy = np.concatenate([np.zeros(4), energy * (reach / distance) ** 4])
    modes = modes * np.sqrt(particles)
    index, operator = around.index.cpu().numpy(), around.gradient.double().cpu().numpy()
    starts, gradient = np.arange(particles + 1) * index.shape[1], []
    for a in range(3):
        entries = operator[..., a].ravel(), index.ravel(), starts
        slope = sparse.csr_matrix(entries, (particles, particles))
        gradient.append(slope @ modes - operator[..., a].sum(1)[:, None] * modes)
    parts = modes, np.stack(gradient, 1), energy
    return Modes(*(torch.as_tensor(part).to(rest) for part in parts))

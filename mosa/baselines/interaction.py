"""Baseline: learned pair forces between particles in place of law and grid, after DEL (Wang et al., NeurIPS 2024).

DEL keeps the form of the discrete element method, forces between particles that depend on what two of them see of each other,
and learns their sizes. Here M nodes, drawn evenly from the body's particles, are joined to their neighbours in the rest shape; a
bond of rest length L between i and j pulls with

    f = E_ref a (g e + d rate) n,    e = log(|x_j - x_i|/L),    rate = (v_j - v_i).n/c,    c = sqrt(E_ref/density)

along n = (x_j - x_i)/|x_j - x_i|, where the network gives g > 0 and d > 0 from e, rate and the mean e of both nodes' bonds. Forces
act along the line of centres and in pairs, and what the network reads does not change with the frame: momentum and angular momentum
are kept and the dynamics is objective, whatever the weights are. a is such that the bonds have the bulk modulus of E_ref at
nu = 1/4, the only Poisson number of central forces; the learned dynamics starts there. Few bonds leave a squashed lattice soft
ways to fold: with 8 a falling block of 60 nodes collapsed, with 16 it bounced as a grid's does.
Differences to the source: bonds are those of the rest shape (solids only), no tangential forces, the ground is a rigid plane and no
learned one, and images are rendered by the project's splats. The other particles follow the deformation of the nodes around them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import numpy as np
import torch
from annotated_types import Interval
from scipy.spatial import cKDTree
from torch import Tensor

from mosa.baselines.pair_dynamics import Interactions
from mosa.errors import ConfigError
from mosa.modules.adapters.base import Adapter
from mosa.modules.adapters.networks import TwoHiddenLayers, zero_outputs
from mosa.physics.adapters.interface import AdapterOperator, MaterialState
from mosa.settings import Width

DAMPING = 0.1
"""Of d where the network answers zero: about a twentieth of critical for a bond."""
FOLLOWED = 12
"""Nodes whose deformation a particle follows."""
SCALE = 10.0
"""Of what the network reads: strains of a tenth become numbers of order one."""


class InteractionNetwork(Adapter):
    """Pair forces between nodes of the rest shape. It brings its own dynamics (`simulator`), and answers no law.

    hidden: width of the network; nodes: at most; neighbours: bonds of a node, at least; stiffer: bound of |log g|.
    Errors: ConfigError naming the key."""

    replaces_law = True
    own_dynamics = True

    def __init__(
        self, *, hidden: Width = 32, nodes: Annotated[int, Interval(ge=8, le=10**5)] = 250,
        neighbours: Annotated[int, Interval(ge=4, le=1000)] = 20, stiffer: Annotated[float, Interval(gt=0, le=5)] = 1.0,
    ) -> None:  # fmt: skip
        super().__init__()
        self.most, self.neighbours, self.stiffer = nodes, neighbours, stiffer
        self.net = TwoHiddenLayers(3, 2, hidden)
        zero_outputs(self.net[-1])
        self.register_buffer("scale", torch.tensor(SCALE), persistent=False)
        self._dynamics: Interactions | None = None

    def __getstate__(self) -> dict:
        # CUDA graphs can be neither copied nor pickled
        return {**super().__getstate__(), "_dynamics": None}

    def settle(self, rest: Tensor, volume: Tensor) -> None:
        """Choose nodes and bonds of a body: rest (N, 3) [m], volume (N,) [m^3]. Errors: ConfigError for too few particles."""
        X, V = rest.detach().cpu().double().numpy(), volume.detach().cpu().double().numpy()
        count = min(self.most, len(X))
        if count <= self.neighbours:
            raise ConfigError(
                f"adapter.neighbours: expected fewer than the body's {count} nodes, found {self.neighbours}"
            )
        nodes = spread(X, count)
        tree = cKDTree(X[nodes])
        V_nodes = np.bincount(tree.query(X)[1], weights=V, minlength=count)
        near = tree.query(X[nodes], k=self.neighbours + 1)[1][:, 1:]
        pairs = np.sort(
            np.stack([np.repeat(np.arange(count), self.neighbours), near.ravel()], 1), axis=1
        )
        i, j = np.unique(pairs, axis=0).T
        L = np.linalg.norm(X[nodes][j] - X[nodes][i], axis=1)

        def summed(weights: np.ndarray | None = None) -> np.ndarray:
            """(M,) sums over the bonds of each node."""
            at_i, at_j = (np.bincount(end, weights=weights, minlength=count) for end in (i, j))
            return at_i + at_j

        # the bonds' sum of a L is then six volumes: K = 2/3 E_ref, that of nu = 1/4
        share = 6 * V_nodes / summed(L)
        area = share[i] + share[j]
        followed, weight, center, inverse = following(X, X[nodes], tree)
        found = {
            "nodes": nodes, "i": i, "j": j, "length": L, "area": area, "node_volume": V_nodes, "degree": summed().astype(float),
            "followed": followed, "weight": weight, "center": center, "inverse": inverse, "node_rest": X[nodes], "rest": X,
        }  # fmt: skip
        for name, value in found.items():
            self.register_buffer(name, torch.as_tensor(value).to(rest.device), persistent=False)
        for name, value in self.named_buffers():
            if value.is_floating_point() and name not in ("E_ref", "poisson"):
                setattr(self, name, value.to(rest.dtype))
        # bound of the nodes' frequencies, times sqrt(E_ref/density)
        self.fastest = float(np.sqrt(2 * (summed(area / L) / V_nodes).max()))
        self.radius = 0.5 * float(V.mean()) ** (1 / 3)

    def tension(
        self, e: Tensor, rate: Tensor, mean: Tensor, net: Callable[[Tensor], Tensor]
    ) -> Tensor:
        """(B,) f/(E_ref a) of bonds; e, rate, mean: (B,) strain, its rate over c and the mean strain around."""
        raw = net(self.scale * torch.stack([e, rate, mean], -1))
        bounded = torch.tanh(raw)
        return (
            e * torch.exp(self.stiffer * bounded[:, 0]) + DAMPING * torch.exp(bounded[:, 1]) * rate
        )

    def forces(
        self, x: Tensor, v: Tensor, density: float, net: Callable[[Tensor], Tensor] | None = None
    ) -> Tensor:
        """(M, 3) [N] on the nodes at x (M, 3) [m] with velocities v (M, 3) [m/s]; density [kg/m^3]; net: in place of the
        network, with other weights."""
        d = x[self.j] - x[self.i]
        r = d.norm(dim=-1)
        n = d / r[:, None]
        e = torch.log(r / self.length)
        rate = ((v[self.j] - v[self.i]) * n).sum(-1) * torch.sqrt(density / self.E_ref)
        zero = torch.zeros(len(x), dtype=x.dtype, device=x.device)
        around = (zero.index_add(0, self.i, e).index_add(0, self.j, e)) / self.degree
        mean = 0.5 * (around[self.i] + around[self.j])
        f = (
            self.E_ref * self.area * self.tension(e, rate, mean, self.net if net is None else net)
        )[:, None] * n
        return torch.zeros_like(x).index_add(0, self.i, f).index_add(0, self.j, -f)

    def follow_nodes(self, x: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(x (N, 3), v (N, 3), F (N, 3, 3)) of all particles: nodes as they are, the others by the affine motion that fits the
        nodes around each best."""
        near, w = x[self.followed], self.weight[..., None]  # (N, K, 3), (N, K, 1)
        arms = self.node_rest[self.followed] - self.center[:, None]
        middle = (w * near).sum(1)
        F = torch.einsum("nka,nkb,nbc->nac", w * (near - middle[:, None]), arms, self.inverse)
        moved = middle + (F @ (self.rest - self.center)[..., None])[..., 0]
        v = (w * v[self.followed]).sum(1).index_copy(0, self.nodes, v)
        return moved.index_copy(0, self.nodes, x), v, F

    def simulator(self, density: float, world, frame_dt: float) -> Interactions:
        """What rolls the nodes out in a world, in place of the body's `Simulator`. Errors: ConfigError."""
        self.check_on()
        if self._dynamics is None or not self._dynamics.serves(density, world, frame_dt):
            self._dynamics = Interactions(self, density, world, frame_dt)
        return self._dynamics

    def forward(self, state: MaterialState) -> AdapterOperator:
        raise ConfigError("adapter=interaction has no stress; expected `Body.simulate`")


def spread(X: np.ndarray, count: int) -> np.ndarray:
    """(count,) indices of points (N, 3) far from each other: the one farthest from the centre, then always the farthest left."""
    chosen = [int(np.linalg.norm(X - X.mean(0), axis=1).argmax())]
    distance = np.linalg.norm(X - X[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(X - X[chosen[-1]], axis=1))
    return np.array(chosen)


def following(X: np.ndarray, nodes: np.ndarray, tree: cKDTree) -> tuple[np.ndarray, ...]:
    """(nearest nodes (N, K), weights (N, K), their centres (N, 3), inverse moments (N, 3, 3)) of particles (N, 3)."""
    K = min(FOLLOWED, len(nodes))
    distance, near = tree.query(X, k=K)
    weight = np.maximum(1 - (distance / (1.1 * distance[:, -1:])) ** 2, 0) ** 2
    weight /= weight.sum(1, keepdims=True)
    center = np.einsum("nk,nka->na", weight, nodes[near])
    arms = nodes[near] - center[:, None]
    moments = np.einsum("nk,nka,nkb->nab", weight, arms, arms)
    return near, weight, center, np.linalg.pinv(moments, rcond=1e-4, hermitian=True)

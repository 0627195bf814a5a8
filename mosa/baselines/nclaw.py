"""Baseline: networks in place of the constitutive law (NCLaw; Ma et al., ICML 2023), an elastic one and a plastic one.

Both read what no rotation of the body changes, the singular values of F, F^T F and det F, and answer in the frame of its polar
rotation R. All of F^T F is read, so that the law is objective but may be anisotropic.

Elastic: tau = E_ref R sym(X W) R^T with X the symmetric matrix of the network's nine outputs and W = R^T F. The source has
P = R X, whose tau = R X W R^T is symmetric only where X and W commute; the symmetric part keeps angular momentum.
Plastic: between evaluations F <- F + rate t R X, t the time between them; the source adds 1e-3 R X in each step of 5e-4 s.
Differences to the source beside these: learned from images and motion cues, not from true particles; the elastic network starts as
the calibrated prior (`start: prior`) or from random weights as there (`start: random`), the plastic one without flow.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor, nn

from mosa.errors import ConfigError
from mosa.modules.adapters.base import Adapter
from mosa.modules.adapters.warm_start import SMALLEST_STRAIN, drawn_stretches
from mosa.modules.fitting.losses import cofactors
from mosa.physics.adapters.interface import AdapterOperator, MaterialState
from mosa.physics.constitutive.singular_values import singular_value_decomposition
from mosa.settings import Positive, Width

INPUTS, OUTPUTS = 13, 9
PLACES = ((0, 5, 4), (5, 1, 3), (4, 3, 2))
"""Of vech components xx, yy, zz, yz, zx, xy in a symmetric matrix."""


def matrix_of(vech: Tensor) -> Tensor:
    """(N, 3, 3) symmetric matrices of vech components (N, 6)."""
    return vech[:, [place for row in PLACES for place in row]].unflatten(-1, (3, 3))


def vech_of(A: Tensor) -> Tensor:
    """(N, 6) vech components of the symmetric part of A (N, 3, 3)."""
    S = 0.5 * (A + A.mT)
    return torch.stack([S[:, 0, 0], S[:, 1, 1], S[:, 2, 2], S[:, 1, 2], S[:, 2, 0], S[:, 0, 1]], -1)


def invariants(W: Tensor) -> Tensor:
    """(N, 13) singular values - 1, F^T F - I, det F - 1 of right stretches W (N, 3, 3), with gradient.

    A singular value is v^T W v: to first order its change is that of W alone, so v needs no gradient, also where two are equal."""
    V = singular_value_decomposition(W)[2]
    S = torch.einsum("nia,nij,nja->na", V, W, V)
    C = W @ W - torch.eye(3).to(W)
    return torch.cat([S - 1, C.flatten(1), S.prod(-1, keepdim=True) - 1], -1)


def network(hidden: int) -> nn.Sequential:
    """13 to 9 through two hidden layers with GELU and without biases, Xavier's weights: an input of zeros answers zeros."""
    widths = ((INPUTS, hidden), (hidden, hidden), (hidden, OUTPUTS))
    layers = [nn.Linear(a, b, bias=False) for a, b in widths]
    for layer in layers:
        nn.init.xavier_normal_(layer.weight)
    return nn.Sequential(layers[0], nn.GELU(), layers[1], nn.GELU(), layers[2])


def symmetric_output(net: nn.Module, W: Tensor) -> Tensor:
    """(N, 3, 3) X: the symmetric part of the network's nine outputs at stretches W (N, 3, 3)."""
    raw = net(invariants(W)).unflatten(-1, (3, 3))
    return 0.5 * (raw + raw.mT)


def polar_rotation(F: Tensor) -> Tensor:
    """(N, 3, 3) polar rotation of F (N, 3, 3) with det F > 0, with gradient: Newton's iteration R <- (R + R^-T)/2 (Higham 1986)."""
    R = F
    for _ in range(8):
        cofactor = cofactors(R)
        R = 0.5 * (R + cofactor / (R[:, 0] * cofactor[:, 0]).sum(-1)[:, None, None])
    return R


class NeuralLaw(Adapter):
    """An elastic and, with `plastic`, a plastic network in place of the prior. Nothing of the prior is left in the stress.

    hidden: width of both layers; start: prior | random; plastic: needs prior=von_mises, whose own return mapping is then off;
    plastic_rate [1/s]: of the plastic network's outputs. The prior's tangent serves between two evaluations (`simulation.stride`).
    Errors: ConfigError naming the key."""

    replaces_law = True

    def __init__(
        self, *, hidden: Width = 64, start: Literal["prior", "random"] = "prior",
        plastic: bool = False, plastic_rate: Positive = 2.0,
    ) -> None:  # fmt: skip
        super().__init__()
        self.start, self.plastic_rate = start, plastic_rate
        self.elastic = network(hidden)
        self.plastic = network(hidden) if plastic else None
        if plastic:
            nn.init.zeros_(self.plastic[-1].weight)

    def check_law(self, law: str) -> None:
        """Errors: ConfigError for a plastic network beside a prior that does not keep the elastic part of F apart."""
        if self.plastic is not None and law != "von_mises":
            raise ConfigError(f"adapter.plastic: expected prior=von_mises, found {law}")

    def prepare(self, law: str, states: Callable[[Tensor], MaterialState]) -> None:
        self.check_law(law)
        if self.start == "prior":
            pretrain(self.elastic, states, float(self.E_ref))

    def stress(self, w: Tensor) -> Tensor:
        """(N, 6) vech(R^T tau R)/E_ref at stretches w (N, 6)."""
        W = matrix_of(w) + torch.eye(3).to(w)
        return vech_of(symmetric_output(self.elastic, W) @ W)

    def increment(self, w: Tensor, s: Tensor) -> Tensor:
        """(N, 6) dimensionless: the law's stress less the prior's s (N, 6)."""
        return self.stress(w) - s

    def forward(self, state: MaterialState) -> AdapterOperator:
        """The law's stress as an offset to the prior's, exact at the state it was asked at.

        Errors: ConfigError before `switch_on`."""
        self.check_on()
        outer, inner = state.w.dtype, self.E_ref.dtype
        h = self.E_ref * self.increment(state.w.to(inner), state.stress.to(inner) / self.E_ref)
        n = len(h)
        self.note_stress(h / self.E_ref)
        G = torch.zeros(n, 6, 6, dtype=outer, device=h.device)
        if state.plastic_strain is None or self.plastic is None:
            return AdapterOperator(G, h.to(outer))  # the prior's own yield, where it has one
        # the strain in the prior's yield function becomes 0: it never yields, the network flows instead
        none = -torch.eye(6).to(G).expand(n, 6, 6).contiguous()
        return AdapterOperator(G, h.to(outer), none, torch.zeros_like(state.w))

    def flow(self, F: Tensor, time: float) -> Tensor:
        """F (N, 3, 3) after plastic flow for `time` [s]; F itself without a plastic network."""
        if self.plastic is None:
            return F
        R = polar_rotation(F)
        X = symmetric_output(self.plastic, (R.mT @ F).to(self.E_ref.dtype)).to(F.dtype)
        return F + self.plastic_rate * time * (R @ X)


def pretrain(
    net: nn.Sequential, states: Callable[[Tensor], MaterialState], unit: float, *, strain: float = 0.5, samples: int = 2048,
    iterations: int = 400, seed: int = 0,
) -> float:  # fmt: skip
    """Fit an elastic network to a law's stress over random Hencky strains up to `strain`; (relative RMS error left).

    unit [Pa]: of the network's stress. Adam with errors relative to each stress, so that the stiffness at rest counts as much as
    that at large strain; then the last layer by linear least squares. The same weights for the same law and seed."""
    device, inner = net[0].weight.device, net[0].weight.dtype
    generator = torch.Generator().manual_seed(seed)

    def draw() -> tuple[Tensor, Tensor, Tensor]:
        state = states(drawn_stretches(samples, strain, generator))
        W, s = matrix_of(state.w) + torch.eye(3).double(), state.stress / unit
        weight = 1 / s.norm(dim=1, keepdim=True).clamp(min=SMALLEST_STRAIN / 10)
        return W, s, weight

    W, s, weight = draw()
    fitted = network(net[0].out_features).double()
    fitted.load_state_dict({name: value.double().cpu() for name, value in net.state_dict().items()})
    x = invariants(W)

    def stress_of(raw: Tensor, W: Tensor) -> Tensor:
        raw = raw.unflatten(-1, (3, 3))
        return vech_of(0.5 * (raw + raw.mT) @ W)

    with torch.enable_grad():
        optimizer = torch.optim.Adam(fitted.parameters(), lr=5e-3)
        for i in range(iterations):
            for group in optimizer.param_groups:
                group["lr"] = 5e-3 * 0.5 * (1 + math.cos(math.pi * i / iterations)) + 1e-5
            optimizer.zero_grad()
            (weight * (stress_of(fitted(x), W) - s)).square().mean().backward()
            optimizer.step()
    with torch.no_grad():
        last = fitted[-1].weight
        features = fitted[:-1](x)
        basis = torch.eye(OUTPUTS).double()
        columns = torch.stack([stress_of(e.expand(len(W), -1), W) for e in basis], -1)  # (N, 6, 9)
        rows = weight[:, :, None, None] * columns[..., None] * features[:, None, None, :]
        rows = rows.flatten(2).flatten(0, 1)
        target = (weight * s).flatten()
        normal = rows.T @ rows
        ridge = 1e-9 * normal.diagonal().mean() * torch.eye(len(normal)).double()
        change = torch.linalg.solve(normal + ridge, rows.T @ (target - rows @ last.flatten()))
        last += change.view_as(last)
        W, s, weight = draw()
        error = (stress_of(fitted(invariants(W)), W) - s).norm(dim=1) * weight[:, 0]
        net.load_state_dict(
            {name: value.to(device, inner) for name, value in fitted.state_dict().items()}
        )
    return float(error.square().mean().sqrt())

"""Baseline: low-rank adaptation of pre-trained constitutive networks (NeuMA; Cao et al., NeurIPS 2024).

The networks are those of `nclaw`. Their weights are fitted to an analytical law, here the calibrated prior, and then held; what is
learned are W = W_0 + (scaling/rank) B A in every layer, with B = 0 at the start, so that the stage begins at the analytical law.
The source adapts checkpoints of NCLaw, which were learned on simulated materials of other parameters; ours are pre-trained in
seconds when the stage begins, and are part of the run's checkpoint.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from mosa.baselines.nclaw import NeuralLaw, network, pretrain
from mosa.physics.adapters.interface import MaterialState
from mosa.settings import Positive, Width


class LowRankLinear(nn.Linear):
    """A linear layer without bias whose weight is held, plus (scaling/rank) B A: A (rank, in) as Kaiming's, B (out, rank) zero."""

    def __init__(self, held: nn.Linear, rank: int, scaling: float) -> None:
        super().__init__(held.in_features, held.out_features, bias=False)
        self.weight = nn.Parameter(held.weight.detach().clone(), requires_grad=False)
        self.A = nn.Parameter(torch.empty(rank, held.in_features))
        self.B = nn.Parameter(torch.zeros(held.out_features, rank))
        nn.init.kaiming_uniform_(self.A, a=5**0.5)
        self.factor = scaling / rank

    def forward(self, x: Tensor) -> Tensor:
        return linear(x, self.weight) + self.factor * linear(linear(x, self.A), self.B)


def low_rank(net: nn.Sequential, rank: int, scaling: float) -> nn.Sequential:
    """The network with every linear layer as a `LowRankLinear`."""
    return nn.Sequential(
        *(
            LowRankLinear(part, rank, scaling) if isinstance(part, nn.Linear) else part
            for part in net
        )
    )


class LowRankLaw(NeuralLaw):
    """`NeuralLaw` of which only a low-rank change is learned. rank, scaling: of the change; the rest as `NeuralLaw`.

    Errors: ConfigError naming the key."""

    def __init__(
        self, *, hidden: Width = 64, rank: Width = 16, scaling: Positive = 16.0,
        plastic: bool = False, plastic_rate: Positive = 2.0,
    ) -> None:  # fmt: skip
        super().__init__(hidden=hidden, plastic=plastic, plastic_rate=plastic_rate)
        self.hidden = hidden
        self.elastic = low_rank(self.elastic, rank, scaling)
        # the held weights of the plastic network's last layer are zero: it starts without flow, and B A is what may begin one
        self.plastic = low_rank(self.plastic, rank, scaling) if plastic else None

    def prepare(self, law: str, states: Callable[[Tensor], MaterialState]) -> None:
        self.check_law(law)
        base = network(self.hidden).to(self.E_ref)
        pretrain(base, states, float(self.E_ref))
        with torch.no_grad():
            for held, fitted in zip(self.elastic[::2], base[::2]):
                held.weight.copy_(fitted.weight)

"""Black-box comparison to the paper's adapter: one bounded network on the same inputs, without the structure."""

from __future__ import annotations

import torch
from torch import Tensor

from mosa.modules.adapters.base import Adapter
from mosa.modules.adapters.networks import TwoHiddenLayers, zero_outputs
from mosa.modules.adapters.stress import rested
from mosa.physics.adapters.interface import AdapterOperator, MaterialState
from mosa.settings import Positive, Width


class DirectAdapter(Adapter):
    """tau_hat = tau + E_ref R mat(l_max tanh net(w, s)) R^T, exactly the prior at initialisation.

    l_max: bound in units of E_ref, None for an unbounded network; rest_free, input_scale, hidden: as `StressAdapter`.
    Errors: ConfigError naming the key for values out of range."""

    def __init__(
        self, *, l_max: Positive | None = 0.1, input_scale: Positive = 10.0, hidden: Width = 64,
        rest_free: bool = True,
    ) -> None:  # fmt: skip
        super().__init__()
        self.l_max, self.scale, self.rest_free = l_max, input_scale, rest_free
        self.net = TwoHiddenLayers(12, 6, hidden)
        zero_outputs(self.net[-1])

    def increment(self, w: Tensor, s: Tensor) -> Tensor:
        """(N, 6) dimensionless stress added to s (N, 6) at stretch w (N, 6)."""
        inputs = self.scale * torch.cat([w, s], -1)
        raw = self.net(torch.cat([inputs, torch.zeros_like(inputs[:1])]))
        b = raw if self.l_max is None else self.l_max * torch.tanh(raw)
        return rested(b[:-1], b[-1:], w, s) if self.rest_free else b[:-1]

    def forward(self, state: MaterialState) -> AdapterOperator:
        """As `StressAdapter.forward`, with G = 0."""
        self.check_on()
        outer, inner = state.w.dtype, self.E_ref.dtype
        b = self.increment(state.w.to(inner), state.stress.to(inner) / self.E_ref)
        self.note_stress(b)
        return AdapterOperator(
            torch.zeros(len(b), 6, 6, dtype=outer, device=b.device), (self.E_ref * b).to(outer)
        )

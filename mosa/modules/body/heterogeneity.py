"""Spatial variation of the stiffness: P(X) = P_global (1 + amplitude tanh eta(X)) (paper, section 3.1)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mosa.errors import ConfigError
from mosa.modules.adapters.networks import TwoHiddenLayers, zero_outputs
from mosa.modules.body.settings import HeterogeneitySettings


class StiffnessField(nn.Module):
    """What every field has; `forward` gives eta (N,) at rest positions X (N, 3) [m], 0 at initialisation.

    low, high: (3,) [m] corners of the object's box. Errors: ConfigError for a box without volume."""

    low: Tensor
    high: Tensor
    few_numbers = False
    """Whether Gauss-Newton can learn its numbers."""

    def __init__(
        self, low: Tensor, high: Tensor, settings: HeterogeneitySettings | None = None
    ) -> None:
        super().__init__()
        if not bool((high > low).all()):
            raise ConfigError(
                f"heterogeneity: the box of the object has no volume: {low.tolist()} to {high.tolist()}"
            )
        self.register_buffer("low", low.detach().clone())
        self.register_buffer("high", high.detach().clone())
        self.settings = settings or HeterogeneitySettings()

    def settle(self, rest: Tensor) -> None:
        """Told once about the particles rest (N, 3) [m]."""

    def factor(self, X: Tensor) -> Tensor:
        """1 + amplitude tanh eta(X), (N,)."""
        return 1 + self.settings.amplitude * torch.tanh(self(X))


class HeterogeneityField(StiffnessField):
    """Coordinate network eta on rest positions normalised to the object's box."""

    def __init__(
        self, low: Tensor, high: Tensor, settings: HeterogeneitySettings | None = None
    ) -> None:
        super().__init__(low, high, settings)
        self.frequencies = self.settings.frequencies
        self.net = TwoHiddenLayers(3 + 6 * self.frequencies, 1, self.settings.hidden)
        zero_outputs(self.net[-1])

    def forward(self, X: Tensor) -> Tensor:
        """eta (N,) at rest positions X (N, 3) [m]."""
        x = 2 * (X - self.low) / (self.high - self.low) - 1
        waves = [
            f(torch.pi * 2**k * x) for k in range(self.frequencies) for f in (torch.sin, torch.cos)
        ]
        return self.net(torch.cat([x, *waves], -1))[..., 0]

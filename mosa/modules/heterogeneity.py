"""Spatial variation of the stiffness: P(X) = P_global (1 + amplitude tanh eta(X)) (paper, section 3.1)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mosa.errors import ConfigError
from mosa.modules.networks import TwoHiddenLayers, zero_outputs


class HeterogeneityField(nn.Module):
    """Coordinate network eta on rest positions normalised to the object's box. eta is exactly 0 at initialisation.

    low, high: (3,) [m] corners of the box; amplitude: largest relative deviation; frequencies: sines and cosines of pi 2^k x,
    k = 0 .. frequencies - 1, beside x in [-1, 1] itself. Errors: ConfigError naming the key.
    """

    def __init__(self, low: Tensor, high: Tensor, amplitude: float = 0.2, hidden: int = 32, frequencies: int = 2) -> None:
        super().__init__()
        if not 0 < amplitude < 1:
            raise ConfigError(f"heterogeneity.amplitude: expected a number between 0 and 1, found {amplitude}")
        if frequencies < 0 or hidden < 1:
            raise ConfigError(f"heterogeneity: expected frequencies >= 0 and hidden >= 1, found {frequencies} and {hidden}")
        if not bool((high > low).all()):
            raise ConfigError(f"heterogeneity: the box of the object has no volume: {low.tolist()} to {high.tolist()}")
        self.register_buffer("low", low.detach().clone())
        self.register_buffer("high", high.detach().clone())
        self.amplitude, self.frequencies = amplitude, frequencies
        self.net = TwoHiddenLayers(3 + 6 * frequencies, 1, hidden)
        zero_outputs(self.net[-1])

    def forward(self, X: Tensor) -> Tensor:
        """eta (N,) at rest positions X (N, 3) [m]."""
        x = 2 * (X - self.low) / (self.high - self.low) - 1
        waves = [f(torch.pi * 2**k * x) for k in range(self.frequencies) for f in (torch.sin, torch.cos)]
        return self.net(torch.cat([x, *waves], -1))[..., 0]

    def factor(self, X: Tensor) -> Tensor:
        """1 + amplitude tanh eta(X), (N,)."""
        return 1 + self.amplitude * torch.tanh(self(X))

"""Spatial variation of the stiffness: P(X) = P_global (1 + amplitude tanh eta(X)) (method.md, section 5)."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class HeterogeneityField(nn.Module):
    """Coordinate network eta on rest positions normalised to the box (low, high), each (3,) [m]. eta is 0 at initialisation.

    frequencies: sines and cosines of pi 2^k x, k = 0 .. frequencies - 1, beside x itself.
    """

    def __init__(self, low: Tensor, high: Tensor, amplitude: float = 0.2, hidden: int = 32, frequencies: int = 2) -> None:
        super().__init__()
        self.register_buffer("low", low.detach().clone())
        self.register_buffer("high", high.detach().clone())
        self.amplitude, self.frequencies = amplitude, frequencies
        self.net = nn.Sequential(nn.Linear(3 + 6 * frequencies, hidden), nn.SiLU(), nn.Linear(hidden, hidden), nn.SiLU(),
                                 nn.Linear(hidden, 1))
        nn.init.zeros_(self.net[-1].weight)
        nn.init.zeros_(self.net[-1].bias)

    def forward(self, X: Tensor) -> Tensor:
        """eta (N,) at rest positions X (N, 3) [m]."""
        x = 2 * (X - self.low) / (self.high - self.low) - 1
        waves = [f(torch.pi * 2**k * x) for k in range(self.frequencies) for f in (torch.sin, torch.cos)]
        return self.net(torch.cat([x, *waves], -1))[..., 0]

    def factor(self, X: Tensor) -> Tensor:
        """1 + amplitude tanh eta(X), (N,)."""
        return 1 + self.amplitude * torch.tanh(self(X))

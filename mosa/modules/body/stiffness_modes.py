"""Spatial variation of the stiffness as a sum of smooth modes: eta(X) = sum_k a_k B_k(X), for identification with few numbers.

B_k are products of cosines on the body's box, from half a wave along its longest side down to a shortest wavelength, each with mean
0 and variance 1 over the particles. P(X) = P_global (1 + amplitude tanh eta(X)) as in `heterogeneity` (paper, section 3.1)."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

from mosa.errors import ConfigError
from mosa.modules.body.heterogeneity import HeterogeneitySettings, StiffnessField


class StiffnessModes(StiffnessField):
    """Call `settle(rest)` once with the particles. Errors: also ConfigError where no wave fits."""

    few_numbers = True

    def __init__(
        self, low: Tensor, high: Tensor, settings: HeterogeneitySettings | None = None
    ) -> None:
        super().__init__(low, high, settings)
        wavelength = self.settings.wavelength
        extent = (high - low).double().cpu()
        sides = (extent / extent.max()).tolist()
        limit = 2 / wavelength  # in half waves per longest side
        counts = [range(int(limit * side) + 1) for side in sides]
        waves = itertools.product(*counts)
        sizes = ((sum((n / s) ** 2 for n, s in zip(wave, sides)) ** 0.5, *wave) for wave in waves)
        found = [(size, *wave) for size, *wave in sizes if 0 < size <= limit]
        found = sorted(found)[: self.settings.most]
        if not found:
            raise ConfigError(
                f"heterogeneity.wavelength: no wave of {wavelength} times the body fits; expected less than 2"
            )
        self.register_buffer("waves", torch.tensor([f[1:] for f in found], dtype=torch.float32))
        self.register_buffer("size", torch.tensor([f[0] for f in found], dtype=torch.float32))
        self.register_buffer("mean", torch.zeros(len(found)))
        self.register_buffer("scale", torch.ones(len(found)))
        self.coefficients = nn.Parameter(torch.zeros(len(found)))

    def raw(self, X: Tensor) -> Tensor:
        """(N, K) products of cosines at X (N, 3) [m]."""
        x = (X - self.low) / (self.high - self.low)
        return torch.cos(torch.pi * x[:, None, :] * self.waves).prod(-1)

    @torch.no_grad()
    def settle(self, rest: Tensor) -> None:
        """Mean 0 and variance 1 of every mode over the particles `rest` (N, 3)."""
        values = self.raw(rest.to(self.low))
        self.mean.copy_(values.mean(0))
        self.scale.copy_(1 / values.std(0).clamp(min=1e-3))

    def basis(self, X: Tensor) -> Tensor:
        """(N, K)."""
        return (self.raw(X) - self.mean) * self.scale

    def forward(self, X: Tensor) -> Tensor:
        """eta (N,) at rest positions X (N, 3) [m]."""
        return self.basis(X) @ self.coefficients

"""Spatial variation of the stiffness: P(X) = P_global (1 + amplitude tanh eta(X)) (paper, section 3.1)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mosa.errors import ConfigError
from mosa.modules.adapters.networks import TwoHiddenLayers, zero_outputs
from mosa.schema import FLAG, WIDEST, check_knobs, knob, number, one_of, whole


@dataclass(frozen=True)
class HeterogeneitySettings:
    """kind: modes (`StiffnessModes`) | network (`HeterogeneityField`), what checkpoints that do not say have; amplitude: largest
    relative deviation.

    Of the modes, wavelength: of the shortest, over the box's longest side; most: of them, the longest waves first. Of the network,
    hidden: width of its layers; frequencies: sines and cosines of pi 2^k x, k = 0 .. frequencies - 1, beside x in [-1, 1] itself.
    Errors: ConfigError naming the key."""

    enabled: bool = knob(True, FLAG)
    kind: str = knob("network", one_of("modes", "network"))
    amplitude: float = knob(0.2, number(0, 1, above=True, below=True))
    wavelength: float = knob(0.33, number(0.02, 2))
    most: int = knob(50, whole(1, WIDEST))
    hidden: int = knob(32, whole(1, WIDEST))
    frequencies: int = knob(2, whole(0, 32))

    def __post_init__(self) -> None:
        check_knobs(self, "heterogeneity")


class StiffnessField(nn.Module):
    """What every field has; `forward` gives eta (N,) at rest positions X (N, 3) [m], 0 at initialisation.

    low, high: (3,) [m] corners of the object's box. Errors: ConfigError for a box without volume.
    """

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

"""Spatial variation of the stiffness: P(X) = P_global (1 + amplitude tanh eta(X)) (paper, section 3.1)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mosa.errors import ConfigError
from mosa.modules.networks import TwoHiddenLayers, zero_outputs
from mosa.schema import FLAG, WIDEST, Kind, check_knobs, is_number, knob, number, one_of, whole

FRACTION = Kind("a number between 0 and 1", lambda v: is_number(v) and 0 < v < 1)


@dataclass(frozen=True)
class HeterogeneitySettings:
    """kind: modes (`StiffnessModes`) | network (`HeterogeneityField`), what checkpoints that do not say have; amplitude: largest
    relative deviation.

    Of the modes, wavelength: of the shortest, over the box's longest side; most: of them, the longest waves first. Of the network,
    hidden: width of its layers; frequencies: sines and cosines of pi 2^k x, k = 0 .. frequencies - 1, beside x in [-1, 1] itself.
    Errors: ConfigError naming the key."""

    enabled: bool = knob(True, FLAG)
    kind: str = knob("network", one_of("modes", "network"))
    amplitude: float = knob(0.2, FRACTION)
    wavelength: float = knob(0.33, number(0, 2, above=True))
    most: int = knob(50, whole(1, WIDEST))
    hidden: int = knob(32, whole(1, WIDEST))
    frequencies: int = knob(2, whole(0, 32))

    def __post_init__(self) -> None:
        check_knobs(self, "heterogeneity")


class HeterogeneityField(nn.Module):
    """Coordinate network eta on rest positions normalised to the object's box. eta is exactly 0 at initialisation.

    low, high: (3,) [m] corners of the box. Errors: ConfigError for a box without volume.
    """

    def __init__(self, low: Tensor, high: Tensor, settings: HeterogeneitySettings | None = None) -> None:
        super().__init__()
        settings = settings or HeterogeneitySettings()
        check_box(low, high)
        self.register_buffer("low", low.detach().clone())
        self.register_buffer("high", high.detach().clone())
        self.amplitude, self.frequencies = settings.amplitude, settings.frequencies
        self.net = TwoHiddenLayers(3 + 6 * self.frequencies, 1, settings.hidden)
        zero_outputs(self.net[-1])

    few_numbers = False
    """Whether Gauss-Newton can learn its weights."""

    def settle(self, rest: Tensor) -> None:
        """Told once about the particles rest (N, 3) [m]; a network needs nothing of them."""

    def forward(self, X: Tensor) -> Tensor:
        """eta (N,) at rest positions X (N, 3) [m]."""
        x = 2 * (X - self.low) / (self.high - self.low) - 1
        waves = [f(torch.pi * 2**k * x) for k in range(self.frequencies) for f in (torch.sin, torch.cos)]
        return self.net(torch.cat([x, *waves], -1))[..., 0]

    def factor(self, X: Tensor) -> Tensor:
        """1 + amplitude tanh eta(X), (N,)."""
        return 1 + self.amplitude * torch.tanh(self(X))


def check_box(low: Tensor, high: Tensor) -> None:
    """Errors: ConfigError for a box from low to high (3,) [m] without volume."""
    if not bool((high > low).all()):
        raise ConfigError(f"heterogeneity: the box of the object has no volume: {low.tolist()} to {high.tolist()}")

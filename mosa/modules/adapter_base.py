"""What every adapter has: the unit of its stress, what the simulator and the fit ask it, and the statistics that penalties read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from mosa.errors import ConfigError
from mosa.modules import microplane
from mosa.modules.stiffening import ADAPTER_MARGIN
from mosa.physics.engine.adapter_interface import MaterialState


class OperatorStatistics(NamedTuple):
    """Of one or more evaluations, with gradients: what penalties and reports are made of.

    mean_abs_C: over particles, the four matrices and all entries of |C|. mean, within: (48,) mean and variance over particles
    (after `pool`: over evaluations too) of each entry of C_x, C_y, C_z, C_xyz (36), L_pre (6), L_post (6). Of an adapter without
    these: of the entries that it notes.
    """

    mean_abs_C: Tensor
    mean: Tensor
    within: Tensor

    @property
    def mean_square(self) -> Tensor:
        """Mean squared entry: penalises any departure from the prior."""
        return (self.within + self.mean.square()).mean()

    @property
    def variance(self) -> Tensor:
        """Mean variance over states: a constant operator, the simplest anisotropy, has none."""
        return self.within.mean()


def statistics(C: Tensor, pre: Tensor, post: Tensor) -> OperatorStatistics:
    """Of the corrections C (N, 4, 3, 3) and the residuals (N, 6) of N particles."""
    entries = torch.cat([C.flatten(1), pre, post], 1)
    mean = entries.mean(0)
    return OperatorStatistics(C.abs().mean(), mean, (entries - mean).square().mean(0))


def pool(parts: Sequence[OperatorStatistics]) -> OperatorStatistics:
    """Over evaluations of equally many particles: the variance is then over particles and time."""
    means, within = torch.stack([p.mean for p in parts]), torch.stack([p.within for p in parts])
    mean = means.mean(0)
    return OperatorStatistics(torch.stack([p.mean_abs_C for p in parts]).mean(), mean, (within + (means - mean).square()).mean(0))


class Adapter(nn.Module):
    """What every adapter has: the unit of stress E_ref [Pa], set once, and the statistics of its last evaluation."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("E_ref", torch.tensor(float("nan")))
        self.register_buffer("poisson", torch.tensor(float("nan")))
        self._last: tuple[Tensor, Tensor, Tensor] | Tensor | None = None

    replaces_law = False
    """Whether nothing of the prior is left in the answer: its stage then holds the prior's parameters, which would only drift."""

    @property
    def steady(self) -> bool:
        """Whether the operator is the same in every state, so that one evaluation serves a whole rollout."""
        return False

    def stiffening(self, poisson: Tensor | float) -> float:
        """Modulus over the prior's that the time step allows for; poisson: the prior's."""
        return ADAPTER_MARGIN

    def prepare(self, law: str, states: Callable[[Tensor], MaterialState]) -> None:
        """Called once, after `switch_on`, when the adapter's stage begins: networks that stand in for the prior start from it.

        law: the prior's name; states: of `mosa.modules.material.material_states`, at its calibrated parameters.
        Errors: ConfigError where the adapter cannot be used with this law."""

    def follow(self, poisson: Tensor) -> None:
        """Told before every rollout: the prior's Poisson number at that moment, (), with its graph."""

    def __getstate__(self) -> dict:
        return {**self.__dict__, "_last": None}  # it holds a graph, which can be neither copied nor pickled

    def switch_on(self, reference_modulus: Tensor | float, poisson: Tensor | float = 0.3) -> None:
        """Fix E_ref [Pa] and the Poisson number of C0 to the calibrated prior's. They never change afterwards: a moving unit
        would make dL/dE wrong and the law irreproducible from its weights. Errors: ConfigError on a second, other value."""
        for name, value in (("E_ref", reference_modulus), ("poisson", poisson)):
            buffer = getattr(self, name)
            value = float(value.detach() if isinstance(value, Tensor) else value)
            if not torch.isnan(buffer) and abs(float(buffer) - value) > 1e-6 * abs(value):
                raise ConfigError(
                    f"adapter: {name} is fixed at {float(buffer):.6g} already, found {value:.6g}: build a new adapter"
                )
            buffer.fill_(value)

    @property
    def is_on(self) -> bool:
        """Whether `switch_on` was called (here or in the run the weights come from)."""
        return not bool(torch.isnan(self.E_ref))

    def check_on(self) -> None:
        if self.E_ref.is_cuda and torch.cuda.is_current_stream_capturing():
            return  # a capture may not look; the pass ran before it was captured
        if not self.is_on:
            raise ConfigError("adapter: no reference modulus; call switch_on(E) with the calibrated prior's before simulating")

    def note(self, entries: Tensor) -> None:
        """Keep what the answer departs from the prior by, (N, K) dimensionless numbers that are 0 at the prior: penalties and
        reports (`statistics`) are made of them."""
        self._last = entries

    def statistics(self) -> OperatorStatistics:
        """Of the last `forward`, with its graph. Errors: ConfigError before the first."""
        if self._last is None:
            raise ConfigError("adapter: statistics are those of the last evaluation, and there was none yet")
        if isinstance(self._last, Tensor):
            mean = self._last.mean(0)
            return OperatorStatistics(self._last.abs().mean(), mean, (self._last - mean).square().mean(0))
        C, pre, post = self._last
        if C.shape[-1] == 12:  # the fused kernels leave the numbers that the matrices are made of
            C = microplane.correction(C)
        return statistics(C, pre, post)

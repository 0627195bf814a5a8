"""What every adapter has: an answer to all of `AdapterProtocol` but the operator."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import Any, Self

import torch
from torch import Tensor, nn

from mosa.errors import ConfigError
from mosa.modules.adapters import microplane
from mosa.modules.adapters.penalties import (
    PENALTIES,
    OperatorStatistics,
    Penalty,
    statistics,
    statistics_of,
)
from mosa.modules.adapters.protocol import AdapterProtocol
from mosa.modules.adapters.stiffening import ADAPTER_MARGIN
from mosa.physics.adapters.interface import AdapterOperator, MaterialState
from mosa.physics.constitutive.laws import Law
from mosa.settings import annotation_of, arguments_of, check_values


class Adapter(nn.Module, AdapterProtocol):
    """What every adapter has; what an adapter answers is documented in `AdapterProtocol`. One that derives from this writes
    `forward`, which notes what it departs from the prior by, and what else is different about it."""

    energetic = False
    few_numbers = False
    replaces_law = False
    own_dynamics = False
    penalties: Mapping[str, Penalty] = PENALTIES
    flow: Callable[[Tensor, float], Tensor] | None = None

    def __new__(cls, *_: Any, **given: Any) -> Self:
        """Errors: ConfigError naming a keyword argument that is not what its annotation says."""
        known = arguments_of(cls, "adapter").model_fields
        check_values(given, {k: annotation_of(f) for k, f in known.items()}, "adapter")
        return super().__new__(cls)

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("E_ref", torch.tensor(float("nan")))
        self.register_buffer("poisson", torch.tensor(float("nan")))
        self._last: tuple[Tensor, Tensor, Tensor] | Tensor | None = None

    @property
    def steady(self) -> bool:
        return False

    def unsuited(self, law: Law) -> str | None:
        return None

    def settle(self, rest: Tensor, volume: Tensor) -> None:
        pass

    def prepare(self, law: str, states: Callable[[Tensor], MaterialState]) -> None:
        pass

    def follow(self, poisson: Tensor) -> None:
        pass

    def stiffening(self, poisson: Tensor | float) -> float:
        return ADAPTER_MARGIN

    def simulator(self, density: float, world: Any, frame_dt: float) -> Any:
        return None

    def in_double(self) -> Adapter:
        self.check_on()
        return copy.deepcopy(self).double().cpu().requires_grad_(False)

    def increment(self, w: Tensor, s: Tensor) -> Tensor:
        answer: AdapterOperator = self(MaterialState(w, self.E_ref * s))
        return (answer.G @ s[..., None])[..., 0] + answer.h / self.E_ref

    def stiffness(self) -> Tensor | None:
        return None

    def __getstate__(self) -> dict[str, Any]:
        # it holds a graph, which can be neither copied nor pickled
        return {**self.__dict__, "_last": None}

    def switch_on(self, reference_modulus: Tensor | float, poisson: Tensor | float = 0.3) -> None:
        """They never change afterwards: a moving unit would make dL/dE wrong and the law irreproducible from its weights."""
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
        return not bool(torch.isnan(self.E_ref))

    def check_on(self) -> None:
        if self.E_ref.is_cuda and torch.cuda.is_current_stream_capturing():
            return  # a capture may not look; the pass ran before it was captured
        if not self.is_on:
            raise ConfigError(
                "adapter: no reference modulus; call switch_on(E) with the calibrated prior's before simulating"
            )

    def note(self, entries: Tensor) -> None:
        """Keep what the answer departs from the prior by, (N, K) dimensionless numbers that are 0 at the prior: penalties and
        reports (`statistics`) are made of them."""
        self._last = entries

    def note_stress(self, added: Tensor) -> None:
        """As `note`, of a stress (N, 6) in units of E_ref that stands beside the prior's: like the paper's L_pre, with C = 0, so
        that a weight of its penalties means the same."""
        self._last = (added.new_zeros(len(added), 4, 3, 3), added, torch.zeros_like(added))

    def statistics(self) -> OperatorStatistics:
        if self._last is None:
            raise ConfigError(
                "adapter: statistics are those of the last evaluation, and there was none yet"
            )
        if isinstance(self._last, Tensor):
            return statistics_of(self._last)
        C, pre, post = self._last
        if C.shape[-1] == 12:  # the fused kernels leave the numbers that the matrices are made of
            C = microplane.correction(C)
        return statistics(C, pre, post)

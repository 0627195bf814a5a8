"""What every adapter has: what the rest of the program asks of an adapter, and an answer to all of it but the operator.

The simulator asks for operators, the fit for penalties and for what the time step has to allow, the analysis for what the law is
like. Nobody asks which adapter it is. No adapter at all is `None`, the prior alone.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import Any, Self

import torch
from torch import Tensor, nn

from mosa.errors import ConfigError
from mosa.modules.adapters.penalties import (
    PENALTIES,
    OperatorStatistics,
    Penalty,
    statistics,
    statistics_of,
)
from mosa.modules.adapters.stiffening import ADAPTER_MARGIN
from mosa.physics.adapters.interface import AdapterOperator, MaterialState
from mosa.physics.constitutive.laws import Law
from mosa.settings import annotation_of, arguments_of, check_values


class Adapter(nn.Module):
    """A correction of the prior's law, whose keyword arguments are the keys of its YAML.

    It starts at the prior, bounds what it adds, and works in the material frame, where stresses are R^T tau R and vech order is
    xx, yy, zz, yz, zx, xy. A new one writes `forward`, which notes what it departs from the prior by, and what else is different
    about it: `forward(state: MaterialState) -> AdapterOperator`, the operator at N states, held until it is asked again:
    G (N, 6, 6), h (N, 6) [Pa], of the states' type and device. Errors: ConfigError before `switch_on`.

    E_ref: () [Pa], the unit of its stress, and poisson: () of the prior, both fixed by `switch_on`, not numbers before."""

    E_ref: Tensor
    poisson: Tensor
    numbers: Any
    energetic = False
    """Whether G is a stiffness, of an energy in Green's strain; else it acts on the prior's stress."""
    few_numbers = False
    """Whether all that it learns is one parameter, `numbers`, so few numbers that Gauss-Newton can learn them; 0 is the prior."""
    later = False
    """Whether it has networks that begin where `numbers` end: their stage, `networks`, calls `vary` first."""
    replaces_law = False
    """Whether nothing of the prior is left in the answer: its stage then holds the prior's parameters, which would only drift."""
    own_dynamics = False
    """Whether it moves the particles itself, without a law and a grid (`simulator`)."""
    penalties: Mapping[str, Penalty] = PENALTIES
    """Terms of the loss that it brings, by name; their weights are `losses.<name>`."""
    flow: Callable[[Tensor, float], Tensor] | None = None
    """F (N, 3, 3) after plastic flow for a time [s], in place of the law's return mapping; None where that stays."""

    def __new__(cls, *_: Any, **given: Any) -> Self:
        """Errors: ConfigError naming a keyword argument that is not what its annotation says."""
        known = arguments_of(cls, "adapter").model_fields  # type: ignore[arg-type]  # classes are hashable
        check_values(given, {k: annotation_of(f) for k, f in known.items()}, "adapter")
        return super().__new__(cls)

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("E_ref", torch.tensor(float("nan")))
        self.register_buffer("poisson", torch.tensor(float("nan")))
        self._last: tuple[Tensor, Tensor, Tensor] | Tensor | None = None

    @property
    def steady(self) -> bool:
        """Whether the operator is the same in every state, so that one evaluation serves a whole rollout."""
        return False

    def unsuited(self, law: Law) -> str | None:
        """Why it can correct nothing of a body of this law: it is left out then, with this as a warning. None where it can."""
        return None

    def vary(self) -> None:
        """From now on networks are learned, not `numbers`; where `later`."""

    def settle(self, rest: Tensor, volume: Tensor) -> None:
        """Told once about the body: rest (N, 3) [m], volume (N,) [m^3]. Errors: ConfigError."""

    def prepare(self, law: str, states: Callable[[Tensor], MaterialState]) -> None:
        """Called once after `switch_on`, when its stage begins: networks that stand in for the prior start from it.

        law: the prior's name; states: of `mosa.modules.body.material.material_states`, at its calibrated parameters.
        Errors: ConfigError where it cannot be used with this law."""

    def follow(self, poisson: Tensor) -> None:
        """Told before every rollout: the prior's Poisson number at that moment, (), with its graph."""

    def stiffening(self, poisson: Tensor | float) -> float:
        """Modulus over the prior's that the time step allows for, at least 1; poisson: the prior's."""
        return ADAPTER_MARGIN

    def simulator(self, density: float, world: Any, frame_dt: float) -> Any:
        """What rolls its own dynamics out, with the `rollout` of `Simulator`; None where a law on the grid is simulated.

        density [kg/m^3], world: `mosa.physics.world.World`, frame_dt [s]. Errors: ConfigError."""
        return None

    def in_double(self) -> Self:
        """A copy in float64 on the CPU, without gradients of its weights. Errors: ConfigError where it is not on."""
        self.check_on()
        return copy.deepcopy(self).double().cpu().requires_grad_(False)

    def increment(self, w: Tensor, s: Tensor) -> Tensor:
        """(N, 6) stress that is added to the prior's s (N, 6), both in units of E_ref, at stretches w (N, 6) = vech(W - I), with
        gradients in both; of a stiffness, to first order in the strain."""
        answer: AdapterOperator = self(MaterialState(w, self.E_ref * s))
        return (answer.G @ s[..., None])[..., 0] + answer.h / self.E_ref

    def stiffness(self) -> Tensor | None:
        """(6, 6) float64 of the learned law at rest, in Mandel scaling and units of 2 mu, where the operator is a stiffness; None
        where it acts on the prior's stress."""
        return None

    def __getstate__(self) -> dict[str, Any]:
        # it holds a graph, which can be neither copied nor pickled
        return {**self.__dict__, "_last": None}

    def switch_on(self, reference_modulus: Tensor | float, poisson: Tensor | float = 0.3) -> None:
        """Fix E_ref [Pa] and the Poisson number of C0 to those of the calibrated prior. They never change afterwards: a moving unit
        would make dL/dE wrong and the law irreproducible from its weights. Errors: ConfigError for others later."""
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
        """Whether `switch_on` was called, here or in the run that the weights come from."""
        return not bool(torch.isnan(self.E_ref))

    @property
    def corrects(self) -> bool:
        """Whether the law is another than the prior's: not before `switch_on`, nor where its
        `few_numbers` are all 0, as a fit leaves them that drops this part."""
        return self.is_on and not (self.few_numbers and not self.numbers.any())

    def check_on(self) -> None:
        if self.E_ref.is_cuda and torch.cuda.is_current_stream_capturing():
            return  # a capture may not look; the pass ran before it was captured
        if not self.is_on:
            raise ConfigError("adapter: no reference modulus yet; call switch_on(E)")

    def note(self, entries: Tensor) -> None:
        """Keep what the answer departs from the prior by, (N, K) dimensionless numbers that are 0 at the prior: penalties and
        reports (`statistics`) are made of them."""
        self._last = entries

    def note_stress(self, added: Tensor) -> None:
        """As `note`, of a stress (N, 6) in units of E_ref that stands beside the prior's: like the paper's L_pre, with C = 0, so
        that a weight of its penalties means the same."""
        self._last = (added.new_zeros(len(added), 4, 3, 3), added, torch.zeros_like(added))

    def statistics(self) -> OperatorStatistics:
        """Of the last evaluation, with its graph. Errors: ConfigError before the first, unless it is `steady`."""
        if self._last is None:
            said = "`forward` to call `note` or `note_stress`, from which statistics are made, found none"
            raise ConfigError(f"adapter: expected an evaluation, and its {said}")
        if isinstance(self._last, Tensor):
            return statistics_of(self._last)
        return statistics(*self._last)

"""What an adapter is asked, what it may answer, and the check of its answer."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from mosa.errors import ConfigError
from mosa.physics.constitutive.laws import Law
from mosa.physics.engine.material_operations import material_state
from mosa.settings import shown
from mosa.types import dense

ANSWER = ("G", "h", "plastic_G", "plastic_h")


class MaterialState(NamedTuple):
    """What an adapter reads, in the material frame. w: (N, 6) vech(W - I); stress: (N, 6) vech(R^T tau R) [Pa] of the prior;
    plastic_strain: (N, 6) vech(dev log W), None for laws that do not yield. vech order: xx, yy, zz, yz, zx, xy."""

    w: Tensor
    stress: Tensor
    plastic_strain: Tensor | None = None


class AdapterOperator(NamedTuple):
    """What an adapter answers, held in the material frame until it is asked again.

    G: (N, 6, 6), h: (N, 6) [Pa]: tau_hat = tau + R mat(G vech(R^T tau R) + h) R^T. plastic_G: (N, 6, 6), plastic_h: (N, 6), both or
    neither: the yield function takes |dev(mat((I + plastic_G) vech(E) + plastic_h))| for |E|.
    Where G and h are the same for all particles, views of one row (`expand`) cost neither memory nor its traffic."""

    G: Tensor
    h: Tensor
    plastic_G: Tensor | None = None
    plastic_h: Tensor | None = None


class Several:
    """An adapter for each of several worlds, asked as one: the particles of the worlds come one after another.

    Errors: ConfigError for another number of adapters than worlds."""

    def __init__(
        self, adapters: Sequence[Callable[[MaterialState], AdapterOperator]], worlds: int
    ) -> None:
        if len(adapters) != worlds:
            raise ConfigError(
                f"adapter: expected one, or one for each of {worlds} worlds, found {len(adapters)}"
            )
        self.adapters = tuple(adapters)

    @property
    def steady(self) -> bool:
        return all(getattr(adapter, "steady", False) for adapter in self.adapters)

    def __call__(self, state: MaterialState) -> AdapterOperator:
        count = len(self.adapters)
        parts = zip(*((None,) * count if t is None else t.chunk(count) for t in state))
        answers = [answer(adapter, part) for adapter, part in zip(self.adapters, parts)]
        return AdapterOperator(
            *(None if own[0] is None else torch.cat(own) for own in zip(*answers))
        )


def answer(adapter: Callable, state: Sequence[Tensor | None]) -> AdapterOperator:
    """Errors: ConfigError where it is no G and h."""
    found = adapter(MaterialState(*state))
    if not isinstance(found, (tuple, list)) or not 2 <= len(found) <= len(ANSWER):
        raise ConfigError(
            f"adapter: expected it to answer (G, h) or an AdapterOperator, found {shown(found)}"
        )
    return AdapterOperator(*found)


def steady_answer(adapter: Callable, law: Law, F: Tensor) -> AdapterOperator:
    """What a `steady` adapter answers, asked of N particles without their state, whose kernel is not compiled. F: (N, 3, 3).

    Errors: ConfigError where it reads the state: what comes of it is no number."""
    none = F.new_full((len(F), 6), torch.nan)
    found = answer(adapter, MaterialState(none, none, none if law.plastic else None))
    if F.is_cuda and torch.cuda.is_current_stream_capturing():
        return found  # as it was when it was not captured
    for name, part in zip(ANSWER, found):
        if torch.is_tensor(part) and not part[:1].isfinite().all():
            raise ConfigError(
                f"adapter output {name}: expected the same numbers in every state, as {type(adapter).__name__} says that it is "
                "steady, found NaN where there is no state: let `steady` be False if it reads the state"
            )
    return found


@dataclass(frozen=True)
class Held:
    """An adapter that answers the same in every state."""

    operator: AdapterOperator
    steady: ClassVar[bool] = True

    def __call__(self, _: MaterialState) -> AdapterOperator:
        return self.operator


def ask(
    law: Law, dtype: torch.dtype, adapter: Callable, F: Tensor, C: Tensor, packed: Tensor, collect: Callable | None = None,
    into: tuple[Tensor, Tensor, Tensor] | None = None,
) -> dict[str, Tensor | None]:  # fmt: skip
    """The adapter's answer by name, checked. into: as `material_state`."""
    n = len(F)
    steady = getattr(adapter, "steady", False)
    found = (
        steady_answer(adapter, law, F) if steady
        else answer(adapter, material_state(law, F, C, packed, into))
    )  # fmt: skip
    plastic = (found.plastic_G, found.plastic_h) if law.plastic else (None, None)
    result = dict(zip(ANSWER, (found.G, found.h, *plastic)))
    for name, value in result.items():
        if name.startswith("plastic") and all(part is None for part in plastic):
            continue
        shape = (n, 6, 6) if name.endswith("G") else (n, 6)
        if not dense(value) or tuple(value.shape) != shape or value.dtype != dtype:
            raise ConfigError(
                f"adapter output {name}: expected shape {shape} of {dtype}, found {shown(value)}"
            )
    if collect is not None:
        collect(adapter.statistics())
    return result

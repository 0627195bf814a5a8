"""The loss terms of a fit by Adam, by name: each is a function of what one step sees, and has its weight in `losses`.

A new term is one function and one call of `register_term`. The terms of the paper are thin: their mathematics is in `losses.py`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from torch import Tensor

from mosa.data.observations import Observations
from mosa.errors import ConfigError
from mosa.modules.adapters.base import Adapter
from mosa.modules.adapters.penalties import PENALTIES, OperatorStatistics
from mosa.modules.body.body import Body, Start
from mosa.modules.fitting import losses
from mosa.rendering.observer import Views, deformed_covariances, observe
from mosa.settings import nearest, shown
from mosa.types import MotionCues, Rollout


class Extra(dict[str, Tensor]):
    """Further cues of a batch by name. Errors: ConfigError naming a cue that it lacks."""

    def __missing__(self, name: str) -> Tensor:
        raise ConfigError(
            f"step.extra: expected a cue {name!r}, found {', '.join(self) or 'none'}: further_cues of the data module returns "
            "it (docs/own_training_script.md, 'A cue of your own')"
        )


@dataclass(frozen=True)
class Step:
    """Data of one sequence in a step: its first `frames` frames, `frame_dt` [s] apart. rollout: of the body from `start`;
    targets: real images of the step's views (`targets.cameras.names`); cues: the reconstruction's motion; operator: statistics
    of the adapter's evaluations, pooled over the rollout, None where it has none; misfit: of the model the joint stage starts
    from, over the object's size; views: the step's, as indices into the training cameras; extra: the batch's own, which spans
    all training frames and, where a cue has views, all training cameras."""

    body: Body
    start: Start
    rollout: Rollout
    targets: Observations
    cues: MotionCues
    frames: int
    background: Tensor
    heterogeneous: bool
    operator: OperatorStatistics | None
    misfit: float
    frame_dt: float
    views: Sequence[int] = ()
    with_flow: bool = field(default=True)
    extra: Mapping[str, Tensor] = field(default_factory=dict)

    @cached_property
    def seen(self) -> Views:
        """Images, mattes and flow of the rollout, from the cameras of `targets`; rendered once, for all terms that ask."""
        body, rollout = self.body, self.rollout
        covariances = deformed_covariances(rollout.F_tot, body.covariances)
        return observe(
            rollout.x, covariances, body.opacities, body.colors, self.targets.cameras, self.background,
            flow=self.with_flow,
        )  # fmt: skip


Term = Callable[[Step], Tensor | None]
"""The term's value, (), without its weight; None where the step has nothing that it could be made of."""


def image(step: Step) -> Tensor:
    return losses.image_loss(step.seen.images, step.targets.images)


def mask(step: Step) -> Tensor:
    return losses.mask_loss(step.seen.mattes, step.targets.mattes)


def flow(step: Step) -> Tensor:
    return losses.flow_loss(step.seen.flow, step.targets.flow, step.targets.image_width)


def rotation(step: Step) -> Tensor:
    cues, frames = step.cues, step.frames
    return losses.rotation_loss(
        step.rollout.F_tot, cues.rotation[:frames], cues.weight[:frames], step.start.rotation
    )


def stretch(step: Step) -> Tensor:
    return losses.stretch_loss(
        step.rollout.F_tot, step.cues.stretch[: step.frames], step.cues.weight[: step.frames]
    )


def position(step: Step) -> Tensor:
    return losses.position_loss(step.rollout.x, step.cues.positions[: step.frames], step.body.size)


def heterogeneity(step: Step) -> Tensor | None:
    if not step.heterogeneous:
        return None
    return losses.heterogeneity_loss(step.body.heterogeneity(step.body.rest))


TERMS: dict[str, Term] = {
    "image": image, "mask": mask, "flow": flow, "rotation": rotation, "stretch": stretch, "position": position,
    "heterogeneity": heterogeneity,
}  # fmt: skip
"""Name in the section `losses` -> term. The penalties of an adapter come with it (`mosa.modules.adapters.penalties`)."""


def register_term(name: str, term: Term) -> None:
    """Make a term known by the name of its weight, `losses.<name>`, 0 where the configuration does not say.

    Errors: ConfigError if another term has the name."""
    if name in PENALTIES or TERMS.setdefault(name, term) is not term:
        raise ConfigError(f"losses.{name}: there is such a term already; choose another name")


def term_names(adapter: Adapter | type[Adapter] | None) -> list[str]:
    """The names that a weight may have beside this adapter. Those of `PENALTIES` are known without one: a run may leave it out."""
    return [*TERMS, *(PENALTIES if adapter is None else {**PENALTIES, **adapter.penalties})]


def check_terms(weights: Mapping[str, float], adapter: Adapter | None) -> None:
    """Errors: ConfigError naming weights of no term."""
    if unknown := sorted(set(weights) - set(known := term_names(adapter))):
        raise ConfigError(
            f"losses.{unknown[0]}: unknown key; expected one of {', '.join(known)}{nearest(unknown[0], known, 'losses')}; one "
            "of another package is known once that is imported (extensions)"
        )


def evaluate_terms(weights: Mapping[str, float], step: Step) -> dict[str, Tensor]:
    """Every term that has a weight, raw, in the order in which they are known; then the penalties of an adapter that is learned.
    Errors: ConfigError naming a term that is no number."""
    found = {name: term(step) for name, term in TERMS.items() if weights.get(name, 0.0) != 0}
    if step.operator is not None:
        known = step.body.adapter.penalties
        counted = [name for name in known if weights.get(name, 0.0) != 0]
        found |= {name: known[name](step.operator, step.misfit) for name in counted}
    for name, value in found.items():
        if value is not None and not (isinstance(value, Tensor) and value.shape == ()):
            raise ConfigError(
                f"losses.{name}: expected a tensor of shape () of its term, found {shown(value)}"
            )
    return {name: value for name, value in found.items() if value is not None}

"""The sequences that a fit learns from, and their cues once more about what the calibrated backbone predicts."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from mosa.data.observations import Observations
from mosa.errors import ConfigError, MosaError
from mosa.modules.body.body import Body, Start, World
from mosa.modules.fitting.residuals import unseen
from mosa.reconstruction.motion.moved import SecondLook
from mosa.reconstruction.motion.response import Response
from mosa.types import MarkerCues, MotionCues

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Take:
    """A sequence to learn from. start: where the body starts; observations: targets; cues: the reconstruction's, of the training
    frames, frame_dt [s] apart; first_contact: index of the first frame after it; again: finds the cues once more about what a
    calibrated backbone predicts, None where the first ones stay; name: of the sequence; extra: further cues by name; response:
    what the cues found again keep of that prediction, None where it is not known and they count as they are."""

    start: Start
    observations: Observations
    cues: MotionCues | MarkerCues
    frame_dt: float
    first_contact: int
    again: SecondLook | None = None
    name: str = "train"
    extra: dict[str, Tensor] = field(default_factory=dict)
    response: Response | None = None


CORRECTING = 0.5
"""Share of its distance from what was seen that the second prediction closes in a frame (`ready.corrected_rollout`)."""


def seen_again(take: Take, body: Body, world: World, response: bool = True) -> tuple[Take, float]:
    """With the cues about what the backbone of `body`, as it stands, predicts, and how far that moved them [m], rms; as it is where
    it has no second look.

    response: whether it shall be found what the cues keep of the prediction."""
    if take.again is None:
        return take, 0.0
    model, seen = body.model().only(heterogeneity=False, adapter=False), take.cues.positions

    @torch.no_grad()
    def predicted(gain: float = 0.0) -> Tensor:
        return body.simulate(
            take.start, world, len(seen), take.frame_dt, model=model, observed=seen if gain else None, gain=gain,
            unseen=unseen(take.cues, None),
        ).x  # fmt: skip

    free, other, found, name = predicted(), None, None, take.again.scene.sequence
    # substeps that vary cannot be corrected frame by frame
    if response and not body.settings.adaptive:
        try:
            other = predicted(CORRECTING)
        except MosaError as error:
            log.info("motion of %s: the corrected prediction cannot be simulated: %s", name, error)
    if other is None:
        cues = take.again.about(free, seen)
    else:
        cues, found = take.again.with_response(free, other, seen, take.first_contact)
    moved = float((cues.positions - seen).square().sum(-1).mean().sqrt())
    told = (
        "motion of %s fitted again, from the calibrated law's prediction: changed by %.2g mm (rms)"
    )
    log.info(told, name, 1e3 * moved)
    return replace(take, cues=cues, response=found), moved


def with_positions(
    takes: Sequence[Take],
    positions: Sequence[Tensor],
    responses: Sequence[dict[str, Tensor] | None] | None = None,
) -> list[Take]:
    """With the cues that `seen_again` found, of which a checkpoint keeps the positions (T, N, 3) [m] of each take, and the
    responses as they were written.

    Errors: ConfigError where they are of others."""
    expected = [tuple(take.cues.positions.shape) for take in takes]
    if [tuple(each.shape) for each in positions] != expected or not all(
        take.again for take in takes
    ):
        raise ConfigError(
            f"ckpt_path: expected cues of shapes {expected}, found {[tuple(each.shape) for each in positions]}: "
            "the checkpoint belongs to other sequences, or reconstruction.informed was switched off since"
        )
    responses = [None] * len(expected) if responses is None else responses
    if len(responses) != len(expected):
        raise ConfigError(
            f"ckpt_path: expected mosa.responses of {len(expected)} sequences, found {len(responses)}"
        )
    return [
        replace(take, cues=take.again.cues(each), response=take.again.response(kept))
        for take, each, kept in zip(takes, positions, responses)
    ]

"""The sequences that a fit learns from, and their cues once more about what the calibrated backbone predicts."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mosa.data.datamodule import Observations
from mosa.errors import ConfigError
from mosa.modules.body import Body, Start, World
from mosa.reconstruction.moved import SecondLook
from mosa.types import MotionCues

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Take:
    """A sequence to learn from. start: where the body starts; observations: targets (datamodule.py); cues: the reconstruction's,
    of the training frames, frame_dt [s] apart; first_contact: index of the first frame after it; again: finds the cues once more
    about what a calibrated backbone predicts, None where the first ones stay."""

    start: Start
    observations: Observations
    cues: MotionCues
    frame_dt: float
    first_contact: int
    again: SecondLook | None = None


def seen_again(take: Take, body: Body, world: World) -> Take:
    """With the cues about what the backbone of `body`, as it stands, predicts; as it is where it has no second look."""
    if take.again is None:
        return take
    model = body.model().only(heterogeneity=False, adapter=False)
    with torch.no_grad():
        rollout = body.simulate(take.start, world, len(take.cues.positions), take.frame_dt, model=model)
    cues = take.again.about(rollout.x, take.cues.positions)
    moved = float((cues.positions - take.cues.positions).square().sum(-1).mean().sqrt())
    log.info("motion of %s once more, about the calibrated backbone's: moved by %.2g mm (root mean square)",
             take.again.scene.sequence, 1e3 * moved)
    return replace(take, cues=cues)


def with_positions(takes: Sequence[Take], positions: Sequence[Tensor]) -> list[Take]:
    """With the cues that `seen_again` found, of which a checkpoint keeps the positions (T, N, 3) [m] of each take.

    Errors: ConfigError where they are of others."""
    expected = [tuple(take.cues.positions.shape) for take in takes]
    if [tuple(each.shape) for each in positions] != expected or not all(take.again for take in takes):
        raise ConfigError(f"ckpt_path: expected cues of shapes {expected}, found {[tuple(each.shape) for each in positions]}: "
                          "the checkpoint belongs to other sequences, or reconstruction.informed was switched off since")
    return [replace(take, cues=take.again.cues(each)) for take, each in zip(takes, positions)]

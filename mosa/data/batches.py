"""Batches of a fit: some views of every frame of each sequence, with its motion cues, and the order in which views are served.

data = SceneDataModule("rabbit")
data.prepare_data()
data.setup("fit")
print(next(iter(data.train_dataloader())))
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from types import SimpleNamespace

import torch
from torch import Tensor
from torch.utils.data import IterableDataset

from mosa.data.observations import Observations
from mosa.errors import ConfigError
from mosa.types import MotionCues


def on_device(extra: Mapping[str, Tensor], device: torch.device | str) -> dict[str, Tensor]:
    """Further cues on a device. Errors: ConfigError naming a cue that is no tensor."""
    for name, value in extra.items():
        if not isinstance(value, Tensor):
            raise ConfigError(
                f"further_cues: {name}: expected a tensor (torch.as_tensor), found {type(value).__name__}"
            )
    return {name: value.to(device) for name, value in extra.items()}


class SequenceBatch(SimpleNamespace):
    """One sequence of a batch. It is no dataclass, so that Lightning passes it on as it is and `to` moves it.

    name: of the sequence; index: among those that are learned from; views: numbers of the V cameras among its training (or, in
    validation, held-out) cameras; frames: numbers of the T frames; observations: images (V, T, h, w, 3) in [0, 1], mattes
    (V, T, h, w), flow (V, T - 1, h, w, 2) [px], cropped cameras; cues: positions (T, N, 3) [m], rotation (T, N, 3, 3), stretch
    (T, N, 3) and their weight (T, N), None in validation; extra: further tensors by name, as a subclass of the data module adds
    them.
    """

    name: str
    index: int
    views: list[int]
    frames: list[int]
    observations: Observations
    cues: MotionCues | None
    extra: dict[str, Tensor]

    def to(self, device: torch.device | str) -> SequenceBatch:
        seen, extra = self.observations.to(device), on_device(self.extra, device)
        cues = None if self.cues is None else self.cues.to(device)
        return SequenceBatch(**vars(self) | {"observations": seen, "extra": extra, "cues": cues})

    def __repr__(self) -> str:
        parts = {**vars(self.observations), **(vars(self.cues) if self.cues else {}), **self.extra}
        shapes = [f"{k} {tuple(v.shape)}" for k, v in parts.items() if isinstance(v, Tensor)]
        seen = f"views {self.views}, {len(self.frames)} frames: {', '.join(shapes)}"
        return f"SequenceBatch({self.name!r}, {seen})"


class MotionBatch(SimpleNamespace):
    """Data of one step. sequences: all that are learned from, each in the same views (modulo its number of cameras)."""

    sequences: tuple[SequenceBatch, ...]

    def to(self, device: torch.device | str) -> MotionBatch:
        return MotionBatch(sequences=tuple(each.to(device) for each in self.sequences))

    def __repr__(self) -> str:
        return "MotionBatch(\n  " + ",\n  ".join(map(repr, self.sequences)) + ")"


class ViewSchedule:
    """Item i: the views of step i. A pass over all views in random order, then the next: a function of (seed, i) alone, so that
    a resumed run sees what an uninterrupted one would."""

    def __init__(self, views: int, per_step: int, seed: int) -> None:
        self.views, self.per_step, self.seed = views, min(per_step, views), seed

    def __getitem__(self, step: int) -> list[int]:
        chosen = []
        for k in range(step * self.per_step, (step + 1) * self.per_step):
            generator = torch.Generator().manual_seed(self.seed * 1_000_003 + k // self.views)
            chosen.append(int(torch.randperm(self.views, generator=generator)[k % self.views]))
        return chosen

    @property
    def epoch_steps(self) -> int:
        """Steps of a pass over the views; the last one reaches into the next pass where the numbers do not divide."""
        return -(-self.views // self.per_step)


class Epochs(IterableDataset[MotionBatch]):
    """The batches of one epoch each time it is iterated over. It has no length, as stages have epochs of different lengths.

    An epoch is a pass over the training views, `per_step` of them a step; for Gauss-Newton, which needs all of them at once
    (`whole`), it is a single batch. step: number of the first step; done: steps of the stage that were made before it, so that a
    fit that is resumed in the middle of an epoch finishes it; left: steps of the stage at most, where its last epoch is shorter.
    """

    def __init__(
        self, schedule: ViewSchedule, batch: Callable[[Sequence[int]], MotionBatch]
    ) -> None:
        self.schedule, self.batch = schedule, batch
        self.begin(whole=False, step=0, done=0, left=schedule.epoch_steps)

    def begin(self, *, whole: bool, step: int, done: int, left: int) -> None:
        """Says what the next epoch is; called by the fit before it begins."""
        self.whole, self.step, self.done, self.left = whole, step, done, left

    def __iter__(self) -> Iterator[MotionBatch]:
        if self.whole:
            yield self.batch(range(self.schedule.views))
            return
        steps = self.schedule.epoch_steps
        for step in range(self.step, self.step + min(steps - self.done % steps, self.left)):
            yield self.batch(self.schedule[step])

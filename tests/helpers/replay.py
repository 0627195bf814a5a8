"""Substeps of frames that are given beforehand, as differences hold them fixed: those that an adaptive rollout chose, or others."""

from collections.abc import Callable, Sequence

from mosa.physics.time.adaptive_steps import StepControl
from mosa.physics.time.clock import Adaptive


class Replay(Adaptive):
    """counts: of the frames - 1 intervals; lag: as `Adaptive`."""

    def __init__(self, counts: Sequence[int], lag: float | None = None) -> None:
        super().__init__(StepControl(), lag)
        object.__setattr__(self, "counts", tuple(counts))

    def chooser(self, *_) -> Callable[..., int]:
        return lambda frame, *_: self.counts[frame - 1]

"""How many substeps the frames of a motion take, and at which times."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from mosa.physics.engine.adaptive_steps import StepControl
from mosa.physics.engine.numerics import State, Steps


@dataclass(frozen=True)
class Adaptive:
    """Substeps chosen for each frame from the state at its start, within the bounds of `control`.

    lag [s]: the start's velocities are those lag/2 before its positions: 0 for velocities at frame 0 itself, frame_dt/counts[-1] of
    an earlier rollout that this one goes on from, None: the first substep's dt, as with a fixed step."""

    control: StepControl
    lag: float | None = None


@dataclass(frozen=True)
class Replay:
    """Given counts of the frames - 1 intervals, those of an earlier rollout (`Rollout.counts`): differences hold them fixed.

    lag: as `Adaptive`."""

    counts: Sequence[int]
    lag: float | None = None


class Clock:
    """Goes through the frames of one motion. taken: substeps of its frames, the last that of the frame which is under way.

    choose: (frame, the state before it) -> its substeps, where they vary; else `count` of each."""

    def __init__(
        self, frame_dt: float, count: int, choose: Callable[[int, State], int] | None = None, lag: float | None = None
    ) -> None:
        self.frame_dt, self._count, self._choose, self._lag = frame_dt, count, choose, lag
        self.taken: list[int] = []

    @property
    def varies(self) -> bool:
        return self._choose is not None

    def start(self, state: State) -> None:
        """The next frame, from `state`."""
        if self.taken:
            self._lag = self.dt
        self.taken.append(self._count if self._choose is None else self._choose(len(self.taken) + 1, state))

    @property
    def count(self) -> int:
        """Substeps of the frame that is under way."""
        return self.taken[-1]

    @property
    def first(self) -> int:
        """Number of its first substep."""
        return sum(self.taken[:-1])

    @property
    def dt(self) -> float:
        """[s] of its substeps, before the first frame those of any."""
        return self.frame_dt / (self.taken[-1] if self.taken else self._count)

    @property
    def steps(self) -> Steps | None:
        """Times of its substeps where they vary, None for the numerics' own."""
        if self._choose is None:
            return None
        return Steps(self.dt if self._lag is None else 0.5 * (self._lag + self.dt), self.dt)

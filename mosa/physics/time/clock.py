"""How many substeps the frames of a motion take, and at which times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from mosa.physics.engine.numerics import State, Steps
from mosa.physics.time.adaptive_steps import StepChooser, StepControl
from mosa.types import ParticleState


@dataclass(frozen=True)
class Adaptive:
    """Substeps chosen for each frame from the state at its start, within the bounds of `control`.

    lag [s]: the start's velocities are those lag/2 before its positions: 0 for velocities at frame 0 itself, frame_dt/counts[-1] of
    an earlier rollout that this one goes on from, None: the first substep's dt, as with a fixed step."""

    control: StepControl
    lag: float | None = None

    def chooser(self, *of_rollout) -> Callable[[int, State, float | None], int]:
        """What a `Clock` asks; of_rollout: what a `StepChooser` takes beside the control."""
        return StepChooser(self.control, *of_rollout).choose


class Moment(NamedTuple):
    """Where a motion is that is advanced frame by frame. state: (N, ...) or, of B worlds, (B, N, ...); substeps: done since its
    start, in how many frames, also of worlds that were begun again later (`Episode.restart`); lag [s]: the last substep's dt,
    before the first as in `Adaptive`, where counts vary."""

    state: ParticleState
    substeps: int = 0
    frames: int = 0
    lag: float | None = 0.0


class Frame(NamedTuple):
    """The substeps of one frame. first: number of the first one; dt [s]; steps: their times where counts vary, else None."""

    first: int
    count: int
    dt: float
    steps: Steps | None


@dataclass(frozen=True)
class Clock:
    """frame_dt [s]; count: substeps of every frame; choose: (number of a frame, the state before it, bound of the colliders' speeds
    in it [m/s] or None) -> its substeps, where they vary."""

    frame_dt: float
    count: int
    choose: Callable[[int, State, float | None], int] | None = None

    @property
    def varies(self) -> bool:
        return self.choose is not None

    @property
    def dt(self) -> float:
        """[s] of a substep where their count is fixed."""
        return self.frame_dt / self.count

    def frame(self, moment: Moment, state: State, speed: float | None = None) -> Frame:
        """The next one after `moment`, whose particles are `state`. speed: as `choose`."""
        if self.choose is None:
            return Frame(moment.substeps, self.count, self.dt, None)
        count = self.choose(moment.frames + 1, state, speed)
        dt = self.frame_dt / count
        kick = dt if moment.lag is None else 0.5 * (moment.lag + dt)
        return Frame(moment.substeps, count, dt, Steps(kick, dt))

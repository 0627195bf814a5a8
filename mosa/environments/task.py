"""What a task with an elastic body is: the trials that are drawn, what a policy sees and does, how far a trial ends from its aim.

World axes: y up, the ground at y = 0. Plain tensors, no Gymnasium."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import torch
from annotated_types import Interval
from torch import Tensor

from mosa.errors import ConfigError
from mosa.physics.contact.motion import exponential
from mosa.physics.engine.inputs import numbers
from mosa.physics.engine.simulator import Substeps
from mosa.physics.world import World
from mosa.system.limits import counted
from mosa.types import Ground

ROOM = 5.0  # half width [m] of the world: a body that rolls away is a failure, not an error
LAST = 5  # control steps at the end over which a reward is averaged: the body may still quiver
CLEARANCE = 0.04  # [m] above what it falls on, where the simulation begins after a parabola

Length = Annotated[float, Interval(ge=0, le=ROOM)]
Size = Annotated[float, Interval(ge=1e-4, le=ROOM)]
Height = Annotated[float, Interval(ge=CLEARANCE, le=ROOM)]
Angle = Annotated[float, Interval(ge=0, le=math.pi)]
Speed = Annotated[float, Interval(ge=0, le=100)]
Steps = Annotated[int, Interval(ge=1, le=10**5)]
"""Of the fields of a task: [m], [rad], [m/s], control steps."""


@dataclass(frozen=True)
class Trials:
    """B drawn trials. observed: (B, O) what a policy is told at the start; hidden: (B, H) what the hand or the floor does beyond
    that, of which no policy knows. Units are the task's."""

    observed: Tensor
    hidden: Tensor

    def __len__(self) -> int:
        return len(self.observed)

    def select(self, which: Sequence[int] | slice) -> Trials:
        return Trials(self.observed[which], self.hidden[which])


@dataclass(frozen=True)
class View:
    """Of B bodies. center, velocity: (B, 3) mass centre [m] and its velocity [m/s]; upright: (B, 3) unit, where the rest shape's up
    axis points; lowest: (B,) height of the lowest particle [m]."""

    center: Tensor
    velocity: Tensor
    upright: Tensor
    lowest: Tensor


@dataclass(frozen=True)
class Quantity:
    """A number of an observation, action or drawn trial. low, high: its range, in `unit`."""

    name: str
    unit: str
    low: float
    high: float


TASKS: dict[str, type[Task]] = {}
"""By name: those of `tasks.py`, and every class of one's own that has one."""


@dataclass(frozen=True)
class Task(ABC):
    """A hand lets go: it chooses the tilt, and where the body's centre shall be when it arrives. What follows is the body's law.

    The hand holds the body without deforming it, its lowest particle `low` to `high` [m] above what it falls on. extents: (3,) of
    the body at rest [m], from which sizes follow, set by `task_named`; steps: control steps of an episode of `control_dt` [s] and
    `substeps`; tilt [rad], aim [m]: the most that an action may ask for; unsteady_tilt, unsteady_aim: by how much the hand is
    off at most.
    """

    extents: tuple[float, float, float] = (0.0, 0.0, 0.0)
    steps: Steps = 50
    control_dt: Annotated[float, Interval(ge=1e-4, le=1)] = 0.02
    tilt: Angle = 0.4
    aim: Length = 0.12
    low: Height = 0.3
    high: Height = 0.5
    substeps: Substeps | None = None
    unsteady_tilt: Angle = 0.02
    unsteady_aim: Length = 0.005
    name: ClassVar[str] = ""
    ground_friction: ClassVar[float] = 0.3
    watched_height: ClassVar[float] = 0.15
    """Height [m] of what pictures look at, where nothing lies under the body."""

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        if "name" in vars(cls):  # a variant under an inherited name does not take its place
            TASKS[cls.name] = cls

    def __post_init__(self) -> None:
        """Errors: ConfigError for a range whose end is below its beginning."""
        for low, high in (("low", "high"), ("close", "far")):
            if hasattr(self, low) and getattr(self, low) > getattr(self, high):
                most, found = getattr(self, high), getattr(self, low)
                raise ConfigError(
                    f"options.{low}: expected at most options.{high}={most:g}, found {found:g}"
                )

    @property
    def actions(self) -> tuple[Quantity, ...]:
        """What an action of numbers in [-1, 1] says, in this order; -1 is `low` and 1 is `high`."""
        return (Quantity("tilt about x", "rad", -self.tilt, self.tilt), Quantity("tilt about z", "rad", -self.tilt, self.tilt),
                Quantity("aim x", "m", -self.aim, self.aim), Quantity("aim z", "m", -self.aim, self.aim))  # fmt: skip

    @property
    def observations(self) -> tuple[Quantity, ...]:
        """Of a policy's observation, in this order: all that a trial draws and does not hide."""
        return self.drawn[0]

    @property
    def unsteady(self) -> tuple[float, ...]:
        """By how much the hand is off at most, in what an action asks."""
        return self.unsteady_tilt, self.unsteady_tilt, self.unsteady_aim, self.unsteady_aim

    @property
    def drawn(self) -> tuple[tuple[Quantity, ...], tuple[Quantity, ...]]:
        """What a trial draws, uniformly in these ranges: (what is observed, what is hidden)."""
        limits = zip(self.actions, self.unsteady)
        hidden = tuple(Quantity(f"unsteady {q.name}", q.unit, -limit, limit) for q, limit in limits)
        return (Quantity("height", "m", self.low, self.high), *self.situation), hidden

    @property
    @abstractmethod
    def situation(self) -> tuple[Quantity, ...]:
        """What is drawn and observed beside the height."""

    @abstractmethod
    def release(self, trials: Trials, given: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        """(tilts (B, 2) [rad], horizontal velocity (B, 2) [m/s]) of what the hand does (B, A), with falling times (B,) [s]."""

    @property
    @abstractmethod
    def top(self) -> float:
        """Height [m] of what the body falls on."""

    @abstractmethod
    def solids(self) -> list[Mapping[str, Any]]:
        """Colliders beside the ground, as `colliders_from_config` takes them."""

    @abstractmethod
    def miss(self, trials: Trials, view: View) -> Tensor:
        """(B,) how far from success, in tolerances squared; differentiable."""

    @abstractmethod
    def succeeded(self, trials: Trials, view: View) -> Tensor:
        """(B,) bool, of the last moment."""

    @property
    def held(self) -> Tensor:
        """(3, 3) how the body is held before it is tilted, relative to its rest shape."""
        return torch.eye(3, dtype=torch.float64)

    def thrown(self, given: Tensor) -> Tensor:
        """(B,) downward speed [m/s] with which the hand lets go."""
        return torch.zeros_like(given[:, 0])

    def command(self, step: int) -> Mapping[str, Any] | None:
        """Velocities [m/s] of driven solids in a control step."""
        return None

    def targets(self, trials: Trials) -> Tensor | None:
        """(B, 3) [m] where the body's middle shall stand, on what lies under it, to be marked in pictures; None without such."""
        return None

    def starts(self, trials: Trials, action: Tensor, rest: Tensor, gravity: float) -> list[dict]:
        """Of `TwinWorlds.reset`, for each trial. action: (B, A) in [-1, 1]; rest: (N, 3) [m] about the centre; gravity [m/s^2]."""
        given = self.physical(action).cpu() + trials.hidden
        down = self.thrown(given)
        fallen = (down.square() + 2 * gravity * (trials.observed[:, 0] - CLEARANCE)).sqrt()
        time = (fallen - down) / gravity
        released = self.release(trials, given, time)
        tilts, flight = (self.told("release", each, len(trials), 2) for each in released)
        found = []
        for b in range(len(trials)):
            turn = torch.stack([tilts[b, 0], 0 * tilts[b, 0], tilts[b, 1]]).double()
            found.append({
                "rotation": (exponential(turn) @ self.held).to(given),
                "position": torch.stack([given[b, 2], 0 * given[b, 2], given[b, 3]]),
                "height": self.top + CLEARANCE,
                "velocity": torch.stack([flight[b, 0], -fallen[b].to(flight), flight[b, 1]]),
                "angular_velocity": (0.0, 0.0, 0.0),
            })  # fmt: skip
        return found

    def world(self, world: World) -> World:
        """The same gravity over a ground at height 0 with friction, in a wide box, whatever the scene's own are."""
        if float((world.up - torch.tensor([0.0, 1.0, 0.0]).to(world.up)).abs().max()) > 1e-6:
            raise ConfigError(
                f"task {self.name}: expected a world with up = [0, 1, 0], found {world.up.tolist()}; "
                "train the twin on cameras in a world with y up"
            )
        box = torch.tensor([[-ROOM, -1.0, -ROOM], [ROOM, ROOM, ROOM]]).to(world.box)
        ground = Ground(0.0, "separate", self.ground_friction)
        return replace(world, ground=ground, box=box, planes=(), colliders=(), driven=())

    def draw(self, count: int, generator: torch.Generator) -> Trials:
        """`count` trials."""
        counted("trials", (count, sum(map(len, self.drawn))), "take fewer", each=3 * 8)
        found = []
        for quantities in self.drawn:
            low, high = torch.tensor([(q.low, q.high) for q in quantities], dtype=torch.float64).T
            part = torch.rand(count, len(quantities), generator=generator, dtype=torch.float64)
            found.append((low + (high - low) * part).float())
        return Trials(*found)

    def physical(self, action: Tensor) -> Tensor:
        """(B, A) in units, of actions in [-1, 1]."""
        low, high = torch.tensor([(q.low, q.high) for q in self.actions]).to(action).T
        return 0.5 * (low + high) + 0.5 * (high - low) * action

    def loss(self, trials: Trials, view: View) -> Tensor:
        """(B,) log(1 + miss): 0 where all is as wanted; a trial that is lost does not outweigh the others."""
        found = self.told("miss", self.miss(trials, view), len(trials))
        if float(found.detach().min()) < 0:
            raise ConfigError(f"task {self.name}: miss: expected 0 or more, found {found.min():g}")
        return torch.log1p(found)

    def told(self, method: str, value: Any, *shape: int) -> Tensor:
        """What a method of a task returned. Errors: ConfigError where that is something else."""
        return numbers(f"task {self.name}: {method}", value, f"finite numbers {shape}", shape)

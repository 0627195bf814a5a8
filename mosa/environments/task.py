"""What a task with an elastic body is: the trials that are drawn, what a policy sees and does, how far a trial ends from its aim.

World axes: y up, the ground at y = 0. Plain tensors, no Gymnasium.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, ClassVar

import torch
from annotated_types import Interval
from torch import Tensor

from mosa.errors import ConfigError
from mosa.physics.world import World
from mosa.settings import Expected, check, is_number, such
from mosa.system.limits import counted
from mosa.types import Ground

ROOM = 5.0
"""Half width [m] of the world: a body that rolls away is a failure, not an error."""
LAST = 5
"""Control steps at the end over which a reward is averaged: the body may still quiver."""


CLEARANCE = 0.04
"""Height [m] of the lowest particle above what it falls on at which the simulation begins; the flight before is a parabola."""


def _number(low: float, high: float) -> Any:
    return Annotated[float, Interval(ge=low, le=high)]


def _whole(low: int, high: int) -> Any:
    return Annotated[int, Interval(ge=low, le=high)]


LENGTH, _SOME, _ANGLE = _number(0, ROOM), _number(1e-4, ROOM), _number(0, math.pi)
RANGES: dict[str, Any] = {
    "extents": Annotated[Any, Expected("three lengths of the body [m]"), such(
        lambda v: isinstance(v, (tuple, list)) and len(v) == 3 and all(
        is_number(x) and 0 <= x <= ROOM for x in v))],
    "steps": _whole(1, 10**5), "control_dt": _number(1e-4, 1), "low": _number(CLEARANCE, ROOM), "high": _number(CLEARANCE, ROOM),
    "tilt": _ANGLE, "unsteady_tilt": _ANGLE, "askew": _ANGLE, "lean": _number(1e-3, math.pi), "near": _SOME,
    "still": _number(1e-4, 100), "fastest": _number(1e-4, 100), "turning": _number(0, 100),
    "slowest": _number(1e-4, 100), "across": _number(0, 100), "stroke": _whole(1, 10**5), "leaning": _number(-math.pi, math.pi),
    "hardest": _number(0, 100), "unsteady_throw": _number(0, 100),
    "shut": _whole(0, 10**5), "closing": _whole(1, 10**5), "squeeze": _number(0, 0.9),
}  # fmt: skip
"""What a field of a task may be: lengths [m] where nothing else is said."""


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
    axis points; lowest: (B,) height of the lowest particle [m]; tool: (B, 3) position of a driven solid [m]; tool_turn: (B,) [rad]
    how far its own x axis is turned towards z; both None without one."""

    center: Tensor
    velocity: Tensor
    upright: Tensor
    lowest: Tensor
    tool: Tensor | None = None
    tool_turn: Tensor | None = None


@dataclass(frozen=True)
class Quantity:
    """A number of an observation, action or drawn trial. low, high: its range, in `unit`."""

    name: str
    unit: str
    low: float
    high: float


@dataclass(frozen=True)
class Task(ABC):
    """extents: (3,) of the body at rest [m], from which sizes follow; steps: control steps of an episode of `control_dt` [s]."""

    extents: tuple[float, float, float]
    steps: int = 50
    control_dt: float = 0.02
    name: ClassVar[str] = ""
    tool: ClassVar[str | None] = None
    """Name of the solid that actions drive; None without one: the decision is how the body starts."""
    once: ClassVar[bool] = True
    """Whether a policy decides once, at the start; else in every control step."""
    ground_friction: ClassVar[float] = 0.3
    watched: ClassVar[float] = 0.05
    """x [m] of what pictures look at."""
    watched_height: ClassVar[float] = 0.15
    """Its height [m], where nothing lies under the body."""

    def __post_init__(self) -> None:
        """Errors: ConfigError naming the field that is out of its range."""
        for field in fields(self):
            kind = RANGES.get(field.name, LENGTH)
            check(f"options.{field.name}", getattr(self, field.name), kind)
        for low, high in (("low", "high"), ("close", "far"), ("slowest", "fastest")):
            if hasattr(self, low) and getattr(self, low) > getattr(self, high):
                raise ConfigError(
                    f"options.{low}: expected at most options.{high}={getattr(self, high):g}, found "
                    f"{getattr(self, low):g}"
                )

    @property
    @abstractmethod
    def actions(self) -> tuple[Quantity, ...]:
        """What an action of numbers in [-1, 1] says, in this order; -1 is `low` and 1 is `high`."""

    @property
    @abstractmethod
    def observations(self) -> tuple[Quantity, ...]:
        """Of a policy's observation, in this order; a number may leave its range where a body flies away."""

    @property
    @abstractmethod
    def drawn(self) -> tuple[tuple[Quantity, ...], tuple[Quantity, ...]]:
        """What a trial draws, uniformly in these ranges: (what is observed, what is hidden)."""

    @abstractmethod
    def solids(self) -> list[Mapping[str, Any]]:
        """Colliders beside the ground, as `colliders_from_config` takes them."""

    @abstractmethod
    def starts(
        self, trials: Trials, action: Tensor | None, rest: Tensor, gravity: float
    ) -> list[dict]:
        """Of `TwinWorlds.reset`, for each trial. action: (B, A) in [-1, 1] of a task of one decision; rest: (N, 3) [m] about the
        centre; gravity [m/s^2]."""

    @abstractmethod
    def miss(self, trials: Trials, view: View) -> Tensor:
        """(B,) how far from success, in tolerances squared; differentiable."""

    @abstractmethod
    def succeeded(self, trials: Trials, view: View) -> Tensor:
        """(B,) bool, of the last moment."""

    def observe(self, trials: Trials, view: View | None) -> Tensor:
        """(B, O) of a policy. view: None before a start that the action decides."""
        return trials.observed

    def targets(self, trials: Trials) -> Tensor | None:
        """(B, 3) [m] where the body's middle shall stand, on what lies under it, to be marked in pictures; None without such."""
        return None

    def command(self, action: Tensor, step: int) -> Mapping[str, Any] | None:
        """Velocities [m/s], [rad/s] of the tool in a control step, of actions (B, A)."""
        return None

    def starting_weights(self) -> tuple[Tensor, Tensor]:
        """(A, O), (A,) of the policy that a search begins from; zeros: the aim without any knowledge of how the body bounces."""
        return torch.zeros(len(self.actions), len(self.observations)), torch.zeros(
            len(self.actions)
        )

    def world(self, world: World) -> World:
        """The same gravity over a ground at height 0 with friction, in a wide box, whatever the scene's own are."""
        if float((world.up - torch.tensor([0.0, 1.0, 0.0]).to(world.up)).abs().max()) > 1e-6:
            raise ConfigError(
                f"task {self.name}: expected a world with up = [0, 1, 0], found {world.up.tolist()}"
            )
        box = torch.tensor([[-ROOM, -1.0, -ROOM], [ROOM, ROOM, ROOM]]).to(world.box)
        return replace(
            world,
            ground=Ground(0.0, "separate", self.ground_friction),
            box=box,
            planes=(),
            colliders=(),
        )

    def draw(self, count: int, generator: torch.Generator) -> Trials:
        """`count` trials."""
        counted("trials", (count, sum(map(len, self.drawn))), "take fewer", each=3 * 8)
        found = []
        for quantities in self.drawn:
            low, high = (
                torch.tensor([getattr(q, side) for q in quantities], dtype=torch.float64)
                for side in ("low", "high")
            )
            part = torch.rand(count, len(quantities), generator=generator, dtype=torch.float64)
            found.append((low + (high - low) * part).float())
        return Trials(*found)

    def physical(self, action: Tensor) -> Tensor:
        """(B, A) in units, of actions in [-1, 1]."""
        low, high = (
            torch.tensor([getattr(q, side) for q in self.actions]).to(action)
            for side in ("low", "high")
        )
        return 0.5 * (low + high) + 0.5 * (high - low) * action

    def loss(self, trials: Trials, view: View) -> Tensor:
        """(B,) log(1 + miss): 0 where all is as wanted; a trial that is lost does not outweigh the others."""
        return torch.log1p(self.miss(trials, view))

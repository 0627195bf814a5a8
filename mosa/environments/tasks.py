"""What is asked of a policy: three tasks with an elastic body, their rewards and what is success. Plain tensors, no Gymnasium.

The paper names two tasks, placing an elastic rabbit onto a white box and hanging on a tower, and their success rates on a robot; it
gives no sizes, starts, actions or criteria of success. What is chosen here, and on what, is in docs/environments.md.
World axes: y up, the ground at y = 0, the box or tower at x = z = 0.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from mosa.errors import ConfigError
from mosa.modules.start import World
from mosa.physics.contact.motion import exponential
from mosa.schema import Kind, is_number, number, whole
from mosa.types import Ground

ROOM = 5.0
"""Half width [m] of the world: a body that rolls away is a failure, not an error."""
CLEARANCE = 0.04
"""Height [m] of the lowest particle above what it falls on at which the simulation begins; the flight before is a parabola."""
THICKNESS = 0.035
"""[m] over which every solid's contact fades in: the same in simulators of different grids."""
FRICTION = 0.6
LAST = 5
"""Control steps at the end over which a reward is averaged: the body may still quiver."""


LENGTH = number(0, ROOM)
_SOME, _ANGLE = number(1e-4, ROOM), number(0, math.pi)
RANGES: dict[str, Kind] = {
    "extents": Kind("three lengths of the body [m]", lambda v: isinstance(v, (tuple, list)) and len(v) == 3 and all(
        is_number(x) and 0 <= x <= ROOM for x in v)),
    "steps": whole(1, 10**5), "control_dt": number(1e-4, 1), "low": number(CLEARANCE, ROOM), "high": number(CLEARANCE, ROOM),
    "tilt": _ANGLE, "unsteady_tilt": _ANGLE, "askew": _ANGLE, "lean": number(1e-3, math.pi), "near": _SOME, "radius": _SOME,
    "still": number(1e-4, 100), "fastest": number(1e-4, 100), "narrow": number(0.1, 2),
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
    axis points; lowest: (B,) height of the lowest particle [m]; tool: (B, 3) position of a driven solid [m], None without one."""

    center: Tensor
    velocity: Tensor
    upright: Tensor
    lowest: Tensor
    tool: Tensor | None = None


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
    """Name of the solid that actions drive; None: one decision at the start, after which nothing is acted on."""
    ground_friction: ClassVar[float] = 0.3

    def __post_init__(self) -> None:
        """Errors: ConfigError naming the field that is out of its range."""
        for field in fields(self):
            value, kind = getattr(self, field.name), RANGES.get(field.name, LENGTH)
            if not kind.fits(value):
                raise ConfigError(f"options.{field.name}: expected {kind.described}, found {str(value)[:80]!r}")
        for low, high in (("low", "high"), ("close", "far")):
            if hasattr(self, low) and getattr(self, low) > getattr(self, high):
                raise ConfigError(f"options.{low}: expected at most options.{high}={getattr(self, high):g}, found "
                                  f"{getattr(self, low):g}")

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
    def starts(self, trials: Trials, action: Tensor | None, rest: Tensor, gravity: float) -> list[dict]:
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

    def command(self, action: Tensor) -> Mapping[str, Tensor] | None:
        """Velocities [m/s] of the tool, of actions (B, A)."""
        return None

    def starting_weights(self) -> tuple[Tensor, Tensor]:
        """(A, O), (A,) of the policy that a search begins from; zeros: the aim without any knowledge of how the body bounces."""
        return torch.zeros(len(self.actions), len(self.observations)), torch.zeros(len(self.actions))

    def world(self, world: World) -> World:
        """The same gravity over a ground at height 0 with friction, in a wide box, whatever the scene's own are."""
        if float((world.up - torch.tensor([0.0, 1.0, 0.0]).to(world.up)).abs().max()) > 1e-6:
            raise ConfigError(f"task {self.name}: expected a world with up = [0, 1, 0], found {world.up.tolist()}")
        box = torch.tensor([[-ROOM, -1.0, -ROOM], [ROOM, ROOM, ROOM]]).to(world.box)
        return replace(world, ground=Ground(0.0, "separate", self.ground_friction), box=box, planes=(), colliders=())

    def draw(self, count: int, generator: torch.Generator) -> Trials:
        """`count` trials."""
        found = []
        for quantities in self.drawn:
            low, high = (torch.tensor([getattr(q, side) for q in quantities], dtype=torch.float64) for side in ("low", "high"))
            part = torch.rand(count, len(quantities), generator=generator, dtype=torch.float64)
            found.append((low + (high - low) * part).float())
        return Trials(*found)

    def physical(self, action: Tensor) -> Tensor:
        """(B, A) in units, of actions in [-1, 1]."""
        low, high = (torch.tensor([getattr(q, side) for q in self.actions]).to(action) for side in ("low", "high"))
        return 0.5 * (low + high) + 0.5 * (high - low) * action

    def loss(self, trials: Trials, view: View) -> Tensor:
        """(B,) log(1 + miss): 0 where all is as wanted; a trial that is lost does not outweigh the others."""
        return torch.log1p(self.miss(trials, view))


@dataclass(frozen=True)
class Release(Task):
    """A hand lets go: it chooses the tilt, and where the body's centre shall be when it arrives. What follows is the body's law.

    The hand holds the body without deforming it, its lowest particle `low` to `high` [m] above what it falls on. tilt [rad], aim
    [m]: the most that an action may ask for; unsteady_tilt, unsteady_aim: by how much the hand is off at most.
    """

    tilt: float = 0.4
    aim: float = 0.12
    low: float = 0.3
    high: float = 0.5
    unsteady_tilt: float = 0.02
    unsteady_aim: float = 0.005

    @property
    def actions(self) -> tuple[Quantity, ...]:
        return (Quantity("tilt about x", "rad", -self.tilt, self.tilt), Quantity("tilt about z", "rad", -self.tilt, self.tilt),
                Quantity("aim x", "m", -self.aim, self.aim), Quantity("aim z", "m", -self.aim, self.aim))  # fmt: skip

    @property
    def observations(self) -> tuple[Quantity, ...]:
        return self.drawn[0]

    @property
    def drawn(self) -> tuple[tuple[Quantity, ...], tuple[Quantity, ...]]:
        tilt, aim = self.unsteady_tilt, self.unsteady_aim
        limits = zip(self.actions, (tilt, tilt, aim, aim))
        hidden = tuple(Quantity(f"unsteady {q.name}", q.unit, -limit, limit) for q, limit in limits)
        return (Quantity("height", "m", self.low, self.high), *self.situation), hidden

    @property
    @abstractmethod
    def situation(self) -> tuple[Quantity, ...]:
        """What is drawn and observed beside the height."""

    @abstractmethod
    def release(self, trials: Trials, given: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        """(tilts (B, 2) [rad], horizontal velocity (B, 2) [m/s]) of what the hand does (B, 4), with falling times (B,) [s]."""

    @property
    @abstractmethod
    def top(self) -> float:
        """Height [m] of what the body falls on."""

    @property
    def held(self) -> Tensor:
        """(3, 3) how the body is held before it is tilted, relative to its rest shape."""
        return torch.eye(3, dtype=torch.float64)

    def starts(self, trials: Trials, action: Tensor | None, rest: Tensor, gravity: float) -> list[dict]:
        given = self.physical(action).cpu() + trials.hidden
        time = (2 * (trials.observed[:, 0] - CLEARANCE) / gravity).sqrt()
        tilts, flight = self.release(trials, given, time)
        found = []
        for b in range(len(trials)):
            turn = torch.stack([tilts[b, 0], 0 * tilts[b, 0], tilts[b, 1]]).double()
            found.append({
                "rotation": (exponential(turn) @ self.held).to(given),
                "position": torch.stack([given[b, 2], 0 * given[b, 2], given[b, 3]]),
                "height": self.top + CLEARANCE,
                "velocity": torch.stack([flight[b, 0], -gravity * time[b].to(flight), flight[b, 1]]),
                "angular_velocity": (0.0, 0.0, 0.0),
            })  # fmt: skip
        return found


@dataclass(frozen=True)
class Placement(Release):
    """Place the elastic body on a white box: at the end it rests there upright, near the middle.

    It was gripped askew by up to `askew` [rad], which is observed; the hand turns it and lets it fall from rest over the aim.
    Success: its centre is within `near` of the box's middle, its up axis within `lean` of the vertical, and its speed below
    `still`. A body that fell off is beside the box.
    """

    steps: int = 60
    low: float = 0.15
    high: float = 0.25
    near: float = 0.04
    lean: float = math.radians(20.0)
    still: float = 0.3
    askew: float = 0.15
    name = "placement"

    @property
    def situation(self) -> tuple[Quantity, ...]:
        return tuple(Quantity(f"askew about {axis}", "rad", -self.askew, self.askew) for axis in "xz")

    def release(self, trials: Trials, given: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        return given[:, :2] + trials.observed[:, 1:3], torch.zeros_like(given[:, 2:4])

    @property
    def edge(self) -> float:
        """[m] of the box's square top: a third longer than the body."""
        return round(1.33 * max(self.extents[0], self.extents[2]), 2)

    @property
    def top(self) -> float:
        """[m]: half of the body's height."""
        return round(0.5 * self.extents[1], 2)

    def solids(self) -> list[Mapping[str, Any]]:
        return [{"type": "box", "name": "box", "size": [self.edge, self.top, self.edge], "position": [0, 0.5 * self.top, 0],
                 "mode": "separate", "friction": FRICTION, "thickness": THICKNESS}]  # fmt: skip

    def miss(self, trials: Trials, view: View) -> Tensor:
        away = view.center[:, [0, 2]].square().sum(1) / self.near**2
        return away + (1 - view.upright[:, 1]) / (1 - math.cos(self.lean))

    def succeeded(self, trials: Trials, view: View) -> Tensor:
        near = view.center[:, [0, 2]].norm(dim=1) < self.near
        stands = (view.upright[:, 1] > math.cos(self.lean)) & (view.lowest > self.top - 0.02)
        return near & stands & (view.velocity.norm(dim=1) < self.still)


@dataclass(frozen=True)
class Hanging(Release):
    """Hang the body between the two arms of a tower, nose down: at the end they carry it, and it reaches down between them.

    The hand is in front of the tower, `close` to `far` [m] along x and up to `aside` beside it, and tosses the body onto the arms:
    it gives the horizontal velocity that reaches the aim in free fall. The arms point along x, `narrow` times the body's
    narrower side apart, which a third of the contact's thickness narrows further: at rest it cannot fall through.
    Success: the lowest particle is at least `deep` below the arms' tops and `free` above the ground, the centre is within `near` of
    the arms' middle along them and between them across, and its speed is below `still`.
    """

    near: float = 0.05
    deep: float = 0.02
    free: float = 0.05
    still: float = 0.25
    radius: float = 0.02
    narrow: float = 0.85
    tilt: float = 0.5
    aim: float = 0.1
    far: float = 0.4
    close: float = 0.2
    aside: float = 0.06
    name = "hanging"

    @property
    def situation(self) -> tuple[Quantity, ...]:
        return Quantity("beside x", "m", -self.far, -self.close), Quantity("beside z", "m", -self.aside, self.aside)

    def release(self, trials: Trials, given: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        return given[:, :2], (given[:, 2:4] - trials.observed[:, 1:3]) / time[:, None]

    @property
    def gap(self) -> float:
        return round(self.narrow * min(self.extents[0], self.extents[2]), 3)

    @property
    def top(self) -> float:
        """[m]: a body that hangs does not reach the ground."""
        return round(1.4 * max(self.extents), 2)

    @property
    def reach(self) -> float:
        """[m] of the arms."""
        return round(1.33 * max(self.extents), 2)

    @property
    def held(self) -> Tensor:
        return exponential(torch.tensor([0.0, 0.0, -0.5 * math.pi], dtype=torch.float64))

    def solids(self) -> list[Mapping[str, Any]]:
        touch = {"mode": "separate", "friction": FRICTION, "thickness": THICKNESS}
        z, y = 0.5 * self.gap + self.radius, self.top - self.radius
        arms = [{"type": "capsule", "name": f"arm {side}", "radius": self.radius, "length": self.reach,
                 "position": [0, y, sign * z], "rotation": [0, 1, 0, 90], **touch}
                for side, sign in (("left", -1), ("right", 1))]  # fmt: skip
        column = {"type": "box", "name": "column", "size": [0.06, y, 2 * z + 2 * self.radius],
                  "position": [0.5 * self.reach + 0.03, 0.5 * y, 0], **touch}  # fmt: skip
        return [*arms, column]

    def miss(self, trials: Trials, view: View) -> Tensor:
        along, across = (view.center[:, 0] / self.near).square(), (view.center[:, 2] / (0.5 * self.gap)).square()
        # where a body is whose side rests on the arms: it may be lower, never by much higher
        fallen = torch.relu(self.top - view.center[:, 1]) / self.near
        shallow = torch.relu(view.lowest - (self.top - self.deep)) / self.deep
        return along + across + fallen.square() + shallow.square()

    def succeeded(self, trials: Trials, view: View) -> Tensor:
        hangs = (view.lowest < self.top - self.deep) & (view.lowest > self.free)
        middle = (view.center[:, 0].abs() < self.near) & (view.center[:, 2].abs() < 0.5 * self.gap)
        return hangs & middle & (view.velocity.norm(dim=1) < self.still)


@dataclass(frozen=True)
class Pushing(Task):
    """Push the body over the ground with a paddle to a target, step by step; at the end it stands there.

    The paddle moves in the plane with at most `fastest`; it begins `apart` from the body. Success: the centre is within `near` of
    the target, the up axis within `lean` of the vertical, and the speed below `still`.
    """

    steps: int = 40
    control_dt: float = 0.04
    near: float = 0.03
    lean: float = math.radians(20.0)
    still: float = 0.1
    fastest: float = 0.8
    apart: float = 0.04
    name = "pushing"
    tool = "paddle"
    DISTANCE, ASIDE, FLOOR = (0.15, 0.3), (-0.05, 0.05), (-0.01, 0.01)

    @property
    def actions(self) -> tuple[Quantity, ...]:
        return tuple(Quantity(f"paddle velocity {axis}", "m/s", -self.fastest, self.fastest) for axis in "xz")

    @property
    def observations(self) -> tuple[Quantity, ...]:
        far, fast = 0.35, 1.0
        return (Quantity("target from body x", "m", -far, far), Quantity("target from body z", "m", -far, far),
                Quantity("body velocity x", "m/s", -fast, fast), Quantity("body velocity z", "m/s", -fast, fast),
                Quantity("body from paddle x", "m", -far, far), Quantity("body from paddle z", "m", -far, far),
                Quantity("up axis x", "1", -1.0, 1.0), Quantity("up axis z", "1", -1.0, 1.0))  # fmt: skip

    @property
    def drawn(self) -> tuple[tuple[Quantity, ...], tuple[Quantity, ...]]:
        told = (Quantity("target x", "m", *self.DISTANCE), Quantity("target z", "m", *self.ASIDE))
        return told, (Quantity("body x", "m", *self.FLOOR), Quantity("body z", "m", *self.FLOOR))

    @property
    def size(self) -> tuple[float, float, float]:
        """Edges of the paddle [m]: over the body's lower half, a little narrower than it."""
        return 0.05, round(0.5 * self.extents[1], 3), round(0.8 * self.extents[2], 3)

    @property
    def first(self) -> tuple[float, float, float]:
        """Where the paddle begins [m]; its lower edge is over the ground by the contact's thickness."""
        return -(0.5 * self.extents[0] + self.apart + 0.5 * self.size[0] + 0.02), THICKNESS + 0.5 * self.size[1], 0.0

    def solids(self) -> list[Mapping[str, Any]]:
        return [{"type": "box", "name": "paddle", "size": list(self.size), "position": list(self.first), "mode": "separate",
                 "friction": 0.3, "thickness": THICKNESS}]  # fmt: skip

    def starts(self, trials: Trials, action: Tensor | None, rest: Tensor, gravity: float) -> list[dict]:
        still = (0.0, 0.0, 0.0)
        upright = torch.eye(3)
        return [{"rotation": upright, "position": (float(x), 0.0, float(z)), "height": 0.0, "velocity": still,
                 "angular_velocity": still} for x, z in trials.hidden]  # fmt: skip

    def observe(self, trials: Trials, view: View | None) -> Tensor:
        plane = [0, 2]
        target = trials.observed.to(view.center)
        apart = view.center[:, plane] - view.tool[:, plane].to(view.center)
        return torch.cat([target - view.center[:, plane], view.velocity[:, plane], apart, view.upright[:, plane]], 1)

    def command(self, action: Tensor) -> Mapping[str, Tensor] | None:
        v = self.physical(action)
        return {"paddle": torch.stack([v[:, 0], torch.zeros_like(v[:, 0]), v[:, 1]], 1)}

    def starting_weights(self) -> tuple[Tensor, Tensor]:
        """Towards the target, and across to where the body is: without it the paddle never touches, and nothing is learned."""
        weight, bias = super().starting_weights()
        weight[0, 0], weight[0, 2], weight[1, 5], weight[1, 1] = 2.0, -0.5, 1.0, -0.5
        return weight, bias

    def miss(self, trials: Trials, view: View) -> Tensor:
        away = (view.center[:, [0, 2]] - trials.observed.to(view.center)).square().sum(1) / self.near**2
        moving = view.velocity.square().sum(1) / (4 * self.still) ** 2
        return away + moving + (1 - view.upright[:, 1]) / (1 - math.cos(self.lean))

    def succeeded(self, trials: Trials, view: View) -> Tensor:
        near = (view.center[:, [0, 2]] - trials.observed.to(view.center)).norm(dim=1) < self.near
        return near & (view.upright[:, 1] > math.cos(self.lean)) & (view.velocity.norm(dim=1) < self.still)


TASKS: dict[str, type[Task]] = {task.name: task for task in (Placement, Hanging, Pushing)}


def task_named(name: str, rest: Tensor, **options: Any) -> Task:
    """The task for a body with rest positions (N, 3) [m]: its sizes follow from the body's. options: of the task.

    Errors: ConfigError naming what is unknown."""
    if not isinstance(name, str) or name not in TASKS:
        raise ConfigError(f"task: expected one of {', '.join(TASKS)}, found {name!r}")
    if unknown := sorted(set(options) - {field.name for field in fields(TASKS[name])} | set(options) & {"extents"}):
        raise ConfigError(f"options.{unknown[0]}: expected a field of the task {name}, found it")
    extents = tuple(round(float(e), 2) for e in (rest.amax(0) - rest.amin(0)))
    return TASKS[name](extents, **options)

"""What is asked of a policy: four tasks with an elastic body, their rewards and what is success.

The paper names two tasks, placing an elastic rabbit onto a white box and hanging on a tower, and their success rates on a robot; it
gives no sizes, starts, actions or criteria of success. What is chosen here, and on what, is in docs/environments.md.
The box or tower stands at x = z = 0.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from mosa.environments.task import CLEARANCE, Quantity, Task, Trials, View
from mosa.errors import ConfigError
from mosa.physics.contact.motion import exponential

THICKNESS = 0.035
"""[m] over which every solid's contact fades in: the same in simulators of different grids."""
FRICTION = 0.6


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

    def targets(self, trials: Trials) -> Tensor:
        return torch.tensor([0.0, self.top, 0.0]).expand(len(trials), 3)

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

    low: float = 0.3
    high: float = 0.35
    unsteady_tilt: float = 0.005
    unsteady_aim: float = 0.001
    near: float = 0.05
    deep: float = 0.02
    free: float = 0.05
    still: float = 0.25
    radius: float = 0.02
    narrow: float = 0.85
    tilt: float = 0.5
    aim: float = 0.1
    far: float = 0.15
    close: float = 0.05
    aside: float = 0.03
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

    The paddle moves in the plane with at most `fastest` and turns about the vertical with at most `turning` [rad/s]: a face that
    stays square to x drags the body along and hardly moves it across, and half of the targets are out of reach. It begins `apart`
    from the body. Success: the centre is within `near` of the target, the up axis within `lean` of the vertical, and the speed
    below `still`.
    """

    steps: int = 40
    control_dt: float = 0.04
    near: float = 0.03
    lean: float = math.radians(20.0)
    still: float = 0.1
    fastest: float = 0.8
    turning: float = 2.0
    apart: float = 0.04
    name = "pushing"
    tool = "paddle"
    once = False
    DISTANCE, ASIDE, FLOOR = (0.15, 0.3), (-0.05, 0.05), (-0.01, 0.01)

    @property
    def actions(self) -> tuple[Quantity, ...]:
        moves = tuple(Quantity(f"paddle velocity {axis}", "m/s", -self.fastest, self.fastest) for axis in "xz")
        return (*moves, Quantity("paddle's turn towards z", "rad/s", -self.turning, self.turning))

    @property
    def observations(self) -> tuple[Quantity, ...]:
        far, aside, near, fast, askew = 0.35, self.ASIDE[1], 0.1, 1.0, 0.5
        return (Quantity("target from body x", "m", -far, far), Quantity("target from body z", "m", -aside, aside),
                Quantity("body velocity x", "m/s", -fast, fast), Quantity("body velocity z", "m/s", -fast, fast),
                Quantity("body from paddle x", "m", -far, far), Quantity("body from paddle z", "m", -near, near),
                Quantity("up axis x", "1", -1.0, 1.0), Quantity("up axis z", "1", -1.0, 1.0),
                Quantity("paddle turned towards z", "rad", -askew, askew))  # fmt: skip

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

    def targets(self, trials: Trials) -> Tensor:
        x, z = trials.observed.T
        return torch.stack([x, torch.zeros_like(x), z], 1)

    def observe(self, trials: Trials, view: View | None) -> Tensor:
        plane = [0, 2]
        target = trials.observed.to(view.center)
        apart = view.center[:, plane] - view.tool[:, plane].to(view.center)
        return torch.cat([target - view.center[:, plane], view.velocity[:, plane], apart, view.upright[:, plane],
                          view.tool_turn.to(view.center)[:, None]], 1)  # fmt: skip

    def command(self, action: Tensor, step: int) -> Mapping[str, Any] | None:
        v = self.physical(action)
        none = torch.zeros_like(v[:, 0])
        turn = torch.stack([none, -v[:, 2], none], 1)  # from x towards z is against the sense about y
        return {"paddle": {"velocity": torch.stack([v[:, 0], none, v[:, 1]], 1), "angular_velocity": turn}}

    def starting_weights(self) -> tuple[Tensor, Tensor]:
        """Towards the target, across to where the body is, and turned a little to the target's side: without the first two the
        paddle never touches, and nothing is learned."""
        weight, bias = super().starting_weights()
        weight[0, 0], weight[0, 2], weight[1, 5], weight[1, 1] = 2.0, -0.5, 0.3, -0.07
        weight[2, 1], weight[2, 8] = 1.0, -2.0
        return weight, bias

    def miss(self, trials: Trials, view: View) -> Tensor:
        away = (view.center[:, [0, 2]] - trials.observed.to(view.center)).square().sum(1) / self.near**2
        moving = view.velocity.square().sum(1) / (4 * self.still) ** 2
        return away + moving + (1 - view.upright[:, 1]) / (1 - math.cos(self.lean))

    def succeeded(self, trials: Trials, view: View) -> Tensor:
        near = (view.center[:, [0, 2]] - trials.observed.to(view.center)).norm(dim=1) < self.near
        return near & (view.upright[:, 1] > math.cos(self.lean)) & (view.velocity.norm(dim=1) < self.still)


@dataclass(frozen=True)
class Striking(Pushing):
    """Strike the body once with the paddle, so that it slides to a target and stops there.

    The stroke lasts `stroke` control steps at a speed of `slowest` to `fastest` towards x, across at up to `across` [m/s], turned
    at up to `turning`; then the paddle stands. How fast the body leaves it is the law's. Success: as in pushing, and nobody
    corrects.
    """

    steps: int = 24
    near: float = 0.015
    fastest: float = 0.97
    slowest: float = 0.7
    across: float = 0.2
    stroke: int = 5
    name = "striking"
    once = True
    watched = 0.2
    DISTANCE, ASIDE, FLOOR = (0.31, 0.45), (-0.015, 0.015), (-0.003, 0.003)

    @property
    def actions(self) -> tuple[Quantity, ...]:
        return (Quantity("paddle velocity x", "m/s", self.slowest, self.fastest),
                Quantity("paddle velocity z", "m/s", -self.across, self.across),
                Quantity("paddle's turn towards z", "rad/s", -self.turning, self.turning))  # fmt: skip

    @property
    def observations(self) -> tuple[Quantity, ...]:
        return self.drawn[0]

    def observe(self, trials: Trials, view: View | None) -> Tensor:
        return trials.observed

    def command(self, action: Tensor, step: int) -> Mapping[str, Any] | None:
        return super().command(action, step) if step < self.stroke else {self.tool: {"velocity": (0.0, 0.0, 0.0)}}

    def starting_weights(self) -> tuple[Tensor, Tensor]:
        """The middle of what may be asked, turned to the target's side."""
        weight, bias = Task.starting_weights(self)
        weight[2, 1] = 0.5
        return weight, bias


TASKS: dict[str, type[Task]] = {task.name: task for task in (Placement, Hanging, Striking, Pushing)}


def task_named(name: str, rest: Tensor, **options: Any) -> Task:
    """The task for a body with rest positions (N, 3) [m]: its sizes follow from the body's. options: of the task.

    Errors: ConfigError naming what is unknown."""
    if not isinstance(name, str) or name not in TASKS:
        raise ConfigError(f"task: expected one of {', '.join(TASKS)}, found {name!r}")
    if unknown := sorted(set(options) - {field.name for field in fields(TASKS[name])} | set(options) & {"extents"}):
        raise ConfigError(f"options.{unknown[0]}: expected a field of the task {name}, found it")
    extents = tuple(round(float(e), 2) for e in (rest.amax(0) - rest.amin(0)))
    return TASKS[name](extents, **options)

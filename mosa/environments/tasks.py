"""What is asked of a policy: four tasks with an elastic body, their rewards and what is success.

The paper names two tasks, placing an elastic rabbit onto a white box and hanging on a tower, and their success rates on a robot; it
gives no sizes, starts, actions or criteria of success. What is chosen here, and on what, is in docs/environments.md.
The box or tower stands at x = z = 0.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from mosa.environments.task import CLEARANCE, Quantity, Task, Trials, View
from mosa.physics.contact.motion import exponential
from mosa.settings import call, check

ABOVE = 0.035
"""[m] from the ground to the paddle's lower edge."""
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
    def unsteady(self) -> tuple[float, ...]:
        """By how much the hand is off at most, in what an action asks."""
        return self.unsteady_tilt, self.unsteady_tilt, self.unsteady_aim, self.unsteady_aim

    @property
    def drawn(self) -> tuple[tuple[Quantity, ...], tuple[Quantity, ...]]:
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

    def thrown(self, given: Tensor) -> Tensor:
        """(B,) downward speed [m/s] with which the hand lets go."""
        return torch.zeros_like(given[:, 0])

    @property
    @abstractmethod
    def top(self) -> float:
        """Height [m] of what the body falls on."""

    @property
    def held(self) -> Tensor:
        """(3, 3) how the body is held before it is tilted, relative to its rest shape."""
        return torch.eye(3, dtype=torch.float64)

    def starts(
        self, trials: Trials, action: Tensor | None, rest: Tensor, gravity: float
    ) -> list[dict]:
        given = self.physical(action).cpu() + trials.hidden
        down = self.thrown(given)
        fallen = (down.square() + 2 * gravity * (trials.observed[:, 0] - CLEARANCE)).sqrt()
        time = (fallen - down) / gravity
        tilts, flight = self.release(trials, given, time)
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


@dataclass(frozen=True)
class Placement(Release):
    """Place the elastic body on a white box: at the end it rests there upright, near the middle.

    It was gripped askew by up to `askew` [rad], which is observed; the hand turns it and lets it fall from rest over the aim.
    Success: its centre is within `near` of the box's middle, its up axis within `lean` of the vertical, and its speed below
    `still`. A body that fell off is beside the box.
    """

    steps: int = 60
    low: float = 0.08
    high: float = 0.14
    near: float = 0.04
    lean: float = math.radians(20.0)
    still: float = 0.3
    askew: float = 0.15
    name = "placement"

    @property
    def situation(self) -> tuple[Quantity, ...]:
        return tuple(
            Quantity(f"askew about {axis}", "rad", -self.askew, self.askew) for axis in "xz"
        )

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
                 "mode": "separate", "friction": FRICTION}]  # fmt: skip

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
    """Hang the body on a tower: thrown to the ground before it, the body bounces up, and the tower's two jaws close about it.

    The body is held leaning by `leaning` [rad] about z, its lowest particle `low` to `high` above the ground, `close` to `far` in
    front of where it lands and up to `aside` beside it. The hand turns it, throws it down at up to `hardest` [m/s], and gives the
    horizontal velocity that brings it to the aim, about `before` in front of the jaws. A light barrier 4 cm above the ground starts
    a clock; after `shut` control steps the jaws close within `closing`, to a gap that is narrower than the body by the share
    `squeeze`. What is between them hangs.
    Success: at the end the centre is within `near` of the jaws' middle, along x and in height, no particle is lower than `free`,
    and the speed is below `still`.
    """

    steps: int = 32
    tilt: float = 0.25
    aim: float = 0.08
    low: float = 0.35
    high: float = 0.45
    unsteady_tilt: float = 0.005
    unsteady_aim: float = 0.001
    unsteady_throw: float = 0.01
    leaning: float = math.radians(60.0)
    hardest: float = 2.0
    before: float = 0.25
    far: float = 0.1
    close: float = 0.0
    aside: float = 0.03
    grip: float = 0.36
    shut: int = 13
    closing: int = 3
    squeeze: float = 0.2
    near: float = 0.03
    free: float = 0.05
    still: float = 0.25
    name = "hanging"
    watched_height = 0.25
    JAW, OPEN = (0.12, 0.08, 0.05), 0.09
    """Edges of a jaw [m], and how far an open one is from the body's side."""

    @property
    def actions(self) -> tuple[Quantity, ...]:
        tilt_x, tilt_z, aim_x, aim_z = super().actions
        return (tilt_x, tilt_z, replace(aim_x, low=aim_x.low - self.before, high=aim_x.high - self.before), aim_z,
                Quantity("downward speed", "m/s", 0.0, self.hardest))  # fmt: skip

    @property
    def unsteady(self) -> tuple[float, ...]:
        return *super().unsteady, self.unsteady_throw

    @property
    def situation(self) -> tuple[Quantity, ...]:
        return (Quantity("beside x", "m", -self.before - self.far, -self.before - self.close),
                Quantity("beside z", "m", -self.aside, self.aside))  # fmt: skip

    def release(self, trials: Trials, given: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        return given[:, :2], (given[:, 2:4] - trials.observed[:, 1:3]) / time[:, None]

    def thrown(self, given: Tensor) -> Tensor:
        return given[:, 4].clamp_min(0.0)

    @property
    def top(self) -> float:
        """[m]: what it falls on is the ground."""
        return 0.0

    @property
    def held(self) -> Tensor:
        return exponential(torch.tensor([0.0, 0.0, self.leaning], dtype=torch.float64))

    @property
    def apart(self) -> float:
        """Half the distance between the faces of the open jaws [m]."""
        return 0.5 * self.extents[2] + self.OPEN

    def solids(self) -> list[Mapping[str, Any]]:
        touch = {"mode": "separate", "friction": FRICTION}
        z = self.apart + 0.5 * self.JAW[2]
        jaws = [{"type": "box", "name": f"jaw {side}", "size": list(self.JAW), "position": [0, self.grip, sign * z], **touch}
                for side, sign in SIDES]  # fmt: skip
        high = self.grip + 0.1
        column = {"type": "box", "name": "column", "size": [0.06, high, 0.12],
                  "position": [0.8 * max(self.extents) + 0.15, 0.5 * high, 0], **touch}  # fmt: skip
        return [*jaws, column]

    def command(self, action: Tensor, step: int) -> Mapping[str, Any] | None:
        shut = 0.5 * (1 - self.squeeze) * self.extents[2]
        going = self.shut <= step < self.shut + self.closing
        speed = (self.apart - shut) / (self.closing * self.control_dt) if going else 0.0
        return {f"jaw {side}": {"velocity": (0.0, 0.0, -sign * speed)} for side, sign in SIDES}

    def miss(self, trials: Trials, view: View) -> Tensor:
        x, y, z = view.center.unbind(1)
        return (x.square() + (y - self.grip).square() + z.square()) / self.near**2

    def succeeded(self, trials: Trials, view: View) -> Tensor:
        away = torch.hypot(view.center[:, 0], view.center[:, 1] - self.grip)
        return (
            (away < self.near)
            & (view.lowest > self.free)
            & (view.velocity.norm(dim=1) < self.still)
        )


SIDES = (("left", -1.0), ("right", 1.0))
"""Of the jaws, and the sign of their z."""


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
        moves = tuple(
            Quantity(f"paddle velocity {axis}", "m/s", -self.fastest, self.fastest) for axis in "xz"
        )
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
        """Where the paddle begins [m]; its lower edge is over the ground by `ABOVE`."""
        return (
            -(0.5 * self.extents[0] + self.apart + 0.5 * self.size[0] + 0.02),
            ABOVE + 0.5 * self.size[1],
            0.0,
        )

    def solids(self) -> list[Mapping[str, Any]]:
        return [{"type": "box", "name": "paddle", "size": list(self.size), "position": list(self.first), "mode": "separate",
                 "friction": 0.3}]  # fmt: skip

    def starts(
        self, trials: Trials, action: Tensor | None, rest: Tensor, gravity: float
    ) -> list[dict]:
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
        turn = torch.stack(
            [none, -v[:, 2], none], 1
        )  # from x towards z is against the sense about y
        return {
            "paddle": {
                "velocity": torch.stack([v[:, 0], none, v[:, 1]], 1),
                "angular_velocity": turn,
            }
        }

    def starting_weights(self) -> tuple[Tensor, Tensor]:
        """Towards the target, across to where the body is, and turned a little to the target's side: without the first two the
        paddle never touches, and nothing is learned."""
        weight, bias = super().starting_weights()
        weight[0, 0], weight[0, 2], weight[1, 5], weight[1, 1] = 2.0, -0.5, 0.3, -0.07
        weight[2, 1], weight[2, 8] = 1.0, -2.0
        return weight, bias

    def miss(self, trials: Trials, view: View) -> Tensor:
        away = (view.center[:, [0, 2]] - trials.observed.to(view.center)).square().sum(
            1
        ) / self.near**2
        moving = view.velocity.square().sum(1) / (4 * self.still) ** 2
        return away + moving + (1 - view.upright[:, 1]) / (1 - math.cos(self.lean))

    def succeeded(self, trials: Trials, view: View) -> Tensor:
        near = (view.center[:, [0, 2]] - trials.observed.to(view.center)).norm(dim=1) < self.near
        return (
            near
            & (view.upright[:, 1] > math.cos(self.lean))
            & (view.velocity.norm(dim=1) < self.still)
        )


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
        return (
            super().command(action, step)
            if step < self.stroke
            else {self.tool: {"velocity": (0.0, 0.0, 0.0)}}
        )

    def starting_weights(self) -> tuple[Tensor, Tensor]:
        """The middle of what may be asked, turned to the target's side."""
        weight, bias = Task.starting_weights(self)
        weight[2, 1] = 0.5
        return weight, bias


TASKS: dict[str, type[Task]] = {task.name: task for task in (Placement, Hanging, Striking, Pushing)}


def task_named(name: str, rest: Tensor, **options: Any) -> Task:
    """The task for a body with rest positions (N, 3) [m]: its sizes follow from the body's. options: of the task.

    Errors: ConfigError naming what is unknown."""
    check("task", name, Literal[tuple(TASKS)])
    extents = tuple(round(float(e), 2) for e in (rest.amax(0) - rest.amin(0)))
    return call("options", TASKS[name], options, extents=extents)

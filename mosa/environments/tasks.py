"""What is asked of a policy: two tasks with an elastic body, their rewards and what is success.

The paper names both, placing an elastic rabbit onto a white box and hanging on a tower, and their success rates on a robot; it
gives no sizes, starts, actions or criteria of success. What is chosen here, and on what, is in docs/environments.md.
The box or tower stands at x = z = 0."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, Literal

import torch
from annotated_types import Interval
from torch import Tensor

from mosa.environments.task import (
    TASKS,
    Angle,
    Height,
    Length,
    Quantity,
    Size,
    Speed,
    Steps,
    Task,
    Trials,
    View,
)
from mosa.physics.contact.motion import exponential
from mosa.settings import Expected, call, check

FRICTION = 0.6


@dataclass(frozen=True)
class Placement(Task):
    """Place the elastic body on a white box: at the end it rests there upright, near the middle.

    It was gripped askew by up to `askew` [rad], which is observed; the hand turns it and lets it fall from rest over the aim.
    Success: its centre is within `near` of the box's middle, its up axis within `lean` of the vertical, and its speed below
    `still`. A body that fell off is beside the box."""

    steps: Steps = 60
    low: Height = 0.08
    high: Height = 0.14
    near: Size = 0.04
    lean: Annotated[float, Interval(ge=1e-3, le=math.pi)] = math.radians(20.0)
    still: Annotated[float, Interval(ge=1e-4, le=100)] = 0.3
    askew: Angle = 0.15
    name = "placement"

    @property
    def situation(self) -> tuple[Quantity, ...]:
        return tuple(Quantity(f"askew about {a}", "rad", -self.askew, self.askew) for a in "xz")

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
class Hanging(Task):
    """Hang the body on a tower: thrown to the ground before it, the body bounces up, and the tower's two jaws close about it.

    The body is held leaning by `leaning` [rad] about z, its lowest particle `low` to `high` above the ground, `close` to `far`
    in front of where it lands and up to `aside` beside it. The hand turns it, throws it down at up to `hardest` [m/s], and
    gives the horizontal velocity that brings it to the aim, about `before` in front of the jaws. A light barrier 4 cm above the
    ground starts a clock; after `shut` control steps the jaws close within `closing`, to a gap that is narrower than the body
    by the share `squeeze`. What is between them hangs. Success: at the end the centre is within `near` of the jaws' middle,
    along x and in height, no particle is lower than `free`, and the speed is below `still`."""

    steps: Steps = 32
    tilt: Angle = 0.25
    aim: Length = 0.08
    low: Height = 0.35
    high: Height = 0.45
    unsteady_tilt: Angle = 0.005
    unsteady_aim: Length = 0.001
    unsteady_throw: Speed = 0.01
    leaning: Annotated[float, Interval(ge=-math.pi, le=math.pi)] = math.radians(60.0)
    hardest: Speed = 2.0
    before: Length = 0.25
    far: Length = 0.1
    close: Length = 0.0
    aside: Length = 0.03
    grip: Length = 0.36
    shut: Annotated[int, Interval(ge=0, le=10**5)] = 13
    closing: Steps = 3
    squeeze: Annotated[float, Interval(ge=0, le=0.9)] = 0.2
    near: Size = 0.03
    free: Length = 0.05
    still: Annotated[float, Interval(ge=1e-4, le=100)] = 0.25
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

    def command(self, step: int) -> Mapping[str, Any] | None:
        shut = 0.5 * (1 - self.squeeze) * self.extents[2]
        going = self.shut <= step < self.shut + self.closing
        speed = (self.apart - shut) / (self.closing * self.control_dt) if going else 0.0
        return {f"jaw {side}": {"velocity": (0.0, 0.0, -sign * speed)} for side, sign in SIDES}

    def miss(self, trials: Trials, view: View) -> Tensor:
        x, y, z = view.center.unbind(1)
        return (x.square() + (y - self.grip).square() + z.square()) / self.near**2

    def succeeded(self, trials: Trials, view: View) -> Tensor:
        away = torch.hypot(view.center[:, 0], view.center[:, 1] - self.grip)
        still = view.velocity.norm(dim=1) < self.still
        return (away < self.near) & (view.lowest > self.free) & still


SIDES = (("left", -1.0), ("right", 1.0))  # of the jaws, and the sign of their z


def task_named(name: str | Task, rest: Tensor, **options: Any) -> Task:
    """The task of a name, or another one, for a body with rest positions (N, 3) [m]: its sizes follow from the body's. options: of
    the task. Errors: ConfigError naming what is unknown."""
    extents = tuple(round(float(e), 2) for e in (rest.amax(0) - rest.amin(0)))
    if isinstance(name, Task):
        own = {f.name: getattr(name, f.name) for f in fields(name) if f.init}
        return call("options", type(name), own | options | {"extents": extents})
    said = Expected(f"{' or '.join(TASKS)}, or a Task")
    check("task", name, Annotated[Literal[tuple(TASKS)], said])
    return call("options", TASKS[name], options, extents=extents)

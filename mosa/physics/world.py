"""Where a body starts, and what it falls in."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from mosa.errors import ConfigError
from mosa.physics.contact.colliders import Collider, reach
from mosa.physics.contact.driven import Driven
from mosa.physics.contact.planes import Plane
from mosa.types import Ground, in_brief

FASTER = 1.5
"""Times the speed that its energy allows a body, which single particles reach (measured on blocks of 1 to 30 kPa: 0.7 to 1.47)."""


def solids_of(colliders: Sequence[Collider], driven: Sequence[Driven]) -> tuple[Collider, ...]:
    """What takes a reaction, see `World.solids`."""
    return (*colliders, *(each.solid for each in driven if each.held))


@dataclass(frozen=True)
class Start:
    """Initial state of a sequence. rotation: (3, 3) pose Q relative to the rest shape; center: (3,) position of the rest
    centre [m]; velocity: (3,) [m/s]; angular_velocity: (3,) [rad/s]; loads: entries as of
    world.driven of masses that go with the body in this sequence alone."""

    __repr__ = in_brief

    rotation: Tensor
    center: Tensor
    velocity: Tensor
    angular_velocity: Tensor
    loads: tuple[Mapping[str, Any], ...] = ()

    def written(self) -> dict[str, list[Any]]:
        """Plain containers, fit for a checkpoint; `read` gives the same numbers."""
        moving = {f.name: getattr(self, f.name).tolist() for f in fields(self)[:-1]}
        return moving | ({"loads": [dict(each) for each in self.loads]} if self.loads else {})

    @classmethod
    def read(cls, written: Mapping[str, list[Any]], like: Tensor | None = None) -> Start:
        """like: tensor of the device and type wanted, None for the CPU's float32."""
        found = {name: torch.tensor(written[name]) for name in (f.name for f in fields(cls)[:-1])}
        return cls(
            **{name: value if like is None else value.to(like) for name, value in found.items()},
            loads=tuple(written.get("loads") or ()),
        )


@dataclass(frozen=True)
class World:
    """What a body falls in. gravity, up: (3,); box: (2, 3) [m]; planes: walls beside the ground;
    colliders: moving rigid solids; driven: sets of the body's own particles that are held, moved or
    loaded; forces: what was measured on these (`data.io.forces`), which moves nothing."""

    __repr__ = in_brief

    ground: Ground | None
    gravity: Tensor
    up: Tensor
    box: Tensor
    planes: tuple[Plane, ...] = ()
    colliders: tuple[Collider, ...] = ()
    driven: tuple[Driven, ...] = ()
    forces: tuple[Any, ...] = ()

    def __post_init__(self) -> None:
        """Errors: ConfigError."""
        if not abs(float(self.up.norm()) - 1) < 1e-3:
            raise ConfigError(f"up: expected a unit vector, found {self.up.tolist()}")

    @property
    def solids(self) -> tuple[Collider, ...]:
        """All that has a motion and takes a reaction, in the order of a rollout's reactions: the
        colliders, then what holds driven particles."""
        return solids_of(self.colliders, self.driven)

    def fastest(self, start: Start, size: float, time: float) -> float:
        """Bound of the speeds [m/s] of a body of this size [m] within `time` [s] from `start`: as far as it can fall, and what
        colliders add."""
        given = self.up, self.gravity, start.center
        up, gravity, center = (v.detach().double().cpu() for v in given)
        first, spin = (
            float(v.detach().norm()) for v in (start.velocity, start.angular_velocity * size)
        )
        fastest, pull = first + float(self.gravity.norm()) * time + spin, -float(gravity @ up)
        if self.ground is not None and pull > 0:
            height = max(0.0, float(center @ up) - self.ground.height + 0.5 * size)
            sliding = float((gravity + pull * up).norm()) * time
            fastest = min(
                fastest, FASTER * math.hypot(first + spin, math.sqrt(2 * pull * height)) + sliding
            )
        moved = [each.motion.max_speed(size) for each in self.driven if each.held]
        return (
            fastest
            + max((c.motion.max_speed(reach(c.shape)) for c in self.colliders), default=0.0)
            + max(moved, default=0.0)
        )

"""Where a body starts, and what it falls in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from mosa.physics.contact.colliders import Collider
from mosa.physics.contact.planes import Plane
from mosa.types import Ground


@dataclass(frozen=True)
class Start:
    """Initial state of a sequence. rotation: (3, 3) pose Q relative to the rest shape; center: (3,) position of the rest
    centre [m]; velocity: (3,) [m/s]; angular_velocity: (3,) [rad/s]."""

    rotation: Tensor
    center: Tensor
    velocity: Tensor
    angular_velocity: Tensor

    def written(self) -> dict[str, list]:
        """Plain containers, fit for a checkpoint; `read` gives the same numbers."""
        return {f.name: getattr(self, f.name).tolist() for f in fields(self)}

    @classmethod
    def read(cls, written: Mapping[str, list], like: Tensor | None = None) -> Start:
        """like: tensor of the device and type wanted, None for the CPU's float32."""
        found = {name: torch.tensor(value) for name, value in written.items()}
        return cls(**{name: value if like is None else value.to(like) for name, value in found.items()})


@dataclass(frozen=True)
class World:
    """What a body falls in. gravity, up: (3,); box: (2, 3) [m]; planes: walls beside the ground; colliders: moving rigid solids."""

    ground: Ground | None
    gravity: Tensor
    up: Tensor
    box: Tensor
    planes: tuple[Plane, ...] = ()
    colliders: tuple[Collider, ...] = ()

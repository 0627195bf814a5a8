"""Whether a body starts inside of a rigid solid: no contact is meant where most of it does, and every result would be wrong."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from mosa.errors import ConfigError
from mosa.physics.contact.colliders import Collider
from mosa.physics.contact.motion import Trajectory, rotation_matrices
from mosa.physics.contact.reference import signed_distance

MOST = 0.5
"""Share of a body's particles: one that is pressed against a solid has fewer of them in it."""


@torch.no_grad()
def check_clear(colliders: Sequence[Collider], x: Tensor, where: str, field: str = "world.colliders") -> None:
    """x: (N, 3) [m] where the body starts, at t = 0; where: what starts, for the message. Errors: ConfigError naming the collider.
    """
    for i, collider in enumerate(colliders):
        moves = isinstance(collider.motion, Trajectory)  # a pose for each substep
        position = torch.as_tensor(collider.motion.position, dtype=torch.float64).cpu().reshape(-1, 3)[0]
        rotation = rotation_matrices(collider.motion.rotation, int(moves)).cpu().reshape(-1, 3, 3)[0]
        inside = float((signed_distance(collider.shape, (x.detach().cpu().double() - position) @ rotation) < 0).double().mean())
        if inside > MOST:
            name = f" ({collider.name})" if collider.name else ""
            raise ConfigError(f"{field}[{i}]{name}: expected a solid that the body is outside of, found {inside:.0%} of {where} "
                              f"inside of it at t = 0, where its position is {[round(p, 4) for p in position.tolist()]} m")

"""Whether a body starts inside of rigid solids: no contact is meant there, and every result would be wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from mosa.errors import ConfigError
from mosa.physics.contact.colliders import Collider, HalfSpace, Particles, half_width, reach
from mosa.physics.contact.mesh import SignedDistanceField
from mosa.physics.contact.motion import pose_at
from mosa.physics.contact.reference import signed_distance

HUGE = 10.0
"""Of the body's extent, that a solid reaches from its origin from which its unit is doubted."""
MOST = 0.01
"""Share of a body's particles that may be deeper than a quarter of their spacing, or of a thin solid: where both touch, they
are half a spacing outside."""


@torch.no_grad()
def check_clear(
    colliders: Sequence[Collider], x: Tensor, where: str, field: str = "world.colliders",
    spacing: float = 0.0, poses: tuple = (), hint: str = "",
) -> float:  # fmt: skip
    """How deep [m] the body starts in the contact of a solid, which begins half a spacing outside of
    it; below 0 where it is clear.

    x: (N, 3) [m] of particles where the body starts, and their spacing [m]; where: what starts, for the message; poses: position
    (K, 3) [m] and rotation (K, 3, 3) of the colliders now, () for theirs at t = 0; hint: more for the message.
    Errors: ConfigError naming the colliders."""
    deep, places, pressed = [], [], -math.inf
    colliders = [each for each in colliders if not isinstance(each.shape, Particles)]
    for k, collider in enumerate(colliders):
        if poses:
            position, rotation = (part[k].detach() for part in poses)
        else:
            position, rotation = pose_at(collider.motion)
        at = (x.detach().cpu().double() - position) @ rotation
        distance = signed_distance(collider.shape, at)
        pressed = max(pressed, 0.5 * spacing - float(distance.min()))
        deep.append(distance < -0.25 * min(spacing, half_width(collider.shape)))
        if half_width(collider.shape) < 0.5 * spacing:  # it may stand between particles
            pairs = torch.from_numpy(
                cKDTree(at.numpy()).query_pairs(1.2 * spacing, output_type="ndarray")
            )
            between = signed_distance(collider.shape, at[pairs].mean(1)) < 0
            deep[-1][pairs[between]] = True
        places.append(str([round(p, 4) for p in position.tolist()]))
    share = float(torch.stack(deep).any(0).double().mean()) if deep else 0.0
    if share > MOST:
        inside = [i for i, each in enumerate(deep) if bool(each.any())]
        size = float((x.amax(0) - x.amin(0)).max())
        hints = dict.fromkeys([*(_hint(colliders[i], size) for i in inside), hint])
        named = " and ".join(
            f"{field}[{i}]" + f" ({colliders[i].name})" * bool(colliders[i].name) for i in inside
        )
        raise ConfigError(
            f"{named}: expected a solid that the body is outside of, found {share:.0%} of {where} inside "
            f"of {'them' if inside[1:] else 'it'} {'now' if poses else 'at t = 0'}, where its position is "
            f"{' and '.join(places[i] for i in inside)} m{'; '.join(['', *filter(None, hints)])}"
        )
    return pressed


def _hint(collider: Collider, size: float) -> str:
    """What may be wrong with a solid that a body of a size [m] is in."""
    if isinstance(collider.shape, HalfSpace):
        return "a plane fills all below its xy plane (normal: towards the free side)"
    if isinstance(collider.shape, SignedDistanceField):
        return (
            f"its mesh is {collider.shape.longest_side:.3g} m long (scale: 0.001 for a file in mm)"
        )
    if (far := reach(collider.shape)) > HUGE * size:
        return f"it reaches {far:.3g} m from its origin (lengths are in metres)"
    return ""

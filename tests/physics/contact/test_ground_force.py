"""The force on the ground, read from a plane above it, as docs/figures.md says."""

from dataclasses import replace

import pytest
import torch
from small_bodies import DX, FRAME_DT, STICKY, WORLD, small_body, start

from mosa.errors import ConfigError
from mosa.physics.contact.colliders import colliders_from_config
from mosa.physics.contact.motion import rotation_matrices
from mosa.physics.contact.reference import signed_distance
from mosa.twin.start import start_in

FLOOR = {"type": "plane", "normal": [0, 1, 0]}


def shares(world, height: float, **floor) -> float:
    """Of the impulse that stops a body which falls from 0.09 m above `height` [m], the share that a plane there takes."""
    body = small_body(adapter=False)
    plane = colliders_from_config([FLOOR | floor | {"position": [0, height, 0]}], "colliders")
    rollout = body.simulate(
        start(height=height + 0.09), replace(world, colliders=plane), 12, FRAME_DT
    )
    mass = body.volume * body.density
    gained = float((mass[:, None] * (rollout.v[-1] - rollout.v[0])).sum(0)[1])
    needed = gained + 9.8 * float(mass.sum()) * 11 * FRAME_DT
    pushed = sum(
        float(force[:, 0, 1].sum()) * FRAME_DT / count
        for force, count in zip(rollout.reactions, rollout.counts)
    )
    return -pushed / needed


@pytest.mark.parametrize(
    "world, floor",
    [(STICKY, {}), (WORLD, {"mode": "separate", "friction": 0.3})],
    ids=["sticks", "slides"],
)
def test_a_plane_above_the_ground_has_the_whole_force(world, floor):
    with torch.no_grad():
        assert shares(world, 1.5 * DX, **floor) == pytest.approx(1, abs=2e-3)
        assert shares(world, 0.0, **floor) < 0.95  # the ground takes the rest


def test_a_plane_as_it_stands_faces_z():
    body, up = (
        small_body(adapter=False),
        {"type": "plane", "position": [0, 0, 0.02]},
    )  # three of its four layers lie below
    given = {"height": 0.1, "velocity": (0.0, -1.0, 0.0)}
    with pytest.raises(
        ConfigError,
        match=r"colliders\[0\]: expected a solid that the body is outside of, found 75% of the body",
    ):
        start_in(body, STICKY, start(), colliders=[up], **given)
    for turned in ({"normal": [0, 1, 0]}, {"rotation": [1, 0, 0, -90]}):
        _, world = start_in(body, STICKY, start(), colliders=[up | turned], **given)
        below = signed_distance(
            world.colliders[0].shape,
            points_in(world.colliders[0], [[0.3, -0.01, 0.2], [0.3, 0.01, 0.2]]),
        )
        assert below.tolist() == pytest.approx([-0.01, 0.01])


def points_in(collider, points) -> torch.Tensor:
    """Points (N, 3) [m] in the frame of a collider that does not move."""
    rotation = rotation_matrices(collider.motion.rotation, 0).reshape(3, 3)
    return (
        torch.tensor(points).double() - torch.as_tensor(collider.motion.position).double()
    ) @ rotation

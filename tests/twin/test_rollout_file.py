"""What a rollout's file holds, read with plain numpy: motion, velocities, reactions and poses of colliders."""

import math

import numpy as np
import pytest
import torch

from mosa.physics.contact.colliders import Collider, Sphere, colliders_from_config
from mosa.physics.contact.motion import Motion
from mosa.twin.rollout_file import poses, save_rollout
from tests.modules.body.test_world import PLATE, twin


def test_forces_velocities_and_poses_are_in_the_file(tmp_path):
    one = twin()
    solids = colliders_from_config([PLATE])
    rollout = one.simulate(frames=8, colliders=[PLATE])
    save_rollout(tmp_path / "rollout.npz", {"simulation": rollout}, solids)
    stored = {
        key.removeprefix("simulation/"): value
        for key, value in np.load(tmp_path / "rollout.npz").items()
    }
    frames, n = rollout.x.shape[:2]
    assert stored["v"].shape == (frames, n, 3) and stored["reactions"].shape == (
        7,
        rollout.counts[0],
        1,
        6,
    )
    assert stored["collider_position"].shape == (8, 1, 3) and stored["collider_rotation"].shape == (
        8,
        1,
        3,
        3,
    )
    assert np.array_equal(stored["v"], rollout.v.numpy()) and np.array_equal(
        stored["counts"], np.array(rollout.counts)
    )
    assert stored["reactions"][-1, :, 0, 1].mean() > 5
    down = np.diff(stored["collider_position"][:, 0, 1]) / np.diff(stored["times"])
    assert down == pytest.approx(
        [-1.5] * 5 + [0.0] * 2, rel=1e-5
    )  # down by 0.15 m in 0.1 s, then at rest
    save_rollout(tmp_path / "alone.npz", {"simulation": one.simulate(frames=3)})
    assert not [
        key
        for key in np.load(tmp_path / "alone.npz").files
        if "collider" in key or "reactions" in key
    ]


def test_poses_at_the_frames():
    turning = Collider(
        Sphere(0.1),
        motion=Motion(
            (0.0, 1.0, 0.0), velocity=(2.0, 0.0, 0.0), angular_velocity=(0.0, 0.0, math.pi)
        ),
    )
    paced = Collider(
        Sphere(0.1), motion=Motion((0.0, 0.0, 0.0), velocity=[(1.0, 0.0, 0.0), (3.0, 0.0, 0.0)])
    )
    position, rotation = poses([turning, paced], torch.tensor([0.0, 0.5, 1.0]))
    assert position[:, 0].tolist() == [[0.0, 1.0, 0.0], [1.0, 1.0, 0.0], [2.0, 1.0, 0.0]]
    torch.testing.assert_close(
        rotation[1, 0], torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).double()
    )
    assert position[:, 1, 0].tolist() == [0.0, 0.5, 2.0]

"""Prescribed motions: closed forms, waypoints, gradients, errors."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from mosa.errors import ConfigError
from mosa.physics.contact.motion import (
    Motion,
    Trajectory,
    exponential,
    rotation_vector,
    sample_poses,
)


def exact(**tolerance):
    return {"rtol": 0, "atol": 1e-13, **tolerance}


def test_constant_twist():
    """A turn about a fixed axis and a straight line, from an attitude of its own; the pose is that at a substep's start."""
    start, spin, velocity = [0.3, -0.2, 0.5], [0.0, 0.0, 2.0], [1.0, 0.0, -0.5]
    x, R, linear, angular = Motion([0.0, 1.0, 2.0], start, velocity, spin).sample(3, 4, 0.05)
    t = 0.05 * torch.arange(12).double()
    torch.testing.assert_close(
        x,
        torch.tensor([0.0, 1, 2]).double() + t[:, None] * torch.tensor(velocity).double(),
        **exact(),
    )
    expected = Rotation.from_rotvec(t.numpy()[:, None] * [spin]) * Rotation.from_rotvec(start)
    torch.testing.assert_close(R, torch.from_numpy(expected.as_matrix()), **exact())
    assert torch.equal(linear, torch.tensor(velocity).double().expand(12, 3))
    assert torch.equal(angular, torch.tensor(spin).double().expand(12, 3))


def test_pieces_per_frame_per_substep_and_by_times_agree():
    velocity = torch.randn(3, 3, generator=torch.Generator().manual_seed(0)).double()
    spin = torch.randn(3, 3, generator=torch.Generator().manual_seed(1)).double()
    by_frame = Motion(velocity=velocity, angular_velocity=spin).sample(3, 5, 0.02)
    repeated = (v.repeat_interleave(5, 0) for v in (velocity, spin))
    for other in (
        Motion((0, 0, 0), (0, 0, 0), *repeated),
        Motion(velocity=velocity, angular_velocity=spin, times=[0.0, 0.1, 0.2]),
    ):
        for a, b in zip(by_frame, other.sample(3, 5, 0.02)):
            torch.testing.assert_close(a, b, **exact())
    later = Motion(velocity=velocity, angular_velocity=spin, times=[0.0, 0.1, 0.2]).sample(
        1, 5, 0.02, start=0.2
    )
    for a, b in zip(by_frame, later):
        torch.testing.assert_close(a[10:], b, **exact())


def test_displacement_is_the_integral_of_the_velocity():
    motion = Motion.waypoints(
        [0.1, 0.2, 0.4], [[0, 0, 0], [1, 0, 0], [1, -1, 0]], [[0, 0, 0], [0, 0, 1.5], [1.0, 0, 0]]
    )
    x, R, linear, angular = motion.sample(10, 5, 0.01)
    torch.testing.assert_close(x[1:] - x[:-1], 0.01 * linear[:-1], **exact())
    torch.testing.assert_close(R[1:], exponential(0.01 * angular[:-1]) @ R[:-1], **exact())
    # at rest before and after, at the waypoints in between
    assert torch.equal(linear[:10].abs().sum() + linear[40:].abs().sum(), torch.zeros(()).double())
    places = torch.tensor([[0, 0, 0], [0, 0, 0], [1, 0, 0], [1, -1, 0], [1, -1, 0]]).double()
    torch.testing.assert_close(x[[0, 10, 20, 40, 49]], places, **exact())
    turns = Rotation.from_rotvec([[0, 0, 0], [0, 0, 1.5], [1.0, 0, 0]]).as_matrix()
    torch.testing.assert_close(R[[10, 20, 40]], torch.from_numpy(turns), **exact(atol=1e-12))


@pytest.mark.parametrize("length", [1e-9, 1e-5, 3e-3, 0.01, 0.013, 0.05])
@pytest.mark.parametrize("begin", [0.0301, 0.0395, 0.0444])
def test_what_a_motion_does_between_substeps_is_felt(begin, length):
    """However short a piece is, the mean velocities of the substeps sum up to all of it, in whatever steps they are asked for."""
    motion = Motion.waypoints(
        [begin, begin + length], [[0, 0, 0], [1, 0, 2]], [[0, 0, 0], [0, 0.5, 0]]
    )
    _, _, linear, angular = motion.sample(4, 5, 0.01)
    torch.testing.assert_close(0.01 * linear.sum(0), torch.tensor([1.0, 0, 2]).double(), **exact())
    torch.testing.assert_close(0.01 * angular.sum(0), torch.tensor([0, 0.5, 0]).double(), **exact())
    apart = [motion.sample(1, 5, 0.01, 0.0, 5 * k)[2] for k in range(4)]
    assert torch.equal(torch.cat(apart), linear)
    felt = linear.norm(dim=1).nonzero()[:, 0]
    assert len(felt) <= length / 0.01 + 2 and 3 <= int(felt[0]) <= 4


@pytest.mark.parametrize(
    "angle", [0.0, 1e-9, 1e-5, 0.5, 2.6, 2.8, 3.0, math.pi - 1e-4, math.pi - 1e-9]
)
def test_rotation_vector_inverts_the_exponential(angle):
    axis = torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64)
    R = exponential(angle * axis)
    torch.testing.assert_close(
        rotation_vector(R), angle * axis, **exact(atol=1e-14 if angle < 1 else 1e-12)
    )
    v = (angle * axis).requires_grad_()
    (gradient,) = torch.autograd.grad(rotation_vector(exponential(v)) @ axis, v)
    torch.testing.assert_close(gradient, axis, **exact(atol=1e-9))


@pytest.mark.parametrize(
    "axis", [(0, 1, 0), (1, 0, 0), (0.6, 0, -0.8), (1, 1, 1), (-0.2, 0.3, 0.9)]
)
def test_half_a_turn_has_a_vector(axis):
    """Either sense is right; whatever comes out is the same rotation. Beside half a turn the sense is told again."""
    axis = torch.tensor(axis).double()
    axis = axis / axis.norm()
    R = 2 * axis[:, None] * axis[None] - torch.eye(3).double()  # exactly half a turn
    v = rotation_vector(R)
    assert float(v.norm()) == pytest.approx(math.pi, abs=1e-12)
    torch.testing.assert_close(exponential(v), R, **exact(atol=1e-12))
    for angle in (math.pi - 1e-6, math.pi + 1e-6):
        sense = 1 if angle < math.pi else -1
        torch.testing.assert_close(
            rotation_vector(exponential(angle * axis)),
            sense * (math.pi - 1e-6) * axis,
            **exact(atol=1e-9),
        )
    batch = torch.stack([R, torch.eye(3).double(), exponential(0.3 * axis)])
    torch.testing.assert_close(
        rotation_vector(batch)[1:], torch.stack([0 * axis, 0.3 * axis]), **exact()
    )


@pytest.mark.parametrize("start, end, turn", [
    ((0, 0, 0), (0, math.pi, 0), (0, math.pi, 0)), ((0, 0, 0), (0, 1.5 * math.pi, 0), (0, 1.5 * math.pi, 0)),
    ((0, 0, 0), (0, -4 * math.pi, 0), (0, -4 * math.pi, 0)), ((0, 3.0, 0), (0, 3.5, 0), (0, 0.5, 0)),
    ((0, 6.0, 0), (0, 5.0, 0), (0, -1.0, 0)), ((0, 3.0, 0), (0, -3.0, 0), (0, 2 * math.pi - 6, 0)),
])  # fmt: skip
def test_waypoints_turn_as_far_as_their_vectors_say(start, end, turn):
    """Half a turn and more about one axis; below it the shortest way."""
    motion = Motion.waypoints([0.0, 2.0], [[0, 0, 0]] * 2, [start, end])
    turn, end = (torch.tensor(vector, dtype=torch.float64) for vector in (turn, end))
    torch.testing.assert_close(motion.sample(2, 4, 0.25)[3][0], turn / 2, **exact(atol=1e-12))
    torch.testing.assert_close(
        motion.sample(3, 4, 0.25)[1][-1], exponential(end), **exact(atol=1e-12)
    )


def test_gradients():
    g = torch.Generator().manual_seed(2)
    twists = tuple(
        torch.randn(*s, 3, generator=g).double().requires_grad_() for s in ((), (), (4,), (4,))
    )
    assert torch.autograd.gradcheck(
        lambda *a: Motion(*a).sample(4, 2, 0.1), twists, rtol=1e-6, atol=1e-8
    )
    points, turns = (torch.randn(3, 3, generator=g).double().requires_grad_() for _ in range(2))
    assert torch.autograd.gradcheck(
        lambda p, r: Motion.waypoints([0.0, 0.2, 0.5], p, r).sample(3, 2, 0.1),
        (points, turns),
        rtol=1e-6,
        atol=1e-8,
    )


def test_trajectory_and_shift():
    motion = Motion([0.0, 1.0, 0.0], [0.1, 0.2, 0.3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    sampled = motion.sample(3, 4, 0.1)
    for a, b in zip(Trajectory(*sampled).sample(2, 4, 0.1, start=0.4), sampled):
        assert torch.equal(a, b[4:])
    offset = torch.tensor([0.0, 0.5, 0.0])
    for moved in (motion.shifted(offset), Trajectory(*sampled).shifted(offset)):
        torch.testing.assert_close(moved.sample(3, 4, 0.1)[0], sampled[0] + offset, **exact())
    assert motion.max_speed(2.0) == pytest.approx(3.0)
    with pytest.raises(ConfigError, match=r"substeps 4 to 16"):
        Trajectory(*sampled).sample(3, 4, 0.1, start=0.4)


STILL, NAN_TURN = torch.zeros(4, 3), torch.zeros(4, 3)
NAN_TURN[2, 1] = math.nan


@pytest.mark.parametrize(
    "make, match",
    [
        (lambda: Motion(velocity=torch.zeros(7, 3)).sample(3, 4, 0.1), r"expected 1, 3 \(per frame interval\) or 12"),
        (lambda: Motion((0, 0, 0), (0, 0, 0), torch.zeros(3, 3), torch.zeros(2, 3)).sample(3, 4, 0.1), "angular_velocity: exp"),
        (lambda: Motion(velocity=(1.0, 2.0)).sample(3, 4, 0.1), r"velocity: expected \(3,\)"),
        (lambda: Motion(position=(math.nan, 0, 0)).sample(3, 4, 0.1), "position"),
        (lambda: Motion(position=torch.zeros(4, 3)).sample(3, 4, 0.1), r"position: expected \(3,\), found 4"),
        (lambda: sample_poses([Motion(), Trajectory(STILL, NAN_TURN, STILL, STILL)], 1, 4, 0.1, 0.0),
         "collider 1: rotation.*at substep 2"),
        (lambda: Motion(rotation=torch.ones(3, 3)).sample(3, 4, 0.1), "expected rotation matrices"),
        (lambda: Motion(times=[0.1, 0.0], velocity=torch.zeros(2, 3)).sample(3, 4, 0.1), "times: expected ascending"),
        (lambda: Motion.waypoints([0.0], [[0, 0, 0]]), "at least two"),
        (lambda: Motion.waypoints([0.0, 1.0], [[0, 0, 0]] * 3), "found 3 and 2"),
        (lambda: Motion.waypoints([0.0, 1.0], [[0, 0, 0]] * 2, exponential(torch.tensor([[0, 0, 0], [3.1, 0, 0]]))), "half a turn"),
    ],
)  # fmt: skip
def test_errors(make, match):
    with pytest.raises(ConfigError, match=match):
        make()

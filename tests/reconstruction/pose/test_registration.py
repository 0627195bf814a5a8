"""Pose and velocity of a known body from images of drawn splats whose motion is known."""

from dataclasses import replace

import pytest
import torch

from mosa.errors import DataError
from mosa.reconstruction.pose.registration import (
    flight,
    flight_jacobian,
    initial_velocity,
    light_of,
    register_pose,
    spread_rotations,
)
from mosa.reconstruction.pose.rigid import (
    Poses,
    RigidBody,
    make_level,
    pose_columns,
    rotation_exp,
)
from mosa.rendering.appearance.lighting import shading
from mosa.rendering.appearance.spherical_harmonics import basis
from mosa.rendering.cameras import look_at
from mosa.types import Cameras, Splats

WHITE = torch.ones(3)
REST_CENTER = torch.tensor([0.01, 0.02, 0.03])
GRAVITY = torch.tensor([0.0, -9.8, 0.0])
AXES = torch.tensor([[0.10, 0.07, 0.07], [0.05, 0.05, 0.05], [0.03, 0.06, 0.03]])
OFFSETS = torch.tensor([[0.0, 0.0, 0.0], [0.09, 0.05, 0.0], [-0.06, 0.03, 0.07]])


def lattice_body(spacing: float, *, ball: bool = False) -> Splats:
    """Splats on a lattice inside three unequal ellipsoids (or one ball), about 0.25 m large, with a smooth pattern."""
    axis = torch.arange(-0.2, 0.2, spacing)
    points = (
        torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
        + spacing / 3
    )
    axes, offsets = (torch.full((1, 3), 0.1), torch.zeros(1, 3)) if ball else (AXES, OFFSETS)
    means = points[(((points[:, None] - offsets) / axes).square().sum(-1) < 1).any(1)]
    waves = torch.tensor([[40.0, 10.0, -20.0], [0.0, 45.0, 30.0], [25.0, -30.0, 35.0]])
    colors = 0.5 + 0.45 * torch.sin(means @ waves + torch.tensor([0.0, 1.0, 2.0]))
    count = len(means)
    return Splats(
        means,
        torch.full((count, 3), 0.55 * spacing),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        torch.full((count,), 0.9),
        colors,
    )


def ring(views: int, size: int) -> Cameras:
    angle = torch.linspace(0, 2 * torch.pi, views + 1)[:-1] + 0.3
    eye = 1.2 * torch.stack((angle.cos(), 0.4 * (2 * angle).sin(), angle.sin()), -1)
    K = torch.tensor([[1.3 * size, 0, size / 2], [0, 1.3 * size, size / 2], [0, 0, 1]])
    w2c = look_at(eye, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    return Cameras(K.repeat(views, 1, 1), w2c, size, size, tuple(f"c{i}" for i in range(views)))


def film(
    splats: Splats, poses: Poses, cameras: Cameras, *, shading: float = 0.0, noise: float = 0.01
):
    """Images (V, T, H, W, 3) and mattes (V, T, H, W); light from above that does not turn with the body."""
    body = RigidBody.of(splats, REST_CENTER)
    frames = []
    for R, c in zip(poses.rotation, poses.center):
        lit = replace(
            body,
            colors=(body.colors * fixed_light(outward(splats) @ R.T, shading)[:, None]).clamp(0, 1),
        )
        frames.append(lit.render(Poses(R[None], c[None]), cameras, WHITE))
    seen = torch.cat(frames).transpose(0, 1)
    seen = seen + noise * torch.randn(seen.shape, generator=torch.Generator().manual_seed(7))
    alpha = seen[..., 3].clamp(0, 1)
    return seen[..., :3].clamp(0, 1), torch.where(alpha > 0.1, alpha, 0)


def outward(splats: Splats) -> torch.Tensor:
    """Directions (N, 3) away from the rest centre."""
    arm = splats.means - REST_CENTER
    return arm / arm.norm(dim=-1, keepdim=True)


def fixed_light(normals: torch.Tensor, strength: float) -> torch.Tensor:
    """Factors (N,) of the colours where the surface has these normals (N, 3) in the world."""
    return 1 - strength + strength * (normals @ torch.tensor([0.3, 0.9, 0.3]))


def degrees(a: torch.Tensor, b: torch.Tensor) -> float:
    """Angle between two rotations."""
    return float(torch.rad2deg(2 * torch.asin((a.double() - b.double()).norm() / 8**0.5)))


def turned(*vector: float) -> Poses:
    return Poses(rotation_exp(torch.tensor([vector])), torch.tensor([[0.05, -0.08, 0.03]]))


def found_pose(splats, truth, cameras, **options):
    images, mattes = film(splats, truth, cameras, **options)
    return images[:, 0], mattes[:, 0]


def test_pose_of_the_same_body():
    """The same splats, noisy images, half a turn away: only noise limits the fit."""
    splats, truth, cameras = lattice_body(0.022), turned(2.0, -1.2, 1.9), ring(5, 112)
    images, mattes = found_pose(splats, truth, cameras)
    Q, center, _ = register_pose(
        splats, images, mattes, cameras, background=WHITE, rest_center=REST_CENTER
    )
    assert degrees(Q, truth.rotation[0]) < 0.1
    assert float((center - truth.center[0]).norm()) < 1e-4
    assert float((Q @ Q.T - torch.eye(3)).abs().max()) < 1e-5 and float(torch.linalg.det(Q)) > 0


def test_pose_of_a_body_known_only_roughly():
    """Filmed with five times as many splats and shaded by a fixed light: 0.5 degrees and 0.5 mm of 0.25 m at 160 px."""
    fine, coarse, truth, cameras = (
        lattice_body(0.0075),
        lattice_body(0.0125),
        turned(-0.4, 0.9, 0.5),
        ring(6, 160),
    )
    images, mattes = found_pose(fine, truth, cameras, shading=0.25)
    options = dict(background=WHITE, rest_center=REST_CENTER, rotations=300, starts=12)
    Q, center, _ = register_pose(coarse, images, mattes, cameras, **options)
    assert degrees(Q, truth.rotation[0]) < 0.5
    assert float((center - truth.center[0]).norm()) < 5e-4


def test_pose_of_a_ball_comes_from_its_colours():
    splats, truth, cameras = lattice_body(0.022, ball=True), turned(0.3, 2.2, -0.8), ring(5, 96)
    images, mattes = found_pose(splats, truth, cameras)
    options = dict(background=WHITE, rest_center=REST_CENTER, rotations=300, starts=12)
    Q, *_ = register_pose(splats, images, mattes, cameras, **options)
    assert degrees(Q, truth.rotation[0]) < 0.3


def test_a_bright_side_finds_no_other_turn():
    """A ball of faint colours that a strong light makes bright on one side, a third of a turn later:
    its hue says how it has turned, its brightness that it hardly has."""
    ball, truth, cameras = lattice_body(0.03, ball=True), turned(0.0, 0.0, 2.1), ring(5, 64)
    ball = replace(ball, colors=0.5 + 0.3 * (ball.colors - 0.5))
    lit = replace(ball, colors=ball.colors * fixed_light(outward(ball), 0.4)[:, None])
    images, mattes = found_pose(ball, truth, cameras, shading=0.4)
    options = dict(background=WHITE, rest_center=REST_CENTER, rotations=300, starts=12)
    Q, *_ = register_pose(lit, images, mattes, cameras, normals=outward(ball), **options)
    assert degrees(Q, truth.rotation[0]) < 1  # 177 where brightness counts as hue does


def test_a_bright_side_does_not_go_along_with_a_turn():
    """A ball of one colour under a light looks the same after a turn that leaves its lattice as it is, and so do all poses near
    by: what tells a turn from its bright side is wrong."""
    axis, cameras, light = 0.02 * (torch.arange(10) - 4.5), ring(3, 48), torch.zeros(8)
    points = torch.cartesian_prod(axis, axis, axis)
    means = points[points.norm(dim=1) < 0.1]
    normals, (n, _) = means / means.norm(dim=1, keepdim=True), means.shape
    light[0], light[3] = 0.8, 0.4
    bright = 0.4 * (basis(normals, 2)[:, 1:] @ light).exp()[:, None].expand(-1, 3)
    body = RigidBody(
        means, 1e-4 * torch.eye(3).expand(n, 3, 3), torch.full((n,), 0.9), bright, 0.08, normals
    )
    pose = Poses(torch.eye(3)[None], torch.zeros(1, 3))
    quarter = Poses(rotation_exp(torch.tensor([[0.0, 0, torch.pi / 2]])), pose.center)
    seen = body.render(pose, cameras, WHITE).transpose(0, 1)
    level = make_level(seen[..., :3], seen[..., 3], cameras, WHITE, pose.center[0])
    for own, same in ((light, True), (None, False)):
        (here, columns), (there, turned_columns) = (
            pose_columns(body, level, at, central=True, light=own) for at in (pose, quarter)
        )
        assert torch.allclose(here, there, atol=1e-4) == same
        assert (
            torch.allclose(columns, turned_columns, atol=0.02 * float(columns.abs().max())) == same
        )


@pytest.mark.parametrize("frames", [2, 5])
def test_velocity_of_free_flight(frames):
    """With a start pose 2 mm and 1 degree off, as a registration may leave it: that must not turn into velocity."""
    splats, cameras = lattice_body(0.016), ring(6, 128)
    times = 0.3 + 0.02 * torch.arange(frames)
    velocity, spin = torch.tensor([0.3, -2.0, 0.15]), torch.tensor([1.5, -2.0, 0.7])
    start = turned(0.5, 0.2, -0.9)
    truth = flight(start, torch.cat((torch.zeros(6), velocity, spin)), times - times[0], GRAVITY)
    images, mattes = film(splats, truth, cameras)
    off = start.moved(torch.tensor([[0.001, -0.001, 0.0014]]), torch.tensor([[0.01, 0.01, -0.01]]))
    v, w = initial_velocity(
        splats,
        (off.rotation[0], off.center[0]),
        images,
        mattes,
        cameras,
        times=times,
        gravity=GRAVITY,
        background=WHITE,
        rest_center=REST_CENTER,
    )
    assert float((v - velocity).norm()) < 0.01
    assert float((w - spin).norm()) < 0.15


def test_flight_is_ballistic():
    """Position by the parabola, rotation at a constant rate about fixed axes."""
    times = torch.tensor([0.0, 0.1, 0.3])
    poses = flight(
        turned(0.0, 0.0, 1.0),
        torch.tensor([0.0] * 6 + [1.0, 0.0, 0.0] + [0.0, 0.0, 2.0]),
        times,
        GRAVITY,
    )
    fallen = poses.center - poses.center[0]
    torch.testing.assert_close(fallen[2], torch.tensor([0.3, -0.5 * 9.8 * 0.09, 0.0]))
    torch.testing.assert_close(poses.rotation[2], rotation_exp(torch.tensor([0.0, 0.0, 1.6])))


def test_flight_jacobian_against_differences():
    motion = torch.tensor(
        [0.01, 0.02, -0.01, 0.1, -0.2, 0.05, 1.0, -2.0, 0.5, 3.0, -4.0, 2.0], dtype=torch.float64
    )
    start = Poses(
        rotation_exp(torch.tensor([[0.5, 1.0, -0.3]]).double()), torch.zeros(1, 3).double()
    )
    times, gravity, radius, h = torch.tensor([0.0, 0.02, 0.1]).double(), GRAVITY.double(), 0.1, 1e-6
    J = flight_jacobian(motion, times, radius)
    middle = flight(start, motion, times, gravity)
    for k in range(12):
        step = torch.zeros_like(motion)
        step[k] = h
        sides = [flight(start, motion + sign * step, times, gravity) for sign in (-1, 1)]
        shift = (sides[1].center - sides[0].center) / (2 * h)
        turn = (sides[1].rotation - sides[0].rotation) / (2 * h) @ middle.rotation.transpose(1, 2)
        angle = radius * torch.stack((turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]), -1)
        torch.testing.assert_close(J[:, :3, k], shift, rtol=1e-6, atol=1e-8)
        torch.testing.assert_close(J[:, 3:, k], angle, rtol=1e-6, atol=1e-8)


def test_rotations_cover_the_sphere_of_rotations():
    """Any rotation has one of 600 within 30 degrees (spread evenly, a cell of them is about 22 degrees wide)."""
    R = spread_rotations(600).double()
    torch.testing.assert_close(
        R @ R.transpose(1, 2), torch.eye(3).double().expand(600, 3, 3), atol=1e-6, rtol=0
    )
    g = torch.Generator().manual_seed(0)
    probes = rotation_exp(torch.randn(300, 3, generator=g, dtype=torch.float64) * 1.5)
    trace = torch.einsum("aij,bij->ab", probes, R)
    nearest = torch.rad2deg(((trace.amax(1) - 1) / 2).clamp(-1, 1).acos())
    assert float(nearest.max()) < 30


def test_too_little_to_go_by_is_an_error():
    splats, cameras = lattice_body(0.03), ring(3, 48)
    images, mattes = film(splats, turned(0.0, 0.0, 0.0), cameras)
    mattes[1:] = 0
    with pytest.raises(DataError, match="1 of 3 views"):
        register_pose(
            splats, images[:, 0], mattes[:, 0], cameras, background=WHITE, rest_center=REST_CENTER
        )
    with pytest.raises(DataError, match="at least 2 are needed"):
        initial_velocity(
            splats,
            (torch.eye(3), REST_CENTER),
            images,
            mattes,
            cameras,
            times=torch.zeros(1),
            gravity=GRAVITY,
            background=WHITE,
            rest_center=REST_CENTER,
        )


def test_a_light_that_stays_does_not_turn_the_body():
    """A ball whose colours were seen in one light is looked for after it turned under the same: the light is found along with the
    pose, from no idea of it, and without it the pose is several times as far off."""
    ball, truth, cameras = lattice_body(0.016, ball=True), turned(0.9, 1.6, -0.8), ring(6, 96)
    images, mattes = found_pose(ball, truth, cameras, shading=0.35)
    normals = outward(ball)
    known = replace(ball, colors=ball.colors * fixed_light(normals, 0.35)[:, None])
    options = dict(background=WHITE, rest_center=REST_CENTER, rotations=300, starts=12)
    unlit = register_pose(known, images, mattes, cameras, **options)
    lit = register_pose(known, images, mattes, cameras, normals=normals, **options)
    assert unlit.light is None
    assert degrees(lit.rotation, truth.rotation[0]) < 0.15
    assert degrees(lit.rotation, truth.rotation[0]) < 0.5 * degrees(
        unlit.rotation, truth.rotation[0]
    )
    # what the light makes of the colours, not its numbers: one pose leaves some of them open
    pose = (truth.rotation[0], truth.center[0])
    light = light_of(
        known, normals, pose, images, mattes, cameras, background=WHITE, rest_center=REST_CENTER
    )
    seen = fixed_light(normals @ truth.rotation[0].T, 0.35) / fixed_light(normals, 0.35)
    surface = (ball.means - REST_CENTER).norm(dim=1) > 0.09
    for found in (light, lit.light):
        off = (shading(found, normals, truth.rotation[0]) / seen)[surface]
        assert float(off.log().abs().mean()) < 0.25 * float(seen[surface].log().abs().mean())


def test_under_a_light_that_is_known_nothing_is_sought_where_nothing_turned():
    ball, cameras = lattice_body(0.022, ball=True), ring(4, 64)
    still = turned(0.0, 0.0, 0.0)
    images, mattes = found_pose(ball, still, cameras, noise=0.0)
    before = torch.linspace(-0.3, 0.4, 8)
    light = light_of(ball, outward(ball), (still.rotation[0], still.center[0]), images, mattes, cameras, background=WHITE,
                     rest_center=REST_CENTER, before=before)  # fmt: skip
    torch.testing.assert_close(light, before, atol=1e-4, rtol=0)

"""Where a known body is: its pose in one frame, and its velocity over a few frames of free flight, by render and
compare.

The body is a set of splats that moves rigidly: x = Q (X - X_c) + x_c. Colour and matte of its rendering are
compared with the images by robust least squares over poses (Levenberg-Marquardt), from many rotations at first,
coarse to fine; geometry alone would not fix a ball. Its colours are those of another pose, in a light that stayed while it turned.
The search therefore compares brightness less than hue, and the eight numbers of that light are found along with the pose at the
end, so that a bright side does not turn the body.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from mosa.data.hull import at_border
from mosa.errors import DataError
from mosa.reconstruction.pose import rigid
from mosa.reconstruction.pose.rigid import Level, Poses, RigidBody
from mosa.rendering.appearance.lighting import LIGHT
from mosa.rendering.cameras import centers
from mosa.rendering.covariance import quaternion_to_matrix
from mosa.types import Cameras, Splats

BRIGHTNESS = 0.3
"""Share of brightness in the search over rotations. A disc that had turned by 60 and 120 degrees about its axis was found at 13
and 29 degrees by whole colours, since its bright rim turned with it."""
SILHOUETTE = 2.29
"""Side of a square as large as a ball's silhouette, over the root mean square distance of its points from the middle."""


def spread_rotations(count: int) -> Tensor:
    """`count` rotations spread evenly over SO(3), (count, 3, 3): super-Fibonacci spirals (Alexa, CVPR 2022)."""
    s = torch.arange(count, dtype=torch.float64) + 0.5
    t = s / count
    alpha, beta = 2 * torch.pi * s / 2**0.5, 2 * torch.pi * s / 1.533751168755204288118041
    r, q = t.sqrt(), (1 - t).sqrt()
    return quaternion_to_matrix(
        torch.stack((r * alpha.sin(), r * alpha.cos(), q * beta.sin(), q * beta.cos()), -1)
    ).float()


def matte_centres(mattes: Tensor, cameras: Cameras, size: float | None = None) -> Tensor:
    """Points (T, 3) [m] nearest to the rays through the mattes' centres of area; mattes: (V, T, H, W).

    Views where the matte is empty or runs over the image's border are left out where two others remain. size: side [m] of a square
    as large as the silhouettes of a known body, by which a single camera tells how far it is. Raises DataError where fewer than
    two views see the object, or one of a body of unknown size."""
    x, y = (
        torch.arange(side, dtype=mattes.dtype, device=mattes.device) + 0.5
        for side in (cameras.width, cameras.height)
    )
    area = mattes.sum((2, 3))
    u = (mattes.sum(2) @ x) / area.clamp(min=1e-6)
    v = (mattes.sum(3) @ y) / area.clamp(min=1e-6)
    seen = area > 0
    whole = seen & (at_border(mattes) < 0.5)
    use = torch.where(whole.sum(0) >= 2, whole, seen).to(mattes)
    for t, number in enumerate(use.sum(0).tolist()):
        if number < (2 if size is None or len(cameras) > 1 else 1):
            raise DataError(
                f"frame {t}: {int(number)} of {len(cameras)} views have a matte of the object, at least 2 are needed"
            )
    cameras = replace(cameras, K=cameras.K.to(mattes), w2c=cameras.w2c.to(mattes))
    K, origins = cameras.K, centers(cameras)
    seen = torch.linalg.solve(K[:, None], torch.stack((u, v, torch.ones_like(u)), -1)[..., None])
    directions = seen[..., 0] @ cameras.w2c[:, :3, :3]
    directions = directions / directions.norm(dim=-1, keepdim=True)
    if len(cameras) == 1 and size is not None:
        return origins[0] + directions[0] * (size * K[0, 0, 0] / area[0].sqrt())[:, None]
    across = torch.eye(3).to(mattes) - directions[..., None] * directions[..., None, :]
    P = use[..., None, None] * across
    return torch.linalg.solve(P.sum(0), (P @ origins[:, None, :, None]).sum(0))[..., 0]


def refine(
    body: RigidBody, level: Level, poses: Poses, *, iterations: int, central: bool = False
) -> tuple[Poses, Tensor]:
    """Each of K poses after a few Levenberg-Marquardt steps, with its cost (K,)."""
    frame = torch.zeros(len(poses.center), dtype=torch.long, device=poses.center.device)
    most = torch.full_like(poses.center[:, 0], 0.6 * body.radius)
    return rigid.descend_each(
        lambda at: rigid.normal_equations(body, level, at, frame, central=central),
        lambda at, step: at.moved(step[:, :3], step[:, 3:] / body.radius), poses, iterations=iterations,
        most=lambda _: most, small=lambda step, _: float(step.norm(dim=-1).max()) < 2e-3 * level.pixel,
    )  # fmt: skip


def coarse_poses(body: RigidBody, level: Level, center: Tensor, rotations: int, keep: int) -> Poses:
    """The `keep` best of many rotations, each placed so that its rendered mattes' centre meets that of the real ones."""
    R = spread_rotations(rotations).to(center)
    poses = Poses(R, center.expand(rotations, 3))
    mattes = body.render(poses, level.cameras, level.background)[..., 3].transpose(0, 1)
    centres = matte_centres(mattes, level.cameras, SILHOUETTE * body.radius)
    del mattes  # with the colours
    poses = Poses(R, center + center - centres)
    some = body.render(poses, level.cameras, level.background).split(50)  # for memory
    costs = [
        rigid.huber(level.weighed(each) - level.target)[0].flatten(1).mean(-1) for each in some
    ]
    return poses.take(torch.cat(costs).argsort()[:keep])


class Registered(NamedTuple):
    """A pose Q (3, 3), x_c (3,) [m], and the light (8,) that stayed while the body turned into it, None where it was not sought."""

    rotation: Tensor
    center: Tensor
    light: Tensor | None


RELIT = (0, 2)
"""Iterations in which the light's part of the Jacobian is made: it changes little with the pose and the light."""


LIT = 30
"""Iterations with a light at most. A disc of faint colours, begun 3 and 6 degrees off, was 1.1 and
2.8 degrees off after 8 of them, and 0.6 and 0.3 after 24."""


def refine_lit(
    body: RigidBody, level: Level, pose: Poses, before: Tensor, *, moves: bool = True
) -> tuple[Poses, Tensor]:
    """One pose and its light (8,), fitted together from the light `before`; moves: whether the pose is fitted too, or known.
    body: with normals."""
    calls, columns = 0, torch.empty(0)

    def evaluate(at: tuple[Poses, Tensor]) -> tuple[Tensor, ...]:
        nonlocal calls, columns
        if calls in RELIT:
            columns = rigid.light_columns(body, level, *at)
        calls += 1
        return rigid.lit_equations(body, level, *at, before, columns)

    def moved(at: tuple[Poses, Tensor], step: Tensor) -> tuple[Poses, Tensor]:
        return at[0].moved(step[None, :3], step[None, 3:6] / body.radius), at[1] + step[6:]

    def small(step: Tensor, _: float) -> bool:
        return float(step[:6].norm()) < 2e-3 * level.pixel and float(step[6:].norm()) < 1e-3

    free = slice(0 if moves else 6, None)
    return rigid.descend(
        evaluate, moved, (pose, before), damping=1e-3, iterations=LIT, small=small, free=free
    )[0]


def light_of(
    splats: Splats, normals: Tensor, pose: tuple[Tensor, Tensor], images: Tensor, mattes: Tensor, cameras: Cameras, *,
    background: Tensor, rest_center: Tensor, before: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """The light (8,) under which a body in a known pose (Q, x_c) looks as one frame shows it, from its colours at rest. normals:
    (N, 3) at rest; before: (8,) what is known of the light; the rest as of `register_pose`."""
    body = RigidBody.of(splats, rest_center, normals)
    given = (images[:, None], mattes[:, None], background, *pose)
    images, mattes, background, Q, center = (x.to(body.arm) for x in given)
    level = rigid.make_level(images, mattes, cameras.to(body.arm.device), background, center)
    before = torch.zeros(LIGHT).to(body.arm) if before is None else before.to(body.arm)
    return refine_lit(body, level, Poses(Q[None], center[None]), before, moves=False)[1]


def register_pose(
    splats: Splats, images: Tensor, mattes: Tensor, cameras: Cameras, *, background: Tensor,
    rest_center: Tensor, normals: Tensor | None = None, light: Tensor | None = None,
    rotations: int = 600, starts: int = 24, coarse_views: int = 6, seed: int = 0,
) -> Registered:  # fmt: skip
    """Rigid pose of a known body in one frame: Q (3, 3) and centre x_c (3,) [m], x = Q (X - X_c) + x_c.

    splats: the body at rest; images: (V, H, W, 3) on `background` (3,); mattes: (V, H, W); rest_center: X_c (3,) [m]; normals:
    (N, 3) of the splats at rest, None where the light is not to be told from the colours; light: (8,) what is known of it.
    `rotations` are tried at about 28 px with at most `coarse_views` views, the best `starts` refined there, the best 3
    at about 56 px, the best at full resolution with all views. Errors: DataError where fewer than two views see the
    object."""
    # about which the body turns while searching, wherever X_c is
    middle = splats.means.detach().mean(0)
    body = RigidBody.of(splats, middle, normals)
    given = images[:, None], mattes[:, None], background
    images, mattes, background = (x.to(body.arm) for x in given)
    cameras = cameras.to(body.arm.device)
    center = matte_centres(mattes, cameras, SILHOUETTE * body.radius)[0]
    count = min(coarse_views, len(cameras))
    chosen = torch.linspace(0, len(cameras) - 1, count).round().long().tolist()
    some = images[chosen], mattes[chosen], cameras.select(chosen), background, center
    thin, level = body.thinned(400, seed), rigid.make_level(*some, 28, BRIGHTNESS)
    poses = coarse_poses(thin, level, center, rotations, starts)
    for iterations, keep in ((4, max(3, starts // 3)), (6, 3)):
        poses, cost = refine(thin, level, poses, iterations=iterations)
        poses = poses.take(distinct(poses, cost, keep))
    poses, cost = refine(body, rigid.make_level(*some, 56, BRIGHTNESS), poses, iterations=8)
    best = poses.take(cost.argsort()[:1])
    level, found = rigid.make_level(images, mattes, cameras, background, center), None
    if normals is None:
        best, _ = refine(body, level, best, iterations=8, central=True)
    else:
        before = torch.zeros(LIGHT).to(body.arm) if light is None else light.to(body.arm)
        best, found = refine_lit(body, level, best, before)
    Q = best.rotation[0]
    arm = rest_center.to(body.arm) - middle.to(body.arm)
    return Registered(Q, best.center[0] + Q @ arm, found)


def distinct(poses: Poses, cost: Tensor, count: int, *, degrees: float = 5.0) -> Tensor:
    """Indices of the best poses that differ by more than `degrees` from every better one."""
    chosen: list[int] = []
    for k in cost.argsort().tolist():
        apart = [(torch.trace(poses.rotation[k].T @ poses.rotation[j]) - 1) / 2 for j in chosen]
        if all(float(c.clamp(-1, 1).acos()) > degrees * torch.pi / 180 for c in apart):
            chosen.append(k)
        if len(chosen) == count:
            break
    return torch.tensor(chosen, device=cost.device)


def flight(pose: Poses, motion: Tensor, times: Tensor, gravity: Tensor) -> Poses:
    """Poses at `times` (T,) [s] of free flight; motion: (12,) shift [m], angle [rad], velocity [m/s], angular
    velocity [rad/s]."""
    shift, angle, velocity, spin = motion.view(4, 3)
    start = pose.moved(shift[None], angle[None])
    t = times[:, None]
    center = start.center + velocity * t + 0.5 * gravity * t**2
    return Poses(rigid.rotation_exp(spin * t) @ start.rotation, center)


def flight_jacobian(motion: Tensor, times: Tensor, radius: float) -> Tensor:
    """Derivative (T, 6, 12) of the poses' parameters (shift, angle x radius) [m] with respect to `motion`."""
    angle, spin = motion[3:6], motion[9:]
    J = torch.zeros(len(times), 6, 12).to(motion)
    eye = torch.eye(3).to(motion)
    J[:, :3, :3] = eye
    J[:, :3, 6:9] = times[:, None, None] * eye
    J[:, 3:, 3:6] = radius * rigid.rotation_exp(spin * times[:, None]) @ rigid.left_jacobian(angle)
    J[:, 3:, 9:] = radius * times[:, None, None] * rigid.left_jacobian(spin * times[:, None])
    return J


def initial_velocity(
    splats: Splats, pose: tuple[Tensor, Tensor], images: Tensor, mattes: Tensor, cameras: Cameras,
    *, times: Tensor, gravity: Tensor, background: Tensor, rest_center: Tensor, exact: bool = True,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Velocity (3,) [m/s] and angular velocity (3,) [rad/s, world axes] at the first of T >= 2 frames of free flight.

    x_c(t) = x_c + v t + g t^2 / 2, R(t) = exp([omega]_x t) Q, with `pose` = (Q, x_c) at the first frame. images:
    (V, T, H, W, 3); mattes: (V, T, H, W); times: (T,) [s]; gravity: (3,) [m/s^2]. All frames are fitted at once; a
    small correction of the pose is fitted along and dropped, so that what offsets the first frame does not turn
    into velocity. exact: at full resolution in the end; False: at about 40 px alone, a third of the time.
    Errors: DataError for fewer than two frames or views."""
    if images.shape[1] < 2:
        raise DataError(
            f"initial velocity: expected 2 frames of free flight, found {images.shape[1]}"
        )
    body = RigidBody.of(splats, rest_center)
    background, gravity = background.to(body.arm), gravity.to(body.arm)
    times = (times - times[0]).to(body.arm)
    images, mattes, cameras = images.to(body.arm), mattes.to(body.arm), cameras.to(body.arm.device)
    start = Poses(pose[0].to(body.arm)[None], pose[1].to(body.arm)[None])
    centres = matte_centres(mattes, cameras, SILHOUETTE * body.radius)
    fallen = centres - centres[0] - 0.5 * gravity * times[:, None] ** 2
    motion = torch.zeros(12).to(body.arm)
    motion[6:9] = (times @ fallen) / times.square().sum()
    for target_px, iterations in ((40, 8), (None, 6))[: 2 if exact else 1]:
        level = rigid.make_level(images, mattes, cameras, background, start.center[0], target_px)
        last = target_px is None
        path = lambda m: flight(start, m, times, gravity)  # noqa: E731
        motion = fit_flight(body, level, path, motion, times, iterations=iterations, central=last)
    return motion[6:9], motion[9:]


def fit_flight(
    body: RigidBody, level: Level, path: Callable[[Tensor], Poses], motion: Tensor, times: Tensor, *, iterations: int,
    central: bool,
) -> Tensor:  # fmt: skip
    """`motion` (12,) after damped Gauss-Newton steps over all frames of the level; path: its poses at the times (T,) [s]."""
    frame = torch.arange(len(times), device=times.device)

    def evaluate(at: Tensor) -> tuple[Tensor, ...]:
        cost, gradient, matrix = rigid.normal_equations(
            body, level, path(at), frame, central=central
        )
        J = flight_jacobian(at, times, body.radius)
        turned = J.transpose(1, 2)
        gradient = (turned @ gradient[..., None]).sum(0)[:, 0]
        return cost.sum(), gradient, (turned @ matrix @ J).sum(0)

    def small(step: Tensor, _: float) -> bool:
        _, _, velocity, spin = step.view(4, 3)
        last = times[-1]
        ways = step[:3].norm(), velocity.norm() * last, spin.norm() * last * body.radius
        return float(torch.stack(ways).max()) < 2e-3 * level.pixel

    return rigid.descend(
        evaluate, torch.add, motion, damping=1e-3, iterations=iterations, small=small
    )[0]

"""Where a body of known shape is: the similarity from its file to frame 0, found from mattes alone.

Many rotations are tried, the best refined. The frames of free flight then decide between what is
left and, where a single camera sees a near small body as a far large one, tell its size: it falls
with the stated gravity.
"""

from __future__ import annotations

import logging
import warnings
from dataclasses import dataclass

import torch
from torch import Tensor

from mosa.data.hull import Volume
from mosa.errors import DataError
from mosa.reconstruction.geometry.known import Solid, known_solid
from mosa.reconstruction.pose import registration
from mosa.reconstruction.pose.outlines import (
    STILL,
    Rays,
    Similarities,
    equations,
    fitted,
    outline_rays,
    overlaps,
)
from mosa.reconstruction.pose.rigid import Poses, descend
from mosa.rendering.cameras import centers
from mosa.types import REST, Cameras, Scene

log = logging.getLogger(__name__)

ROTATIONS = 600
"""That are tried."""
MOST_FRAMES = 6
"""Of free flight."""
OTHERWISE = 1.5
"""Of the first frame's misfit [px], and `LOOSE` px more, beyond which a frame shows no rigid body."""
LOOSE = 0.1
POOR, WRONG = 0.93, 0.8
"""Intersections over unions of a silhouette and its matte below which the shape is said to be
another than the body's, and refused."""
SAME = 0.95
"""Share of a body inside of itself in another pose from which on both poses are one."""
AMBIGUOUS, FAR = 1.3, 3.0
"""Of the best misfit: another pose that fits as well, and one that is not looked at again."""
SIZED = 0.05
"""Relative standard deviation of a size that is known well enough."""
CORRELATED = 3.0
"""Pixels of an outline that err together: the information of all is divided by it."""
SOFT = 1e-7
"""Damping of the first step: along a single camera's line of sight the misfit has a long valley."""
NOISE = 0.1
"""[px] of an outline, at least."""


@dataclass(frozen=True)
class Registered:
    """place: the one similarity; solid: what it takes to the world; overlap: intersection over
    union of every training camera's matte; off [px]: root mean square misfit of the outlines;
    deviation: relative standard deviation of the size; rival: misfit of the next best pose over
    the best one's, at most `FAR`; frames: of free flight that were used."""

    solid: Solid
    place: Similarities
    overlap: dict[str, float]
    off: float
    deviation: float
    rival: float
    frames: int

    def figures(self) -> dict[str, float]:
        """`geometry/...` of a run."""
        return {
            "geometry/registered_iou": min(self.overlap.values()),
            "geometry/registered_off_px": self.off,
            "geometry/registered_scale": float(self.place.size[0]) / self.solid.unit,
            "geometry/registered_scale_deviation": self.deviation,
            "geometry/registered_rival": self.rival,
            "geometry/free_frames": float(self.frames),
        }

    def body(self, resolution: int) -> Volume:
        """The solid in the world (values 0 or 1), `resolution` voxels along its longest side."""
        R, center, size = self.place.rotation[0], self.place.center[0], self.place.size[0]
        placed = size * self.solid.inside @ R.T
        low, high = placed.amin(0), placed.amax(0)
        pitch = float((high - low).max()) / resolution
        room = 2 * pitch + float(size) * self.solid.distance.pitch
        counts = ((high - low + 2 * room) / pitch).ceil().long() + 1
        grid = Volume(torch.empty(tuple(counts.tolist())), low - room, pitch)
        inside = self.solid.at(grid.points() @ R / size) < 0
        return Volume(inside.float(), grid.origin + center, pitch)


def register_known(scene: Scene) -> Registered:
    """The body of `scene.body` in frame 0, from training cameras and frames alone.

    Errors: DataError where the shape does not fit the mattes, or nothing tells its size."""
    assert scene.body is not None
    solid = known_solid(scene.body)
    views = scene.training_cameras
    cameras = scene.cameras.select(views)
    size = None if scene.body.scale is None else scene.body.scale * solid.unit
    rays = outline_rays(scene.mattes[views, 0], cameras)
    if not len(rays.view.unique()) == len(views):
        raise DataError(f"scene {scene.name}: expected a matte of frame 0 in every training camera")
    sized = size is None and len(views) > 1
    found, cost = searched(solid, scene, rays, size, sized=sized)
    flights = [flown(solid, scene, found.take(torch.tensor([k])), size) for k in range(len(cost))]
    flights.sort(key=lambda each: each.off)
    best = flights[0]
    others = [f.off for f in flights[1:] if not same(solid, best.place, f.place)]
    rival = min(others, default=torch.inf) / max(best.off, NOISE)
    frames = len(best.places.size)
    if best.deviation > SIZED and size is None:
        raise DataError(
            f"scene.body: expected cameras that tell the size of {scene.body.shape}, found "
            f"{len(views)} and {frames} frames of free flight, from which it is known to "
            f"{best.deviation:.0%}: say scene.body.scale=<metres per unit of the file>, or learn "
            "from a second camera"
        )
    overlap = dict(zip(cameras.names, overlaps(solid, best.place, scene.mattes[views, 0], cameras)))
    listed = ", ".join(f"{name} {share:.3f}" for name, share in overlap.items())
    result = Registered(
        solid, best.place, overlap, best.off, best.deviation, min(rival, FAR), frames
    )
    log.info(
        "%s: registered; intersection over union of camera %s; outlines %.2f px off; %.5g m per "
        "unit of the file (+- %.2f %%), %d frames of free flight; the next best pose fits %.1f "
        "times as badly%s",
        scene.body.shape, listed, best.off, float(best.place.size[0]) / solid.unit,
        100 * best.deviation, frames, result.rival, " or more" * (result.rival == FAR),
    )  # fmt: skip
    said = (
        f"scene.body.shape: {scene.body.shape}: expected a shape whose silhouettes fill the mattes "
        f"of frame 0, found an intersection over union in camera {listed}"
    )
    worst = min(overlap.values())
    if worst < WRONG:
        raise DataError(f"{said}: another body, or one that is deformed there?")
    if worst < POOR:
        warnings.warn(
            f"{said}: is it this body's, at rest, and are the mattes right?", stacklevel=2
        )
    if result.rival < AMBIGUOUS:
        warnings.warn(
            f"scene.body.shape: {scene.body.shape}: another pose fits the mattes nearly as well, "
            f"{result.rival:.2f} times as badly: the registration is ambiguous; learn from one more "
            "camera, or look at the first frame",
            stacklevel=2,
        )
    return result


def same(solid: Solid, one: Similarities, other: Similarities) -> bool:
    """Whether a body covers the same room in two places; sizes apart."""
    inside = solid.inside
    inside = inside[:: max(1, len(inside) // 2000)]
    turned = inside @ (other.rotation[0].T @ one.rotation[0]).T
    away = (one.center[0] - other.center[0]) @ other.rotation[0] / other.size[0]
    # along a single camera's line of sight a size stands for a way
    factor = float(one.size[0] / other.size[0])
    shares = [float((solid.at(p) < 0).float().mean()) for p in (turned, factor * turned + away)]
    return max(shares) > SAME


def middle_of(
    scene: Scene, cameras: Cameras, mattes: Tensor, area: float, size: float | None
) -> tuple[Tensor, float]:
    """A place (3,) [m] and a size [m] of the solid's unit to begin with. area: of its silhouettes,
    in units squared; size: where it is known."""
    single = len(cameras) == 1
    center = (
        scene.box.mean(0) if single else registration.matte_centres(mattes[:, None], cameras)[0]
    )
    if size is None:
        depth = (center - centers(cameras)).norm(dim=1)
        seen = mattes.sum((1, 2)) * (depth / cameras.K[:, 0, 0]).square()
        size = float((seen.mean() / area).sqrt())
    if single:
        center = registration.matte_centres(mattes[:, None], cameras, size * area**0.5)[0]
    return center, size


def searched(
    solid: Solid, scene: Scene, rays: Rays, size: float | None, *, sized: bool
) -> tuple[Similarities, Tensor]:
    """The best similarities of frame 0 that are not one, at most four, with their costs (K,)."""
    views = scene.training_cameras
    mattes, cameras = scene.mattes[views, 0], scene.cameras.select(views)
    inside = solid.distance.values < 0
    area = sum(float(inside.any(a).sum()) for a in range(3)) / 3 * solid.distance.pitch**2
    center, begin = middle_of(scene, cameras, mattes, area, size)
    sizes = torch.full((ROTATIONS,), begin)
    found = Similarities(
        registration.spread_rotations(ROTATIONS), center.expand(ROTATIONS, 3), sizes
    )
    for count, iterations, keep in ((24, 3, 96), (40, 6, 32), (80, 10, 12)):
        found, cost = fitted(solid, found, rays.some(count), iterations, sized=sized)
        found = found.take(cost.argsort()[:keep])
    found, cost = fitted(solid, found, rays.some(400), 12, sized=sized)
    chosen: list[int] = []
    for k in cost.argsort().tolist():
        one = found.take(torch.tensor([k]))
        near = cost[k] <= FAR**2 * cost.min() and len(chosen) < 4
        if near and not any(same(solid, found.take(torch.tensor([j])), one) for j in chosen):
            chosen.append(k)
    return found.take(torch.tensor(chosen)), cost[chosen]


@dataclass(frozen=True)
class Flight:
    """places: similarities of the frames of free flight, the first of frame 0; off [px], deviation
    as of `Registered`; velocity [m/s] and spin [rad/s] (3,) at frame 0."""

    places: Similarities
    off: float
    deviation: float
    velocity: Tensor
    spin: Tensor

    @property
    def place(self) -> Similarities:
        return self.places.take(torch.tensor([0]))


def flown(solid: Solid, scene: Scene, place: Similarities, size: float | None) -> Flight:
    """One candidate, followed through the frames of free flight, in which it is fitted once more."""
    views = scene.training_cameras
    cameras, gravity = scene.cameras.select(views), scene.gravity
    times = scene.times - scene.times[0]
    last = scene.last_free_frame
    most = min(MOST_FRAMES, len(scene.training_frames), 99 if last is None else last + 1)
    single = len(views) == 1 and size is None
    rays = [outline_rays(scene.mattes[views, 0], cameras).some(300)]
    left = float(equations(solid, place, rays[0])[3])
    tracked = [place]
    for t in range(1, 1 if scene.start == REST else most):
        if float(scene.mattes[views, t].amax((1, 2)).min()) < 0.5:
            break
        own, moved = followed(solid, scene, tracked, t)
        off = float(equations(solid, moved, own)[3])
        if last is None and (
            off > OTHERWISE * left + LOOSE or (not single and lowest(solid, moved, scene) < 0)
        ):
            break
        tracked.append(moved)
        rays.append(own)
    while len(tracked) > 1:
        first, velocity = ballistic(tracked, times, gravity, cameras, single=single)
        found = joint(solid, first, velocity, rays, times[: len(rays)], gravity, sized=size is None)
        end = found.places.take(torch.tensor([len(rays) - 1]))
        if last is not None or not single or len(rays) <= 3 or lowest(solid, end, scene) > 0:
            return found
        tracked, rays = tracked[:-1], rays[:-1]
    _, _, matrix, left_over = equations(solid, place, rays[0])
    misfit = float(left_over)
    noise = max(misfit, NOISE) ** 2 * CORRELATED / len(rays[0].origin)
    deviation = torch.inf if single else 0.0
    if size is None and not single:
        deviation = spread(solid, place, matrix[0], noise)
    return Flight(place, misfit, deviation, torch.zeros(3), torch.zeros(3))


def followed(
    solid: Solid, scene: Scene, tracked: list[Similarities], frame: int
) -> tuple[Rays, Similarities]:
    """(rays of a frame's outlines, the similarity that fits them), sought from where the frames before lead."""
    views, before = scene.training_cameras, tracked[-1]
    own = outline_rays(scene.mattes[views, frame], scene.cameras.select(views)).some(300)
    shift = before.center - tracked[-2].center if frame > 1 else torch.zeros(1, 3)
    start = Similarities(before.rotation, before.center + shift, before.size)
    return own, fitted(solid, start, own, 15, sized=False)[0]


def alike(solid: Solid, scene: Scene, place: Similarities) -> Similarities:
    """`place`, which colours say, fitted to the outlines of frame 0, where these leave it; else the pose they leave that is turned
    least from it: a side that no training camera has seen has no colours of its own. How far a round body has turned about its
    axis is in its colours alone."""
    views = scene.training_cameras
    rays = outline_rays(scene.mattes[views, 0], scene.cameras.select(views))
    found, costs = searched(solid, scene, rays, float(place.size[0]), sized=False)
    own, cost = fitted(solid, place, rays.some(400), 12, sized=False)
    if float(cost) <= AMBIGUOUS**2 * max(float(costs.min()), NOISE**2):
        return own
    nearest = (found.rotation * place.rotation).sum((1, 2)).argmax()
    return found.take(nearest[None])


def known_start(
    scene: Scene, place: Similarities, rest: Similarities, rest_center: Tensor, *, register: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rotation (3, 3) from the rest shape, centre (3,) [m], velocity and spin (3,) that the outlines of
    free flight show. place: of frame 0, nearly, or, where a pose is to be registered, what colours
    say of it; rest: of the rest shape, whose centre of mass is `rest_center` (3,). Errors:
    DataError where there is no second frame of free flight."""
    assert scene.body is not None
    solid = known_solid(scene.body)
    place = alike(solid, scene, place) if register else place
    found = flown(solid, scene, place, float(place.size[0]))
    if len(found.places.size) < 2:
        raise DataError(
            f"{scene.name}/{scene.sequence}: expected two frames of free flight at least in which "
            "the outlines are those of scene.body.shape, found one (scene.frames, "
            "scene.last_free_frame); of a film that starts at rest say scene.start=rest"
        )
    rotation = found.place.rotation[0] @ rest.rotation[0].T
    center = found.place.center[0] + rotation @ (rest_center - rest.center[0])
    return rotation, center, found.velocity, found.spin


def known_centres(scene: Scene, place: Similarities) -> Tensor:
    """Centres (T, 3) [m] of a body of known shape in the training frames: of free flight, and then
    of the rigid one whose outlines are nearest. place: of frame 0.

    A single camera does not see how far a body is that is squashed: it moves on as it flew."""
    assert scene.body is not None
    solid, views = known_solid(scene.body), scene.training_cameras
    cameras = scene.cameras.select(views)
    free = flown(solid, scene, place, float(place.size[0])).places
    tracked = [free.take(torch.tensor([t])) for t in range(len(free.size))]
    flew = len(tracked)
    for t in scene.training_frames[flew:]:
        _, moved = followed(solid, scene, tracked, t)
        if len(views) == 1:
            eye, here = centers(cameras)[0], tracked[flew - 1].center[0]
            velocity = torch.zeros(3)
            if flew > 1:
                step = scene.times[flew - 1] - scene.times[flew - 2]
                velocity = (here - tracked[flew - 2].center[0]) / step
            sight = moved.center[0] - eye
            ahead = sight - (sight @ scene.up) * scene.up
            way = here - eye + velocity * (scene.times[t] - scene.times[flew - 1])
            factor = (way @ ahead) / (sight @ ahead)
            moved = Similarities(moved.rotation, eye + factor * sight[None], moved.size)
        tracked.append(moved)
    return torch.cat([each.center for each in tracked])


def lowest(solid: Solid, at: Similarities, scene: Scene) -> float:
    """Height [m] of a placed solid's lowest point above the ground; infinite without one."""
    if scene.ground is None:
        return torch.inf
    heights = (at.size * solid.inside @ at.rotation[0].T + at.center) @ scene.up
    return float(heights.min()) - scene.ground.height


def spread(solid: Solid, at: Similarities, matrix: Tensor, noise: float) -> float:
    """Relative standard deviation of the size, which is number 6 of a matrix (D, D) [px^2/m^2] of
    means; noise: variance [px^2] of a mean."""
    inverse = torch.linalg.pinv(matrix.double(), rtol=1e-9, hermitian=True)
    return float((noise * inverse[6, 6]).clamp(min=0).sqrt() / (at.size[0] * solid.reach))


def ballistic(
    tracked: list[Similarities], times: Tensor, gravity: Tensor, cameras: Cameras, *, single: bool
) -> tuple[Similarities, Tensor]:
    """The similarity of frame 0 and the velocity (3,) [m/s] that the tracked centres fall with.

    single: of one camera, from whose place all lengths are scaled so that they fall with gravity."""
    first = tracked[0]
    t = times[1 : len(tracked), None].double()
    way = torch.cat([each.center for each in tracked[1:]]).double() - first.center.double()
    fall = 0.5 * gravity.double() * t**2
    if not single or len(tracked) < 3:
        return first, ((way - fall) * t).sum(0).div(t.square().sum()).float()
    # (factor) way - t v = fall
    rows = torch.zeros(len(t), 3, 4, dtype=torch.float64)
    rows[:, :, 0] = way
    rows[:, :, 1:] = -t[..., None] * torch.eye(3, dtype=torch.float64)
    found = torch.linalg.lstsq(rows.flatten(0, 1), fall.flatten()).solution
    factor = float(found[0]) if 0.02 < float(found[0]) < 50 else 1.0
    eye = centers(cameras)
    scaled = Similarities(first.rotation, eye + factor * (first.center - eye), factor * first.size)
    return scaled, found[1:].float()


def joint(
    solid: Solid, first: Similarities, velocity: Tensor, rays: list[Rays], times: Tensor,
    gravity: Tensor, *, sized: bool,
) -> Flight:  # fmt: skip
    """A free flight fitted to the outlines of all frames: its first pose, size, velocity and spin."""
    reach = solid.reach
    start = torch.zeros(13)
    start[6:9] = velocity

    def placed(motion: Tensor) -> Similarities:
        sizes = first.size * (motion[12] / (first.size * reach)).exp()
        poses = registration.flight(
            Poses(first.rotation, first.center), motion[:12], times, gravity
        )
        return Similarities(poses.rotation, poses.center, sizes.expand(len(times)))

    def evaluate(motion: Tensor) -> tuple[Tensor, ...]:
        at = placed(motion)
        own = [equations(solid, at.take(torch.tensor([t])), each) for t, each in enumerate(rays)]
        cost, vector, matrix, off = (torch.cat(part) for part in zip(*own))
        J = torch.zeros(len(times), 7, 13)
        J[:, :6, :12] = registration.flight_jacobian(motion[:12], times, float(at.size[0]) * reach)
        J[:, 6, 12] = at.size[0] / first.size[0]
        gradient = torch.einsum("tij,ti->j", J, vector) / len(times)
        curvature = torch.einsum("tij,tik,tkl->jl", J, matrix, J) / len(times)
        return cost.mean(), gradient, curvature, off.square().mean().sqrt()

    still, free = STILL * float(first.size[0]) * reach, slice(0, 13 if sized else 12)
    small = lambda step, damping: float(step.norm()) < still and damping < 10 * SOFT  # noqa: E731
    best, (_, _, matrix, off) = descend(
        evaluate, torch.add, start, damping=SOFT, iterations=25, small=small, free=free
    )
    at = placed(best)
    rays_in_all = sum(len(each.origin) for each in rays)
    noise = max(float(off), NOISE) ** 2 * CORRELATED / rays_in_all
    order = [*range(6), 12, *range(6, 12)]
    deviation = spread(solid, at, matrix[order][:, order], noise) if sized else 0.0
    return Flight(at, float(off), deviation, best[6:9], best[9:12])

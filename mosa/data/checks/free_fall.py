"""Does the film move as a thrown object can? Wrong frame rates, units and orders of frames show before anything is learned.

The track is the point where the lines of sight through the mattes' centroids meet, frame by frame. What contradicts mechanics by a
factor of two or more beyond its own noise is refused, what does by less is a warning."""

from __future__ import annotations

import math
import warnings
from itertools import combinations, groupby, pairwise
from typing import NamedTuple

import torch
from scipy.stats import t as student
from torch import Tensor

from mosa.data.checks.cameras import lines_of_sight, misses
from mosa.errors import DataError
from mosa.types import REST, Scene

PIXELS, RADII, FINE = 0.25, 0.02, 0.3
"""Noise of a point of the track, the larger of: in pixels, and in radii of the object (a silhouette's centroid is not the body's).
FINE: share of it that is assumed at least where residuals say how large it is."""
LIGHT, HEAVY = 0.5, 30.0
"""Gravity [m/s^2] of asteroids and of the largest planets, beyond which its unit is doubted."""
SURE, SUSPECT = 2.0, 1.3
"""Factors of an acceleration or an energy from which on data are refused, and warned of, where noise cannot explain it. Free frames
of the built-in scenes and the bird fall with 0.93 to 1.07 of the stated gravity, and end with at most 1.01 of their energy."""
HELD = "of a film that starts at rest, held or in contact, say scene.start=rest"
ODD, ASIDE = 1.6, 0.25
"""Factor of the acceleration, and its share across gravity, that is said even where the noise assumed could explain it. That noise
is cautious: in the films above, three frames alone find gravity to 9 %, with 0.1 of it across."""
WEIGHTLESS = 1.0  # [m/s^2] that a film without gravity may show before it touches anything
SIZES, FASTEST = (1e-4, 1e3), 1e3  # [m], [m/s] of a falling object, with much room
SWAPPED = 3.0
"""Factor by which swapping two frames makes a track smoother from which on they are swapped. It is 0.9 to 1.02 for films as they
are; two swapped frames of the bird give 1.0 (at rest) to 100."""

COARSE, ABRUPT, MOVED = 160, 10.0, 0.1
"""Pictures are compared at about so many pixels across. They stop where they change that many times less than in the frame beside;
radii that the object then moves at least where data are refused."""


class Track(NamedTuple):
    """points: (T, 3) [m]; low: (T,) [m] lowest height along up that a matte shows; noise [m] of a point; radius [m]; dt [s]."""

    points: Tensor
    low: Tensor
    noise: float
    radius: float
    dt: float


def track_of(scene: Scene) -> Track | None:
    """Where the object is, float64; None where a frame has fewer than two whole mattes."""
    points, low, noise, radius = [], [], 0.0, 0.0
    for t in range(scene.frames):
        chosen, origins, directions, radii = lines_of_sight(scene, t)
        if len(chosen) < 2:
            return None
        point, _ = misses(origins, directions, radii)
        depth = ((point - origins) * directions).sum(1)
        if not bool((depth > 0).all()) or not bool(torch.isfinite(point).all()):
            return None
        points.append(point)
        low.append(min(lowest_seen(scene, v, t, float(d)) for v, d in zip(chosen, depth)))
        radius = max(radius, float((radii * depth).mean()))
        noise = max(noise, float((depth / scene.cameras.K[chosen, 0, 0].double()).mean()))
    dt = float(scene.times.double().diff().median())
    noise = max(PIXELS * noise, RADII * radius)
    return Track(torch.stack(points), torch.tensor(low).double(), noise, radius, dt)


def lowest_seen(scene: Scene, camera: int, frame: int, depth: float) -> float:
    """Height [m] along up of the lowest of a matte's pixels, were all at the object's depth [m]."""
    y, x = (scene.mattes[camera, frame] > 0.5).nonzero().double().T + 0.5
    K, w2c = scene.cameras.K[camera].double(), scene.cameras.w2c[camera].double()
    rays = torch.linalg.solve(K, torch.stack([x, y, torch.ones_like(x)]))
    world = w2c[:3, :3].T @ (depth * rays - w2c[:3, 3:])
    return float((scene.up.double() @ world).min())


def parabola(track: Track, frames: int) -> tuple[Tensor, float]:
    """Acceleration (3,) [m/s^2] of a parabola through the first frames, at least three, and what it may be off by.

    That is three standard errors of the assumed noise, or Student's quantile of the same probability of the residuals', whichever
    is more. Three frames leave no residuals: the noise assumed is then that of a coarse track."""
    t = torch.arange(frames, dtype=torch.float64)
    design = torch.stack([torch.ones_like(t), t, 0.5 * t * t], 1)
    x = track.points[:frames]
    solution = torch.linalg.lstsq(design, x).solution
    spread = float(torch.linalg.inv(design.T @ design)[2, 2]) ** 0.5
    if frames == 3:
        return solution[2] / track.dt**2, 3 * track.noise * spread / track.dt**2
    free = 3 * (frames - 3)
    scatter = float((x - design @ solution).square().sum() / free) ** 0.5
    error = max(3 * FINE * track.noise, float(student.ppf(0.9987, free)) * scatter)
    return solution[2] / track.dt**2, error * spread / track.dt**2


def check_fall(scene: Scene, label: str) -> None:
    """The film is one of an object that falls and meets the ground. Errors: DataError naming what contradicts it, and the keys."""
    track = track_of(scene)
    g = float(scene.gravity.double().norm())
    if track is None:
        return
    check_still(scene, track, label)
    check_size(track, label)
    if scene.start == REST:  # what holds or presses the body may move it in any way
        return
    if g == 0:
        for frames in range(3, scene.frames + 1):
            a, error = parabola(track, frames)
            if float(a.norm()) - error > WEIGHTLESS:
                warnings.warn(
                    f"{label}: in the first {frames} frames the object's speed changes by {float(a.norm()):.3g} "
                    f"+- {error:.2g} m/s^2, under a stated gravity of 0: check scene.gravity",
                    stacklevel=3,
                )
                return
        return
    check_order(scene, track, label)
    check_rate(scene, track, label, g)
    check_direction(scene, track, label, g)


def check_still(scene: Scene, track: Track, label: str) -> None:
    """The pictures go on while the object moves. Of a body at rest they may be alike to the bit: what counts is that those of all
    cameras stop, or go on, from one frame to the next. Errors: DataError naming the frames."""
    step = math.ceil(max(scene.mattes.shape[2:]) / COARSE)
    frames = [(scene.images[:, t, ::step, ::step], scene.mattes[:, t, ::step, ::step] > 0.5)
              for t in range(scene.frames)]  # fmt: skip
    change = torch.stack([((b - a).abs().mean(3) * (m | n)).sum() / (m | n).sum()
                          for (a, m), (b, n) in pairwise(frames)])  # fmt: skip
    if not bool(change.any()):
        raise DataError(
            f"{label}: all {scene.frames} frames are identical: expected a moving object"
        )
    same = change <= torch.minimum(2 * change.min(), change.max() / ABRUPT)
    ends = torch.nn.functional.pad(same.int(), (1, 1)).diff().nonzero()[:, 0].tolist()
    seen = [images.numpy().tobytes() for images, _ in frames]
    for t, first in ((t, seen.index(each)) for t, each in enumerate(seen)):
        away = float((track.points[first : t + 1] - track.points[t]).norm(dim=1).max())
        if away > MOVED * track.radius and change[first:t].any():
            raise DataError(
                f"{label}: expected new pictures, found those of frame {first} in frame {t} of all cameras, after "
                f"the object was {away:.3g} m away: is a part of the film there twice? Leave it out (scene.frames)"
            )
    moves, fall = track.points.diff(dim=0), float(scene.gravity.double().norm()) * track.dt**2
    for first, last in zip(ends[::2], ends[1::2]):
        level = ABRUPT * float(change[first:last].max())
        sides = [k for k in (first - 1, last) if 0 <= k < len(change) and float(change[k]) > level]
        if last == first + 1 and len(sides) == 2 and float(moves[sides[0]] @ moves[sides[1]]) < 0:
            continue  # where it turns round it may look the same before and after
        # what is let go starts to fall
        moved = max((float(moves[k].norm()) - fall * (k == last) for k in sides), default=0.0)
        said = (
            f"{label}: expected new pictures, found the same in frames {first} to {last} of all cameras, and an object moving "
            f"by {moved:.3g} m in a frame beside ({len(ends) // 2} such stretches): did the recording freeze, or was it "
            "brought to another frame rate? Leave these frames out (scene.frames), or each one that is there again"
        )
        if moved > MOVED * track.radius:
            raise DataError(said)
        if moved > track.noise:
            warnings.warn(said, stacklevel=4)


def check_size(track: Track, label: str) -> None:
    """Lengths and speeds of things that are filmed."""
    keys = "the unit of the poses, scene.box and scene.fps"
    if not SIZES[0] < track.radius < SIZES[1]:
        raise DataError(
            f"{label}: expected an object of {SIZES[0]:g} to {SIZES[1]:g} m, found a radius of {track.radius:.3g} m: "
            f"check {keys}"
        )
    speed = float(track.points.diff(dim=0).norm(dim=1).max()) / track.dt
    if speed > FASTEST:
        wanted = f"an object of at most {FASTEST:g} m/s"
        raise DataError(f"{label}: expected {wanted}, found {speed:.3g} m/s: check {keys}")


def check_rate(scene: Scene, track: Track, label: str, g: float) -> None:
    """Before it touches anything an object falls with gravity; what it touches from above only brakes it."""
    down = scene.gravity.double() / g
    keys = f"scene.fps (now {1 / track.dt:.6g} frames per second), the unit of the poses, scene.gravity and scene.up"
    for frames in range(3, scene.frames + 1):
        a, error = parabola(track, frames)
        along = float(a @ down)
        if along > SURE * g and along - error > SUSPECT * g:
            raise DataError(
                f"{label}: in the first {frames} frames the object falls with {along:.3g} +- {error:.2g} m/s^2, under "
                f"a stated gravity of {g:.3g}: check {keys}"
            )
    ground = -math.inf if scene.ground is None else scene.ground.height
    aloft = track.low > ground + 0.3 * track.radius
    free = int(aloft.int().cumprod(0).sum())
    if scene.last_free_frame is not None:
        free = min(free, scene.last_free_frame + 1)
    if free < 3:
        check_sideways(track, label, g, down)
        check_flight(track, aloft, label, g, down, keys)
        return
    a, error = parabola(track, free)
    along = float(a @ down)
    across = float((a - along * down).norm())
    found = f"{label}: above the ground, in frames 0 to {free - 1}, the object falls with {along:.3g} +- {error:.2g} m/s^2"
    slow = along < g / SURE and along + error < g / SUSPECT
    if slow or across - error > g / SURE:
        raise DataError(
            f"{found} along the stated gravity of {g:.3g}, and moves with {across:.3g} across: check {keys}; {HELD}"
        )
    if (along < g / SUSPECT and along + error < g) or (along > SUSPECT * g and along - error > g):
        warnings.warn(f"{found}, under a stated gravity of {g:.3g}: check {keys}", stacklevel=4)
    elif not g / ODD < along < ODD * g or across > ASIDE * g:
        warnings.warn(
            f"{found} along the stated gravity of {g:.3g}, and with {across:.3g} across, which so few frames may "
            f"excuse: check {keys}",
            stacklevel=4,
        )


def check_sideways(track: Track, label: str, g: float, down: Tensor) -> None:
    """A warning where too few frames are above the stated ground and the object falls first, as fast as gravity says, along that
    ground: what it strikes or rubs on seldom does just that."""
    if len(track.points) < 3:
        return
    a, error = parabola(track, 3)
    along = float(a @ down)
    across = a - along * down
    if error < 3 * g and abs(along) < ASIDE * g and abs(float(across.norm()) - g) < ASIDE * g:
        found = [round(float(x), 1) for x in across]
        warnings.warn(
            f"{label}: in the first three frames the object falls with about {found} m/s^2, across the stated gravity of "
            f"{g:.3g}: is another axis up? check scene.up, scene.gravity and the axes of the poses",
            stacklevel=5,
        )


def check_flight(
    track: Track, aloft: Tensor, label: str, g: float, down: Tensor, keys: str
) -> None:
    """Where too few frames are before contact: of the longest flight after it, which something unseen may touch, a warning.

    An object that is aloft in a frame and in the next rises and falls between them by g dt^2/8. Errors: DataError where this is
    more than all heights that the film shows, as where its clock counts milliseconds or frames."""
    heights, rise = track.points @ -down, g * track.dt**2 / 8
    shown = float(heights.max() - heights.min()) + 2 * track.radius
    if bool((aloft[1:] & aloft[:-1]).any()) and rise > shown:
        raise DataError(
            f"{label}: the object is aloft in frames that are {track.dt:.3g} s apart, between which it would rise and fall by "
            f"{rise:.3g} m; the heights that the film shows differ by {shown:.3g} m: expected times in seconds; check {keys}; "
            f"{HELD}"
        )
    runs = (list(run) for _, run in groupby(range(len(aloft)), aloft.tolist().__getitem__))
    flight = max((run for run in runs if aloft[run[0]]), key=len, default=[])
    if (frames := len(flight)) > 3:
        first = flight[0]
        a, error = parabola(track._replace(points=track.points[first:]), frames)
        if not g / SUSPECT - error < float(a @ down) < g * SUSPECT + error:
            found = f"the object falls with {float(a @ down):.3g} +- {error:.2g} m/s^2"
            where = f"{label}: aloft, in frames {first} to {first + frames - 1}, {found}"
            warnings.warn(f"{where}, under a stated gravity of {g:.3g}: check {keys}", stacklevel=5)
    elif not LIGHT < g < HEAVY:
        said = f"{label}: expected scene.gravity in m/s^2, found {g:.3g}"
        warnings.warn(f"{said}, which this film cannot tell", stacklevel=5)


def check_direction(scene: Scene, track: Track, label: str, g: float) -> None:
    """Of its energy the falling centre keeps at most all: a film that runs backwards gains some."""
    up = scene.up.double()
    v, height = track.points.diff(dim=0) / track.dt, track.points @ up
    speed = v.norm(dim=1)
    energy = 0.5 * speed**2 + g * (0.5 * (height[1:] + height[:-1]) - height.min())
    error = (2**0.5 / track.dt * speed + g) * track.noise
    start, last = float(energy[0]), int((energy - 3 * error).argmax())
    beyond = float(energy[last] - 3 * error[last]) > start + 3 * float(error[0])
    found = (
        f"{label}: the object has {float(energy[last]):.3g} J/kg in frames {last} to {last + 1}, {start:.3g} at the start: "
        "expected a fall, in which the ground takes energy"
    )
    cause = "another gravity (scene.gravity), or a film that runs backwards (times negated, frames in descending order)?"
    if scene.ground is not None and float(track.low[0]) < scene.ground.height + 0.3 * track.radius:
        cause = "a film that begins after contact (start it earlier, scene.frames), or one that runs backwards or is upside "
        cause += "down (scene.up, axes of the poses, flipped pictures)?"
    if beyond and float(energy[last]) > SURE * start:
        raise DataError(f"{found}; {cause}")
    if beyond and float(energy[last]) > SUSPECT * start:
        warnings.warn(f"{found}; {cause}", stacklevel=4)


def check_order(scene: Scene, track: Track, label: str) -> None:
    """No two frames in each other's place, and no stretch in reverse."""
    fall = scene.gravity.double() * track.dt**2

    def rough(points: Tensor) -> float:
        return float((points[2:] - 2 * points[1:-1] + points[:-2] - fall).square().sum())

    now, best, pair = rough(track.points), math.inf, (0, 0, "")
    for i, j in combinations(range(scene.frames), 2):
        swapped, reverse = track.points.clone(), track.points.clone()
        swapped[[i, j]] = track.points[[j, i]]
        said = f"frames {i} and {j} seem to be in each other's place: swapping"
        best, pair = min((best, pair), (rough(swapped), (i, j, said)))
        if 3 <= j - i < scene.frames - 1:
            reverse[i : j + 1] = track.points[i : j + 1].flip(0)
            said = f"frames {i} to {j} seem to be in reverse order: turning"
            best, pair = min((best, pair), (rough(reverse), (i, j, said)))
    floor = 6 * scene.frames * track.noise**2  # of second differences of noise
    if now > SWAPPED * (best + floor):
        raise DataError(
            f"{label}: {pair[2]} them makes the object's path {now / best:.3g} times smoother; put them in order, or "
            "restrict scene.frames"
        )

"""scene=markers: tracked points of a body of known shape, without images (docs/beam.md)."""

from __future__ import annotations

import hashlib
import logging
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from annotated_types import MinLen

from mosa.data.formats.scene_from_footage import check_density, directions
from mosa.data.io.markers import AT_REST, alignment, read_markers, released, swung
from mosa.errors import ConfigError, DataError
from mosa.physics.contact.colliders import Box, collider_of
from mosa.physics.contact.driven import driven_from_config
from mosa.physics.contact.mesh import SignedDistanceField
from mosa.physics.contact.reference import signed_distance
from mosa.settings import Expected, Names, Positive, Three, Whole, check_values, is_number
from mosa.types import AUTO, Cameras, Ground, Markers, Scene

log = logging.getLogger(__name__)

Places = Annotated[dict[str, Three], Expected("a section of places like {a: [0, 0, 0.1]} [m]")]
KINDS: dict[str, Any] = {"points": Places | None, "tracked": Annotated[Names, MinLen(1)] | None, "fps": Positive | None,
                         "duration": Positive | None, "holdout_frames": Whole}  # fmt: skip
FOUND = {AUTO: released, "swing": swung}  # how scene.start is found
MOST_FRAMES = 100_000
MISALIGNED = 0.1  # of the points' extent: a distance (rms) of aligned points that is refused
LEAST_SPAN, MOST_SPAN = 0.01, 3.0  # distances of tracked points over the body's size
LARGE = 10.0  # [m] of a body that is asked about: a specimen of 10 mm, and its recording, read in millimetres
FARTHEST = (
    1e9  # mm from a surface, beyond which it was not measured: outside of the lattice around a mesh
)
WIDE = 3.0  # the world reaches so many sizes of the body beyond it


def load_markers(
    *, path: Path, body: Mapping[str, Any] | None = None, density: float, ground: Ground | None = None,
    name: str | None = None, sequence: str = "train",
    points: Mapping[str, Sequence[float]] | None = None, tracked: Sequence[str] | None = None,
    start: float | str = AUTO, duration: float | None = None, fps: float | None = None,
    up: Sequence[float] = (0, 1, 0), gravity: Sequence[float] = (0, -9.8, 0),
    loads: Sequence[Mapping[str, Any]] = (), holdout_frames: int = 0,
) -> Scene:  # fmt: skip
    """A sequence without cameras, whose frame 0 is when the body was let go at rest, undeformed.

    path: the recording (`read_markers`); body: {type: box, size} or {type: mesh, path, scale} with
    position and rotation as a collider has them, at rest, in the axes in which the run computes;
    density [kg/m^3]; points: name -> place (x, y, z) [m] in these axes, by which the recording is
    aligned as a rigid body, None where it is in them already; tracked: names that are compared,
    None for all; start: auto (the release is found) or [s] of the recording; duration [s], None to
    the end; fps: frames per second that it is resampled to, None for the recording's; loads: sets
    with a mass that goes with the body in this recording, as in world.driven; holdout_frames: how
    many last frames are not learned from.
    Errors: ConfigError naming the key, DataError naming the file."""
    check_density("scene.density", density)
    given = {"points": points, "tracked": tracked, "duration": duration, "fps": fps}
    check_values(given | {"holdout_frames": holdout_frames}, KINDS, "scene")
    upright, pull = directions(up, gravity, ground)
    recording = read_markers(Path(path))
    names = recording.names if tracked is None else tuple(tracked)
    seen = recording.of(names, "scene.tracked")
    times = recording.times
    if isinstance(start, str) and start in FOUND:
        begin = FOUND[start](times, seen, str(path))
    elif is_number(start) and times[0] <= float(start) < times[-1]:
        begin = float(start)
    else:
        raise ConfigError(
            f"scene.start: expected auto, swing, or seconds from {times[0]:g} to {times[-1]:g}, "
            f"found {start!r}"
        )
    rate = 1 / float(np.median(np.diff(times))) if fps is None else float(fps)
    end = times[-1] if duration is None else min(times[-1], begin + float(duration))
    span = float(np.floor((end - begin) * rate + 1e-6)) + 1
    if not 2 + holdout_frames <= span <= MOST_FRAMES:
        raise ConfigError(
            f"scene.holdout_frames: expected to learn from 2 frames or more, and {MOST_FRAMES} at most "
            f"in all, found {span:.6g} in all, {holdout_frames} held out (scene.duration, scene.fps)"
        )
    frames = int(span)
    before = (times <= begin) & (times >= begin - AT_REST)
    known = {name: None for name in names} if points is None else dict(points)
    still = medians(recording.of(list(known), "scene.points")[before])
    R, t = np.eye(3), np.zeros(3)
    if points is not None:
        R, t, off = alignment(still, points, "scene.points")
        log.info("%s: aligned by %d points, %.2g mm off (rms)", Path(path).name, len(points), 1e3 * off)  # fmt: skip
        if off > MISALIGNED * (size := float(np.ptp(list(points.values()), axis=0).max())):
            raise ConfigError(
                f"scene.points: expected places [m] of the recording's points, found them {off:.3g} m "
                f"(rms) of {size:.3g} m off: another unit, a mirrored axis, exchanged names?"
            )
    chosen = [recording.names.index(each) for each in names]
    moving = recording.at(begin + np.arange(frames) / rate)[:, chosen] @ R.T + t
    rest = medians(seen[before]) @ R.T + t
    if unseen := [each for each, place in zip(names, rest) if not np.isfinite(place).all()]:
        raise DataError(
            f"{path}: expected every tracked point at rest before the release at {begin:.3f} s, "
            f"found none of {unseen[0]!r}; leave it out of scene.tracked, or set scene.start"
        )
    log.info("%s: let go at %.4f s; %d frames at %g Hz", Path(path).name, begin, frames, rate)
    solid = solid_of(body, Path(path).parent)
    at_rest, tracks = (torch.from_numpy(each).float() for each in (rest, moving))
    position, turn = pose_of(solid)
    apart = 1e3 * signed_distance(solid.shape, (at_rest.double() - position) @ turn).sort().values
    log.info(
        "%s: at rest the points are %s to %s mm from the body's surface (negative: inside)",
        Path(path).name,
        *(
            f"{each:.1f}" if each < FARTHEST else f"more than {1e3 * solid.shape.margin:.0f}"
            for each in apart[[0, -1]]
        ),
    )
    low, high = corners(solid)
    far = WIDE * (across := float((high - low).max()))
    span = float(np.ptp(rest, axis=0).max())
    if len(rest) > 1 and not LEAST_SPAN < span / across < MOST_SPAN:
        raise ConfigError(
            f"scene.body: expected the body [m] on which the tracked points lie, found one of {across:.3g} m, and points that "
            f"are {span:.3g} m apart: another unit?"
        )
    if across > LARGE:
        warnings.warn(
            f"scene.body: expected metres, found a body of {across:.3g} m on which the points lie: are both in millimetres? Moduli "
            "scale with lengths",
            stacklevel=3,
        )
    for each in driven_from_config(loads, "scene.loads"):
        if each.held or not each.mass:
            raise ConfigError(
                "scene.loads: expected sets with a mass and held: false, which go with the body; "
                "what holds it belongs to world.driven"
            )
    nothing = torch.zeros(0, frames, 1, 1)
    return Scene(
        name=name or Path(path).stem, sequence=sequence, mattes=nothing,
        images=nothing[..., None].expand(-1, -1, -1, -1, 3),
        cameras=Cameras(torch.zeros(0, 3, 3), torch.zeros(0, 4, 4), 1, 1, ()),
        times=torch.arange(frames) / rate, gravity=pull, up=upright, ground=ground,
        box=torch.stack([low - far, high + far]).float(), density=float(density),
        background=torch.ones(3), synthetic=False, last_free_frame=0,
        holdout_frames=tuple(range(frames - holdout_frames, frames)),
        fingerprint=hashlib.sha256(Path(path).read_bytes()).hexdigest()[:16],
        markers=Markers(names, at_rest, tracks, solid, tuple(dict(each) for each in loads)),
    )  # fmt: skip


def medians(places: np.ndarray) -> np.ndarray:
    """(M, 3) of the places (n, M, 3) at which points were seen, NaN of one that never was."""
    found = np.full(places.shape[1:], np.nan)
    for m in range(places.shape[1]):
        there = places[np.isfinite(places[:, m]).all(1), m]
        if len(there):
            found[m] = np.median(there, 0)
    return found


def solid_of(body: Mapping[str, Any] | None, folder: Path):
    """The body at rest as a solid with a pose. folder: of relative paths. Errors: ConfigError."""
    moves = isinstance(body, Mapping) and body.get("motion")
    if moves or not isinstance(body, Mapping) or body.get("type") not in ("box", "mesh"):
        raise ConfigError(
            "scene.body: expected {type: box, size: [x, y, z]} or {type: mesh, path: <file>}, with "
            f"position and rotation, found {body!r}"
        )
    keys = {key: value for key, value in body.items() if value is not None}
    if isinstance(keys.get("path"), str):
        keys["path"] = str(folder / keys["path"])
    return collider_of(keys, "scene.body")


def extent(solid) -> tuple[torch.Tensor, torch.Tensor]:
    """Lowest and highest corner (3,) float64 [m] of a box or a mesh in its own axes."""
    shape = solid.shape
    if isinstance(shape, Box):
        half = 0.5 * torch.tensor(shape.size, dtype=torch.float64)
        return -half, half
    assert isinstance(shape, SignedDistanceField)
    low = torch.tensor(shape.origin, dtype=torch.float64)
    high = low + shape.spacing * (torch.tensor(shape.values.shape) - 1)
    return low + shape.margin, high - shape.margin


def corners(solid) -> tuple[torch.Tensor, torch.Tensor]:
    """Lowest and highest corner (3,) float64 [m] of a solid where it stands."""
    position, rotation = pose_of(solid)
    ends = torch.stack(extent(solid))
    every = torch.cartesian_prod(*ends.T) @ rotation.T + position
    return every.amin(0), every.amax(0)


def pose_of(solid) -> tuple[torch.Tensor, torch.Tensor]:
    """Position (3,) and rotation (3, 3) float64 of a solid at rest."""
    position, rotation, *_ = solid.motion.timed(None, 1.0).sample(1, 1, 1e-9)
    return position[0], rotation[0]

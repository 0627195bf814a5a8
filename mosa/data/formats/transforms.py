"""transforms.json, as Blender scripts and Nerfstudio write it, with a time per frame: the way in for one's own capture."""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mosa.data.formats.footage import (
    Footage,
    even_times,
    footage_of,
    frame_range,
    matrix,
    number,
    read_json,
    same_camera,
    warn_of_other_rate,
    world_to_camera,
)  # fmt: skip
from mosa.data.formats.scene_from_footage import scene_from_footage
from mosa.data.formats.views import read_views, split_alpha, split_mask
from mosa.data.images.lens import COEFFICIENTS, FOREIGN, Lens, is_fisheye, lens_of
from mosa.errors import DataError
from mosa.types import Scene

LONGEST = 1000  # characters of a path: a file system takes 4096 bytes, of names of 255 each
INTRINSICS = (
    "fl_x",
    "fl_y",
    "cx",
    "cy",
    "w",
    "h",
    "camera_angle_x",
    "camera_angle_y",
    *COEFFICIENTS,
)
EXTENSIONS = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
JITTER = 0.01
"""By how much poses of a camera that stands still may differ: radians, and shares of the cameras' distance from their middle. Where
each image's is solved for itself they differ by about a pixel, 0.002."""


@dataclass(frozen=True)
class Shot:
    """One entry: where it is written, image and mask file, time [s] or None, own intrinsics, pose w2c (4, 4), camera label,
    whether its lens is a fisheye."""

    where: str
    image: Path
    mask: Path | None
    time: float | None
    intrinsics: dict[str, float]
    w2c: np.ndarray
    camera: str | None
    fisheye: bool = False

    @property
    def place(self) -> np.ndarray:
        """(3,) in the world."""
        return -self.w2c[:3, :3].T @ self.w2c[:3, 3]


def read_transforms(
    path: str | Path, *, frames=None, fps: float | None = None, scale: float = 1.0, fill: int = 0
) -> Footage:
    """Footage of a transforms.json (path: the file, or its folder).

    Top level or per entry: fl_x, fl_y, cx, cy [px] or camera_angle_x [rad], w, h, the lens' k1 to k4, p1, p2, camera_model (see
    `lens.py`: it is undone, images and mattes are then those of a pinhole). Per entry: file_path (extension may be left
    out), transform_matrix (camera to world, OpenGL axes), time [s] (left out: the last number in the file names that differs
    counts frames at fps; where all entries have one and fps is given, evenly spaced times take their place), mask_path (grey,
    white = object; left out: the image's alpha), camera (left out: entries with one pose are one camera). fill: holes
    of mattes up to this many pixels of the file are covered. Errors: DataError naming file and entry, ConfigError.
    """
    file = Path(path)
    file = file / "transforms.json" if file.is_dir() or not file.suffix else file
    if not file.is_file():
        raise DataError(f"{file}: file not found; a relative scene.path begins at scene.root")
    document = read_json(file)
    shots = read_shots(file, document, fps)
    cameras, by_camera = group(shots, file)
    times, table = synchronise(by_camera, fps)
    wanted = frame_range(list(range(len(times))), frames, str(file))
    if fps is not None and all(entry.get("time") is not None for entry in document["frames"]):
        warn_of_other_rate([times[f] for f in wanted], fps, str(file))
        times = [i / fps for i in range(len(times))]
    even_times([times[f] for f in wanted], wanted, str(file))
    rows = {name: {frame: row[frame] for frame in wanted} for name, row in zip(cameras, table)}
    shots_of = {shot.image: shot for row in rows.values() for shot in row.values()}

    def bent(camera: str, width: int, height: int) -> tuple[np.ndarray, Lens | None]:
        shot = cameras[camera]
        K = camera_matrix(shot, width, height)
        lens = lens_of(K, shot.intrinsics, width, height, fisheye=shot.fisheye, where=shot.where)
        return (K if lens is None else lens.K), lens

    calibration, images, mattes = read_views(
        {name: (np.eye(3), shot.w2c) for name, shot in cameras.items()}, wanted,
        lambda camera, frame: rows[camera][frame].image,
        lambda _, file, pixels: split_shot(shots_of[file], pixels), str(file), scale=scale, fill=fill, bent=bent)  # fmt: skip
    return footage_of(calibration, images, mattes, wanted, [times[f] for f in wanted], str(file))


def entries_of(file: Path, document) -> list[tuple[str, dict]]:
    """(where it is written, entry) of each image of a document. Errors: DataError naming entry and key."""
    frames = document.get("frames") if isinstance(document, dict) else None
    if not isinstance(frames, list) or not frames:
        raise DataError(f"{file}: expected an object with a list `frames`, one entry per image")
    found = [(f"{file}, frames[{i}]", entry) for i, entry in enumerate(frames)]
    for where, entry in found:
        for key in ("file_path", "transform_matrix"):
            if not isinstance(entry, dict) or key not in entry:
                raise DataError(f"{where}: expected the key {key}")
    return found


def shot_of(where: str, entry: dict, document: dict) -> Shot:
    """What an entry says of its camera; image and mask as they are named, time None where it has none. Errors: DataError."""
    both = {**document, **entry}
    if bent := [k for k in FOREIGN if both.get(k)]:
        raise DataError(
            f"{where}: {bent[0]}: expected a lens of k1, k2, k3, p1, p2 (or k1 to k4 of a fisheye), found a "
            "rational or thin prism model; undistort the images first"
        )
    given = {key: both[key] for key in INTRINSICS if both.get(key) is not None}
    intrinsics = {key: number(value, f"{where}, {key}") for key, value in given.items()}
    fisheye = is_fisheye(both.get("camera_model"), both.get("is_fisheye"), where)
    pose = matrix(entry["transform_matrix"], (3, 4), f"{where}, transform_matrix")
    time = number(entry["time"], f"{where}, time") if entry.get("time") is not None else None
    camera = str(entry["camera"]) if entry.get("camera") is not None else None
    mask = Path(str(entry["mask_path"])) if entry.get("mask_path") else None
    image = Path(str(entry["file_path"]))
    return Shot(where, image, mask, time, intrinsics, world_to_camera(pose, where), camera, fisheye)


def read_shots(file: Path, document, fps: float | None) -> list[Shot]:
    """The entries of a document, with files that there are and a time. Errors: DataError naming entry and key."""
    entries = entries_of(file, document)
    counting = counting_place([str(e["file_path"]) for _, e in entries if "time" not in e])
    shots = []
    for where, entry in entries:
        shot = shot_of(where, entry, document)
        image = locate(file.parent, str(entry["file_path"]), where)
        mask = None if shot.mask is None else locate(file.parent, str(entry["mask_path"]), where)
        time = counted_time(image, fps, where, counting) if shot.time is None else shot.time
        shots.append(replace(shot, image=image, mask=mask, time=time))
    return shots


def locate(folder: Path, name: str, where: str) -> Path:
    """The file a path names, its extension left out or not. Errors: DataError where there is none."""
    if len(name) > LONGEST or "\0" in name:
        found = f"found {len(name)}: {name[:60]!r} ..."
        raise DataError(f"{where}: expected a path of at most {LONGEST} characters, {found}")
    for extension in EXTENSIONS:
        candidate = folder / (name + extension)
        if candidate.is_file():
            return candidate
    raise DataError(f"{folder / name}: image not found ({where})")


def counted_time(image: Path, fps: float | None, where: str, place: int) -> float:
    """Time [s] from the number at that place of a file name."""
    counter = re.findall(r"\d+", image.stem)
    if fps is None or not counter:
        way = "add `time`, or number the files and set scene.fps"
        raise DataError(f"{where}: expected a time in seconds, found none; {way}")
    return int(counter[place]) / fps


def counting_place(names: list[str]) -> int:
    """Which of the numbers in file names counts frames: the last that is not the same in all of them (`0_003_v2`: 003)."""
    numbers = [re.findall(r"\d+", Path(name).stem) for name in names]
    differ = [k for k, each in enumerate(zip(*numbers)) if len(set(each)) > 1]
    return differ[-1] if differ and len({len(each) for each in numbers}) == 1 else -1


def group(shots: list[Shot], file: Path) -> tuple[dict[str, Shot], dict[str, list[Shot]]]:
    """Camera name -> the shot whose pose is nearest to the mean, and all its shots; by label, or by equal pose.

    A warning where the poses of a label differ by a little. Errors: DataError where a camera has several intrinsics or moves, or
    unlabelled ones all do."""
    members: dict[str, list[Shot]] = {}
    for shot in shots:
        eye, name = np.eye(3), shot.camera
        if name is None:
            bare = ((n, own[0].w2c) for n, own in members.items() if own[0].camera is None)
            same = (n for n, w2c in bare if same_camera((eye, w2c), eye, shot.w2c))
            name = next(same, str(len(members)))
        members.setdefault(name, []).append(shot)
    places = np.array([shot.place for shot in shots])
    spread = float(np.linalg.norm(places - places.mean(0), axis=1).max()) or 1.0

    def apart(a: Shot, b: Shot) -> float:
        turn = float(np.abs(a.w2c[:3, :3] - b.w2c[:3, :3]).max())
        return max(turn, float(np.linalg.norm(a.place - b.place)) / spread)

    if len(shots) > 2 and len(members) == len(shots):
        close = sum(any(apart(a, b) < JITTER for b in shots if b is not a) for a in shots)
        still = 2 * close > len(shots) >= 2 * len({shot.time for shot in shots})
        cause = "a single moving camera cannot be used"
        if still:
            cause = "they seem to, with poses solved for each image: name the camera of each entry"
        raise DataError(
            f"{file}: {len(shots)} entries with {len(members)} different poses: expected cameras that stand still and "
            f"see every frame; {cause}"
        )
    for name, (known, *others) in members.items():
        for shot in others:
            a, b = known.intrinsics, shot.intrinsics
            for key in (k for k in INTRINSICS if a.get(k) != b.get(k)):
                raise DataError(
                    f"{shot.where}: camera {name} has {key} = {b.get(key)}, {a.get(key)} in {known.where}: expected one "
                    "lens, focus and zoom a camera; write one set in all its entries"
                )
        off, where = max(((apart(known, shot), shot.where) for shot in others), default=(0.0, ""))
        found = (
            f"{where}: camera {name} has another pose than in {known.where}, {off:.2%} away (of a radian, or of the cameras' "
            "distance from their middle)"
        )
        if off > JITTER:
            raise DataError(f"{found}; cameras must not move")
        if off > 1e-5:
            warnings.warn(
                f"{found}: solved for each image? The pose nearest to the mean is taken for all",
                stacklevel=4,
            )
    chosen = {}
    for name, own in members.items():
        middle = np.mean([shot.w2c for shot in own], 0)
        off = [float(np.abs(shot.w2c - middle).sum()) for shot in own]
        chosen[name] = own[int(np.argmin(off))]
    return chosen, members


def synchronise(
    by_camera: dict[str, list[Shot]], fps: float | None
) -> tuple[list[float], list[list[Shot]]]:
    """Times of the frames [s], and the shots [camera][frame]. DataError where one is missing or doubled."""
    tolerance = 1e-6 if fps is None else 0.25 / fps
    times: list[float] = []
    for time in sorted(s.time for shots in by_camera.values() for s in shots):
        if not times or time - times[-1] > tolerance:
            times.append(time)
    table = []
    for name, shots in by_camera.items():
        row: list[Shot | None] = [None] * len(times)
        for shot in shots:
            index = int(np.abs(np.array(times) - shot.time).argmin())
            if (other := row[index]) is not None:
                found = f"two images at {shot.time:.6f} s, the other in {other.where}"
                raise DataError(f"{shot.where}: camera {name} has {found}")
            row[index] = shot
        missing = [round(t, 6) for t, s in zip(times, row) if s is None]
        if missing:
            raise DataError(
                f"{shots[0].where}: camera {name} has no image at {missing[:4]} s, where other cameras have one; "
                f"cameras must be synchronous: {len(times)} frames expected, {len(shots)} found; {clocks(by_camera, fps)}"
            )
        table.append(row)
    return times, table


def clocks(by_camera: dict[str, list[Shot]], fps: float | None) -> str:
    """What helps where the cameras' times do not meet: a frame rate, if their clocks are less than half a frame apart."""
    rows = [sorted(shot.time for shot in shots) for shots in by_camera.values()]
    count = len(rows[0])
    if any(len(row) != count for row in rows) or count < 2:
        return "add the missing images, or remove those of the other cameras at these times"
    rate = (count - 1) / float(np.median([row[-1] - row[0] for row in rows]))
    apart = max(max(moment) - min(moment) for moment in zip(*rows))
    if fps is None and apart < 0.25 / rate:
        return (
            f"their clocks are at most {1e3 * apart:.3g} ms apart: scene.fps={rate:.4g} takes images that belong together as "
            "one frame, and evenly spaced times"
        )
    return f"their clocks are up to {1e3 * apart:.3g} ms apart, of a frame of {1e3 / rate:.3g} ms: shift the times of late cameras"


def split_shot(shot: Shot, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colour (H, W, 3) and matte (H, W) of its pixels. Errors: DataError where there is no matte."""
    if shot.mask is not None:
        return split_mask(shot.image, pixels, shot.mask)
    return split_alpha(shot.image, pixels, f" or a mask_path in {shot.where}")


def camera_matrix(shot: Shot, width: int, height: int) -> np.ndarray:
    """K (3, 3) [px]. Errors: DataError where the focal length is missing, or intrinsics are of another image size."""
    known = shot.intrinsics
    for key, size in (("w", width), ("h", height)):
        if key in known and known[key] != size:
            found = f"{shot.image.name} is {width}x{height}"
            raise DataError(
                f"{shot.where}: intrinsics are for {key} = {known[key]:g} px, but {found}"
            )
    if "fl_x" in known:
        focal = known["fl_x"], known.get("fl_y", known["fl_x"])
    elif "camera_angle_x" in known:
        across = {"camera_angle_x": width, "camera_angle_y": height}
        for key in across:
            if not 0 < known.get(key, 1) < math.pi:
                wanted = "expected radians between 0 and pi"
                raise DataError(f"{shot.where}: {key}: {wanted}, found {known[key]:g}")
        found = [0.5 * across[key] / math.tan(0.5 * known[key]) for key in across if key in known]
        focal = found[0], found[-1]
    else:
        wanted = "fl_x (and fl_y) in pixels or camera_angle_x in radians"
        raise DataError(f"{shot.where}: expected {wanted}, found neither")
    K = np.diag([*focal, 1.0])
    K[:2, 2] = known.get("cx", width / 2), known.get("cy", height / 2)
    return K


def load_transforms(
    path: str | Path, *, frames=None, fps=None, scale=1.0, fill_holes=0, name=None, **world
) -> Scene:
    """Scene of a transforms.json. `world`: the keyword arguments of `scene_from_footage`."""
    footage = read_transforms(path, frames=frames, fps=fps, scale=scale, fill=fill_holes)
    folder = Path(path).resolve()
    name = name or (folder.parent if folder.suffix else folder).name
    return scene_from_footage(footage, name=name, **world)

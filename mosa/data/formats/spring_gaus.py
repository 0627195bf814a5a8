"""Spring-Gaus' layout of synthetic bodies: camera.json, frame.json, <camera>/<frame>.png (docs/data.md)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from mosa.data.formats.footage import (
    Footage,
    check_rate,
    footage_of,
    frame_range,
    matrix,
    number,
    read_entries,
    world_to_camera,
)
from mosa.data.formats.scene_from_footage import scene_from_footage
from mosa.data.formats.views import read_views, split_alpha
from mosa.errors import DataError
from mosa.types import Scene

PICTURE = re.compile(r"(\d{3,})\.png$")


def read_spring_gaus(
    path: str | Path, *, frames=None, fps: float | None = None, scale: float = 1.0, fill: int = 0
) -> Footage:
    """Footage of a folder in Spring-Gaus' layout: RGBA pictures whose alpha is the matte, of cameras that stay where they are.

    frames: (first, last) or None for all there are; fps: given where the file's times are not to be used; scale: image scale in
    (0, 1]; fill: holes of mattes up to this many pixels of the file are covered.
    Errors: DataError naming the file (missing, damaged, of another size, without a matte), ConfigError."""
    folder = Path(path)
    if not folder.is_dir():
        raise DataError(
            f"{folder}: folder not found; set scene.path to a body in Spring-Gaus' layout (camera.json, frame.json, "
            "a folder of pictures for each camera)"
        )
    calibration, times = read_cameras(folder / "camera.json"), read_times(folder / "frame.json")
    present = sorted({int(found[1]) for camera in calibration for file in pictures(folder / camera)
                      if (found := PICTURE.fullmatch(file.name)) is not None})  # fmt: skip
    if not present:
        wanted = f"pictures {next(iter(calibration))}/000.png and so on"
        raise DataError(f"{folder}: expected {wanted}, found none")
    numbers, listing = frame_range(present, frames, str(folder)), str(folder / "frame.json")
    if numbers[-1] >= len(times):
        raise DataError(
            f"{listing}: expected a time for each frame up to {numbers[-1]}, found {len(times)}; add them, or restrict "
            "scene.frames"
        )
    chosen = [times[frame] for frame in numbers]
    check_rate(chosen, numbers, fps, listing)
    scaled_calibration, images, mattes = read_views(
        calibration, numbers, lambda camera, frame: folder / camera / f"{frame:03}.png",
        lambda _, file, pixels: split_alpha(file, pixels), "camera.json", scale=scale, fill=fill)  # fmt: skip
    where = str(folder / "camera.json")
    return footage_of(scaled_calibration, images, mattes, numbers, chosen, where)


def pictures(folder: Path) -> list[Path]:
    """Errors: DataError for a camera's folder that is not there."""
    if not folder.is_dir():
        raise DataError(f"{folder}: folder not found, though camera.json lists the camera")
    return sorted(folder.iterdir())


def read_cameras(path: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Calibration (folder of the camera -> K, w2c) from a list of {"camera": folder, "K": 3x3 [px], "c2w": 4x4 in OpenGL axes}."""
    calibration = {}
    for where, entry in read_entries(path, "camera", "camera", "K", "c2w"):
        name = entry["camera"]
        if not isinstance(name, str) or name in ("", ".", "..") or set(name) & set("/\\\0"):
            wanted = f"the name of a folder beside {path.name}"
            raise DataError(f"{where}, camera: expected {wanted}, found {str(name)[:80]!r}")
        if name in calibration:
            raise DataError(f"{where}: camera {name!r} twice")
        calibration[name] = (matrix(entry["K"], (3, 3), f"{where}, K"),
                             world_to_camera(matrix(entry["c2w"], (3, 4), f"{where}, c2w"), f"{where}, c2w"))  # fmt: skip
    return calibration


def read_times(path: Path) -> list[float]:
    """Time [s] of each frame, from a list of objects that have one entry each."""
    times = []
    for where, entry in read_entries(path, "frame"):
        if len(entry) != 1:
            raise DataError(f"{where}: expected one key, a time [s], found {str(entry)[:80]}")
        times.append(number(next(iter(entry.values())), where))
    return times


def load_spring_gaus(
    path: str | Path, *, frames=None, scale=1.0, fill_holes=0, name=None, **world
) -> Scene:
    """Scene of a folder in Spring-Gaus' layout. `world`: the keyword arguments of `scene_from_footage`."""
    fps = world.get("fps")
    footage = read_spring_gaus(path, frames=frames, fps=fps, scale=scale, fill=fill_holes)
    return scene_from_footage(footage, name=name or Path(path).resolve().name, **world)

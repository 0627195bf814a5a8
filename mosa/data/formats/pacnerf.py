"""PAC-NeRF's layout: all_data.json with one object per image, data/{a,m,r}_<camera>_<frame>.png (docs/data.md)."""

from __future__ import annotations

import logging
import re
from functools import lru_cache
from pathlib import Path

import numpy as np

from mosa.data.formats.footage import (
    Footage,
    check_rate,
    footage_of,
    frame_range,
    matrix,
    merge_time,
    number,
    read_entries,
    same_camera,
    world_to_camera,
)  # fmt: skip
from mosa.data.formats.scene_from_footage import scene_from_footage
from mosa.data.formats.views import read_views, split_alpha, three_channels
from mosa.data.images.matting import matte_from_plate
from mosa.data.images.reading import expect_size, read_image
from mosa.errors import DataError
from mosa.types import Scene

log = logging.getLogger(__name__)

NAME = re.compile(r"([a-z])_(-?\d+)_(-?\d+)\.png$")
# a pixel of the m_ files belongs to the white background above this
WHITE_LEVEL = 0.99
PUBLISHED = {
    "torus": {"E": 1e6, "nu": 0.3},
    "bird": {"E": 3e5, "nu": 0.3},
    "playdoh": {"E": 2e6, "nu": 0.3, "yield_stress": 1.54e4},
    "cat": {"E": 1e6, "nu": 0.3, "yield_stress": 3.85e3},
    "droplet": {"mu": 200.0, "kappa": 1e5},
    "letter": {"mu": 100.0, "kappa": 1e5},
    "cream": {"mu": 1e4, "kappa": 1e6, "yield_stress": 3e3, "viscosity": 10.0},
    "toothpaste": {"mu": 5e3, "kappa": 1e5, "yield_stress": 200.0, "viscosity": 10.0},
    "trophy": {"friction_angle": 40.0},
}
"""Published parameters by folder name (SI, degrees): compared with at the end, never read by learning, in no config."""
CAMERAS = 11  # of every published film: one of another number is somebody's own, whatever its folder is called


def read_pacnerf(
    path: str | Path, *, frames=None, fps: float | None = None, scale: float = 1.0, fill: int = 0
) -> Footage:
    """Footage of a folder in PAC-NeRF's layout; only all_data.json and data/ are opened.

    Raw images without mattes are matted from the empty plates of their cameras. frames: (first, last) or None for all there
    are; fps: given where the file's times are not to be used; scale: image scale in (0, 1]; fill: holes of mattes up to this
    many pixels of the file are covered.
    Errors: DataError naming the file (missing, damaged, of another size, without a matte, with another time), ConfigError.
    """
    folder = Path(path)
    if not folder.is_dir():
        wanted = "set scene.path to a scene in PAC-NeRF's layout (all_data.json, data/)"
        raise DataError(f"{folder}: folder not found; {wanted}")
    listing = folder / "all_data.json"
    calibration, times = read_listing(listing, fps)
    prefix, present = usable_frames(folder, calibration)
    numbers = frame_range([f for f in present if f in times], frames, str(folder / "data"))
    moments = [times[f][0] for f in numbers]
    check_rate(moments, numbers, fps, str(listing))
    if prefix == "r":
        log.info("%s: raw images, matted from the background plates r_<camera>_-1.png", folder)

    @lru_cache(maxsize=1)  # one at a time: cameras come one after the other
    def plate(camera: str) -> np.ndarray | None:
        file = folder / "data" / f"r_{camera}_-1.png"
        return three_channels(read_image(file)) if prefix == "r" else None

    scaled_calibration, images, mattes = read_views(
        calibration, numbers, lambda camera, frame: folder / "data" / f"{prefix}_{camera}_{frame}.png",
        lambda camera, file, pixels: split(file, pixels, plate(camera)), listing.name, scale=scale, fill=fill)  # fmt: skip
    return footage_of(scaled_calibration, images, mattes, numbers, moments, str(listing))


def read_listing(
    path: Path, fps: float | None = None
) -> tuple[dict[str, tuple[np.ndarray, np.ndarray]], dict[int, tuple[float, str]]]:
    """Calibration (camera name -> K, w2c) in order of camera number, and frame -> (time, where it was read)."""
    calibration, times = {}, {}
    for where, entry in read_entries(path, "image", "file_path", "time", "c2w", "intrinsic"):
        found = NAME.search(str(entry["file_path"]))
        if found is None:
            wanted = "a file_path like ./data/r_<camera>_<frame>.png"
            raise DataError(f"{where}: expected {wanted}, found {entry['file_path']!r}")
        camera, frame = found[2], int(found[3])
        K = matrix(entry["intrinsic"], (3, 3), f"{where}, intrinsic")
        w2c = world_to_camera(matrix(entry["c2w"], (3, 4), f"{where}, c2w"), f"{where}, c2w")
        if not same_camera(known := calibration.setdefault(camera, (K, w2c)), K, w2c):
            other = "another pose" if same_camera(known, K, known[1]) else "other intrinsics"
            why = f"has {other} than before; cameras must not move, focus or zoom"
            raise DataError(f"{where}: camera {camera} {why}")
        if frame >= 0:
            merge_time(times, frame, number(entry["time"], f"{where}, time"), where, fps)
    return dict(sorted(calibration.items(), key=lambda item: int(item[0]))), times


def usable_frames(folder: Path, calibration: dict) -> tuple[str, list[int]]:
    """The kind of file to read (a, else m, else r) and the frame numbers any camera has it for.

    Errors: DataError where there is nothing, or only raw images and a camera without its background plate.
    """
    present: dict[str, set[int]] = {"a": set(), "m": set(), "r": set()}
    if (folder / "data").is_dir():
        for file in (folder / "data").iterdir():
            found = NAME.match(file.name)
            if found and found[1] in present and int(found[3]) >= 0 and found[2] in calibration:
                present[found[1]].add(int(found[3]))
    for kind in ("a", "m"):
        if present[kind]:
            return kind, sorted(present[kind])
    if present["r"]:
        plates = {camera: folder / "data" / f"r_{camera}_-1.png" for camera in calibration}
        bare = [camera for camera, plate in plates.items() if not plate.is_file()]
        if bare:
            raise DataError(
                f"{folder / 'data'}: no mattes: expected a_<camera>_<frame>.png (RGBA) or m_<camera>_<frame>.png "
                f"(background painted white), found raw r_ images only, and no background plate r_{bare[0]}_-1.png to matte them "
                f"with; add the plates of camera {', '.join(bare)}, or matte the images first"
            )
        return "r", sorted(present["r"])
    raise DataError(f"{folder / 'data'}: expected images a_<camera>_<frame>.png, found none")


def split(file: Path, pixels: np.ndarray, plate: np.ndarray | None) -> tuple[np.ndarray, ...]:
    """Colour (H, W, 3) and matte (H, W): the alpha channel of an a_ file, what is not white in an m_ file, what differs from the
    plate in an r_ file."""
    if file.name.startswith("a_"):
        return split_alpha(file, pixels)
    color = three_channels(pixels)
    if plate is not None:
        reason = "as the background plate of its camera"
        expect_size(file, pixels, *plate.shape[1::-1], reason=reason)
        return matte_from_plate(color, plate)
    return color, (color.min(-1) < WHITE_LEVEL).astype(np.float32)


def load_pacnerf(
    path: str | Path, *, frames=None, scale=1.0, fill_holes=0, name=None, **world
) -> Scene:
    """Scene of a folder in PAC-NeRF's layout. `world`: the keyword arguments of `scene_from_footage`."""
    footage = read_pacnerf(path, frames=frames, fps=world.get("fps"), scale=scale, fill=fill_holes)
    folder = Path(path).resolve().name
    known = PUBLISHED.get(folder, {}) if len(footage.cameras.names) == CAMERAS else {}
    return scene_from_footage(footage, name=name or folder, known_parameters=known, **world)

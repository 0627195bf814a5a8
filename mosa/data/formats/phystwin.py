"""PhysTwin's layout (docs/data.md): RGB-D films of a body that hands move. Read are colours, masks,
calibration, the body's points at rest and the hands' points, which drive particles; depth, tracked
points and meshes are not. Its z axis points down."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mosa.data.formats.footage import (
    OPENGL_TO_OPENCV,
    footage_of,
    frame_range,
    matrix,
    read_json,
    warn_of_other_rate,
    world_to_camera,
)
from mosa.data.formats.particles import kept_cloud
from mosa.data.formats.scene_from_footage import scene_from_footage
from mosa.data.formats.views import read_views, split_mask
from mosa.errors import DataError
from mosa.settings import Positive, check, fits
from mosa.types import REST, Scene

HAND = "hand"  # name of the masks that are not the body's


def load_phystwin(
    path: str | Path,
    *,
    frames=None,
    fps=30.0,
    scale=1.0,
    fill_holes=0,
    name=None,
    reach=0.04,
    body: dict[str, Any] | None = None,
    start=REST,
    holdout_frames=None,
    cache=None,
    **world,
) -> Scene:
    """Scene of the folder of a case, with the driven set `controller`.

    fps: of the film, which metadata.json may say too; reach [m]: the controller's points that are at most so far
    from the body in the first frame move its particles, the others nothing; body: {shape, scale} as
    of `scene_from_footage`: without a shape it is what the body's points enclose, whose unit is the
    metre; holdout_frames: None for those of split.json's test. `world`: other keyword arguments of
    `scene_from_footage`. Errors: DataError naming file and field, ConfigError."""
    folder = Path(path)
    check("scene.reach", reach, Positive)
    calibration, masks = read_cameras(folder)
    listed = folder / "color" / "0"
    present = sorted(int(f.stem) for f in listed.glob("*.png") if f.stem.isdecimal())
    if not present:
        raise DataError(f"{listed}: expected pictures 0.png, 1.png and so on, found none")
    numbers = frame_range(present, frames, str(listed))
    rest, driven = read_points(folder / "final_data.pkl", numbers, fps, reach)

    scaled, images, mattes = read_views(
        calibration, numbers, lambda camera, frame: folder / "color" / camera / f"{frame}.png",
        lambda camera, picture, pixels: split_mask(picture, pixels, masks[camera] / picture.name),
        "metadata.json", scale=scale, fill=fill_holes)  # fmt: skip
    times, where = [k / fps for k in numbers], str(folder / "metadata.json")
    if fits(Positive, stated := read_json(folder / "metadata.json").get("fps")):
        warn_of_other_rate([k / stated for k in numbers], fps, where)
    footage = footage_of(scaled, images, mattes, numbers, times, where)
    given = {} if body is None else dict(body)
    if given.get("shape") is None:
        given = {"shape": kept_cloud(rest, cache), "scale": given.get("scale") or 1.0}
    if holdout_frames is None:
        holdout_frames = tested_frames(folder / "split.json", numbers)
    return scene_from_footage(
        footage, name=name or folder.resolve().name, body=given, driven=(driven,), start=start,
        holdout_frames=holdout_frames, **world)  # fmt: skip


def read_cameras(folder: Path) -> tuple[dict[str, tuple[np.ndarray, np.ndarray]], dict[str, Path]]:
    """(calibration, folder of the body's masks) of each camera 0, 1, ..."""
    listing, poses = folder / "metadata.json", numbers_of(folder / "calibrate.pkl")
    document = read_json(listing)
    intrinsics = document.get("intrinsics") if isinstance(document, dict) else None
    if not isinstance(intrinsics, list) or not isinstance(poses, (list, np.ndarray)) or len(poses) != len(intrinsics):  # fmt: skip
        raise DataError(
            f"{listing}, intrinsics: expected a 3x3 matrix for each pose of calibrate.pkl, found "
            f"{str(intrinsics)[:80]}"
        )
    calibration, masks = {}, {}
    for k, (K, c2w) in enumerate(zip(intrinsics, poses)):
        where, camera = f"{folder / 'calibrate.pkl'}, pose {k}", str(k)
        pose = matrix(np.asarray(c2w).tolist(), (3, 4), where) @ OPENGL_TO_OPENCV
        calibration[camera] = matrix(K, (3, 3), f"{listing}, intrinsics[{k}]"), world_to_camera(pose, where)  # fmt: skip
        names = read_json(folder / "mask" / f"mask_info_{k}.json")
        bodies = [n for n, what in names.items() if what != HAND] if isinstance(names, dict) else []
        if len(bodies) != 1 or not bodies[0].isdecimal():
            raise DataError(
                f"{folder / 'mask' / f'mask_info_{k}.json'}: expected one number of a mask that is not "
                f"called {HAND!r}, found {str(names)[:80]}"
            )
        masks[camera] = folder / "mask" / camera / bodies[0]
    return calibration, masks


def read_points(
    file: Path, frames: list[int], fps: float, reach: float
) -> tuple[np.ndarray, dict[str, Any]]:
    """((M, 3) [m] points of the body in the first frame, the controller as an entry of world.driven)."""
    stored = numbers_of(file)
    found = {}
    for key, axes in (("object_points", 3), ("controller_points", 3), ("surface_points", 2), ("interior_points", 2)):  # fmt: skip
        value = stored.get(key) if isinstance(stored, dict) else None
        if isinstance(value, np.ndarray) and axes == 2 and not value.size:
            value = value.reshape(0, 3)  # of a case without a mesh
        if not isinstance(value, np.ndarray) or value.ndim != axes or value.shape[-1] != 3 or value.dtype.kind != "f":  # fmt: skip
            raise DataError(
                f"{file}, {key}: expected numbers of shape ({'frames, ' if axes == 3 else ''}points, 3), "
                f"found {getattr(value, 'shape', None)}"
            )
        if axes == 3 and len(value) <= frames[-1]:
            raise DataError(
                f"{file}, {key}: expected frames up to {frames[-1]}, as there are pictures of, found "
                f"{len(value)}; restrict scene.frames"
            )
        found[key] = value.astype(np.float64)
    parts = found["object_points"][frames[0]], found["surface_points"], found["interior_points"]
    body = np.concatenate(parts)
    body = body[np.isfinite(body).all(1)]
    hand = found["controller_points"][frames]
    hand = hand[:, np.isfinite(hand).all((0, 2))]
    away = cKDTree(body).query(hand[0])[0] if len(body) and hand.size else np.array([np.inf])
    if not away.min() <= reach:
        raise DataError(
            f"{file}, controller_points: expected one within scene.reach={reach:g} m of the body in "
            f"frame {frames[0]}, found the nearest {away.min():.3g} m away; set scene.reach"
        )
    motion = {"times": [(k - frames[0]) / fps for k in frames], "points": hand[:, away <= reach].tolist()}  # fmt: skip
    return body, {"name": "controller", "motion": motion}


def tested_frames(file: Path, frames: list[int]) -> list[int]:
    """Those of `frames` that the case keeps for a test; none where there is no such file."""
    document = read_json(file) if file.is_file() else {"test": [frames[-1] + 1]}
    test = document.get("test") if isinstance(document, dict) else None
    if not isinstance(test, list) or not test or not isinstance(test[0], int):
        raise DataError(f"{file}, test: expected [first, end], found {str(test)[:80]}")
    return [k for k in frames if k >= test[0]]


class Numbers(pickle.Unpickler):
    """Lists, dictionaries, texts and numpy's arrays of numbers, and nothing that a file could run."""

    def find_class(self, module: str, name: str) -> Any:
        plain = {
            "ndarray": "ndarray",  # which _reconstruct is told
            "dtype": np.dtype,
            "_reconstruct": lambda *_: np.zeros(0, "b"),
            "_frombuffer": lambda data, kind, shape, order: np.frombuffer(data, kind).reshape(shape, order=order),
            "scalar": lambda kind, data: np.frombuffer(data, kind)[0],
        }  # fmt: skip
        if module.split(".")[0] != "numpy" or name not in plain:
            raise pickle.UnpicklingError(f"the name {module}.{name}")
        return plain[name]


def numbers_of(file: Path) -> Any:
    """What a pickle holds. Errors: DataError naming a file that is damaged or names anything else."""
    if not file.is_file():
        raise DataError(f"{file}: file not found; set scene.path to a folder of a case of PhysTwin")
    try:
        with open(file, "rb") as stream:
            return Numbers(stream).load()
    except Exception as error:  # whatever is found: the file is not what its name says
        wanted = "a pickle of lists, dictionaries and arrays of numbers alone"
        raise DataError(f"{file}: expected {wanted}, found {error}") from error

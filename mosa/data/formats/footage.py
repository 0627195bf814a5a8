"""What every file format comes down to before it is a Scene: named cameras, numbered frames, images and mattes."""

from __future__ import annotations

import json
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from mosa.data.images.one_size import one_size
from mosa.errors import ConfigError, DataError
from mosa.settings import Expected, check, fits, such
from mosa.types import Cameras

WHITE = np.ones(3, np.float32)
# columns 1 and 2 of a pose with OpenGL axes (y up, looks along -z) point against those of OpenCV (y down, z forward)
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])

FirstLast = Annotated[
    list[int],
    Expected("[first, last], in this order"),
    such(lambda v: len(v) == 2 and v[0] <= v[1]),
]
LARGEST = 1e30  # of a number in a file: single precision holds it

# relative jitter of frame times that still counts as a constant frame rate
TIME_JITTER = 1e-3
GAP = 1.5  # mean steps between two frames, from which on one between them was left out
RATE = 0.005  # share by which scene.fps may differ from the file's rate: 59.94 and 60 are one


@dataclass(frozen=True)
class Footage:
    """cameras: V; frames: T frame numbers as in the files; times: (T,) [s]; images: (V, T, H, W, 3) in [0, 1] composited on
    `background` (3,); mattes: (V, T, H, W) in [0, 1]. All tensors are float32; a pixel's centre is at half integers."""

    cameras: Cameras
    frames: tuple[int, ...]
    times: Tensor
    images: Tensor
    mattes: Tensor
    background: Tensor


class TwiceError(ValueError):
    """A key of a JSON object that is there twice: which of its values counts is left to each reader."""


def each_once(pairs: list[tuple[str, object]]) -> dict:
    """An object of JSON. Errors: TwiceError for a key that is there twice with two values."""
    found: dict[str, object] = {}
    for key, value in pairs:
        if key in found and found[key] != value:
            raise TwiceError(
                f"the key {key[:60]!r} twice, as {str(found[key])[:40]} and as {str(value)[:40]}"
            )
        found[key] = value
    return found


def read_json(path: Path):
    """Contents of a JSON file. Errors: DataError naming file and line, or a key that is there twice."""
    if not path.is_file():
        raise DataError(f"{path}: file not found")
    try:
        # some editors put a byte order mark before it
        return json.loads(path.read_text(encoding="utf-8-sig"), object_pairs_hook=each_once)
    except json.JSONDecodeError as error:
        raise DataError(
            f"{path}: expected JSON, found a mistake in line {error.lineno}, column {error.colno}: {error.msg}"
        ) from error
    except RecursionError as error:
        raise DataError(
            f"{path}: expected JSON of a few levels, found brackets in brackets beyond any depth"
        ) from error
    except ValueError as error:  # a number of thousands of digits
        if isinstance(error, UnicodeDecodeError):
            raise DataError(f"{path}: expected JSON text, found bytes that are no UTF-8") from error
        found = str(error) if isinstance(error, TwiceError) else f"what cannot be read ({error})"
        raise DataError(f"{path}: expected JSON, found {found}") from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error


def read_entries(path: Path, of: str, *keys: str) -> list[tuple[str, dict]]:
    """(where it is written, entry) of a JSON list with one object per `of` that has these keys. Errors: DataError."""
    entries = read_json(path)
    if not isinstance(entries, list) or not entries:
        raise DataError(
            f"{path}: expected a list with one object per {of}, found {type(entries).__name__}"
        )
    found = [(f"{path}, entry {i}", entry) for i, entry in enumerate(entries)]
    for where, entry in found:
        if not isinstance(entry, dict) or (missing := [key for key in keys if key not in entry]):
            lacks = missing[0] if isinstance(entry, dict) else "object"
            raise DataError(f"{where}: expected the keys {', '.join(keys)}, found no {lacks}")
    return found


def matrix(value, shape: tuple[int, int], where: str) -> np.ndarray:
    """A finite matrix of that shape from nested lists. Errors: DataError beginning with `where`."""
    if not fits(list[list[float]], value) or len({len(row) for row in value}) != 1:
        raise DataError(
            f"{where}: expected a {shape[0]}x{shape[1]} matrix of finite numbers, found {str(value)[:80]}"
        )
    array = np.array(value, dtype=np.float64)
    if array.shape == (4, 4) and shape == (3, 4):
        if not np.abs(array[3] - (0, 0, 0, 1)).max() <= 1e-6:
            raise DataError(
                f"{where}: expected 0, 0, 0, 1 in the fourth row, found {array[3].tolist()}; transposed, or scaled?"
            )
        array = array[:3]
    if array.shape != shape:
        raise DataError(
            f"{where}: expected a {shape[0]}x{shape[1]} matrix, found shape {array.shape}"
        )
    return array


def number(value, where: str) -> float:
    """A finite number. Errors: DataError beginning with `where`."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= LARGEST:
        raise DataError(f"{where}: expected a finite number, found {str(value)[:80]!r}")
    return float(value)


def world_to_camera(c2w: np.ndarray, where: str) -> np.ndarray:
    """w2c (4, 4) in OpenCV axes from c2w (3, 4) in OpenGL axes. Errors: DataError where c2w holds no rotation."""
    full = np.eye(4)
    full[:3] = c2w
    rotation = full[:3, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > 1e-3 or np.linalg.det(rotation) < 0:
        raise DataError(
            f"{where}: expected a rotation in the first three columns, found one that is off orthonormal by {error:.2g} with "
            f"determinant {np.linalg.det(rotation):.3g}; scaled or mirrored poses cannot be used"
        )
    opencv = full @ OPENGL_TO_OPENCV
    return np.linalg.inv(opencv)


def same_camera(known: tuple[np.ndarray, np.ndarray], K: np.ndarray, w2c: np.ndarray) -> bool:
    """Whether two calibrations agree to 1e-3 px and 1e-5."""
    return bool(np.abs(known[0] - K).max() < 1e-3 and np.abs(known[1] - w2c).max() < 1e-5)


def frame_range(present: list[int], wanted, where: str) -> list[int]:
    """The frame numbers of `present` inside `wanted` = (first, last), both included, or all of them where it is None.

    Errors: ConfigError where an end is not there, DataError where numbers are missing in between.
    """
    if wanted is not None:
        wanted = list(wanted) if isinstance(wanted, (list, tuple)) else [wanted]
        check("scene.frames", wanted, FirstLast)
        for end in wanted:
            if end not in present:
                raise ConfigError(
                    f"scene.frames: {where} has no frame {end}, only {min(present)} to {max(present)}"
                )
        present = [f for f in present if wanted[0] <= f <= wanted[1]]
    missing = sorted(set(range(present[0], present[-1] + 1)) - set(present)) if present else []
    if missing:
        raise DataError(
            f"{where}: frames {missing} are missing between {present[0]} and {present[-1]}; restrict scene.frames"
        )
    if len(present) < 2:
        raise DataError(f"{where}: expected at least two frames, found {len(present)}")
    return present


def merge_time(
    times: dict[int, tuple[float, str]], frame: int, time: float, where: str, fps: float | None
) -> None:
    """Note the time of a frame, the first that is given. Errors: DataError where another camera gave the same frame a time that
    is another by more than a quarter of a frame, or, without frames per second, at all."""
    known, first = times.setdefault(frame, (time, where))
    if abs(known - time) > (1e-6 if fps is None else 0.25 / fps):
        remedy = "; where their clocks are a little apart, scene.fps=<frames per second> takes a frame as one moment"
        raise DataError(
            f"{where}: frame {frame} has time {time:.6f} s, but {known:.6f} s in {first}; "
            f"the cameras of a scene must be synchronous{remedy if fps is None else ''}"
        )


def check_rate(times: list[float], frames: list[int], fps: float | None, where: str) -> None:
    """The times [s] of the chosen frames increase at one rate; where scene.fps takes their place, a warning if they say another.
    Errors: DataError with the times, beginning with `where`."""
    if fps is None:
        even_times(times, frames, where)
    else:
        warn_of_other_rate(times, fps, where)


def even_times(times: list[float], frames: list[int], where: str, rounding: float = 0.0) -> None:
    """The times [s] of the chosen frames increase at one rate, to their `rounding` [s]. Errors: DataError with the times, beginning
    with `where`."""
    remedy = "correct them, restrict scene.frames, or set scene.fps"
    steps = np.diff(np.asarray(times, dtype=np.float64))
    listed = ", ".join(f"{t:.6g}" for t in times[:8]) + (" ..." if len(times) > 8 else "")
    if not (steps > 0).all():
        raise DataError(f"{where}: expected increasing frame times, found {listed} s; {remedy}")
    middle = float(np.median(steps))
    worst = int(np.abs(steps - middle).argmax())
    if abs(steps[worst] - middle) > TIME_JITTER * middle + rounding:
        raise DataError(
            f"{where}: expected one frame rate, found the times {listed} s: {steps[worst]:.6f} s between frames "
            f"{frames[worst]} and {frames[worst + 1]}, {middle:.6f} s elsewhere; {remedy}"
        )


def warn_of_other_rate(times: list[float], fps: float, where: str) -> None:
    """A warning where scene.fps takes the place of times in the file that say another rate, or that a frame was left out."""
    steps = np.diff(np.asarray(times, dtype=np.float64))
    mean = float(steps.mean()) if len(steps) else 0.0  # rounded times have another median
    if mean > 0 and (abs(mean * fps - 1) > RATE or steps.max() > GAP * mean):
        warnings.warn(
            f"{where}: scene.fps = {fps:g} takes the place of the file's own times, which say {1 / mean:.5g} frames per second, "
            f"{steps.min():.4g} to {steps.max():.4g} s apart: expected the same rate, but for a film in slow motion, and no frame "
            "left out",
            stacklevel=2,
        )


def scaled(K: np.ndarray, full: tuple[int, int], size: tuple[int, int]) -> np.ndarray:
    """K (3, 3) [px] of images that were brought from `full` to `size`, (width, height) [px] each."""
    # as a scene keeps it: what was read before has the same bits, and so the same place in the cache
    K = K.astype(np.float32)
    K[0] *= size[0] / full[0]
    K[1] *= size[1] / full[1]
    return K


def footage_of(
    calibration: dict[str, tuple[np.ndarray, np.ndarray]],
    images: list[np.ndarray],
    mattes: list[np.ndarray],
    frames: list[int],
    times: list[float],
    where: str,
) -> Footage:
    """Footage from name -> (K, w2c) and, in the same order, (T, h, w, 3) images on white and (T, h, w) mattes, whose sizes may
    differ between cameras. Errors: DataError beginning with `where` (`mosa.data.images.one_size`)."""
    for name in calibration:  # it stands in messages and figures
        if not name.strip() or len(name) > 100 or not name.isprintable():
            raise DataError(
                f"{where}: expected names of cameras of at most 100 printable characters, found {name[:60]!r}"
            )
    K, w2c = (np.stack(part) for part in zip(*calibration.values()))
    K, stack, coverage = one_size(
        K, images, mattes, background=WHITE, names=list(calibration), where=where
    )
    intrinsics, poses = (torch.tensor(part, dtype=torch.float32) for part in (K, w2c))
    height, width = coverage.shape[2:]
    cameras = Cameras(intrinsics, poses, width, height, tuple(calibration))
    moments = np.array(times)
    digits = np.spacing(np.abs(moments).max(), dtype=np.float32)
    if digits > 0.1 * TIME_JITTER * np.diff(moments).min():
        moments -= moments[0]  # seconds of a clock, which single precision does not keep
    seconds, pictures, shown = map(torch.from_numpy, (moments, stack, coverage))
    return Footage(cameras, tuple(frames), seconds.float(), pictures, shown, torch.ones(3))

"""Particles in PLY files: the truth, a file for each frame, and rest shapes that a format brings."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement, PlyParseError
from torch import Tensor

from mosa.errors import DataError
from mosa.system.caches import default_cache
from mosa.system.ply import check_ply
from mosa.system.whole_files import made_folder, written_whole


def read_ply(path: Path) -> Tensor:
    """(M, 3) [m] vertices of a PLY file. Errors: DataError naming the file."""
    if not path.is_file():
        raise DataError(f"{path}: file not found")
    check_ply(path)
    try:
        vertices = PlyData.read(path)["vertex"]
        points = np.stack([np.asarray(vertices[axis], dtype=np.float32) for axis in "xyz"], -1)
    except (PlyParseError, KeyError, ValueError, OSError, UnicodeDecodeError) as error:
        raise DataError(
            f"{path}: expected a PLY file with vertices x, y, z, found a damaged or other one ({error})"
        ) from error
    if len(points) == 0:
        raise DataError(f"{path}: expected particles, found none")
    bad = np.flatnonzero(~np.isfinite(points).all(-1))
    if len(bad):
        raise DataError(
            f"{path}: expected finite positions, found NaN or infinity in {len(bad)} of {len(points)}, first at {bad[0]}"
        )
    return torch.from_numpy(points)


def kept_cloud(points: np.ndarray, cache: str | Path | None) -> str:
    """File of points (M, 3) in the cache folder, for `scene.body.shape`: equal points, equal file."""
    rows = np.ascontiguousarray(points, "<f4")
    name = f"{hashlib.sha256(rows.tobytes()).hexdigest()[:16]}.ply"
    file = made_folder(Path(cache or default_cache()) / "shapes", "scene.cache") / name
    if not file.is_file():
        vertices = rows.view([(axis, "<f4") for axis in "xyz"])[:, 0]
        with written_whole(file) as partial:
            PlyData([PlyElement.describe(vertices, "vertex")]).write(str(partial))
    return str(file)


def read_clouds(folder: Path, frames: Sequence[int]) -> tuple[Tensor, ...]:
    """One cloud (M_t, 3) [m] for each of the frames, which are numbers as in the scene's files.

    The last number in a file's name is its frame where all frames are found so; else, of as many files as frames, the order of
    their numbers is the frames'. Errors: DataError where the folder is missing, or neither says which file is which frame.
    """
    if not Path(folder).is_dir():
        raise DataError(
            f"{folder}: folder not found; scene.particles is the folder of ground-truth PLY files, or null"
        )
    files = sorted(
        Path(folder).glob("*.ply"), key=lambda f: [int(n) for n in re.findall(r"\d+", f.stem)]
    )
    numbered = {int(numbers[-1]): f for f in files if (numbers := re.findall(r"\d+", f.stem))}
    if len(numbered) == len(files) and all(frame in numbered for frame in frames):
        files = [numbered[frame] for frame in frames]
    elif len(files) != len(frames):
        raise DataError(
            f"{folder}: expected {len(frames)} PLY files, one per frame, numbered {frames[0]} to {frames[-1]} as the frames are, "
            f"found {len(files)}; restrict scene.frames"
        )
    return tuple(read_ply(f) for f in files)

"""Ground-truth particles: folders of PLY files, one per frame."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyParseError
from torch import Tensor

from mosa.errors import DataError
from mosa.ply import check_ply


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


def read_clouds(folder: Path, frames: int) -> tuple[Tensor, ...]:
    """One cloud (M_t, 3) [m] per frame from the PLY files of a folder, ordered by the numbers in their names.

    Errors: DataError where the folder is missing or holds another number of files than the scene has frames.
    """
    if not Path(folder).is_dir():
        raise DataError(f"{folder}: folder not found; scene.particles is the folder of ground-truth PLY files, or null")
    files = sorted(Path(folder).glob("*.ply"), key=lambda f: [int(n) for n in re.findall(r"\d+", f.stem)])
    if len(files) < frames:
        raise DataError(
            f"{folder}: expected {frames} PLY files, one per frame, found {len(files)}; restrict scene.frames"
        )
    return tuple(read_ply(f) for f in files[:frames])

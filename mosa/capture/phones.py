"""The cameras of a capture: pinhole or lens, still, in the world of the program that found their poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mosa.data.images.lens import lens_of
from mosa.data.io.colmap import Camera
from mosa.errors import DataError

FOCAL, BESIDE = (0.05, 1000.0), 1.0
"""Focal length over the image's longer side, and image sizes by which the principal point may lie beside the image."""
FARTHEST = 1e9  # of a camera from the origin of the poses' world, in whatever unit that has


@dataclass(frozen=True)
class Phone:
    """name: of its video, without the ending; camera: for images of the size of that video."""

    name: str
    camera: Camera
    video: Path


def plausible(camera: Camera) -> Camera:
    """The camera. Errors: DataError where a lens that takes images of that size cannot have these numbers."""
    (width, height), K, longer = camera.size, camera.K, max(camera.size)
    for name, value in (("fl_x", K[0, 0]), ("fl_y", K[1, 1])):
        if not FOCAL[0] * longer <= value <= FOCAL[1] * longer:
            raise DataError(
                f"{camera.where}: expected a focal length {name} of {FOCAL[0] * longer:g} to {FOCAL[1] * longer:g} px for "
                f"images of {width}x{height} px, found {value:g}"
            )
    for name, value, side in (("cx", K[0, 2], width), ("cy", K[1, 2], height)):
        if not -BESIDE * side <= value <= (1 + BESIDE) * side:
            raise DataError(
                f"{camera.where}: expected a principal point near the images of {width}x{height} px, found {name}={value:g}"
            )
    if not np.abs(camera.w2c[:3, 3]).max() <= FARTHEST:
        raise DataError(
            f"{camera.where}: expected a camera within {FARTHEST:g} of the origin, found {camera.centre.tolist()}"
        )
    lens_of(K, camera.coefficients, width, height, fisheye=camera.fisheye, where=camera.where)
    return camera


def nearest_point(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The point (3,) nearest to lines through origins (C, 3) along unit directions (C, 3), least squares."""
    across = np.eye(3) - directions[:, :, None] * directions[:, None]
    return np.linalg.lstsq(across.sum(0), (across @ origins[..., None]).sum(0)[:, 0], rcond=None)[0]

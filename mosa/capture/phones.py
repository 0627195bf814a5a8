"""The cameras of a capture: pinhole or lens, still, in the world of the program that found their poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from mosa.data.images.lens import lens_of
from mosa.errors import DataError

FOCAL, BESIDE = (0.05, 1000.0), 1.0
"""Focal length over the image's longer side, and image sizes by which the principal point may lie beside the image."""
FARTHEST = 1e9
"""Of a camera from the origin of the poses' world, in whatever unit that has."""
HALF = 0.5
"""Pixel centres lie at half integers here and in COLMAP, at whole numbers in OpenCV."""


@dataclass(frozen=True)
class Camera:
    """K: (3, 3) [px, pixel centres at half integers]; w2c: (4, 4), OpenCV axes, length unit of the poses; size: (width, height)
    [px]; coefficients: k1 to k4, p1, p2 of the lens (`mosa.data.images.lens`); where: file and entry, for messages."""

    K: np.ndarray
    w2c: np.ndarray
    size: tuple[int, int]
    where: str
    coefficients: Mapping[str, float] = field(default_factory=dict)
    fisheye: bool = False

    @property
    def centre(self) -> np.ndarray:
        """(3,) in the world of the poses."""
        return -self.w2c[:3, :3].T @ self.w2c[:3, 3]

    def lens(self) -> np.ndarray:
        """Coefficients in OpenCV's order."""
        names = ("k1", "k2", "k3", "k4") if self.fisheye else ("k1", "k2", "p1", "p2", "k3")
        return np.array([self.coefficients.get(name, 0.0) for name in names])

    def opencv_K(self) -> np.ndarray:
        return self.K - HALF * np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of points (N, 3) of the world, lens included."""
        seen = points @ self.w2c[:3, :3].T + self.w2c[:3, 3]
        if not self.fisheye and not any(self.coefficients.values()):
            return (seen @ self.K.T)[:, :2] / seen[:, 2:]
        none, K, shape = np.zeros(3), self.opencv_K(), (-1, 1, 3)
        found = (
            cv2.fisheye.projectPoints(seen.reshape(shape), none, none, K, self.lens())
            if self.fisheye
            else cv2.projectPoints(seen.reshape(shape), none, none, K, self.lens())
        )[0]
        return found.reshape(-1, 2) + HALF

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions (N, 3) in the world of what pixels (N, 2) show."""
        K, shape = self.opencv_K(), (-1, 1, 2)
        flat = np.asarray(pixels, np.float64).reshape(shape) - HALF
        flat = (
            cv2.fisheye.undistortPoints(flat, K, self.lens())
            if self.fisheye
            else cv2.undistortPoints(flat, K, self.lens())
        )
        flat = flat.reshape(-1, 2)
        rays = np.concatenate([flat, np.ones((len(flat), 1))], 1) @ self.w2c[:3, :3]
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


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

"""The cameras of a capture: pinhole or lens, still, in the world of the program that found their poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

HALF = 0.5
"""Pixel centres lie at half integers here and in COLMAP, at whole numbers in OpenCV."""


@dataclass(frozen=True)
class Camera:
    """K: (3, 3) [px, pixel centres at half integers]; w2c: (4, 4), OpenCV axes, length unit of the poses; size: (width, height)
    [px]; coefficients: k1 to k4, p1, p2 of the lens (`mosa.data.lens`); where: file and entry, for messages."""

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
        flat = cv2.fisheye.undistortPoints(flat, K, self.lens()) if self.fisheye else cv2.undistortPoints(flat, K, self.lens())
        flat = flat.reshape(-1, 2)
        rays = np.concatenate([flat, np.ones((len(flat), 1))], 1) @ self.w2c[:3, :3]
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


@dataclass(frozen=True)
class Phone:
    """name: of its video, without the ending; camera: for images of the size of that video."""

    name: str
    camera: Camera
    video: Path


def nearest_point(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The point (3,) nearest to lines through origins (C, 3) along unit directions (C, 3), least squares."""
    across = np.eye(3) - directions[:, :, None] * directions[:, None]
    return np.linalg.lstsq(across.sum(0), (across @ origins[..., None]).sum(0)[:, 0], rcond=None)[0]

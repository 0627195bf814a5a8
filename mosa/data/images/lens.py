"""Lens distortion undone: images and mattes of a bent lens as a pinhole camera would have taken them.

The models are OpenCV's, which COLMAP and Nerfstudio use too. With x, y = X/Z, Y/Z and r^2 = x^2 + y^2, a point appears at
fx x' + cx, fy y' + cy where (Brown 1971)
    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y
or, fisheye (Kannala and Brandt 2006), (x', y') = (x, y) theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)/r with
theta = atan r."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from mosa.errors import DataError

COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
FOREIGN = ("k5", "k6", "s1", "s2", "s3", "s4")  # other lens models, not undone
MODELS = {
    name: False for name in ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
} | {name: True for name in ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")}
"""camera_model as COLMAP names it -> whether it is a fisheye's."""
ZOOM = 4.0  # largest change of the focal length that still counts as undoing a lens


@dataclass(frozen=True)
class Lens:
    """K: (3, 3) of the pinhole camera that the images are brought to [px]; places: (H, W, 2) float32, where each of its pixels lies
    in the image of the lens [px, OpenCV: pixel centres at whole numbers]; kept: (H, W) bool, what of that image it shows."""

    K: np.ndarray
    places: np.ndarray
    kept: np.ndarray

    def straighten(
        self, picture: np.ndarray, matte: np.ndarray, background: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """A picture (H, W, 3) composited on a background colour (3,) and its matte (H, W) as the pinhole camera sees them.

        What the lens did not show is background. Bicubic: 2 dB closer to a pinhole's picture than bilinear. Overshoots at edges are
        cut off; they would leave 2 % of a colour where there is no matte."""
        x, y = self.places[..., 0], self.places[..., 1]

        def seen_by(image: np.ndarray, behind) -> np.ndarray:
            around = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": behind}
            return cv2.remap(image, x, y, cv2.INTER_CUBIC, **around).clip(0, 1)

        seen, matte = seen_by(picture, tuple(map(float, background))), seen_by(matte, 0.0)
        return np.where(matte[..., None] > 0, seen, background), matte

    def lost(self, matte: np.ndarray) -> float:
        """Share of a matte (H, W) of the lens' image that the pinhole camera does not show."""
        return float(matte[~self.kept].sum() / max(matte.sum(), 1e-6))


def is_fisheye(model, flag, where: str) -> bool:
    """Whether a camera_model (None: none given), or the flag is_fisheye of instant-ngp, means a fisheye. DataError for others."""
    if flag not in (None, False, True):
        raise DataError(f"{where}: is_fisheye: expected true or false, found {str(flag)[:60]!r}")
    if model is None:
        return bool(flag)
    if not isinstance(model, str) or model.upper() not in MODELS:
        raise DataError(
            f"{where}: camera_model: expected one of {', '.join(MODELS)}, found {model!r}; undistort the images first"
        )
    return MODELS[model.upper()] or bool(flag)


def lens_of(
    K: np.ndarray,
    coefficients: Mapping[str, float],
    width: int,
    height: int,
    *,
    fisheye: bool,
    where: str,
) -> Lens | None:
    """The lens of a camera with K (3, 3) [px, pixel centres at half integers] and images of width x height px; None: a pinhole.

    The pinhole camera's view is the largest rectangle that the lens shows in full, so that all its pixels are seen ones (but for
    a fisheye's corners): its K differs from the lens'. Errors: DataError beginning with `where` for coefficients that fold the
    image or belong to another model."""
    k1, k2, k3, k4, p1, p2 = (float(coefficients.get(name, 0.0)) for name in COEFFICIENTS)
    if not fisheye and not any((k1, k2, k3, k4, p1, p2)):
        return None
    size, centres = (width, height), np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    K = np.asarray(K, dtype=np.float64) - centres
    if fisheye:
        if p1 or p2:
            raise DataError(
                f"{where}: a fisheye has no p1, p2: expected k1 to k4 only, found {p1:g}, {p2:g}"
            )
        D = np.array([k1, k2, k3, k4])
        pinhole = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
            K, D, size, np.eye(3), balance=0.0
        )
        build = cv2.fisheye.initUndistortRectifyMap
    else:
        if k4:
            raise DataError(
                f"{where}: k4 = {k4:g}: programs disagree on its meaning without camera_model OPENCV_FISHEYE; "
                "expected k1, k2, k3, p1, p2; undistort the images first"
            )
        D = np.array([k1, k2, p1, p2, k3])
        pinhole, _ = cv2.getOptimalNewCameraMatrix(K, D, size, 0.0)
        build = cv2.initUndistortRectifyMap
    focal = np.array([pinhole[0, 0] / K[0, 0], pinhole[1, 1] / K[1, 1]])
    places = None
    if np.isfinite(pinhole).all() and (focal > 1 / ZOOM).all() and (focal < ZOOM).all():
        places = np.stack(build(K, D, np.eye(3), pinhole, size, cv2.CV_32FC1), -1)
    if places is None or folded(places):
        written = ", ".join(
            f"{name} = {coefficients[name]:g}" for name in COEFFICIENTS if coefficients.get(name)
        )
        raise DataError(
            f"{where}: the lens distortion {written or '(fisheye)'} cannot be undone over the whole image: expected "
            "coefficients of normalised coordinates, in OpenCV's model; correct them, or undistort the images"
        )
    return Lens(pinhole + centres, places, inside(places))


def folded(places: np.ndarray) -> bool:
    """Whether a map (H, W, 2) turns over or is not finite anywhere: no lens shows one point twice."""
    if not np.isfinite(places).all():
        return True
    down, right = np.gradient(places.astype(np.float64), axis=(0, 1))
    return bool((right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0] <= 0).any())


def inside(places: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels of the lens' image within the outline of what is shown of it."""
    outline = np.concatenate([places[0], places[1:, -1], places[-1, -2::-1], places[-2:0:-1, 0]])
    shown = np.zeros(places.shape[:2], np.uint8)
    cv2.fillPoly(shown, [np.round(outline).astype(np.int32)], 1)
    return shown > 0

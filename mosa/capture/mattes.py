"""Mattes of phone footage, from plates or from mask videos of another program, and the outlines that follow from them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mosa.capture.videos import Clip, find_videos, frames_of, open_clip, plate_of
from mosa.data.checks.cameras import HOLE
from mosa.data.images.matting import SPECK, matte_from_plate
from mosa.data.images.reading import fill_holes
from mosa.errors import ConfigError, DataError

DARK = 0.1  # plate values below say nothing about the exposure
SMALLEST = 30  # pixels of an object below which its centre is not a number to fit a fall to

Matting = Callable[[int, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""(number of the frame, its picture (H, W, 3) in [0, 1]) -> straight colour (H, W, 3), matte (H, W)."""


@dataclass(frozen=True)
class Track:
    """What one phone sees of the object. times: (T,) [s] of its own clock; centres: (T, 2) [px] of the matte, NaN where no whole
    object is seen; radii: (T,) [px] of a disc of as many pixels; masks: per frame first column and row [px] and a part (h, w) of
    bools, or None."""

    clip: Clip
    times: np.ndarray
    centres: np.ndarray
    radii: np.ndarray
    masks: tuple[tuple[int, int, np.ndarray] | None, ...] = ()

    @property
    def seen(self) -> np.ndarray:
        """(T,) bool: frames with a whole object."""
        return np.isfinite(self.centres[:, 0])

    def shows(self, frame: int, pixels: np.ndarray) -> np.ndarray:
        """(N,) bool: whether the object covers pixels (N, 2) in a frame."""
        x0, y0, part = self.masks[frame]
        column, row = np.floor(pixels).astype(int).T - np.array([[x0], [y0]])
        inside = (column >= 0) & (column < part.shape[1]) & (row >= 0) & (row < part.shape[0])
        row, column = np.clip(row, 0, part.shape[0] - 1), np.clip(column, 0, part.shape[1] - 1)
        return inside & part[row, column]


def matting_of(
    kind: str, clip: Clip, plates: Path | None, plate_seconds, masks: str | None
) -> Matting:
    """How the frames of a clip are matted. kind: plates | masks. Errors: ConfigError, DataError."""
    if kind == "plates":
        plate = plate_of(plates, clip, plate_seconds)
        return lambda i, picture: matte_from_plate(same_exposure(picture, plate), plate)
    if masks is None:
        raise ConfigError(
            "masks: expected the folder of mask videos, found none; or choose mattes=plates"
        )
    return from_videos(Path(masks), clip)


def same_exposure(picture: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """A picture with the plate's exposure and white balance, which phones change as something comes into sight: each channel by
    the median of what it is over the plate's. That is the background's as long as it fills more than half of the picture."""
    gains = []
    for channel in range(3):
        small, behind = picture[::4, ::4, channel], plate[::4, ::4, channel]
        bright = behind > DARK
        gains.append(float(np.median(small[bright] / behind[bright])) if bright.any() else 1.0)
    return np.clip(picture / np.maximum(gains, 0.1), 0, 1).astype(np.float32)


def from_videos(folder: Path, clip: Clip) -> Matting:
    """Masks of another program, one video per phone of as many frames, white where the object is. Errors: DataError."""
    named = {file.stem: file for file in find_videos(folder)}
    if clip.path.stem not in named:
        raise DataError(
            f"{folder}: expected a mask video named {clip.path.stem}, found {list(named)}"
        )
    other = open_clip(named[clip.path.stem])
    if len(other.times) != len(clip.times) or other.size != clip.size:
        raise DataError(
            f"{other.path}: expected {len(clip.times)} frames of {clip.size[0]}x{clip.size[1]} px "
            f"as {clip.path}, found {len(other.times)} of {other.size[0]}x{other.size[1]}"
        )
    source: Iterator[tuple[int, np.ndarray]] | None = None
    at = -1

    def matted(i: int, picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        nonlocal source, at
        if source is None or i <= at:
            source = frames_of(other, i)
        at, mask = next(found for found in source if found[0] == i)
        # a compressed mask is never quite black or white
        return picture, np.clip((mask[..., 0].astype(np.float32) / 255 - 0.1) / 0.8, 0, 1)

    return matted


def whole_object(matte: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
    """A matte (H, W) of nothing but the object: the largest piece that does not touch the picture's border, with pieces of it that
    lie beside; all zero without one. Hands and threads that reach into the picture touch the border, and as long as they hold the
    object it is no whole one. near: centre (2,) [px] of the frame before, where the piece is the nearest large one."""
    _, labels, stats, centroids = cv2.connectedComponentsWithStats((matte > 0.5).astype(np.uint8))
    height, width = matte.shape
    x, y, w, h, area = stats.T
    inside = (x > 0) & (y > 0) & (x + w < width) & (y + h < height) & (area >= SMALLEST)
    inside[0] = False
    if not inside.any():
        return np.zeros_like(matte)
    large = np.where(inside, area, 0)
    best = int(large.argmax())
    if near is not None:
        candidates = np.flatnonzero(large >= 0.3 * large.max())
        best = int(candidates[np.linalg.norm(centroids[candidates] - near, axis=1).argmin()])
    reach = np.sqrt(area[best] / np.pi)
    beside = np.linalg.norm(centroids - centroids[best], axis=1) < 2 * reach
    kept = inside & (area >= SPECK * area[best]) & beside
    kept[best] = True
    around = cv2.dilate(kept[labels].astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return fill_holes(np.where(around, matte, 0).astype(np.float32), int(HOLE * area[best]))


def centre_of(matte: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre (2,) [px, pixel centres at half integers] of a matte by its coverage, NaN of an empty one, and radius [px]."""
    total = float(matte.sum())
    if total < SMALLEST:
        return np.full(2, np.nan), 0.0
    height, width = matte.shape
    x = float(matte.sum(0) @ (np.arange(width) + 0.5)) / total
    y = float(matte.sum(1) @ (np.arange(height) + 0.5)) / total
    return np.array([x, y]), float(np.sqrt(total / np.pi))


def matted_frames(
    clip: Clip, matting: Matting, first: int = 0, last: int | None = None
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """(number, straight colour (H, W, 3), matte (H, W) of the whole object) of the frames first to last."""
    near = None
    for i, picture in frames_of(clip, first, last):
        color, matte = matting(i, picture.astype(np.float32) / 255)
        matte = whole_object(matte, near)
        found, _ = centre_of(matte)
        near = found - 0.5 if np.isfinite(found[0]) else near
        yield i, color, matte


def follow(clip: Clip, matting: Matting, progress: Callable[[], None] = lambda: None) -> Track:
    """Centres, radii and masks in all frames of a clip."""
    centres, radii = np.full((len(clip.times), 2), np.nan), np.zeros(len(clip.times))
    masks: list[tuple[int, int, np.ndarray] | None] = [None] * len(clip.times)
    for i, _, matte in matted_frames(clip, matting):
        centres[i], radii[i] = centre_of(matte)
        if np.isfinite(centres[i, 0]):
            x0, y0, w, h = cv2.boundingRect((matte > 0.5).astype(np.uint8))
            masks[i] = x0, y0, matte[y0 : y0 + h, x0 : x0 + w] > 0.5
        progress()
    return Track(clip, clip.times, centres, radii, tuple(masks))

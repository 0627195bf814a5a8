"""Pictures of fixed cameras, a file for each camera and frame, as images on white and mattes of one size."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from mosa.data.formats.footage import WHITE, scaled
from mosa.data.images.lens import Lens
from mosa.data.images.reading import (
    check_amount,
    composite,
    expect_size,
    faintless,
    fill_holes,
    matte_of,
    read_image,
    resize,
    scaled_size,
    warn_of_turned,
)
from mosa.errors import DataError

CUT = 1e-3
"""Share of a matte that undoing a lens may cut off before it is said."""
Calibration = Mapping[str, tuple[np.ndarray, np.ndarray]]
"""Camera name -> K (3, 3) [px], w2c (4, 4) in OpenCV axes."""


def read_views(
    calibration: Calibration,
    frames: Sequence[int],
    file: Callable[[str, int], Path],
    split: Callable[[str, Path, np.ndarray], tuple[np.ndarray, np.ndarray]],
    listing: str,
    *,
    scale: float = 1.0,
    fill: int = 0,
    bent: Callable[[str, int, int], tuple[np.ndarray, Lens | None]] | None = None,
) -> tuple[dict[str, tuple[np.ndarray, np.ndarray]], list[np.ndarray], list[np.ndarray]]:
    """(calibration of the scaled images, (T, h, w, 3) images on white, (T, h, w) mattes), cameras in the order of `calibration`.

    file: of a camera and frame; split: colour (H, W, 3) and matte (H, W) of a camera's file and its pixels; listing: name of the
    file that lists the cameras; scale: of the images, in (0, 1]; fill: holes of mattes up to this many pixels are covered; bent: of
    a camera and its images' width and height, K and the lens that is undone, in place of the calibration's K.
    Errors: DataError naming a file that is missing, damaged or of another size, ConfigError for the scale."""
    images, mattes, scaled_calibration = [], [], {}
    for camera, (K, w2c) in calibration.items():
        rows, full, lens, cut = [], None, None, 0.0
        for frame in frames:
            pixels = read_image(path := file(camera, frame))
            if full is None:
                warn_of_turned(path)
                full, first = pixels.shape[1::-1], path.name
                size = scaled_size(*full, scale)
                check_amount(len(calibration) * len(frames), *size)
                K, lens = (K, None) if bent is None else bent(camera, *full)
                scaled_calibration[camera] = scaled(K, full, size), w2c
            expect_size(path, pixels, *full, reason=f"as {first} of the same camera")
            color, matte = split(camera, path, pixels)
            matte = fill_holes(matte, fill)
            picture = composite(color, matte, WHITE)
            if lens is not None:
                cut = max(cut, lens.lost(matte))
                picture, matte = lens.straighten(picture, matte, WHITE)
            rows.append((resize(picture, *size), resize(matte, *size)))
        if cut > CUT:
            warnings.warn(
                f"{listing}: camera {camera}: undoing its lens distortion cuts off up to {cut:.1%} of the object, too close "
                "to the border of the image",
                stacklevel=3,
            )
        images.append(np.stack([r[0] for r in rows]))
        mattes.append(np.stack([r[1] for r in rows]))
    return scaled_calibration, images, mattes


def split_alpha(path: Path, pixels: np.ndarray, more: str = "") -> tuple[np.ndarray, np.ndarray]:
    """Colour (H, W, 3) and matte (H, W) of RGBA with the matte as alpha; more: what else would do. Errors: DataError for other
    channels, a faint matte."""
    if pixels.shape[2] != 4:
        raise DataError(
            f"{path}: expected RGBA with the matte as alpha{more}, found {pixels.shape[2]} channels"
        )
    return pixels[..., :3], faintless(path, np.ascontiguousarray(pixels[..., 3]))


def split_mask(picture: Path, pixels: np.ndarray, mask: Path) -> tuple[np.ndarray, np.ndarray]:
    """Colour (H, W, 3) of a picture's pixels and matte (H, W) of its mask, white = object. Errors: DataError."""
    found = read_image(mask)
    expect_size(mask, found, *pixels.shape[1::-1], reason=f"as {picture.name}")
    return three_channels(pixels), matte_of(mask, found)


def three_channels(pixels: np.ndarray) -> np.ndarray:
    """Colour (H, W, 3) of a picture of 1, 3 or 4 channels."""
    return np.ascontiguousarray(np.broadcast_to(pixels[..., :3], (*pixels.shape[:2], 3)))

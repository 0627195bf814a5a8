"""Reading footage: image files to float RGB and mattes, composited on one colour, brought to the wanted size."""

from __future__ import annotations

from pathlib import Path

import cv2
import imageio.v3 as iio
import numpy as np

from mosa.errors import ConfigError, DataError


def read_image(path: Path) -> np.ndarray:
    """Pixels of an image file, (H, W, C) float32 in [0, 1], C = 1, 3 or 4.

    Errors: DataError where the file is missing, truncated, no image, or holds values that are not finite.
    """
    if not path.is_file():
        raise DataError(f"{path}: image not found")
    try:
        pixels = np.asarray(iio.imread(path, plugin="pillow"))
    except (OSError, SyntaxError, ValueError, RuntimeError) as error:
        raise DataError(
            f"{path}: expected a readable image, found a damaged one ({error}); copy or export it again"
        ) from error
    if pixels.dtype == np.uint8:
        pixels = pixels.astype(np.float32) / 255
    elif pixels.dtype == np.uint16:
        pixels = pixels.astype(np.float32) / 65535
    elif np.issubdtype(pixels.dtype, np.floating) or pixels.dtype == bool:
        pixels = pixels.astype(np.float32)
    else:
        raise DataError(f"{path}: expected 8 or 16 bits per channel or floating point, found {pixels.dtype}")
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 3, 4):
        raise DataError(f"{path}: expected a picture with 1, 3 or 4 channels, found an array of shape {pixels.shape}")
    if not np.isfinite(pixels).all():
        raise DataError(
            f"{path}: expected finite pixels, found {int((~np.isfinite(pixels)).sum())} that are NaN or infinite"
        )
    return np.clip(pixels, 0, 1)


def expect_size(path: Path, pixels: np.ndarray, width: int, height: int, reason: str) -> None:
    """DataError where an image is not width x height [px]; `reason` says where the expected size comes from."""
    if pixels.shape[:2] != (height, width):
        raise DataError(
            f"{path}: expected {width}x{height} px ({reason}), found {pixels.shape[1]}x{pixels.shape[0]}; "
            "all images of a scene need one size"
        )


def composite(color: np.ndarray, matte: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Straight (not premultiplied) colour (H, W, 3) with matte (H, W) in front of a background colour (3,)."""
    return color * matte[..., None] + (1 - matte[..., None]) * background


def scaled_size(width: int, height: int, scale: float) -> tuple[int, int]:
    """Size [px] of a scaled image. Errors: ConfigError for a scale outside (0, 1] or one that leaves under 16 px."""
    if not 0 < scale <= 1:
        raise ConfigError(f"scene.scale: expected a number in (0, 1], found {scale}")
    size = round(width * scale), round(height * scale)
    if min(size) < 16:
        raise ConfigError(
            f"scene.scale: {scale} leaves {size[0]}x{size[1]} px of {width}x{height}; at least 16 px are needed"
        )
    return size


def resize(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """Area average (H, W, C) or (H, W) to width x height: no aliasing, and mattes stay coverages."""
    if pixels.shape[:2] == (height, width):
        return pixels
    return cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)

"""Reading footage: image files to float RGB and mattes, composited on one colour, brought to the wanted size."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from annotated_types import Gt, Le
from PIL import ExifTags, Image

from mosa.errors import ConfigError, DataError
from mosa.settings import Whole, check
from mosa.system.limits import counted
from mosa.system.ply import named

MOST_PIXELS = 2**26  # of one picture: twice an 8K frame


def read_image(path: Path) -> np.ndarray:
    """Pixels of an image file, (H, W, C) float32 in [0, 1], C = 1, 3 or 4.

    Palettes become colours, with an alpha channel where an entry is transparent, grey with alpha becomes RGBA, and 16-bit
    PNGs keep their 16 bits. Errors: DataError where the file is missing, truncated, no image, or holds values that are not finite.
    """
    if not path.is_file():
        raise DataError(f"{path}: image not found; restore it, or restrict scene.frames")
    try:
        check_pixels(path)
        pixels = deep_png(path)
        if pixels is None:
            with Image.open(path) as picture:
                pixels = np.asarray(picture.convert(plain_mode(picture)))
    except (OSError, SyntaxError, ValueError, RuntimeError, Image.DecompressionBombError) as error:
        raise DataError(
            f"{path}: expected a readable image, found {named(path)} ({error})"
        ) from error
    kind = pixels.dtype.newbyteorder("=")  # big-endian in TIFF files of ImageJ
    if kind not in (np.uint8, np.uint16, bool) and not np.issubdtype(kind, np.floating):
        raise DataError(
            f"{path}: expected 8 or 16 bits per channel or floating point, found {kind}"
        )
    most = np.iinfo(kind).max if np.issubdtype(kind, np.integer) else 1
    pixels = pixels.astype(np.float32) / most
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 3, 4):
        wanted = "a picture with 1, 3 or 4 channels"
        raise DataError(f"{path}: expected {wanted}, found an array of shape {pixels.shape}")
    if not np.isfinite(pixels).all():
        found = int((~np.isfinite(pixels)).sum())
        raise DataError(f"{path}: expected finite pixels, found {found} that are NaN or infinite")
    if (brightest := float(pixels.max(initial=0))) > OVER:
        raise DataError(
            f"{path}: expected floating point from 0 to 1, found up to {brightest:.4g}: write 8 or 16 bits per channel"
        )
    return np.clip(pixels, 0, 1)


OVER = 2.0  # of floating point: an overshoot of 1 is cut off, 255 is another scale
FAINT = 0.5
"""Of a matte that has anything in it at least. Labels are numbers from 1 on, of 255; and a pixel belongs to the object from half
coverage on, so that one which is fainter everywhere would be an empty one in all that looks at outlines."""
SLIVER = 50  # pixels that may all be so faint: the edge of an object leaving the picture
GREY = 8 / 255  # by which the channels of a grey mask differ at most, which JPEG may have written


def matte_of(path: Path, pixels: np.ndarray) -> np.ndarray:
    """(H, W) of a mask's pixels, white = object. Errors: DataError for colours, whose first channel would be taken for it, for an
    alpha channel beside them, and for labels of 1, 2, ..., which are nearly black."""
    if pixels.shape[2] == 4 and float(np.ptp(pixels[..., 3])) > GREY:
        raise DataError(
            f"{path}: expected a grey mask, white = object, found an alpha channel that differs over the picture; "
            "write it as the mask, or leave mask_path out where the image itself has that alpha"
        )
    channels = pixels[..., : min(3, pixels.shape[2])]
    if float(np.ptp(channels, axis=-1).max()) > GREY:
        raise DataError(
            f"{path}: expected a grey mask, white = object, found colours (a label's palette, or the picture itself); "
            "write white where the object is"
        )
    return faintless(path, np.ascontiguousarray(pixels[..., 0]))


def faintless(path: Path, matte: np.ndarray) -> np.ndarray:
    """The matte. Errors: DataError where all of it that is not empty is below half coverage."""
    most = float(matte.max())
    if most < FAINT and int((matte > 0).sum()) > SLIVER:
        raise DataError(
            f"{path}: expected a matte that is white (255) where the object is, found {255 * most:.3g} at most: the "
            "number of a label, or a matte that is half transparent? write 255 in its place"
        )
    return matte


def check_pixels(path: Path) -> None:
    """The header says how large a picture is, and of how many, before any of it is decoded. Errors: DataError."""
    with Image.open(path) as picture:
        width, height = picture.size
        # pages of a TIFF are small copies too, and the second picture of a phone's JPEG is its preview
        several = getattr(picture, "n_frames", 1) if picture.format in ("PNG", "GIF", "WEBP") else 1
    if several > 1:
        raise DataError(f"{path}: expected one picture, found an animation of {several}")
    if width * height > MOST_PIXELS:
        most = f"at most {MOST_PIXELS / 1e6:.0f} million pixels"
        raise DataError(f"{path}: expected {most}, found {width}x{height}: scale it down")


def warn_of_turned(path: Path) -> None:
    """A warning where a photograph asks to be shown turned or mirrored: programs that make poses and masks differ in doing so."""
    with Image.open(path) as picture:
        # a PNG would be decoded for it once more
        turned = (
            1 if picture.format == "PNG" else picture.getexif().get(ExifTags.Base.Orientation, 1)
        )
    if turned not in (0, 1):
        warnings.warn(
            f"{path}: expected pixels that are stored upright, found EXIF orientation {turned}: they are read as stored, in which "
            "pose, intrinsics and mask have to agree; otherwise write the pictures upright (mogrify -auto-orient)",
            stacklevel=4,
        )


def check_amount(pictures: int, width: int, height: int) -> None:
    """Errors: ConfigError where that many pictures with mattes, of that size, do not fit into this machine's memory."""
    # colours and matte in single precision, and once more while they are put together
    where, remedy = "scene.scale: pixels of all pictures", "lower it, or restrict scene.frames"
    counted(where, (pictures, width, height), remedy, each=16)


def plain_mode(picture: Image.Image) -> str:
    """The mode without palette, with straight alpha where there is transparency, that holds a picture."""
    if picture.mode in ("PA", "LA", "La", "RGBa") or "transparency" in picture.info:
        return "RGBA"
    return "RGB" if picture.mode in ("P", "CMYK", "YCbCr", "LAB", "HSV") else picture.mode


def deep_png(path: Path) -> np.ndarray | None:
    """Pixels of a colour PNG with 16 bits per channel, which Pillow would cut to 8; None for any other file."""
    with path.open("rb") as file:
        header = file.read(26)
    if header[:8] != b"\x89PNG\r\n\x1a\n" or header[24:26] not in (b"\x10\x02", b"\x10\x06"):
        return None
    with Image.open(path) as picture:
        picture.load()  # OpenCV fills the rest of a truncated file with black, Pillow says so
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise OSError("OpenCV cannot decode it")
    return cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA if pixels.shape[2] == 4 else cv2.COLOR_BGR2RGB)


def fill_holes(matte: np.ndarray, largest: int) -> np.ndarray:
    """A matte (H, W) whose enclosed holes of at most `largest` pixels are covered; 0 leaves it as it is.

    Errors: ConfigError for a size that is none."""
    check("scene.fill_holes", largest, Whole)
    if largest == 0:
        return matte
    labels, areas = enclosed_holes(matte)
    return np.where(((areas > 0) & (areas <= largest))[labels], np.float32(1), matte)


def enclosed_holes(matte: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Labels (H, W) of the pieces of a matte (H, W) below half coverage, and the area (n,) [px] of each label: 0 of what is covered
    and of pieces that reach the border."""
    below = (matte < 0.5).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(below, connectivity=4)
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    areas[np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])] = 0
    return labels, areas


def expect_size(path: Path, pixels: np.ndarray, width: int, height: int, reason: str) -> None:
    """DataError where an image is not width x height [px]; `reason` says where the expected size comes from."""
    if pixels.shape[:2] != (height, width):
        raise DataError(
            f"{path}: expected {width}x{height} px ({reason}), found {pixels.shape[1]}x{pixels.shape[0]}; "
            "all images of a camera need one size"
        )


def composite(color: np.ndarray, matte: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Straight (not premultiplied) colour (H, W, 3) with matte (H, W) in front of a background colour (3,)."""
    return color * matte[..., None] + (1 - matte[..., None]) * background


def scaled_size(width: int, height: int, scale: float) -> tuple[int, int]:
    """Size [px] of a scaled image. Errors: ConfigError for a scale outside (0, 1] or one that leaves under 16 px."""
    check("scene.scale", scale, Annotated[float, Gt(0), Le(1)])
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

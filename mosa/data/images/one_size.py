"""Cameras whose images differ in size, brought to images of one size without a change of what they say.

Images of many more pixels than the smallest are reduced to as many (area average), so that a pixel shows about as much of the
object in all of them; what is then narrower or lower than another is surrounded by background and an empty matte. That is no guess:
a camera that sees the whole object says that it is nowhere else. Where the object runs over a border the image says nothing about
what lies beyond, so such a border stays a border of the larger image, at which `mosa.data.hull` and `mosa.data.checks.cameras`
look for objects that are cut."""

from __future__ import annotations

import logging

import numpy as np

from mosa.data.images.reading import resize
from mosa.errors import DataError

log = logging.getLogger(__name__)

FINER = 1.5  # times as many pixels as the smallest image above which one is reduced


def one_size(
    K: np.ndarray,
    images: list[np.ndarray],
    mattes: list[np.ndarray],
    *,
    background: np.ndarray,
    names: list[str],
    where: str,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """K (V, 3, 3) [px], images (V, T, H, W, 3) and mattes (V, T, H, W) of one size.

    K: (V, 3, 3) [px], pixel centres at half integers; images, mattes: per camera (T, h, w, 3) and (T, h, w); background: colour
    (3,). Errors: DataError, beginning with `where`, for a camera that would have to be surrounded where its object is cut.
    """
    sizes = [matte.shape[1:] for matte in mattes]
    K = np.array(K, dtype=np.float64)
    if len(set(sizes)) > 1:
        fewest = min(height * width for height, width in sizes)
        for v, (images_, mattes_) in enumerate(zip(images, mattes)):
            height, width = sizes[v]
            factor = (fewest / (height * width)) ** 0.5
            factor = factor if factor**2 < 1 / FINER else 1.0
            size = round(width * factor), round(height * factor)
            images[v] = np.stack([resize(image, *size) for image in images_])
            mattes[v] = np.stack([resize(matte, *size) for matte in mattes_])
            K[v, 0] *= size[0] / width
            K[v, 1] *= size[1] / height
        height, width = (max(matte.shape[axis] for matte in mattes) for axis in (1, 2))
        for v, name in enumerate(names):
            size = height, width
            down, right = start = place(mattes[v], size, f"{where}: camera {name}")
            images[v], mattes[v] = surround(images[v], mattes[v], size, start, background)
            K[v, 0, 2] += right
            K[v, 1, 2] += down
        said = ", ".join(f"{name} {w}x{h}" for name, (h, w) in zip(names, sizes))
        log.info("%s: images of %s px, brought to %dx%d px", where, said, width, height)
    return K, np.stack(images), np.stack(mattes)


def place(mattes: np.ndarray, size: tuple[int, int], label: str) -> tuple[int, int]:
    """Row and column of a larger image, (height, width) `size`, where mattes (T, h, w) begin: in the middle, or at the border over
    which the object runs. Errors: DataError where it runs over both borders of an axis that has to grow."""
    start = []
    for axis, wanted in enumerate(size, 1):
        room = wanted - mattes.shape[axis]
        low, high = (bool((mattes.take(end, axis) > 0.5).any()) for end in (0, -1))
        if room and low and high:
            sides, extent = (
                (("top", "bottom"), "height") if axis == 1 else (("left", "right"), "width")
            )
            raise DataError(
                f"{label}: expected images of the other cameras' size, or the object within the {sides[0]} or the {sides[1]} "
                "border of these smaller ones, found it cut by both: cut the images of all cameras to one "
                f"{extent}, or leave this camera out"
            )
        start.append(0 if low else room if high else room // 2)
    return start[0], start[1]


def surround(
    images: np.ndarray, mattes: np.ndarray, size: tuple[int, int], start: tuple[int, int], background: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Images (T, h, w, 3) and mattes (T, h, w) as parts, from row and column `start`, of (height, width) `size` images."""
    frames, height, width = mattes.shape
    if (height, width) == size:
        return images, mattes
    window = slice(None), slice(start[0], start[0] + height), slice(start[1], start[1] + width)
    larger = np.empty((frames, *size, 3), np.float32)
    larger[:] = background
    larger[window] = images
    empty = np.zeros((frames, *size), np.float32)
    empty[window] = mattes
    return larger, empty

"""Pictures and videos of a run."""

from __future__ import annotations

import errno
from collections.abc import Mapping
from pathlib import Path

import cv2
import imageio.v2 as imageio
import numpy as np
from torch import Tensor

from mosa.errors import ConfigError
from mosa.system.whole_files import written_whole


def ffmpeg(key: str) -> str:
    """Path of the program that writes the video which `key` asks for. Errors: ConfigError where there is none."""
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise ConfigError(
            f"{key}: expected false, or an ffmpeg to write it with (set IMAGEIO_FFMPEG_EXE, or install "
            f"imageio-ffmpeg), found none ({' '.join(str(error).split())[:200]})"
        ) from error


def to_uint8(image: Tensor | np.ndarray) -> np.ndarray:
    """(H, W, 3) float in [0, 1] to uint8; what is that already stays."""
    if isinstance(image, np.ndarray):
        return image
    return (image.clamp(0, 1).numpy() * 255 + 0.5).astype(np.uint8)


FONT, SIZE, SMALLEST, LEFT = cv2.FONT_HERSHEY_SIMPLEX, 0.48, 0.3, 6
"""Of captions: the letters, their usual and their smallest scale, and the pixels left of them."""


def text_width(text: str, scale: float) -> int:
    """[px] of a caption."""
    return cv2.getTextSize(text, FONT, scale, 1)[0][0]


def fitted(text: str, room: int, usual: float = SIZE) -> tuple[str, float]:
    """A caption and its scale, of at most `room` [px]: smaller than `usual` where that suffices, else cut with dots at the end."""
    scale = min(usual, max(SMALLEST, usual * room / max(1, text_width(text, usual))))
    kept = text
    while kept and text_width(text, scale) > room:
        kept = kept[:-1]
        text = kept.rstrip() + "..."
    return text, scale


def bar(width: int, texts: list[str], height: int = 26) -> np.ndarray:
    """A caption bar, with the texts at equal distances, each within its share of the width."""
    picture = np.full((height, width, 3), 245, np.uint8)
    for k, text in enumerate(texts):
        shown, scale = fitted(text, width // len(texts) - 2 * LEFT)
        place = (LEFT + k * width // len(texts), height - 8)
        cv2.putText(picture, shown, place, FONT, scale, (30, 30, 30), 1, cv2.LINE_AA)
    return picture


def label(image: np.ndarray, text: str) -> np.ndarray:
    """The image under a caption bar."""
    return np.concatenate([bar(image.shape[1], [text]), image])


Images = Mapping[str, Tensor | np.ndarray]  # name -> (T, H, W, 3), float in [0, 1] or uint8


def side_by_side(
    columns: Images, *, below: Images | None = None, footer: list[str] | None = None
) -> list[np.ndarray]:
    """Frames with the columns beside each other. below: a second row, of as many; footer: a text under each frame."""
    frames = []
    for t in range(min(len(c) for c in columns.values())):
        shown = (row.items() for row in (columns, below) if row)
        named = ([label(to_uint8(images[t]), name) for name, images in row] for row in shown)
        rows = [np.concatenate(row, 1) for row in named]
        if footer is not None:
            rows.append(bar(rows[0].shape[1], [footer[t]]))
        frames.append(np.concatenate(rows))
    return frames


def write_video(path: str | Path, frames: list[np.ndarray], fps: float = 12.0) -> Path:
    """H.264 video; the size is padded to even numbers. Plays slower than real time where fps is below the capture's.

    Errors: ImportError or RuntimeError without an ffmpeg (`ffmpeg` says it before); OSError where that cannot write."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = frames[0].shape[:2]
    padding = ((0, height % 2), (0, width % 2), (0, 0))
    from imageio_ffmpeg import write_frames

    # imageio takes the kind of file from its name, which has it only once the file is whole
    size, options = (width + width % 2, height + height % 2), {"quality": 8, "macro_block_size": 2}
    with written_whole(path) as partial:
        writer = write_frames(
            str(partial), size, fps=fps, codec="libx264", output_params=["-f", "mp4"], **options
        )
        try:
            writer.send(None)
            for frame in frames:
                writer.send(np.pad(frame, padding, mode="edge").tobytes())
        except OSError as error:  # ffmpeg has ended, and what it said is its whole output
            raise OSError(errno.EIO, "ffmpeg has ended while it wrote", str(path)) from error
        finally:
            writer.close()
        # ffmpeg says nothing of it
        found = int(cv2.VideoCapture(str(partial)).get(cv2.CAP_PROP_FRAME_COUNT))
        if found != len(frames):
            said = f"{found} of {len(frames)} pictures are in it: is the disk full?"
            raise OSError(errno.EIO, said, str(path))
    return path


def write_strip(
    path: str | Path,
    columns: Images,
    frames: int = 6,
    *,
    notes: Mapping[str, list[str]] | None = None,
) -> np.ndarray:
    """PNG of about `frames` frames from left to right, one captioned row per entry of `columns`, whose sizes may differ. notes: of
    some rows, a text over each frame. Returns its pixels (H, W, 3) uint8."""
    notes = notes or {}
    count = min(len(c) for c in columns.values())
    chosen = np.unique(np.linspace(0, count - 1, frames).round().astype(int))
    rows = []
    for name, images in columns.items():
        row = np.concatenate([to_uint8(images[t]) for t in chosen], 1)
        if name in notes:
            row = np.concatenate([bar(row.shape[1], [notes[name][t] for t in chosen], 22), row])
        rows.append(label(row, name))
    width = max(row.shape[1] for row in rows)
    room = (((0, 0), (0, width - row.shape[1]), (0, 0)) for row in rows)
    rows = [np.pad(row, each, constant_values=255) for row, each in zip(rows, room)]
    picture = np.concatenate(rows)
    with written_whole(path) as partial:
        imageio.imwrite(partial, picture, format="PNG", compress_level=3)
    return picture

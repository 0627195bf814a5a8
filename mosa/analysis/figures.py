"""Pictures and videos of a run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import imageio.v2 as imageio
import numpy as np
from torch import Tensor


def to_uint8(image: Tensor | np.ndarray) -> np.ndarray:
    """(H, W, 3) float in [0, 1] to uint8; what is that already stays."""
    return image if isinstance(image, np.ndarray) else (image.clamp(0, 1).numpy() * 255 + 0.5).astype(np.uint8)


def bar(width: int, texts: list[str], height: int = 26) -> np.ndarray:
    """A caption bar, with the texts at equal distances."""
    picture = np.full((height, width, 3), 245, np.uint8)
    for k, text in enumerate(texts):
        place = (6 + k * width // len(texts), height - 8)
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.48, (30, 30, 30), 1, cv2.LINE_AA)
    return picture


def label(image: np.ndarray, text: str) -> np.ndarray:
    """The image under a caption bar."""
    return np.concatenate([bar(image.shape[1], [text]), image])


Images = Mapping[str, Tensor | np.ndarray]
"""Name -> (T, H, W, 3), float in [0, 1] or uint8."""


def side_by_side(columns: Images, *, below: Images | None = None, footer: list[str] | None = None) -> list[np.ndarray]:
    """Frames with the columns beside each other. below: a second row, of as many; footer: a text under each frame."""
    frames = []
    for t in range(min(len(c) for c in columns.values())):
        rows = [np.concatenate([label(to_uint8(images[t]), name) for name, images in row.items()], 1)
                for row in (columns, below) if row]
        if footer is not None:
            rows.append(bar(rows[0].shape[1], [footer[t]]))
        frames.append(np.concatenate(rows))
    return frames


def write_video(path: str | Path, frames: list[np.ndarray], fps: float = 12.0) -> Path:
    """H.264 video; the size is padded to even numbers. Plays slower than real time where fps is below the capture's."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = frames[0].shape[:2]
    padding = ((0, height % 2), (0, width % 2), (0, 0))
    with imageio.get_writer(path, fps=fps, codec="libx264", quality=8, macro_block_size=2) as writer:
        for frame in frames:
            writer.append_data(np.pad(frame, padding, mode="edge"))
    return path


def write_strip(path: str | Path, columns: Images, frames: int = 6, *, notes: Mapping[str, list[str]] | None = None) -> Path:
    """PNG of about `frames` frames from left to right, one captioned row per entry of `columns`, whose sizes may differ. notes: of
    some rows, a text over each frame."""
    path, notes = Path(path), notes or {}
    count = min(len(c) for c in columns.values())
    chosen = np.unique(np.linspace(0, count - 1, frames).round().astype(int))
    rows = []
    for name, images in columns.items():
        row = np.concatenate([to_uint8(images[t]) for t in chosen], 1)
        if name in notes:
            row = np.concatenate([bar(row.shape[1], [notes[name][t] for t in chosen], 22), row])
        rows.append(label(row, name))
    width = max(row.shape[1] for row in rows)
    rows = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    imageio.imwrite(path, np.concatenate(rows))
    return path

"""Pictures and videos of a run."""

from __future__ import annotations

from pathlib import Path

import cv2
import imageio.v2 as imageio
import numpy as np
from torch import Tensor


def to_uint8(image: Tensor) -> np.ndarray:
    """(H, W, 3) float in [0, 1] to uint8."""
    return (image.clamp(0, 1).numpy() * 255 + 0.5).astype(np.uint8)


def label(image: np.ndarray, text: str) -> np.ndarray:
    """The image under a caption bar."""
    bar = np.full((26, image.shape[1], 3), 245, np.uint8)
    cv2.putText(bar, text, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.48, (30, 30, 30), 1, cv2.LINE_AA)
    return np.concatenate([bar, image])


def side_by_side(columns: dict[str, Tensor], enlarge: int = 1) -> list[np.ndarray]:
    """Frames with the columns beside each other: name -> (T, H, W, 3)."""
    frames = []
    for t in range(min(len(c) for c in columns.values())):
        parts = []
        for name, images in columns.items():
            image = to_uint8(images[t])
            if enlarge > 1:
                image = cv2.resize(image, None, fx=enlarge, fy=enlarge, interpolation=cv2.INTER_CUBIC)
            parts.append(label(image, name))
        frames.append(np.concatenate(parts, 1))
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


def write_strip(path: str | Path, columns: dict[str, Tensor], frames: int = 6, enlarge: int = 1) -> Path:
    """PNG of about `frames` frames from left to right, one captioned row per entry of `columns`: name -> (T, H, W, 3), sizes may
    differ."""
    path = Path(path)
    count = min(len(c) for c in columns.values())
    chosen = np.unique(np.linspace(0, count - 1, frames).round().astype(int))
    rows = []
    for name, images in columns.items():
        row = np.concatenate([to_uint8(images[t]) for t in chosen], 1)
        if enlarge > 1:
            row = cv2.resize(row, None, fx=enlarge, fy=enlarge, interpolation=cv2.INTER_CUBIC)
        rows.append(label(row, name))
    width = max(row.shape[1] for row in rows)
    rows = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    imageio.imwrite(path, np.concatenate(rows))
    return path

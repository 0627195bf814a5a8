"""What the reconstruction looks at: windows of one size that follow the object through the images of all views and frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from mosa.errors import DataError
from mosa.rendering.cameras import crop_cameras
from mosa.types import Cameras, Scene


@dataclass(frozen=True)
class Windows:
    """B windows. images: (B, h, w, 3); mattes: (B, h, w); cameras: B, shifted to their window; view, frame: (B,) long."""

    images: Tensor
    mattes: Tensor
    cameras: Cameras
    view: Tensor
    frame: Tensor

    def __len__(self) -> int:
        return len(self.images)

    def select(self, chosen: Tensor) -> Windows:
        """The windows at `chosen`, a long tensor of indices."""
        parts = self.images, self.mattes, self.view, self.frame
        at = chosen.to(self.images.device)
        images, mattes, view, frame = (part[at] for part in parts)
        return Windows(images, mattes, self.cameras.select(chosen.tolist()), view, frame)

    def draws(self, count: int, generator: torch.Generator) -> Iterator[Tensor]:
        """Indices of `count` windows at a time: all are drawn before one is again."""
        order = torch.empty(0, dtype=torch.long)
        while True:
            while len(order) < count:
                order = torch.cat([order, torch.randperm(len(self), generator=generator)])
            yield order[:count]
            order = order[count:]

    def of_frame(self, frame: int) -> Windows:
        return self.select((self.frame == frame).nonzero()[:, 0])

    def to(self, device: torch.device | str) -> Windows:
        return Windows(*(getattr(self, f.name).to(device) for f in fields(self)))

    def masked(self) -> Tensor:
        """Colours times matte, and the matte, (B, 4, h, w)."""
        matte = self.mattes[..., None]
        return torch.cat([self.images * matte, matte], -1).permute(0, 3, 1, 2)


def _extent(mattes: Tensor) -> tuple[Tensor, Tensor]:
    """First and last occupied index along the last axis of (B, n) flags."""
    n = mattes.shape[1]
    return mattes.float().argmax(1), n - 1 - mattes.flip(1).float().argmax(1)


def _overlap(start: int, size: int, limit: int) -> tuple[slice, slice]:
    """What a window of `size` px from `start` shows of an image of `limit` px: where in the image, where in the window."""
    low, high = max(start, 0), min(start + size, limit)
    return slice(low, high), slice(low - start, high - start)


def object_windows(
    scene: Scene, views: list[int], frames: list[int], *, margin: int = 6, multiple: int = 8
) -> Windows:
    """Windows around the mattes of the given views and frames, `margin` px wider on each side, sides a multiple of `multiple`.

    A window may reach beyond the image: there it shows the background and an empty matte.
    Raises DataError where a matte is empty."""
    mattes = scene.mattes[views][:, frames].flatten(0, 1)
    view = torch.tensor(views).repeat_interleave(len(frames))
    frame = torch.tensor(frames).repeat(len(views))
    occupied = mattes > 0.5
    for b in (~occupied.flatten(1).any(1)).nonzero()[:, 0].tolist():
        raise DataError(
            f"scene {scene.name}: the matte of camera {scene.cameras.names[view[b]]} at frame {int(frame[b])} is empty; the "
            "object has to be seen by every training camera at every training frame (else put the camera into "
            "scene.holdout_cameras)"
        )
    left, right = _extent(occupied.any(1))
    top, bottom = _extent(occupied.any(2))
    round_up = lambda n: -(-int(n) // multiple) * multiple  # noqa: E731
    width = round_up((right - left).max() + 1 + 2 * margin)
    height = round_up((bottom - top).max() + 1 + 2 * margin)
    x0 = (left + right + 1 - width) // 2
    y0 = (top + bottom + 1 - height) // 2
    images = scene.background.to(scene.images).expand(len(view), height, width, 3).contiguous()
    cut = mattes.new_zeros(len(view), height, width)
    for b, (v, t, x, y) in enumerate(zip(view.tolist(), frame.tolist(), x0.tolist(), y0.tolist())):
        rows, in_rows = _overlap(y, height, scene.cameras.height)
        columns, in_columns = _overlap(x, width, scene.cameras.width)
        images[b, in_rows, in_columns] = scene.images[v, t, rows, columns]
        cut[b, in_rows, in_columns] = mattes[b, rows, columns]
    cameras = crop_cameras(scene.cameras.select(view.tolist()), x0, y0, width, height)
    return Windows(images, cut, cameras, view, frame)

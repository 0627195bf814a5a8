"""What the reconstruction looks at: windows of one size that follow the object through the images of all views and frames."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from mosa.errors import DataError
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
        return Windows(
            self.images[chosen],
            self.mattes[chosen],
            self.cameras.select(chosen.tolist()),
            self.view[chosen],
            self.frame[chosen],
        )

    def of_frame(self, frame: int) -> Windows:
        return self.select((self.frame == frame).nonzero()[:, 0])

    def to(self, device: torch.device | str) -> Windows:
        return Windows(
            self.images.to(device), self.mattes.to(device), self.cameras.to(device), self.view.to(device), self.frame.to(device)
        )


def _extent(mattes: Tensor) -> tuple[Tensor, Tensor]:
    """First and last occupied index along the last axis of (B, n) flags."""
    n = mattes.shape[1]
    return mattes.float().argmax(1), n - 1 - mattes.flip(1).float().argmax(1)


def object_windows(scene: Scene, views: list[int], frames: list[int], *, margin: int = 6, multiple: int = 8) -> Windows:
    """Windows around the mattes of the given views and frames, `margin` px wider on each side, sides a multiple of `multiple`.

    A window may reach beyond the image: there it shows the background and an empty matte.
    Raises DataError where a matte is empty.
    """
    mattes = scene.mattes[views][:, frames].flatten(0, 1)
    images = scene.images[views][:, frames].flatten(0, 1)
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
    pad = max(width, height)
    mattes = F.pad(mattes, (pad, pad, pad, pad))
    images = torch.stack([F.pad(images[..., c], (pad, pad, pad, pad), value=float(scene.background[c])) for c in range(3)], -1)
    corners = list(enumerate(zip(x0.tolist(), y0.tolist())))

    def cut(padded: Tensor) -> Tensor:
        return torch.stack([padded[b, y + pad : y + pad + height, x + pad : x + pad + width] for b, (x, y) in corners])

    K = scene.cameras.K[view].clone()
    K[:, 0, 2] -= x0
    K[:, 1, 2] -= y0
    cameras = Cameras(K, scene.cameras.w2c[view], width, height, tuple(scene.cameras.names[v] for v in view.tolist()))
    return Windows(cut(images), cut(mattes), cameras, view, frame)

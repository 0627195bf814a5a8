"""Targets that a fit is compared with: images and mattes cropped to the object, with the flow maps of the reconstruction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mosa.rendering.cameras import crop_boxes, crop_cameras, crop_images
from mosa.rendering.observer import observe
from mosa.types import Cameras, MotionCues, Reconstruction, Scene


@dataclass(frozen=True)
class Observations:
    """Targets of V views and T frames: images (V, T, h, w, 3), mattes (V, T, h, w), flow (V, T - 1, h, w, 2) [px] or None where no
    cues tell it, cropped cameras. image_width [px]: of the pictures before they were cropped."""

    images: Tensor
    mattes: Tensor
    flow: Tensor | None
    cameras: Cameras
    image_width: int

    def select(self, views: Sequence[int], frames: int | None = None) -> Observations:
        """The given views and the first `frames` frames, all of them where None."""
        views, last = list(views), None if frames is None else frames - 1
        # all of them are the same memory
        chosen = slice(None) if views == list(range(len(self.cameras))) else views
        flow = None if self.flow is None else self.flow[chosen, :last]
        images, mattes = self.images[chosen, :frames], self.mattes[chosen, :frames]
        return Observations(images, mattes, flow, self.cameras.select(views), self.image_width)

    def to(self, device: torch.device | str) -> Observations:
        flow = None if self.flow is None else self.flow.to(device)
        images, mattes = self.images.to(device), self.mattes.to(device)
        return Observations(images, mattes, flow, self.cameras.to(device), self.image_width)


def cropped(scene: Scene, views: Sequence[int], frames: Sequence[int], margin: int) -> Observations:
    """Images and mattes of these cameras and frames, in one window per camera that holds its mattes and `margin` pixels."""
    views, frames = list(views), list(frames)
    images, mattes = scene.images[views][:, frames], scene.mattes[views][:, frames]
    x0, y0, width, height = crop_boxes(mattes, margin=margin)
    images, mattes = (crop_images(s, x0, y0, width, height, axis=2) for s in (images, mattes))
    cameras = crop_cameras(scene.cameras.select(views), x0, y0, width, height)
    return Observations(images, mattes, None, cameras, scene.cameras.width)


@torch.no_grad()
def training_observations(
    scene: Scene,
    reconstruction: Reconstruction,
    *,
    margin: int = 6,
    device: torch.device | str = "cpu",
) -> Observations:
    """Cropped images, mattes and cue flow of the cameras and frames that learning may read, on `device`."""
    frames = scene.training_frames
    if scene.markers is not None:
        none = scene.images[:, frames], scene.mattes[:, frames]
        return Observations(*none, None, scene.cameras, 1).to(device)
    found = cropped(scene, scene.training_cameras, frames, margin).to(device)
    cues, splats = reconstruction.cues, reconstruction.splats
    assert isinstance(cues, MotionCues)  # of a scene with images
    x, shapes = (p[: len(frames)].to(device) for p in (cues.positions, cues.covariances))
    opacities, colors = splats.opacities.to(device), splats.colors.to(device)
    cameras, behind = found.cameras, scene.background.to(device)
    flow = [observe(x, shapes, opacities, colors, cameras.select([v]), behind, flow=True).flow
            for v in range(len(cameras))]  # fmt: skip
    flows = torch.cat(flow)  # type: ignore[arg-type]  # each is there, as it was asked for
    return Observations(found.images, found.mattes, flows, found.cameras, found.image_width)

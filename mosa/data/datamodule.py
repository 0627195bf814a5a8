"""What a training step sees: some views of every frame, cropped to the mattes' box, with the flow maps of the reconstruction."""

from __future__ import annotations

from dataclasses import dataclass

import lightning as L
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from mosa.modules.observer import observe
from mosa.rendering.cameras import crop_boxes, crop_cameras, crop_images
from mosa.types import Cameras, Reconstruction, Scene


@dataclass(frozen=True)
class Observations:
    """Targets of V views: images (V, T, h, w, 3), mattes (V, T, h, w), flow (V, T - 1, h, w, 2) [px], cropped cameras."""

    images: Tensor
    mattes: Tensor
    flow: Tensor
    cameras: Cameras
    image_width: int

    def select(self, views: list[int], frames: int) -> Observations:
        """The given views and the first `frames` frames."""
        return Observations(self.images[views, :frames], self.mattes[views, :frames], self.flow[views, : frames - 1],
                            self.cameras.select(views), self.image_width)


@torch.no_grad()
def training_observations(scene: Scene, reconstruction: Reconstruction, *, margin: int = 6, device="cpu") -> Observations:
    """Cropped images, mattes and cue flow of the cameras and frames that learning may read, on `device`."""
    views, frames = scene.training_cameras, scene.training_frames
    images, mattes = scene.images[views][:, frames], scene.mattes[views][:, frames]
    cameras = scene.cameras.select(views)
    x0, y0, width, height = crop_boxes(mattes, margin=margin)
    cameras = crop_cameras(cameras, x0, y0, width, height).to(device)
    cues, splats = reconstruction.cues, reconstruction.splats
    flow = [
        observe(cues.positions[: len(frames)].to(device), cues.covariances[: len(frames)].to(device),
                splats.opacities.to(device), splats.colors.to(device), cameras.select([v]), scene.background.to(device),
                flow=True).flow
        for v in range(len(views))
    ]
    images, mattes = (crop_images(stack, x0, y0, width, height, axis=2).to(device) for stack in (images, mattes))
    return Observations(images, mattes, torch.cat(flow), cameras, scene.cameras.width)


class ViewSchedule(Dataset):
    """Item i: the views of step i. A pass over all views in random order, then the next: a function of (seed, i) alone, so that
    a resumed run sees what an uninterrupted one would."""

    def __init__(self, views: int, per_step: int, steps: int, seed: int) -> None:
        self.views, self.per_step, self.steps, self.seed = views, min(per_step, views), steps, seed

    def __len__(self) -> int:
        return self.steps

    def __getitem__(self, step: int) -> list[int]:
        chosen = []
        for k in range(step * self.per_step, (step + 1) * self.per_step):
            generator = torch.Generator().manual_seed(self.seed * 1_000_003 + k // self.views)
            chosen.append(int(torch.randperm(self.views, generator=generator)[k % self.views]))
        return chosen


class MultiViewDataModule(L.LightningDataModule):
    """Serves the view schedule, one step per epoch (so that a checkpoint never falls inside one); holds the observations."""

    def __init__(self, observations: Observations, *, views_per_step: int, steps: int, seed: int) -> None:
        super().__init__()
        self.observations = observations
        self.schedule = ViewSchedule(len(observations.cameras), views_per_step, steps, seed)

    def train_dataloader(self) -> DataLoader:
        step = self.trainer.lightning_module.steps_done
        return DataLoader([self.schedule[step]], batch_size=None, collate_fn=list)

"""The motion of known particles in a sequence: first from its images alone, then once more about what a simulation predicts."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from mosa.progress import tqdm
from mosa.reconstruction.cache import StageCache
from mosa.reconstruction.cues import gaussian_cues, neighbourhood, neighbourhood_cues
from mosa.reconstruction.dynamic import Motion, Scaffold, fit_motion
from mosa.reconstruction.hull import hull_centroid
from mosa.reconstruction.informed import informed_motion
from mosa.reconstruction.modes import deformation_modes
from mosa.reconstruction.motion import MotionSample
from mosa.reconstruction.observed import Windows, object_windows
from mosa.reconstruction.settings import ReconstructionSettings
from mosa.rendering.covariance import quaternion_to_matrix
from mosa.rendering.rasterizer import rasterize
from mosa.threads import threaded
from mosa.types import MotionCues, Reconstruction, Scene, Splats

log = logging.getLogger(__name__)


class MovingParts:
    """What a motion of particles is fitted with. Found when it is first asked for, and kept: the second look takes the first one's.

    splats: the particles at frame 0; static: Gaussians that carry their images; on the device of both fits.
    """

    def __init__(self, scene: Scene, splats: Splats, static: Splats, settings: ReconstructionSettings) -> None:
        self.scene, self.splats, self.static, self.settings = scene, splats, static, settings

    @cached_property
    def centres(self) -> Tensor:
        """(T, 3) [m] of the visual hulls of the training frames."""
        scene = self.scene
        views, frames = scene.training_cameras, scene.training_frames
        cameras = scene.cameras.select(views)
        found = list(threaded(lambda t: hull_centroid(scene.mattes[views, t], cameras, scene.box), frames))
        return torch.stack(found).to(self.splats.means)

    @cached_property
    def scaffold(self) -> Scaffold:
        """The particles, with the modes at them."""
        around = neighbourhood(self.splats.means, neighbours=self.settings.neighbours)
        return Scaffold(self.splats, deformation_modes(self.splats.means, around, count=self.settings.dynamic.modes), around)

    @cached_property
    def carried(self) -> Scaffold:
        """What is compared with the images."""
        if self.settings.dynamic.carriers != "static":
            return self.scaffold
        return Scaffold(self.static, self.scaffold.modes.at(self.static.means, self.splats.means))

    @property
    def reach(self) -> float:
        """Radius of the body [m]."""
        means = self.splats.means
        return float((means - means.mean(0)).norm(dim=1).max())

    def sample(self, motion: Motion) -> MotionSample:
        """The particles in all training frames."""
        frames = torch.arange(len(self.centres), device=self.splats.means.device)
        return motion(frames, self.splats, self.scaffold.modes, self.scaffold.around)


def first_motion(
    parts: MovingParts, windows: Windows, background: Tensor, seed: int, bar: Callable[[str, int], tqdm], cache: StageCache
) -> dict[str, Tensor]:
    """Positions, covariances and, where free, shapes of the particles in every training frame."""
    dynamic, splats = parts.settings.dynamic, parts.splats
    tracked = dynamic.track_iterations * (len(parts.centres) - 1) if dynamic.model == "modes" else 0
    with bar("motion", dynamic.iterations + tracked) as steps:
        motion = fit_motion(
            parts.scaffold, parts.carried, windows, parts.centres, background, dynamic, reach=parts.reach, seed=seed,
            progress=steps.update,
        )  # fmt: skip
    with torch.no_grad():
        sample = parts.sample(motion)
        rendered = rasterize(sample.positions, sample.covariances, splats.opacities, splats.colors[None], windows.cameras,
                             windows.frame, background)[0]  # fmt: skip
    cache.strip("motion", windows, rendered, columns=12)
    result = {"positions": sample.positions, "covariances": sample.covariances}
    if sample.scales is not None:
        result |= {"scales": sample.scales, "rotations": sample.rotations}
    return {name: value.cpu() for name, value in result.items()}


def cues_of(motion: dict[str, Tensor], splats: Splats, settings: ReconstructionSettings) -> MotionCues:
    """Cues of a reconstructed motion, relative to `splats`, where it starts."""
    if settings.cue == "gaussian":
        return gaussian_cues(motion["positions"], motion["covariances"], splats, motion["scales"], motion["rotations"])
    around = neighbourhood(splats.means, neighbours=settings.neighbours)
    return neighbourhood_cues(motion["positions"], motion["covariances"], around)


@dataclass(frozen=True)
class SecondLook:
    """The cues of a sequence once more, about what a simulation predicts (`informed`). Nothing is cached: the prediction is a run's
    own.

    reconstruction: of `scene`; seed: of the order in which views are drawn.
    """

    scene: Scene
    reconstruction: Reconstruction
    settings: ReconstructionSettings
    seed: int = 0
    device: torch.device | str = "cpu"
    progress: bool = True

    def about(self, predicted: Tensor, seen: Tensor | None = None) -> MotionCues:
        """predicted: (T, N, 3) [m] of the particles in the training frames; seen: what was found of them before, None for the
        reconstruction's own."""
        found, scene, settings = self.reconstruction, self.scene, self.settings
        parts = found.moving
        windows = object_windows(scene, scene.training_cameras, scene.training_frames, margin=settings.margin).to(self.device)
        seen = (found.cues.positions if seen is None else seen).to(parts.centres)
        background = scene.background.to(parts.centres)
        title = f"motion of {scene.sequence} about the prediction"
        with tqdm(total=settings.informed.iterations, desc=title, disable=not self.progress, leave=False) as steps:
            motion = informed_motion(parts.scaffold, parts.carried, windows, parts.centres, background, predicted.to(seen), seen,
                                     settings.informed, settings.dynamic, reach=parts.reach, seed=self.seed, progress=steps.update)
        if motion is None:
            log.warning("reconstruction.informed: what the calibrated law predicts of %s is no guide to its images, and the first "
                        "motion stays", scene.sequence)
            return self.cues(seen)
        with torch.no_grad():
            return self.cues(parts.sample(motion).positions)

    def cues(self, positions: Tensor) -> MotionCues:
        """Of positions (T, N, 3) [m] that `about` found, for instance those in a checkpoint."""
        splats = self.reconstruction.splats.to(self.device)
        around, positions = neighbourhood(splats.means, neighbours=self.settings.neighbours), positions.to(splats.means)
        deformed = around.deformation(positions) @ (quaternion_to_matrix(splats.rotations) * splats.scales[:, None, :])
        return neighbourhood_cues(positions, deformed @ deformed.mT, around)

"""The motion of known particles in a sequence: first from its images alone, then once more about what a simulation predicts."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from mosa.data.hull import hull_centroid
from mosa.errors import ConfigError
from mosa.reconstruction.cache import StageCache
from mosa.reconstruction.motion.cues import gaussian_cues, neighbourhood, neighbourhood_cues
from mosa.reconstruction.motion.dynamic import Motion, Scaffold, fit_motion
from mosa.reconstruction.motion.informed import informed_motion
from mosa.reconstruction.motion.modes import deformation_modes
from mosa.reconstruction.motion.motion import MotionSample
from mosa.reconstruction.motion.observed import Windows, object_windows
from mosa.reconstruction.motion.response import (
    MODES,
    UNEXPLAINED,
    Response,
    image_matrices,
    response_of,
)
from mosa.reconstruction.pose.known import known_centres
from mosa.reconstruction.pose.outlines import Similarities
from mosa.reconstruction.settings import ReconstructionSettings
from mosa.rendering.appearance.carrying import bind
from mosa.rendering.appearance.lighting import turned_basis
from mosa.rendering.covariance import carried_covariance
from mosa.rendering.rasterizer import rasterize
from mosa.system.progress import tqdm
from mosa.system.threads import threaded
from mosa.types import MotionCues, Reconstruction, Scene, Splats

log = logging.getLogger(__name__)


class MovingParts:
    """What a motion of particles is fitted with. Found when it is first asked for, and kept: the second look takes the first one's.

    splats: the particles at frame 0; static: Gaussians that carry their images; on the device of both fits; place: of a body of
    known shape in frame 0.
    """

    def __init__(
        self,
        scene: Scene,
        splats: Splats,
        static: Splats,
        settings: ReconstructionSettings,
        place: Similarities | None = None,
    ) -> None:
        self.scene, self.splats, self.static, self.settings = scene, splats, static, settings
        self.place = place

    @cached_property
    def centres(self) -> Tensor:
        """(T, 3) [m] of the visual hulls of the training frames; those of a body of known shape, which few cameras may film, from
        its outlines."""
        scene = self.scene
        if self.place is not None:
            return known_centres(scene, self.place).to(self.splats.means)
        views, frames = scene.training_cameras, scene.training_frames
        cameras = scene.cameras.select(views)
        found = list(
            threaded(lambda t: hull_centroid(scene.mattes[views, t], cameras, scene.box), frames)
        )
        return torch.stack(found).to(self.splats.means)

    @cached_property
    def scaffold(self) -> Scaffold:
        """The particles, with the modes at them."""
        around = neighbourhood(self.splats.means, neighbours=self.settings.neighbours)
        return Scaffold(
            self.splats,
            deformation_modes(self.splats.means, around, count=self.settings.dynamic.modes),
            around,
        )

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
    parts: MovingParts,
    windows: Windows,
    background: Tensor,
    seed: int,
    bar: Callable[[str, int], tqdm],
    cache: StageCache,
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


def cues_of(
    motion: dict[str, Tensor], splats: Splats, settings: ReconstructionSettings
) -> MotionCues:
    """Cues of a reconstructed motion, relative to `splats`, where it starts."""
    if settings.cue == "gaussian":
        return gaussian_cues(
            motion["positions"],
            motion["covariances"],
            splats,
            motion["scales"],
            motion["rotations"],
        )
    around = neighbourhood(splats.means, neighbours=settings.neighbours)
    return neighbourhood_cues(motion["positions"], motion["covariances"], around)


@dataclass(frozen=True)
class SecondLook:
    """The cues of a sequence once more, about what a simulation predicts (`informed`). Nothing is cached: the prediction is a run's
    own.

    reconstruction: of `scene`; seed: of the order in which views are drawn; plastic: whether the body yields or flows,
    asked when images are first looked at (which law a body has may be found by its fit).
    """

    scene: Scene
    reconstruction: Reconstruction
    settings: ReconstructionSettings
    seed: int = 0
    device: torch.device | str = "cpu"
    progress: bool = True
    plastic: Callable[[], bool] = lambda: False

    def about(self, predicted: Tensor, seen: Tensor | None = None) -> MotionCues:
        """predicted: (T, N, 3) [m] of the particles in the training frames; seen: what was found of them before, None for the
        reconstruction's own."""
        seen = self._seen(seen)
        found = self._found(predicted, seen, self._windows())
        return self.cues(seen if found is None else found[0])

    def with_response(
        self, predicted: Tensor, other: Tensor, seen: Tensor, first_contact: int
    ) -> tuple[MotionCues, Response | None]:
        """`about` and what the cues keep of the prediction, measured from another prediction (T, N, 3) [m]; None where one of them
        is no guide to the images, or where what they keep cannot be told.

        first_contact: index of the first frame after it: until then predictions do not differ."""
        seen, scene, parts, settings = (
            self._seen(seen),
            self.scene,
            self.reconstruction.moving,
            self.settings.informed,
        )
        windows = self._windows()
        found = self._found(predicted, seen, windows)
        if found is None:
            return self.cues(seen), None
        positions, about = found
        second = (
            self._found(other, seen, windows)
            if settings.response and first_contact < len(positions)
            else None
        )
        if second is None:
            return self.cues(positions), None
        frames = len(positions) - 1
        with tqdm(
            total=frames,
            desc=f"{scene.sequence}: how far images determine the motion",
            disable=not self.progress,
            leave=False,
        ) as steps:
            matrices = image_matrices(
                parts.scaffold,
                self._carried,
                windows,
                parts.centres,
                self._background(),
                positions,
                reach=parts.reach,
                views=settings.response,
                progress=steps.update,
            )
        response, strength, left = response_of(
            parts.scaffold.modes, matrices, about, positions, second[1], second[0], first_contact
        )
        log.info(
            "motion of %s: its bias towards the prediction is measured by a second prediction: the weight of the prediction is "
            "%.3g of the images' (median direction), which explains %.0f%% of the change",
            scene.sequence,
            strength,
            100 * (1 - left),
        )
        return self.cues(positions), response if left < UNEXPLAINED else None

    def response(self, written: dict[str, Tensor] | None) -> Response | None:
        """As `Response.written` has it. Errors: ConfigError where it is another body's."""
        if written is None:
            return None
        modes = self.reconstruction.moving.scaffold.modes
        T, (N, K) = len(self.scene.training_frames), modes.values[:, :MODES].shape
        found = {name: tuple(written[name].shape) for name in ("about", "share")}
        expected = {"about": (T, N, 3), "share": (T, 3 * K, 3 * K)}
        if found != expected:
            raise ConfigError(
                f"ckpt_path: expected mosa.responses of shapes {expected}, found {found}: the checkpoint belongs to "
                "another sequence"
            )
        about, share = (written[name].to(modes.values) for name in ("about", "share"))
        return Response(about, share, modes.values[:, :K], modes.gradient[..., :K])

    @cached_property
    def _carried(self) -> Scaffold:
        """What is compared with the images."""
        parts, appearance = self.reconstruction.moving, self.reconstruction.appearance
        carriers = self.settings.informed.carriers
        first = carriers == "first" or (carriers == "auto" and self.plastic())
        if first or appearance is None or appearance.light is None:
            return parts.carried
        appearance = appearance.to(self.device)
        splats, seen = appearance.splats, self._seen(None)
        turns = turned_basis(
            appearance.normals, bind(splats.means, parts.splats.means).carry(seen).rotations
        )
        return Scaffold(
            splats,
            parts.scaffold.modes.at(splats.means, parts.splats.means),
            shades=(turns @ appearance.light).exp(),
        )

    def _seen(self, seen: Tensor | None) -> Tensor:
        return (self.reconstruction.cues.positions if seen is None else seen).to(
            self.reconstruction.moving.centres
        )

    def _windows(self) -> Windows:
        scene = self.scene
        return object_windows(
            scene, scene.training_cameras, scene.training_frames, margin=self.settings.margin
        ).to(self.device)

    def _background(self) -> Tensor:
        return self.scene.background.to(self.reconstruction.moving.centres)

    def _found(
        self, predicted: Tensor, seen: Tensor, windows: Windows
    ) -> tuple[Tensor, Tensor] | None:
        """(positions, the shapes that they were sought from), (T, N, 3) [m] each; None where the prediction is no guide."""
        parts, settings, sequence = self.reconstruction.moving, self.settings, self.scene.sequence
        title = f"{sequence}: motion fitted to images from the prior's prediction"
        with tqdm(
            total=settings.informed.iterations, desc=title, disable=not self.progress, leave=False
        ) as steps:
            found = informed_motion(parts.scaffold, self._carried, windows, parts.centres, self._background(),
                                    predicted.to(seen), seen, settings.informed, settings.dynamic, reach=parts.reach,
                                    seed=self.seed, judging=parts.carried, progress=steps.update)  # fmt: skip
        if found is None:
            log.warning(
                "reconstruction.informed: a motion of %s that starts from the calibrated law's prediction follows the images "
                "much worse than the first reconstruction, which is kept",
                sequence,
            )
            return None
        with torch.no_grad():
            return parts.sample(found[0]).positions, found[1]

    def cues(self, positions: Tensor) -> MotionCues:
        """Of positions (T, N, 3) [m] that `about` found, for instance those in a checkpoint."""
        splats = self.reconstruction.splats.to(self.device)
        around, positions = (
            neighbourhood(splats.means, neighbours=self.settings.neighbours),
            positions.to(splats.means),
        )
        covariances = carried_covariance(
            around.deformation(positions), splats.scales, splats.rotations
        )
        return neighbourhood_cues(positions, covariances, around)

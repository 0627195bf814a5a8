"""The motion of known particles in a sequence: first from its images alone, then once more about what a simulation predicts."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from mosa.data.hull import hull_centroid
from mosa.errors import ConfigError
from mosa.reconstruction.cache import StageCache
from mosa.reconstruction.motion.cues import gaussian_cues, neighbourhood, neighbourhood_cues
from mosa.reconstruction.motion.dynamic import Motion, Scaffold, Target, fit_motion
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
from mosa.rendering.cameras import centers
from mosa.rendering.covariance import carried_covariance
from mosa.rendering.rasterizer import rasterize
from mosa.system.progress import tqdm
from mosa.system.threads import threaded
from mosa.types import MotionCues, Reconstruction, Scene, Splats

log = logging.getLogger(__name__)


class MovingParts:
    """What a motion of particles is fitted with. Found when it is first asked for, and kept: the second look takes the first one's.

    splats: the particles at frame 0; static: Gaussians that carry their images; on the device of both
    fits; place: of a body of known shape in frame 0; lit: the static ones' normals in frame 0 and the
    light, where it is known."""

    def __init__(
        self, scene: Scene, splats: Splats, static: Splats, settings: ReconstructionSettings,
        place: Similarities | None = None, lit: tuple[Tensor, ...] = (),
    ) -> None:  # fmt: skip
        self.scene, self.splats, self.static, self.settings = scene, splats, static, settings
        self.place, self.lit = place, lit

    @cached_property
    def centres(self) -> Tensor:
        """(T, 3) [m] of the visual hulls of the training frames; those of a body of known shape, which few cameras may film, from
        its outlines."""
        scene = self.scene
        if self.place is not None:
            return known_centres(scene, self.place).to(self.splats.means)
        views, frames = scene.training_cameras, scene.training_frames
        device = self.splats.means.device
        cameras = scene.cameras.select(views).to(device)
        of_frame = lambda t: hull_centroid(scene.mattes[views, t].to(device), cameras, scene.box)  # noqa: E731
        return torch.stack(list(threaded(of_frame, frames))).to(self.splats.means)

    @cached_property
    def scaffold(self) -> Scaffold:
        """The particles, with the modes at them."""
        means = self.splats.means
        around = neighbourhood(means, neighbours=self.settings.neighbours)
        modes = deformation_modes(means, around, count=self.settings.dynamic.modes)
        return Scaffold(self.splats, modes, around)

    @cached_property
    def carried(self) -> Scaffold:
        """What is compared with the images."""
        if self.settings.dynamic.carriers != "static":
            return self.scaffold
        return self.carriers(self.static, *self.lit)

    def carriers(self, seen: Splats, *lit: Tensor) -> Scaffold:
        """Gaussians of frame 0 that the particles carry; lit: normals and light, as of `Scaffold`."""
        return Scaffold(seen, self.scaffold.modes.at(seen.means, self.splats.means), None, *lit)

    @property
    def eyes(self) -> Tensor:
        """(V, 3) [m] of the training cameras."""
        return centers(self.scene.cameras.select(self.scene.training_cameras))

    @property
    def reach(self) -> float:
        """Radius of the body [m]."""
        means = self.splats.means
        return float((means - means.mean(0)).norm(dim=1).max())

    def target(self, carried: Scaffold, windows: Windows, background: Tensor) -> Target:
        """The parts with the Gaussians and the windows that are compared."""
        return Target(self.scaffold, carried, windows, self.centres, background, self.reach)

    def sample(self, motion: Motion) -> MotionSample:
        """The particles in all training frames."""
        frames = torch.arange(len(self.centres), device=self.splats.means.device)
        return motion(frames, self.splats, self.scaffold.modes, self.scaffold.around)


def first_motion(
    parts: MovingParts, windows: Windows, background: Tensor, seed: int, bar: Callable[[str, int], tqdm], cache: StageCache,
) -> dict[str, Tensor]:  # fmt: skip
    """Positions, covariances and, where free, shapes of the particles in every training frame."""
    dynamic, splats = parts.settings.dynamic, parts.splats
    tracked = dynamic.track_iterations * (len(parts.centres) - 1) if dynamic.model == "modes" else 0
    target = parts.target(parts.carried, windows, background)
    with bar("motion", dynamic.iterations + tracked) as steps:
        motion = fit_motion(target, dynamic, seed=seed, progress=steps.update)
    with torch.no_grad():
        sample = parts.sample(motion)
        rendered = rasterize(sample.positions, sample.covariances, splats.opacities, splats.colors[None], windows.cameras,
                             windows.frame, background)[0]  # fmt: skip
    cache.strip("motion", windows, rendered, columns=12)
    result = {"positions": sample.positions, "covariances": sample.covariances}
    if sample.scales is not None:
        result |= {"scales": sample.scales, "rotations": sample.rotations}
    return {name: value.cpu() for name, value in result.items()}


def cues_of(motion: dict[str, Tensor], splats: Splats, parts: MovingParts) -> MotionCues:
    """Cues of a reconstructed motion, relative to `splats`, where it starts."""
    if parts.settings.cue == "gaussian":
        return replace(gaussian_cues(**motion, splats=splats), eyes=parts.eyes)
    around = neighbourhood(splats.means, neighbours=parts.settings.neighbours)
    found = neighbourhood_cues(motion["positions"], motion["covariances"], around)
    return replace(found, eyes=parts.eyes)


@dataclass(frozen=True)
class SecondLook:
    """The cues of a sequence once more, about what a simulation predicts (`informed`). Nothing is cached: the prediction is a run's
    own.

    reconstruction: of `scene`; seed: of the order in which views are drawn; plastic: whether the body yields or flows,
    asked when images are first looked at (which law a body has may be found by its fit)."""

    scene: Scene
    reconstruction: Reconstruction
    settings: ReconstructionSettings
    seed: int = 0
    device: torch.device | str = "cpu"
    progress: bool = True
    plastic: Callable[[], bool] = bool

    def about(self, predicted: Tensor, seen: Tensor | None = None) -> MotionCues:
        """predicted: (T, N, 3) [m] of the particles in the training frames; seen: what was found of them before, None for the
        reconstruction's own."""
        seen = self._seen(seen)
        found = self._found(predicted, seen, self._target())
        return self.cues(seen if found is None else found[0])

    def with_response(
        self, predicted: Tensor, other: Tensor, seen: Tensor, first_contact: int
    ) -> tuple[MotionCues, Response | None]:
        """`about` and what the cues keep of the prediction, measured from another prediction (T, N, 3) [m]; None where one of them
        is no guide to the images, or where what they keep cannot be told.

        first_contact: index of the first frame after it: until then predictions do not differ."""
        seen, target, views = self._seen(seen), self._target(), self.settings.informed.response
        told = bool(views) and first_contact < len(predicted)
        both = (threaded if seen.is_cpu else map)(
            lambda each: self._found(each, seen, target), [predicted, other][: 1 + told]
        )
        found, second = (*both, None)[:2]
        if found is None:
            return self.cues(seen), None
        positions, about = found
        if second is None:
            return self.cues(positions), None
        with self._bar("how far images determine the motion", len(positions) - 1) as steps:
            matrices = image_matrices(target, positions, views=views, progress=steps.update)
        modes = target.scaffold.modes
        response, strength, left = response_of(
            modes, matrices, about, positions, second[1], second[0], first_contact
        )
        log.info(
            "motion of %s: found about two predictions, to see how far it follows them: a prediction weighs %.3g times as much "
            "as the images (median direction); this explains %.0f%% of the difference between the two",
            self.scene.sequence, strength, 100 * (1 - left),
        )  # fmt: skip
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
        seen = appearance.to(self.device)
        return parts.carriers(seen.splats, seen.normals, seen.light)

    def _seen(self, seen: Tensor | None) -> Tensor:
        found = self.reconstruction.cues.positions if seen is None else seen
        return found.to(self.reconstruction.moving.centres)

    def _bar(self, title: str, total: int) -> tqdm:
        title = f"{self.scene.sequence}: {title}"
        return tqdm(total=total, desc=title, disable=not self.progress, leave=False)

    def _target(self) -> Target:
        scene, parts, margin = self.scene, self.reconstruction.moving, self.settings.margin
        views, frames = scene.training_cameras, scene.training_frames
        windows = object_windows(scene, views, frames, margin=margin).to(self.device)
        return parts.target(self._carried, windows, scene.background.to(parts.centres))

    def _found(
        self, predicted: Tensor, seen: Tensor, target: Target
    ) -> tuple[Tensor, Tensor] | None:
        """(positions, the shapes that they were sought from), (T, N, 3) [m] each; None where the prediction is no guide."""
        parts, settings = self.reconstruction.moving, self.settings
        title = "motion fitted to images from the prior's prediction"
        with self._bar(title, settings.informed.iterations) as steps:
            found = informed_motion(target, predicted.to(seen), seen, settings.informed, settings.dynamic,
                                    seed=self.seed, judging=parts.carried, progress=steps.update)  # fmt: skip
        if found is None:
            log.warning(
                "reconstruction.informed: a motion of %s that starts from the calibrated law's prediction follows the images "
                "much worse than the first reconstruction, which is kept",
                self.scene.sequence,
            )
            return None
        with torch.no_grad():
            return parts.sample(found[0]).positions, found[1]

    def cues(self, positions: Tensor) -> MotionCues:
        """Of positions (T, N, 3) [m] that `about` found, for instance those in a checkpoint."""
        splats = self.reconstruction.splats.to(self.device)
        around = neighbourhood(splats.means, neighbours=self.settings.neighbours)
        positions = positions.to(splats.means)
        moved = around.deformation(positions)
        covariances = carried_covariance(moved, splats.scales, splats.rotations)
        found = neighbourhood_cues(positions, covariances, around)
        return replace(found, eyes=self.reconstruction.moving.eyes).to(self.device)

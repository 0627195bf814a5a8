"""Dynamic stage: the motion of the filled scaffold through all frames, fitted to the images by rendering.

Second stage of the paper's section 3.2. First every frame is tracked from the one before it, starting from the displacement of
the visual hulls' centres; then all frames are refined together. The interior, which no camera sees, follows the surface
through the smooth modes, their bending energy and a weak elastic energy.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.func import functional_call

from mosa.reconstruction.gaussians.photometric import image_loss
from mosa.reconstruction.gaussians.uniform_adam import UniformAdam, adam
from mosa.reconstruction.motion.cues import Neighbourhood
from mosa.reconstruction.motion.modes import Modes
from mosa.reconstruction.motion.motion import ModalMotion, MotionBasisNetwork, MotionSample
from mosa.reconstruction.motion.observed import Windows
from mosa.reconstruction.settings import DynamicSettings
from mosa.rendering.appearance.lighting import moved_shading
from mosa.rendering.rasterizer import rasterize
from mosa.system.cuda_graphs import Graphed
from mosa.types import Splats

Motion = ModalMotion | MotionBasisNetwork

TRACK_RATE = 0.03
"""Step of the first pass, in units of the object's radius."""
NETWORK = {"bases", "hidden", "basis_layers", "coefficient_layers", "space_frequencies", "time_frequencies"}  # fmt: skip
"""Settings that are the network's own."""


@dataclass(frozen=True)
class Scaffold:
    """Gaussians in frame 0 with the modes at their positions and, where they are the particles, their
    neighbourhoods; normals: (M, 3) of the surface at them, and light: (8,) that stays while they move
    (`lighting.py`), None where it is not known."""

    splats: Splats
    modes: Modes
    around: Neighbourhood | None = None
    normals: Tensor | None = None
    light: Tensor | None = None

    def colors(self, deformation: Tensor | None) -> Tensor:
        """(S, M, 3) under deformation gradients (S, M, 3, 3); (1, M, 3) where they are the same under all.

        The light's part of them follows the motion that is being found: else a bright side would go
        along with a body that turns, and hold back a motion by which it turns."""
        colors = self.splats.colors[None]
        if self.light is None or self.normals is None or deformation is None:
            return colors
        return colors * moved_shading(self.light, self.normals, deformation)[..., None]


def elastic_energy(deformation: Tensor, poisson: float) -> Tensor:
    """Mean St. Venant-Kirchhoff energy per unit shear modulus: E:E + poisson/(1 - 2 poisson) tr(E)^2, E = (F^T F - I)/2."""
    identity = torch.eye(3, dtype=deformation.dtype, device=deformation.device)
    strain = 0.5 * (deformation.transpose(-1, -2) @ deformation - identity)
    trace = strain.diagonal(dim1=-2, dim2=-1).sum(-1)
    return (strain**2).sum((-1, -2)).mean() + poisson / (1 - 2 * poisson) * (trace**2).mean()


def _round_robin(
    windows: Windows, frames: list[int], generator: torch.Generator
) -> Callable[[int, list[int]], Tensor]:
    """draw(n, some): indices of n windows of every frame in `some`; all views of a frame are seen before one repeats."""
    by_frame = {t: (windows.frame == t).nonzero()[:, 0].cpu() for t in frames}
    queue = {t: torch.empty(0, dtype=torch.long) for t in frames}

    def draw(count: int, some: list[int]) -> Tensor:
        chosen = []
        for t in some:
            while len(queue[t]) < count:
                order = torch.randperm(len(by_frame[t]), generator=generator)
                queue[t] = torch.cat([queue[t], by_frame[t][order]])
            chosen.append(queue[t][:count])
            queue[t] = queue[t][count:]
        return torch.cat(chosen)

    return draw


@dataclass(frozen=True)
class Target:
    """What a motion is fitted to. scaffold: the N filled particles; carried: the Gaussians that are rendered, the particles
    themselves or others; windows: of all frames; offsets: (T, 3) [m] first guess of the object's centre per frame; background:
    (3,); reach [m]: radius of the object, the unit of displacements."""

    scaffold: Scaffold
    carried: Scaffold
    windows: Windows
    offsets: Tensor
    background: Tensor
    reach: float

    def modal(self, *, free_shape: bool = False) -> ModalMotion:
        """A motion by the scaffold's modes that only shifts, by the offsets."""
        energy = self.scaffold.modes.energy
        return ModalMotion(self.offsets, energy, reach=self.reach, free_shape=free_shape)


@dataclass(frozen=True)
class Predicted:
    """A motion from which energies are counted. coefficients: (T, K, 3) [m] of the modes; inverse: (T, N, 3, 3) of its deformation
    gradients at the scaffold's particles."""

    coefficients: Tensor
    inverse: Tensor


class Shown(nn.Module):
    """Of frames: positions (S, M, 3) [m], covariances (S, M, 3, 3) [m^2] and colours of the carriers, and what is added to the loss
    of their images: elastic energy of the scaffold, bending energy of the amplitudes."""

    def __init__(
        self, motion: Motion, target: Target, settings: DynamicSettings, predicted: Predicted | None, refining: bool,
    ) -> None:  # fmt: skip
        super().__init__()
        self.motion, self.target, self.settings = motion, target, settings
        self.predicted, self.refining = predicted, refining

    def forward(self, frames: Tensor, state: Tensor) -> tuple[Tensor, ...]:
        """Arguments as of `Objective`; colours are (1, M, 3) where all windows share them, else (B, M, 3)."""
        carried, settings = self.target.carried, self.settings
        deforms = settings.elastic > 0 or carried.light is not None
        around = carried.around if deforms else None
        sample = self.motion(frames, carried.splats, carried.modes, around)
        colors = carried.colors(sample.deformation)
        colors = colors if len(colors) == 1 else colors[state]
        added = sample.positions.new_zeros(())
        if settings.elastic > 0:
            energy = elastic_energy(self._deformation(frames, sample), settings.poisson)
            added = added + settings.elastic * energy
        if settings.bending > 0 and isinstance(self.motion, ModalMotion):
            c = self.motion.coefficients(frames)
            c = c if self.predicted is None else c - self.predicted.coefficients[frames]
            energy = self.target.scaffold.modes.energy[:, None]
            curvature = (energy * (c / self.motion.reach) ** 2).sum((-2, -1))
            # what a frame shows sets its own weight
            if self.refining and settings.bending_scale > 0:
                curvature = settings.bending_scale * torch.log1p(curvature / settings.bending_scale)
            added = added + settings.bending * curvature.mean()
        return sample.positions, sample.covariances, colors, added

    def _deformation(self, frames: Tensor, sample: MotionSample) -> Tensor:
        scaffold = self.target.scaffold
        if self.target.carried is scaffold and self.predicted is None:
            return sample.deformation
        if isinstance(self.motion, MotionBasisNetwork):
            return self.motion(frames, scaffold.splats, None, scaffold.around).deformation
        found = self.motion.displacement(frames, scaffold.modes)[1]
        return found if self.predicted is None else found @ self.predicted.inverse[frames]


class Objective:
    """Loss of a batch: that of the carriers' images, and energies (`Shown`).

    predicted: a motion in which neither energy is stored; None: the body at rest; refining: all frames together."""

    def __init__(
        self, motion: Motion, target: Target, settings: DynamicSettings, predicted: Predicted | None = None,
        refining: bool = False,
    ) -> None:  # fmt: skip
        self.target = target
        self._off = image_loss(settings.ssim, settings.matte)
        shown = Shown(motion, target, settings, predicted, refining)
        names = [name for name, _ in shown.named_parameters()]

        def evaluated(frames: Tensor, state: Tensor, *numbers: Tensor) -> tuple[Tensor, ...]:
            return functional_call(shown, dict(zip(names, numbers)), (frames, state))

        self._shown, self._evaluated = shown, Graphed(evaluated)

    def __call__(self, frames: Tensor, batch: Windows, state: Tensor) -> Tensor:
        """frames: (S,) long; state: (B,) which of them each window shows."""
        positions, shapes, colors, added = self._evaluated(frames, state, *self._shown.parameters())
        seen = positions, shapes, self.target.carried.splats.opacities, colors, batch.cameras, state
        image, alpha = rasterize(*seen, self.target.background)
        return self._off(image, alpha, batch.images, batch.mattes) + added

    def minimise(
        self, optimizer: torch.optim.Optimizer, frames: list[int], steps: int, views: int, generator: torch.Generator,
        progress: Callable[[int], None] | None, at_once: int | None = None,
    ) -> None:  # fmt: skip
        """`steps` steps from the optimizer's rate on, each on `views` random windows of every frame in `frames`, or of `at_once` of
        these."""
        windows, rate = self.target.windows, optimizer.param_groups[0]["lr"]
        draw = _round_robin(windows, frames, generator)
        device = windows.images.device
        some, every = frames, torch.tensor(frames, device=device)
        shown = len(frames) if at_once is None else min(at_once, len(frames))
        state = torch.arange(shown, device=device).repeat_interleave(views)
        for step in range(steps):
            factor = 0.51 + 0.49 * math.cos(math.pi * step / steps)
            optimizer.param_groups[0]["lr"] = rate * factor
            if at_once is not None:
                some = [frames[i] for i in torch.randperm(len(frames), generator=generator)[:shown]]
                every = torch.tensor(some, device=device)
            loss = self(every, windows.select(draw(views, some)), state)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            if progress is not None:
                progress(1)


def fit_motion(
    target: Target,
    settings: DynamicSettings,
    *,
    seed: int,
    progress: Callable[[int], None] | None = None,
) -> Motion:
    """Motion through all frames of the target's windows."""
    draws = torch.Generator().manual_seed(seed), progress
    moving = list(range(1, len(target.offsets)))
    if settings.model == "modes":
        motion = target.modal(free_shape=settings.free_shape)
        objective = Objective(motion, target, settings)
        for t in moving:
            with torch.no_grad():
                motion.amplitude[t] = motion.amplitude[t - 1]
            # a fresh optimiser per frame: frames without a gradient and without momentum stay where they are
            optimizer = UniformAdam(motion.parameters(), lr=TRACK_RATE, betas=(0.8, 0.95))
            steps, views = settings.track_iterations, settings.track_views
            objective.minimise(optimizer, [t], steps, views, *draws)
        optimizer = UniformAdam(motion.parameters(), lr=settings.lr)
    else:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            centre = target.scaffold.splats.means.mean(0)
            sizes = settings.model_dump(include=NETWORK)
            motion = MotionBasisNetwork(target.offsets, centre=centre, reach=target.reach, **sizes)
        motion = motion.to(target.background.device)
        optimizer = adam([{"params": list(motion.parameters()), "lr": settings.lr_network}])
    objective = Objective(motion, target, settings, refining=True)
    sizes = settings.iterations, settings.views
    objective.minimise(optimizer, moving, *sizes, *draws, settings.frames)
    return motion

"""Static stage: Gaussians fitted to one frame by rendering, and where they start (paper, section 3.2)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from mosa.data.hull import Volume
from mosa.errors import ConfigError
from mosa.reconstruction.gaussians.densification import MarkovChain, Relocation
from mosa.reconstruction.gaussians.gaussians import FreeGaussians, Rates
from mosa.reconstruction.gaussians.initial import initial_splats, random_splats
from mosa.reconstruction.gaussians.photometric import image_loss
from mosa.reconstruction.motion.observed import Windows
from mosa.rendering.rasterizer import rasterize
from mosa.schema import COUNT, WEIGHT, check_knobs, knob, number, one_of, or_null, whole
from mosa.types import Splats

SMALLEST = 0.25
"""Bound of a scale in units of its start."""
STARTS = {"hull": initial_splats, "random": random_splats}


@dataclass(frozen=True)
class FitSettings:
    """iterations; views: images per step; lr_*: Adam steps, of positions in units of the mean scale, of the others per
    unconstrained number; ssim: weight of 1 - SSIM against L1; matte: weight of the alpha term; keep: what a Gaussian's first colour
    counts for, in pixels of an image; largest: bound of a scale in units of its start; shape: isotropic | anisotropic, three scales
    and a rotation, which start isotropic; axis_ratio: an anisotropic one's largest scale over its smallest, at most."""

    iterations: int = knob(400, whole(0))
    views: int = knob(2, COUNT)
    lr_positions: float = knob(0.03, WEIGHT)
    lr_scales: float = knob(0.02, WEIGHT)
    lr_opacities: float = knob(0.05, WEIGHT)
    lr_colors: float = knob(0.02, WEIGHT)
    lr_rotations: float = knob(0.02, WEIGHT)
    ssim: float = knob(0.2, number(0, 1))
    matte: float = knob(1.0, WEIGHT)
    keep: float = knob(0.0, WEIGHT)
    largest: float = knob(2.0, number(1))
    shape: str = knob("isotropic", one_of("isotropic", "anisotropic"))
    axis_ratio: float = knob(10.0, number(1))

    def __post_init__(self) -> None:
        check_knobs(self, "reconstruction.*")


@dataclass(frozen=True)
class StaticSettings(FitSettings):
    """start: hull, on the visual hull's surface | random, in its box; densify: relocate, every `relocate_every` steps (0: never)
    vanished Gaussians are moved to where opaque ones are | mcmc, every `refine_every` steps they are moved and `growth` of the
    number is added, up to `max_points` (None: the number at the start), as copies that leave the image as it is. Of mcmc also:
    fade, what an opacity of 1 costs, in pixels of an image: Gaussians that no image shows vanish and get moved; noise: random
    steps of those about to vanish, in their standard deviations at the first step."""

    start: str = knob("hull", one_of(*STARTS))
    densify: str = knob("relocate", one_of("relocate", "mcmc"))
    max_points: int | None = knob(None, or_null(whole(8)))
    relocate_every: int = knob(100, whole(0))
    refine_every: int = knob(10, COUNT)
    growth: float = knob(0.1, WEIGHT)
    fade: float = knob(0.03, WEIGHT)
    noise: float = knob(0.2, WEIGHT)

    def __post_init__(self) -> None:
        check_knobs(self, "reconstruction.static")
        if self.max_points is not None and self.densify != "mcmc":
            raise ConfigError(
                f"reconstruction.static.max_points: expected null, found {self.max_points}: densify={self.densify} keeps the "
                "number of Gaussians (reconstruction.points); set reconstruction.static.densify=mcmc"
            )

    def densifier(self, count: int) -> Relocation | MarkovChain:
        """What moves and adds Gaussians, of which there are `count` at the start."""
        if self.densify == "relocate":
            return Relocation(self.relocate_every)
        return MarkovChain(
            self.max_points or count, self.refine_every, self.growth, self.fade, self.noise
        )


def start_splats(
    volume: Volume, windows: Windows, settings: StaticSettings, *, count: int, seed: int
) -> Splats:
    """`count` Gaussians, less where the hull's surface has fewer voxels, from which the static stage starts."""
    return STARTS[settings.start](volume, windows, count=count, seed=seed)


def fit_splats(
    splats: Splats,
    windows: Windows,
    background: Tensor,
    settings: FitSettings,
    *,
    move: bool,
    seed: int,
    progress: Callable[[int], None] | None = None,
) -> Splats:
    """Gaussians fitted to windows of ONE frame: colours, opacities, scales, rotations where anisotropic, positions with `move`.

    They start isotropic, of the mean scale of `splats`. With `move` and StaticSettings vanished ones are moved; with densify=mcmc
    their number changes, never beyond `max_points`. The same bits for the same seed on a CPU.
    """
    generator = torch.Generator().manual_seed(seed)
    densifier = (
        settings.densifier(len(splats.means))
        if move and isinstance(settings, StaticSettings)
        else None
    )
    unit = float(splats.scales.mean(1).mean())
    rates = Rates(
        settings.lr_positions * unit,
        settings.lr_scales,
        settings.lr_opacities,
        settings.lr_colors * 4,
        settings.lr_rotations,
    )
    gaussians = FreeGaussians(
        splats,
        rates,
        move=move,
        anisotropic=settings.shape == "anisotropic",
        smallest=SMALLEST
        * (densifier.shrinkage(len(splats.means)) if densifier is not None else 1.0),
        largest=settings.largest,
        axis_ratio=settings.axis_ratio,
    )
    order = torch.empty(0, dtype=torch.long)
    for step in range(settings.iterations):
        while len(order) < settings.views:
            order = torch.cat([order, torch.randperm(len(windows), generator=generator)])
        batch, order = windows.select(order[: settings.views]), order[settings.views :]
        gaussians.anneal(0.55 + 0.45 * math.cos(math.pi * step / settings.iterations))
        image, alpha = rasterize(
            gaussians.parameters["means"][None],
            gaussians.covariances()[None],
            gaussians.opacities,
            gaussians.colors[None],
            batch.cameras,
            torch.zeros(len(batch), dtype=torch.long, device=background.device),
            background,
        )
        loss = image_loss(
            image, alpha, batch, ssim_weight=settings.ssim, matte_weight=settings.matte
        )
        if settings.keep > 0:
            # Adam moves a Gaussian of a hundredth of a pixel as fast as one of ten: hardly seen ones drift to any colour, which
            # shows when the object turns
            change = gaussians.colors - gaussians.fixed["first_colors"]
            loss = loss + settings.keep * change.square().mean(1).sum() / alpha.numel()
        if densifier is not None and densifier.fade > 0:
            loss = loss + densifier.fade * gaussians.opacities.sum() / alpha.numel()
        gaussians.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        gaussians.optimizer.step()
        gaussians.bound()
        if densifier is not None and step:
            densifier.after_step(gaussians, step, settings.iterations, generator)
        if progress is not None:
            progress(1)
    if densifier is not None:
        densifier.finish(gaussians)
    return gaussians.splats()

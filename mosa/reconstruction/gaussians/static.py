"""Static stage: Gaussians fitted to one frame by rendering (paper, section 3.2)."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from mosa.reconstruction.gaussians.gaussians import FreeGaussians
from mosa.reconstruction.gaussians.photometric import image_loss
from mosa.reconstruction.gaussians.relocation import UNTIL, relocate
from mosa.reconstruction.motion.observed import Windows
from mosa.reconstruction.settings import FitSettings, StaticSettings
from mosa.rendering.rasterizer import rasterize
from mosa.types import Splats


def fit_splats(
    splats: Splats, windows: Windows, background: Tensor, settings: FitSettings, *, move: bool,
    seed: int, progress: Callable[[int], None] | None = None,
) -> Splats:  # fmt: skip
    """Gaussians fitted to windows of ONE frame: colours, opacities, scales, rotations where anisotropic, positions with `move`.

    They start isotropic, of the mean scale of `splats`. With `move` and StaticSettings vanished ones are moved onto opaque
    ones. The same bits for the same seed on a CPU."""
    generator = torch.Generator().manual_seed(seed)
    every = settings.relocate_every if move and isinstance(settings, StaticSettings) else 0
    gaussians = FreeGaussians(splats, settings, move=move)
    off = image_loss(settings.ssim, settings.matte)
    draw = windows.draws(settings.views, generator)
    for step in range(settings.iterations):
        batch = windows.select(next(draw))
        gaussians.anneal(0.55 + 0.45 * math.cos(math.pi * step / settings.iterations))
        means, state = gaussians.parameters["means"][None], torch.zeros_like(batch.frame)
        shapes, opacities, colors = gaussians.drawn()
        image, alpha = rasterize(
            means, shapes[None], opacities, colors[None], batch.cameras, state, background
        )
        loss = off(image, alpha, batch.images, batch.mattes)
        if settings.keep > 0:
            # Adam moves a Gaussian of a hundredth of a pixel as fast as one of ten: hardly seen ones drift to any colour, which
            # shows when the object turns
            change = gaussians.colors - gaussians.fixed["first_colors"]
            loss = loss + settings.keep * change.square().mean(1).sum() / alpha.numel()
        gaussians.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        gaussians.optimizer.step()
        gaussians.bound()
        if every and step and step % every == 0 and step < UNTIL * settings.iterations:
            relocate(gaussians, generator)
        if progress is not None:
            progress(1)
    return gaussians.splats()

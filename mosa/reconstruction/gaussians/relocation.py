"""Static stage: Gaussians that vanished are moved to where there is something to see; their number stays."""

from __future__ import annotations

import torch

from mosa.reconstruction.gaussians.gaussians import FreeGaussians

VANISHED = 0.02
"""Gaussians of a smaller opacity are moved to where there is something to see."""
SPREAD = 0.5
"""Random shift of copies, in their standard deviations."""
UNTIL = 0.8
"""Part of the iterations after which Gaussians stay."""


def relocate(gaussians: FreeGaussians, generator: torch.Generator) -> None:
    """Moves Gaussians whose opacity fell below VANISHED onto opaque ones, at half their scale apart, and forgets their momentum."""
    opacity, scale = gaussians.opacities.detach(), gaussians.scales.detach()
    vanished = opacity < VANISHED
    dead = vanished.nonzero()[:, 0]
    if len(dead) == 0 or len(dead) == len(opacity):
        return
    # seen area: of the two larger axes
    area = scale.sort(1).values[:, 1:].prod(1)
    chance = torch.where(vanished, 0.0, opacity * area).cpu()
    target = torch.multinomial(chance, len(dead), replacement=True, generator=generator)
    source = torch.arange(len(opacity), device=dead.device)
    source[dead] = target.to(dead.device)
    gaussians.take(source, vanished)
    noise = torch.randn(len(dead), 3, generator=generator).to(dead.device)
    gaussians.shift(dead, (noise * SPREAD * gaussians.scales.detach()[dead])[..., None])

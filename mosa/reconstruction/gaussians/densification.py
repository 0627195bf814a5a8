"""How many Gaussians the static stage has, and where: vanished ones are moved, or the set also grows up to a bound (3DGS-MCMC).

Source: Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo" (eq. 9: copies of a Gaussian that render as it
did; growth; noise of those that are hardly seen).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from mosa.reconstruction.gaussians.gaussians import FreeGaussians
from mosa.rendering.covariance import quaternion_to_matrix

VANISHED = 0.02
"""Gaussians of a smaller opacity are moved to where there is something to see."""
SPREAD = 0.5
"""Random shift of copies, in their standard deviations."""
UNTIL = 0.8
"""Part of the iterations after which Gaussians stay."""


@dataclass(frozen=True)
class Relocation:
    """Every `every` steps (0: never) vanished Gaussians are moved to where opaque ones are; their number stays."""

    every: int
    fade = 0.0

    def shrinkage(self, count: int) -> float:
        """How much finer than at the start the Gaussians may become because there will be more of them."""
        return 1.0

    def after_step(
        self, gaussians: FreeGaussians, step: int, steps: int, generator: torch.Generator
    ) -> None:
        if self.every and step % self.every == 0 and step < UNTIL * steps:
            relocate(gaussians, generator)

    def finish(self, gaussians: FreeGaussians) -> None:
        """All stay, the vanished too."""


@dataclass(frozen=True)
class MarkovChain:
    """3DGS-MCMC: every `every` steps vanished Gaussians are moved and `growth` of the number is added, up to `most`; those about to
    vanish move at random by `noise` standard deviations, less as the steps get smaller; an opacity of 1 costs `fade` pixels."""

    most: int
    every: int
    growth: float
    fade: float
    noise: float

    def shrinkage(self, count: int) -> float:
        """As for `Relocation`: by the mean distance on a surface."""
        return math.sqrt(min(1.0, count / self.most))

    def after_step(
        self, gaussians: FreeGaussians, step: int, steps: int, generator: torch.Generator
    ) -> None:
        if self.noise > 0:
            perturb(gaussians, generator, amount=self.noise * gaussians.annealed)
        if step % self.every == 0 and step < UNTIL * steps:
            refine(gaussians, generator, growth=self.growth, most=self.most)

    def finish(self, gaussians: FreeGaussians) -> None:
        prune(gaussians)


def shared_opacity(opacity: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity of each of `copies` equal Gaussians in one place that together let through what one of `opacity` did, and the factor
    of their scale with which they also spread as far. All (N,); computed in float64.

    1 - (1 - o')^n = o in the middle. Along a line the n composed ones cover the integral of 1 - (1 - o' exp(-x^2/2))^n, the one
    o sqrt(2 pi): their quotient is the factor. The paper writes the integral as a double sum of alternating binomials; the
    trapezoidal rule has it to rounding for any n.
    """
    o, n = opacity.double(), copies.double()
    each = -torch.expm1(torch.log1p(-o) / n)
    x = torch.linspace(-8, 8, 65, dtype=torch.float64, device=o.device)
    covered = -torch.expm1(n[:, None] * torch.log1p(-each[:, None] * torch.exp(-0.5 * x**2))).sum(
        1
    ) * (x[1] - x[0])
    return each.to(opacity), (math.sqrt(2 * math.pi) * o / covered).to(opacity)


def relocate(gaussians: FreeGaussians, generator: torch.Generator) -> None:
    """Moves Gaussians whose opacity fell below VANISHED onto opaque ones, at half their scale apart, and forgets their momentum."""
    opacity, scale = gaussians.opacities.detach(), gaussians.scales.detach()
    vanished = opacity < VANISHED
    dead = vanished.nonzero()[:, 0]
    if len(dead) == 0 or len(dead) == len(opacity):
        return
    # seen area: of the two larger axes
    area = (
        scale.square()[:, 0] if not gaussians.anisotropic else scale.sort(1).values[:, 1:].prod(1)
    )
    chance = torch.where(vanished, torch.zeros_like(opacity), opacity * area)
    target = torch.multinomial(chance.cpu(), len(dead), replacement=True, generator=generator).to(
        dead.device
    )
    source = torch.arange(len(opacity), device=dead.device)
    source[dead] = target
    gaussians.take(source, vanished)
    noise = torch.randn(len(dead), 3, generator=generator).to(dead.device)
    gaussians.shift(dead, (noise * SPREAD * gaussians.scales.detach()[dead])[..., None])


def refine(
    gaussians: FreeGaussians, generator: torch.Generator, *, growth: float, most: int
) -> None:
    """Moves the vanished onto others and adds `growth` of their number, to `most` at most, all as copies of Gaussians drawn by
    opacity; those and their copies share the opacity (`shared_opacity`) and forget their momentum.

    Copies lie half a standard deviation of theirs apart (SPREAD): the paper's lie in one place, which in runs as short as ours they
    hardly leave. No more Gaussians than before if there are `most` already.
    """
    opacity = gaussians.opacities.detach()
    count = len(opacity)
    vanished = opacity < VANISHED
    dead = vanished.nonzero()[:, 0]
    added = max(0, min(most, math.ceil((1 + growth) * count)) - count)
    if len(dead) == count or len(dead) + added == 0:
        return
    chance = torch.where(vanished, torch.zeros_like(opacity), opacity)
    target = torch.multinomial(
        chance.cpu(), len(dead) + added, replacement=True, generator=generator
    ).to(dead.device)
    copies = 1 + torch.bincount(target, minlength=count)
    source = torch.cat([torch.arange(count, device=dead.device), target[len(dead) :]])
    source[dead] = target[: len(dead)]
    changed = copies[source] > 1
    gaussians.take(source, changed)
    each, factor = (value[source][changed] for value in shared_opacity(opacity, copies))
    noise = torch.randn(int(changed.sum()), 3, generator=generator).to(dead.device)
    gaussians.dim(changed, each, factor)
    gaussians.shift(changed, SPREAD * _root(gaussians)[changed] @ noise[..., None])


def _root(gaussians: FreeGaussians) -> Tensor:
    """A square root of each covariance, (N, 3, 3) [m]."""
    if not gaussians.anisotropic:
        return torch.diag_embed(gaussians.scales.detach())
    return (
        quaternion_to_matrix(gaussians.parameters["rotation"].detach())
        * gaussians.scales.detach()[:, None]
    )


def perturb(gaussians: FreeGaussians, generator: torch.Generator, *, amount: float) -> None:
    """Moves each Gaussian at random by `amount` of its standard deviations, times a gate that is a half at VANISHED and 0 from an
    opacity of 0.1 on: those about to vanish look for a place where they are of use."""
    gate = torch.sigmoid(-100 * (gaussians.opacities.detach() - VANISHED))
    noise = torch.randn(len(gaussians), 3, generator=generator).to(gate.device)
    gaussians.shift(
        slice(None), (amount * gate)[:, None, None] * _root(gaussians) @ noise[..., None]
    )


def prune(gaussians: FreeGaussians) -> None:
    """Drops Gaussians that no image shows: of an opacity below 1/255, which the rasteriser skips."""
    kept = (gaussians.opacities.detach() > 1 / 255).nonzero()[:, 0]
    if len(kept):
        gaussians.take(kept)

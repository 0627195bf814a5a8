"""Appearance of the body: the static stage's Gaussians, fitted further to all training frames, carried by the observed motion.

One frame shows each part in one light and blames what its cameras miss on colours; the frames after it show the same parts from
other sides, and in another light, which is fitted too (`lighting.py`). The fit is photometric and in the rest shape's
axes: the motion that carries the Gaussians is the reconstruction's and stays as it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import normalize

from mosa.reconstruction.gaussians.gaussians import OPACITY_RATE, ROTATION_RATE, SMALLEST
from mosa.reconstruction.gaussians.photometric import image_loss
from mosa.reconstruction.gaussians.uniform_adam import adam
from mosa.reconstruction.motion.observed import Windows
from mosa.reconstruction.settings import CarriedSettings
from mosa.rendering.appearance import spherical_harmonics
from mosa.rendering.appearance.carrying import bind
from mosa.rendering.appearance.lighting import LIGHT, surface_normals, turned_basis
from mosa.rendering.cameras import centers
from mosa.rendering.covariance import covariance_from
from mosa.rendering.rasterizer import rasterize
from mosa.system.cuda_graphs import Graphed
from mosa.types import Appearance, Splats

CONSTANT_RATE, HIGHER_RATE, LIGHT_RATE = 0.03, 0.005, 0.02
"""Adam's steps of mean colours, of the harmonics of degree 1 and more, and of the light."""


class RestGaussians:
    """The free numbers of M splats at rest: shift of the centres [m], log scales, quaternions, logits of opacity, harmonics; and of
    the light."""

    def __init__(self, splats: Splats, normals: Tensor, settings: CarriedSettings) -> None:
        unit, extra = float(splats.scales.mean()), (settings.degree + 1) ** 2 - 1
        self.settings, self.start, self.normals = settings, splats, normals
        self.shift = torch.zeros_like(splats.means)
        self.log_scale, self.quaternion = splats.scales.log(), splats.rotations.clone()
        self.logit = torch.logit(splats.opacities.clamp(0.01, 0.99))
        self.first = spherical_harmonics.constant_coefficients(splats.colors)
        self.constant = self.first.clone()
        self.higher = splats.means.new_zeros(len(splats.means), extra, 3)
        self.light = splats.means.new_zeros(LIGHT)
        rates = {"shift": settings.lr_positions * unit, "log_scale": settings.lr_scales, "logit": OPACITY_RATE,
                 "constant": CONSTANT_RATE, "higher": HIGHER_RATE}  # fmt: skip
        if settings.shape == "anisotropic":
            rates["quaternion"] = ROTATION_RATE
        if settings.light:
            rates["light"] = LIGHT_RATE
        groups = [
            {"params": [getattr(self, name).requires_grad_(True)], "start": rate}
            for name, rate in rates.items()
        ]
        self.optimizer = adam(groups)
        self._drawn = Graphed(self._as_drawn)
        scale = splats.scales.mean(1, keepdim=True)
        self.lower, self.upper = (SMALLEST * scale).log(), (settings.largest * scale).log()

    @property
    def harmonics(self) -> Tensor:
        return torch.cat((self.constant, self.higher), 1)

    def drawn(self, *moved: Tensor) -> tuple[Tensor, ...]:
        """Of B windows: means (B, M, 3) [m], covariances (B, M, 3, 3) [m^2], opacities (M,), colours (B, M, 3), and `change`.

        moved: where the centres at rest are (B, M, 3) [m], the motion's gradients and rotations there (B, M, 3, 3), its
        `turned_basis` (B, M, LIGHT), and the eyes (B, 3) [m]."""
        numbers = "shift", "log_scale", "quaternion", "logit", "constant", "higher", "light"
        return self._drawn(*moved, *(getattr(self, name) for name in numbers))

    def _as_drawn(
        self, middle: Tensor, A: Tensor, R: Tensor, turned: Tensor, eyes: Tensor, shift: Tensor, log_scale: Tensor,
        quaternion: Tensor, logit: Tensor, constant: Tensor, higher: Tensor, light: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        means = middle + (A @ shift[..., None])[..., 0]
        # seen from the body: R^T d
        directions = (means.detach() - eyes[:, None])[..., None, :] @ R
        harmonics = torch.cat((constant, higher), 1)
        colors = spherical_harmonics.colors_in(harmonics, directions[..., 0, :])
        shapes = A @ covariance_from(log_scale.exp(), quaternion) @ A.mT
        shades = (turned @ light).exp()[..., None]
        change = self.change(constant, higher)
        return means, shapes, torch.sigmoid(logit), colors * shades, change

    def change(self, constant: Tensor, higher: Tensor) -> Tensor:
        """Sum over the splats of the squares by which their colours, in the mean over directions and channels, left the first ones,
        each weighted by what it counts for."""
        both = constant - self.first, higher
        means = [(spherical_harmonics.Y0 * moved).square().mean(2).sum() for moved in both]
        return self.settings.keep * means[0] + self.settings.keep_harmonics * means[1]

    def step(self, loss: Tensor, factor: float) -> None:
        """One of Adam's, at `factor` of the first; scales back between their bounds, as those of the static stage."""
        for group in self.optimizer.param_groups:
            group["lr"] = group["start"] * factor
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()
        with torch.no_grad():
            if self.settings.shape == "isotropic":
                self.log_scale.copy_(self.log_scale.mean(1, keepdim=True).expand(-1, 3))
            self.log_scale.copy_(
                torch.minimum(torch.maximum(self.log_scale, self.lower), self.upper)
            )
            least = self.log_scale.amax(1, keepdim=True) - math.log(self.settings.axis_ratio)
            self.log_scale.copy_(torch.maximum(self.log_scale, least))

    @torch.no_grad()
    def appearance(self) -> Appearance:
        """The splats as they are."""
        harmonics = self.harmonics.detach()
        splats = Splats(
            self.start.means + self.shift.detach(),
            self.log_scale.detach().exp(),
            normalize(self.quaternion.detach(), dim=-1),
            torch.sigmoid(self.logit.detach()),
            spherical_harmonics.mean_colors(harmonics),
        )
        return Appearance(splats, harmonics, self.normals, self.light.detach())


def fit_carried(
    static: Splats, particles: Tensor, positions: Tensor, windows: Windows, background: Tensor,
    settings: CarriedSettings, *, seed: int, progress: Callable[[int], None] | None = None,
) -> Appearance:  # fmt: skip
    """The splats of a body that its particles carry, fitted to windows of all frames.

    static: Gaussians at rest, where the fit starts; particles: (N, 3) at rest and positions: (T, N, 3) [m] of the frames 0 to T - 1
    that `windows` show. Each splat follows the motion's affine part where the static one lies. The same bits for the same seed on
    a CPU."""
    generator = torch.Generator().manual_seed(seed)
    gaussians = RestGaussians(static, surface_normals(static.means, particles), settings)
    carried, eyes = bind(static.means, particles).carry(positions), centers(windows.cameras)
    turns = turned_basis(gaussians.normals, carried.rotations)
    draw, off = windows.draws(settings.views, generator), image_loss(settings.ssim, settings.matte)
    for step in range(settings.iterations):
        chosen = next(draw)
        batch = windows.select(chosen)
        frames = batch.frame
        means, shapes, opacities, colors, change = gaussians.drawn(
            carried.means[frames], carried.gradients[frames], carried.rotations[frames],
            turns[frames], eyes[chosen],
        )  # fmt: skip
        shown = torch.arange(len(batch), device=means.device)
        image, alpha = rasterize(means, shapes, opacities, colors, batch.cameras, shown, background)
        loss = off(image, alpha, batch.images, batch.mattes) + change / alpha.numel()
        cosine = math.cos(math.pi * step / settings.iterations)
        gaussians.step(loss, 0.03 + 0.97 * 0.5 * (1 + cosine))
        if progress is not None:
            progress(1)
    return gaussians.appearance()

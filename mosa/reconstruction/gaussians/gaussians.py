"""A set of Gaussians while it is fitted: free numbers, their bounds, and Adam's moments, which follow their Gaussian."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mosa.reconstruction.gaussians.uniform_adam import adam
from mosa.reconstruction.settings import FitSettings
from mosa.rendering.covariance import covariance_from
from mosa.system.cuda_graphs import Graphed
from mosa.types import Splats

SMALLEST = 0.25
"""Bound of a scale in units of its start."""
OPACITY_RATE, COLOR_RATE, ROTATION_RATE = 0.05, 0.08, 0.02
"""Adam's steps of the logits of opacities and colours, and of quaternions."""


def isotropic_covariances(scale: Tensor) -> Tensor:
    """(N, 3, 3) [m^2] of standard deviations (N,) [m]."""
    return (scale**2)[:, None, None] * torch.eye(3, dtype=scale.dtype, device=scale.device)


class FreeGaussians:
    """N Gaussians as free numbers: position [m], log of the scale(s), logits of opacity and colour, quaternion where anisotropic.

    Starts isotropic, with the mean scale of each of `splats`. move: positions too. `first_colors` (N, 3) are the colours at the
    start."""

    def __init__(self, splats: Splats, settings: FitSettings, *, move: bool) -> None:
        scale, anisotropic = splats.scales.mean(1), settings.shape == "anisotropic"
        rates = {"means": settings.lr_positions * float(scale.mean()), "log_scale": settings.lr_scales,
                 "opacity": OPACITY_RATE, "color": COLOR_RATE, "rotation": ROTATION_RATE}  # fmt: skip
        self.parameters = {
            "means": splats.means.clone(),
            "log_scale": scale.log(),
            "opacity": torch.logit(splats.opacities.clamp(0.01, 0.99)),
            "color": torch.logit(splats.colors.clamp(0.01, 0.99)),
        }
        if anisotropic:
            self.parameters["log_scale"] = scale.log()[:, None].repeat(1, 3)
            self.parameters["rotation"] = splats.rotations.clone()
        self.fixed = {"lower": (scale * SMALLEST).log(), "upper": (scale * settings.largest).log(), "rotations": splats.rotations,
                      "first_colors": splats.colors}  # fmt: skip
        self.anisotropic, self.axis_ratio = anisotropic, settings.axis_ratio
        groups = [{"params": [p.requires_grad_(True)], "start": rates[name], "name": name}
                  for name, p in self.parameters.items() if move or name != "means"]  # fmt: skip
        self.optimizer = adam(groups)
        self._drawn = Graphed(self._as_drawn)

    def __len__(self) -> int:
        return len(self.parameters["opacity"])

    @property
    def opacities(self) -> Tensor:
        return torch.sigmoid(self.parameters["opacity"])

    @property
    def colors(self) -> Tensor:
        return torch.sigmoid(self.parameters["color"])

    @property
    def scales(self) -> Tensor:
        """(N, 3) [m]."""
        scale = self.parameters["log_scale"].exp()
        return scale if self.anisotropic else scale[:, None].repeat(1, 3)

    def drawn(self) -> tuple[Tensor, Tensor, Tensor]:
        """Covariances (N, 3, 3) [m^2], opacities (N,) and colours (N, 3)."""
        return self._drawn(*(p for name, p in self.parameters.items() if name != "means"))

    @staticmethod
    def _as_drawn(
        log_scale: Tensor, opacity: Tensor, color: Tensor, rotation: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        scale = log_scale.exp()
        shapes = (
            isotropic_covariances(scale) if rotation is None else covariance_from(scale, rotation)
        )
        return shapes, torch.sigmoid(opacity), torch.sigmoid(color)

    def anneal(self, factor: float) -> None:
        """Steps at `factor` of their start."""
        for group in self.optimizer.param_groups:
            group["lr"] = group["start"] * factor

    @torch.no_grad()
    def bound(self) -> None:
        """Scales back between their bounds, the smaller ones of a Gaussian not further below its largest than the axis ratio."""
        scale, lower, upper = self.parameters["log_scale"], self.fixed["lower"], self.fixed["upper"]
        if not self.anisotropic:
            scale.clamp_(lower, upper)
            return
        scale.clamp_(lower[:, None], upper[:, None])
        torch.maximum(scale, scale.amax(1, keepdim=True) - math.log(self.axis_ratio), out=scale)

    @torch.no_grad()
    def take(self, source: Tensor, fresh: Tensor | None = None) -> None:
        """Gaussian i becomes a copy of Gaussian source[i], (M,) long; Adam's moments go along, and are 0 where `fresh` (M,)."""
        for group in self.optimizer.param_groups:
            old = group["params"][0]
            new = old.detach()[source].requires_grad_(True)
            state = self.optimizer.state.pop(old, None)
            if state is not None:
                for moment in ("exp_avg", "exp_avg_sq"):
                    state[moment] = state[moment][source]
                    if fresh is not None:
                        state[moment][fresh] = 0
                self.optimizer.state[new] = state
            group["params"], self.parameters[group["name"]] = [new], new
        learned = {group["name"] for group in self.optimizer.param_groups}
        self.parameters |= {
            name: p[source] for name, p in self.parameters.items() if name not in learned
        }
        self.fixed = {name: value[source] for name, value in self.fixed.items()}

    @torch.no_grad()
    def shift(self, rows: Tensor | slice, vectors: Tensor) -> None:
        """Moves the Gaussians `rows` by (M, 3, 1) [m]."""
        self.parameters["means"][rows] += vectors[..., 0]

    @torch.no_grad()
    def splats(self) -> Splats:
        """The Gaussians as they are, rotations of unit length."""
        rotations = self.fixed["rotations"]
        if self.anisotropic:
            rotations = torch.nn.functional.normalize(self.parameters["rotation"].detach(), dim=-1)
        means = self.parameters["means"].detach()
        return Splats(means, self.scales, rotations, self.opacities, self.colors)

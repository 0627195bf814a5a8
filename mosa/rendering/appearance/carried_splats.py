"""What a body looks like wherever its particles go: splats carried by their motion, or the particles themselves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from mosa.rendering.appearance import spherical_harmonics
from mosa.rendering.appearance.carrying import Binding, Carried, bind
from mosa.rendering.appearance.lighting import LIGHT, shading
from mosa.rendering.cameras import centers
from mosa.rendering.covariance import covariance_from
from mosa.rendering.observer import deformed_covariances, repeat_cameras
from mosa.rendering.rasterizer import rasterize
from mosa.types import Appearance, Cameras, Splats

COLORED = ("harmonics", "normals", "light")


class CarriedSplats(nn.Module):
    """M splats of a body of N particles, all at rest: the appearance (`types.Appearance`) and how it hangs on the particles. Its
    buffers go along to a device and are no part of a state dictionary: a checkpoint keeps what `written` gives."""

    def __init__(self, appearance: Appearance, particles: Tensor) -> None:
        """particles: (N, 3) [m]. Errors: DataError for fewer than 8 particles."""
        super().__init__()
        splats, normals, light = appearance.splats, appearance.normals, appearance.light
        if light is None or normals is None:
            normals = torch.tensor([0.0, 0, 1]).expand_as(splats.means)
            light = torch.zeros(LIGHT)
        bound = vars(bind(splats.means, particles))
        kept = {f"bound_{name}": value for name, value in bound.items()} | vars(splats)
        kept |= {"harmonics": appearance.harmonics, "normals": normals, "light": light}
        for name, value in kept.items():
            like = particles if value.is_floating_point() else particles.device
            self.register_buffer(name, value.detach().to(like), persistent=False)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def appearance(self) -> Appearance:
        splats = Splats(*(getattr(self, f.name) for f in fields(Splats)))
        return Appearance(splats, self.harmonics, self.normals, self.light)

    @property
    def binding(self) -> Binding:
        return Binding(**{f.name: getattr(self, f"bound_{f.name}") for f in fields(Binding)})

    def carry(self, positions: Tensor) -> Carried:
        """Where the splats are and what the motion's gradient is there, with the particles at positions (T, N, 3) [m]."""
        return self.binding.carry(positions)

    def written(self) -> dict[str, Tensor]:
        """Tensors on the CPU, fit for a checkpoint; `read` gives the same splats."""
        names = (*(f.name for f in fields(Splats)), *COLORED)
        return {name: getattr(self, name).detach().cpu().clone() for name in names}

    @classmethod
    def read(cls, written: Mapping[str, Any], particles: Tensor) -> CarriedSplats:
        tensors = dict(written)
        colored = {name: tensors.pop(name) for name in COLORED}
        return cls(Appearance(Splats(**tensors), **colored), particles)


@dataclass(frozen=True)
class Seen:
    """M Gaussians over T frames. means: (T, M, 3) [m]; covariances: (T, M, 3, 3) [m^2]; opacities: (M,); harmonics: (M, K, 3) in
    the axes of the rest shape; rotations: (T, M, 3, 3) from there, None where the colours are the same from everywhere; shades:
    (T, M) factors of the colours, None where the light does not matter."""

    means: Tensor
    covariances: Tensor
    opacities: Tensor
    harmonics: Tensor
    rotations: Tensor | None = None
    shades: Tensor | None = None

    def images(self, cameras: Cameras, background: Tensor) -> Tensor:
        """(V, T, H, W, 3), in [0, 1] up to harmonics that are brighter than white. background: (3,), or (T, H, W, 3) pictures of
        what lies behind. One camera at a time, which bounds memory."""
        each = (repeat_cameras(cameras.select([v]), len(self.means)) for v in range(len(cameras)))
        return torch.stack([self.film(views, background) for views in each])

    def film(self, cameras: Cameras, background: Tensor) -> Tensor:
        """(T, H, W, 3) as `images`, each frame from its own one of T cameras."""
        if self.rotations is None:
            colors = spherical_harmonics.colors_in(self.harmonics, torch.ones_like(self.means[:1]))
        else:
            lines = self.means - centers(cameras).to(self.means)[:, None]
            turned = lines[..., None, :] @ self.rotations  # R^T d
            colors = spherical_harmonics.colors_in(self.harmonics, turned[..., 0, :])
        if self.shades is not None:
            colors = colors * self.shades[..., None]
        index = torch.arange(len(self.means), device=self.means.device)
        given = self.means, self.covariances, self.opacities, colors, cameras, index
        return rasterize(*given, background)[0]

    def during(self, frames: list[int]) -> Seen:
        """The same over some of its frames."""
        same = "opacities", "harmonics"
        given = vars(self).items()
        return Seen(**{k: v if v is None or k in same else v[frames] for k, v in given})

    def colors(self) -> Tensor:
        """(T, M, 3) in [0, 1], averaged over all directions, in each frame's light."""
        constant = spherical_harmonics.mean_colors(self.harmonics)
        shades = self.means.new_ones(self.means.shape[:2]) if self.shades is None else self.shades
        return (constant * shades[..., None]).clamp(0, 1)


class HasAppearance(Protocol):
    """A body (`body.py`), or one that is only shown (`shown_body.py`). splats: None where particles are what is seen of it;
    covariances: (N, 3, 3) [m^2], opacities: (N,), colors: (N, 3) of its particles."""

    splats: CarriedSplats | None
    covariances: Tensor
    opacities: Tensor
    colors: Tensor


def seen(body: HasAppearance, positions: Tensor, F_tot: Tensor | None) -> Seen:
    """The body's splats where its particles are at positions (T, N, 3) [m]; where it has none the particles, deformed by F_tot
    (T, N, 3, 3), which splats do not need."""
    splats = body.splats
    if splats is None:
        if F_tot is None:
            raise ValueError("seen: a body without splats needs F_tot")
        shapes = deformed_covariances(F_tot, body.covariances)
        colors = spherical_harmonics.constant_coefficients(body.colors)
        return Seen(positions, shapes, body.opacities, colors)
    carried = splats.carry(positions)
    shapes = carried.covariances(covariance_from(splats.scales, splats.rotations))
    turns = carried.rotations if splats.harmonics.shape[1] > 1 else None
    shades = None
    if bool(splats.light.any()):
        shades = shading(splats.light, splats.normals, carried.rotations)
    return Seen(carried.means, shapes, splats.opacities, splats.harmonics, turns, shades)

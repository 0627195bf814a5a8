"""The particles of a body at rest with their appearance: all of a body that is known before it has a law."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mosa.rendering.appearance.carried_splats import CarriedSplats
from mosa.rendering.covariance import covariance_from
from mosa.types import Reconstruction


@dataclass(frozen=True)
class RestShape:
    """N particles. rest: (N, 3) [m]; volume: (N,) [m^3]; colors: (N, 3); opacities: (N,); covariances: (N, 3, 3) [m^2]; splats:
    what its images show, None where that is the particles."""

    rest: Tensor
    volume: Tensor
    colors: Tensor
    opacities: Tensor
    covariances: Tensor
    splats: CarriedSplats | None = None

    @classmethod
    def of(
        cls, reconstruction: Reconstruction, device: torch.device | str, *, with_splats: bool = True
    ) -> RestShape:
        """with_splats: whether images show the reconstruction's Gaussians, where it has some."""
        seen = reconstruction.splats
        shapes = covariance_from(seen.scales, seen.rotations)
        tensors = seen.means, reconstruction.volume, seen.colors, seen.opacities, shapes
        carried = None
        if with_splats and reconstruction.appearance is not None:
            carried = CarriedSplats(reconstruction.appearance, seen.means).to(device)
        rest, volume, colors, opacities, covariances = (tensor.to(device) for tensor in tensors)
        return cls(rest, volume, colors, opacities, covariances, carried)

    @property
    def center(self) -> Tensor:
        """(3,) centre of mass [m]."""
        return (self.rest * self.volume[:, None]).sum(0) / self.volume.sum()

    def tensors(self) -> dict[str, Tensor]:
        """What `build_body` takes."""
        names = ("rest", "volume", "colors", "opacities", "covariances")
        return {name: getattr(self, name) for name in names}

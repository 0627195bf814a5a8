"""Flow maps as pictures: direction is the hue of a colour wheel, length the saturation."""

from __future__ import annotations

import torch
from kornia.color import hsv_to_rgb
from torch import Tensor

from mosa.errors import DataError


def flow_colors(flow: Tensor, largest: float | None = None) -> Tensor:
    """Colours (..., H, W, 3) in [0, 1] of flow maps (..., H, W, 2) [px]: white is rest, full colour is `largest` [px] or more.

    Hue runs with the angle in the image, y downwards: red to the right, yellow-green down, cyan to the left, violet up.
    largest: None for the largest length in `flow`. Errors: DataError where a number is not finite.
    """
    if not bool(torch.isfinite(flow).all()):
        raise DataError(
            f"flow_colors: expected finite flow, found {int((~torch.isfinite(flow)).sum())} NaN or infinite numbers"
        )
    flow = flow.detach().cpu().float()
    length = flow.norm(dim=-1)
    if largest is None:
        largest = float(length.max())
    hue = torch.atan2(flow[..., 1], flow[..., 0]) % (2 * torch.pi)
    saturation = (length / largest).clamp(max=1) if largest > 0 else torch.zeros_like(length)
    return hsv_to_rgb(torch.stack((hue, saturation, torch.ones_like(hue)), -3)).movedim(-3, -1)


def color_wheel(size: int) -> Tensor:
    """The legend: colours (size, size, 3) of all directions, length growing from the centre to the rim, white outside."""
    axis = (torch.arange(size) + 0.5) * 2 / size - 1
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    flow = torch.stack((x, y), -1)
    return flow_colors(
        torch.where(flow.norm(dim=-1, keepdim=True) <= 1, flow, torch.zeros_like(flow)), 1.0
    )

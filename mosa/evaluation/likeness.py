"""Whether the body that was found is the one that another film shows: what it looks like where that film's first frame has it,
beside the pictures. A start is found for any body in any light; what is wrong with it shows here alone.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from mosa.modules.body.body import Body, Start
from mosa.rendering.appearance.carried_splats import seen
from mosa.types import Scene

FILLED = 0.93
"""Share of the outlines that is filled, over that in the training film, below which it is said. The right body where its start was
found is above 0.98; other bodies reach 0.69 to 0.84 (a chick or a ball for a rabbit, three of them)."""
USUAL = 0.9
"""Share of the outlines that a coarse body fills in its own film."""
BRIGHTER = 0.15
"""Mean colour, of 0 to 1 per channel, by which the object may differ from the body: in one light and exposure the parts that turn
to the light and away from it leave 0.005 (12 cameras, or four of them) to 0.1 (two)."""


VIEWS = 4
"""Looked at, evenly out of a film's cameras: large pictures of many splats take seconds each."""


class Likeness(NamedTuple):
    """outline: share that rendered and true mattes have in common of what either has; color: (3,) mean colour of the pictures less
    that of the body, where both are."""

    outline: float
    color: Tensor


@torch.no_grad()
def likeness(body: Body, start: Start, scene: Scene) -> Likeness:
    """Of the body at the start of a film to its first frame, in some of the cameras that learning may read."""
    every, rotation = scene.training_cameras, start.rotation.to(body.rest)
    cameras = [
        every[i]
        for i in torch.linspace(0, len(every) - 1, min(VIEWS, len(every))).round().long().tolist()
    ]
    x = (body.rest - body.center) @ rotation.T + start.center.to(body.rest)
    shown = seen(body, x[None], rotation.expand(1, len(x), 3, 3))
    views = scene.cameras.select(cameras).to(x.device)
    black, white = (
        shown.images(views, torch.full((3,), value).to(x))[:, 0] for value in (0.0, 1.0)
    )
    alpha = (1 - (white - black).mean(-1)).clamp(0, 1)
    mattes, images = scene.mattes[cameras, 0].to(alpha), scene.images[cameras, 0].to(alpha)
    common = torch.minimum(alpha, mattes).sum((1, 2)) / torch.maximum(alpha, mattes).sum(
        (1, 2)
    ).clamp(min=1e-6)
    inside = ((alpha > 0.9) & (mattes > 0.9)).to(alpha)[..., None]
    rendered = black + (1 - alpha)[..., None] * scene.background.to(alpha)
    off = ((images - rendered) * inside).sum((0, 1, 2)) / inside.sum().clamp(min=1)
    return Likeness(float(common.mean()), off.cpu())


def warn_of_others(body: Body, found: Mapping[str, Start], scenes: Sequence[Scene]) -> None:
    """A warning for each other film whose first frame does not show this body, or not in this light. found: starts by prefix, that
    of the training film as `train`; scenes: theirs, in this order."""
    own = Likeness(USUAL, torch.zeros(3))
    for (prefix, start), scene in zip(found.items(), scenes):
        if scene.markers is not None:
            continue
        like = likeness(body, start, scene)
        if prefix == "train":
            own = like
            continue
        if like.outline < FILLED * own.outline:
            warnings.warn(
                f"{prefix}: in its first frame the body of the training film fills {like.outline:.0%} of the outlines, "
                f"where it looks most like it, and {own.outline:.0%} of its own: another body, a pose that was not "
                "found, or a shape that the training film tells too little of (few cameras)? figures of this sequence "
                "count on it",
                stacklevel=2,
            )
        off = like.color - own.color
        if float(off.abs().max()) > BRIGHTER:
            said = ", ".join(
                f"{name} {value:+.2f}"
                for name, value in zip(("red", "green", "blue"), off.tolist())
            )
            warnings.warn(
                f"{prefix}: in its first frame the object's mean colour is not the body's ({said}): another exposure, "
                "white balance or light, or another object? PSNR and SSIM of this sequence say that as well, and its "
                "start was sought by colours",
                stacklevel=2,
            )

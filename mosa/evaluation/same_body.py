"""Check that a held-out film shows the reconstructed body: renders the body at the film's estimated start and compares it with the
first frame. A start is estimated for any body in any light, so that only this comparison detects a wrong body or exposure."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from mosa.modules.body.body import Body, Start
from mosa.rendering.appearance.carried_splats import seen
from mosa.types import Scene

MIN_OUTLINE_RATIO = 0.93
"""Overlap of rendered and true mattes, over that in the training film, below which a warning is given. The right body at the right
start is above 0.98; other bodies reach 0.69 to 0.84 (a chick or a ball for a rabbit, three of them)."""
TRAINING_OUTLINE = 0.9  # overlap assumed where no training film was compared
MAX_COLOR_OFFSET = 0.15
"""Largest difference of mean colour, of 0 to 1 per channel, without a warning. In one light and exposure the difference is 0.005
(12 cameras, or four of them) to 0.1 (two), as the object turns in the light."""
MAX_VIEWS = 4  # cameras compared; large pictures of many splats take seconds each


class BodyMatch(NamedTuple):
    """outline: intersection over union of rendered and true mattes; color: (3,) mean colour of the pictures minus that of the body,
    over their intersection."""

    outline: float
    color: Tensor


@torch.no_grad()
def body_match(body: Body, start: Start, scene: Scene) -> BodyMatch:
    """Compare the body at the start of a film with the film's first frame, in at most `MAX_VIEWS` training cameras."""
    every, rotation = scene.training_cameras, start.rotation.to(body.rest)
    places = torch.linspace(0, len(every) - 1, min(MAX_VIEWS, len(every)))
    cameras = [every[i] for i in places.round().long().tolist()]
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
    return BodyMatch(float(common.mean()), off.cpu())


def warn_of_other_bodies(body: Body, found: Mapping[str, Start], scenes: Sequence[Scene]) -> None:
    """Warn of each other film whose first frame shows another body or another light. found: starts by prefix, that of the training
    film as `train`; scenes: their scenes, in the same order."""
    own = BodyMatch(TRAINING_OUTLINE, torch.zeros(3))
    for (prefix, start), scene in zip(found.items(), scenes):
        if scene.markers is not None:
            continue
        match = body_match(body, start, scene)
        if prefix == "train":
            own = match
            continue
        if match.outline < MIN_OUTLINE_RATIO * own.outline:
            warnings.warn(
                f"{prefix}: in its first frame the body of the training film fills {match.outline:.0%} of the outlines, "
                f"where it looks most like it, and {own.outline:.0%} of its own: another body, a pose that was not "
                "found, or a shape that the training film hardly shows (few cameras)? figures of this sequence "
                "depend on it",
                stacklevel=2,
            )
        off = match.color - own.color
        if float(off.abs().max()) > MAX_COLOR_OFFSET:
            named = zip(("red", "green", "blue"), off.tolist())
            said = ", ".join(f"{name} {value:+.2f}" for name, value in named)
            warnings.warn(
                f"{prefix}: in its first frame the object's mean colour is not the body's ({said}): another exposure, "
                "white balance or light, or another object? PSNR and SSIM of this sequence say that as well, and its "
                "start was sought by colours",
                stacklevel=2,
            )

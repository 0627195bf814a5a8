"""Distances between a rollout and the motion cues as least squares wants them, with a noise that is found from them.

Three fields per rollout, over frames and particles: position [m], rotation [rad] (vector of R_cue^T R) and singular values [-].
Each frame of each field is divided by its own root mean square, floored at what the cues can be trusted to. Particles near each
other move alike, and so do frames: a frame counts as `count` independent data, not as many as it has particles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from mosa.data.observations import Observations
from mosa.physics.constitutive.singular_values import singular_value_decomposition
from mosa.physics.rotations import axial
from mosa.reconstruction.motion.response import Response
from mosa.rendering.observer import repeat_cameras
from mosa.rendering.rasterizer import rasterize
from mosa.types import MarkerCues, MotionCues, Rollout

CUE_ERRORS = (0.5e-3, 0.01, 0.015)
"""Per component: positions [m], rotations [rad], singular values. Cues that a simulation informed are 0.5 to 0.7 mm off after
contact, 0.3 to 0.4 in a component (rabbit, chick1, mandarin, peanut); what they get wrong beyond is measured from the residuals."""
CAMERAS = 12
"""That saw the cues of `CUE_ERRORS`. Three leave cues that are 1.7 to 1.9 mm off (rabbit, chick1), one 2.6 mm across its lines of
sight (rabbit)."""
MODEL_ERRORS = (1.0, 0.3, 0.15)
"""Rotations and singular values that a grid gets wrong where it gets positions wrong by a cell."""
SAMPLES = 2000
"""Particles compared at most: far more than a frame has independent data."""

BALL, OPACITY = 0.37, 0.6
"""Standard deviation [spacings] and opacity of a particle in a silhouette, with which bodies at rest have their area."""
EDGE, PIXELS = 5, 4
"""Width [px] of an outline, and of the blocks of pixels that are compared."""


@dataclass(frozen=True)
class Fields:
    """position, rotation, stretch: (T - 1, M, 3) each, frames after the first of M particles.
    force: (R,) of measured forces, whitened (`forces`); None where there are none."""

    position: Tensor
    rotation: Tensor
    stretch: Tensor
    force: Tensor | None = None

    def __iter__(self):
        return iter((self.position, self.rotation, self.stretch))


def sampled(particles: int, device: torch.device) -> Tensor:
    """(M,) evenly spread indices of at most `SAMPLES` particles (they are stored along a lattice)."""
    count = min(particles, SAMPLES)
    return (torch.arange(count, device=device) * particles) // count


@torch.no_grad()
def fields(
    rollout: Rollout,
    cues: MotionCues | MarkerCues,
    start_rotation: Tensor,
    chosen: Tensor,
    response: Response | None = None,
) -> Fields:
    """rollout: of T frames; cues: of at least as many, relative to the rest pose; start_rotation: (3, 3) Q of the sequence;
    response: what the cues keep of the prediction that they were found about. Of tracked points,
    `chosen` of which are compared, positions alone: the others are 0."""
    frames, x, F = len(rollout.x), rollout.x, rollout.F_tot
    if isinstance(cues, MarkerCues):
        away = cues.first(frames).away(x)[1:, chosen]
        return Fields(away, torch.zeros_like(away), torch.zeros_like(away))
    if response is not None:
        x, F = response.seen(x, F, start_rotation)
    U, S, V = singular_value_decomposition(F[1:, chosen])
    relative = cues.rotation[1:frames, chosen].mT @ (U @ V.mT @ start_rotation.T.to(U))
    weight = cues.weight[1:frames, chosen, None]
    away = cues.first(frames).away(x)[1:, chosen]
    return Fields(
        away, 0.5 * axial(relative) * weight, (S - cues.stretch[1:frames, chosen]) * weight
    )


def outlines(mattes: Tensor) -> Tensor:
    """(V, T, h, w) how much a wider outline would change blocks of pixels of mattes (V, T, H, W): the same for all rollouts."""
    edge = max_pool2d(mattes, EDGE, 1, EDGE // 2) + max_pool2d(-mattes, EDGE, 1, EDGE // 2)
    return avg_pool2d(edge, PIXELS, ceil_mode=True)


@torch.no_grad()
def silhouettes(x: Tensor, spacing: float, observations: Observations, edge: Tensor) -> Fields:
    """Of particles at x (T, N, 3) [m], `spacing` [m] apart at rest, from the mattes: position (T - 1, P, 1) over blocks of pixels.
    edge: `outlines` of the mattes.

    Particles are drawn as balls, since splats that are carried by a flow have fins. How far an outline is from them is not known:
    in each frame the part of the difference that a wider or narrower outline in all views would make is left out."""
    frames, n = x.shape[:2]
    shapes = ((BALL * spacing) ** 2 * torch.eye(3).to(x)).expand(frames, n, 3, 3).contiguous()
    opacities, index, found = x.new_full((n,), OPACITY), torch.arange(frames).to(x.device), []
    for view, mattes in enumerate(observations.mattes[:, :frames].to(x)):
        cameras = repeat_cameras(observations.cameras.select([view]), frames)
        alpha = rasterize(x, shapes, opacities, x.new_ones(1, n, 1), cameras, index)[1]
        found.append(avg_pool2d(alpha - mattes, PIXELS, ceil_mode=True))
    away, edge = (
        t.transpose(0, 1)[1:].flatten(1) for t in (torch.stack(found), edge[:, :frames].to(x))
    )
    share = (away * edge).sum(1) / edge.square().sum(1).clamp(min=1e-12)
    away = (away - share[:, None] * edge)[..., None]
    none = away.new_zeros(len(away), 1, 1)
    return Fields(away, none, none)


def unseen(
    cues: MotionCues | MarkerCues, response: Response | None
) -> Callable[[Tensor, int], Tensor] | None:
    """What would not have been found of positions (..., N, 3) [m] in a frame, (..., N, 3) [m]; None where all would."""
    kept = None if response is None else response.unseen
    if not cues.single:
        return kept

    def hidden(x: Tensor, frame: int) -> Tensor:
        seen = cues.positions[frame].to(x)
        away = x - seen
        return away - cues.across(away if kept is None else away - kept(x, frame), seen)

    return hidden


def fewer(cues: Sequence[MotionCues | MarkerCues]) -> float:
    """Factor of `CUE_ERRORS` with as many cameras as the cues have that fewest saw."""
    counts = [len(each.eyes) for each in cues if each.eyes is not None]
    return max(1.0, CAMERAS / min(counts, default=CAMERAS)) ** 0.5


def floors(dx: float, cells: float, few: float = 1.0) -> tuple[float, float, float]:
    """Noise per component that no frame gets below: that of the cues, `few` times as large, and what a simulation on a grid of
    dx [m] gets wrong whatever its law is, `cells` of it in positions."""
    return tuple(
        ((few * cue) ** 2 + (model * cells * (dx if i == 0 else 1.0)) ** 2) ** 0.5
        for i, (cue, model) in enumerate(zip(CUE_ERRORS, MODEL_ERRORS))
    )


def patterns(found: list[Fields]) -> float:
    """How many independent patterns the positions' residuals consist of: (sum l)^2 / sum l^2 over the eigenvalues l of their
    covariance, at most the number of frames; of several rollouts the mean."""
    counts = []
    for each in found:
        field = each.position.flatten(1).double()
        # as the noise weighs the frames
        field = field / field.norm(dim=1, keepdim=True).clamp(min=1e-12)
        gram = field @ field.T
        counts.append(float(gram.trace() ** 2 / gram.square().sum()))
    return sum(counts) / len(counts)


def difference(one: list[Fields], other: list[Fields]) -> list[Fields]:
    """Field by field."""
    return [
        Fields(*(x - y for x, y in zip(a, b)), None if a.force is None else a.force - b.force)
        for a, b in zip(one, other)
    ]


def along(found: list[Fields], direction: list[Fields], amount: float) -> list[Fields]:
    """found + amount direction; forces as they are."""
    return [
        Fields(*(x + amount * y for x, y in zip(a, b)), a.force) for a, b in zip(found, direction)
    ]


def spread(
    found: list[Fields], least: tuple[float, float, float], model: list[Fields] | None = None
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Root mean square (T - 1,) over particles of each frame's vectors: the noise of the three kinds, at least as `floors` says and
    no less than what the model gets wrong there, of which `model` is a sample."""

    def squares(field: Tensor) -> Tensor:
        return field.square().sum(-1).mean(-1)

    noise = []
    for i, each in enumerate(found):
        wrong = [squares(field) for field in model[i]] if model is not None else [0.0, 0.0, 0.0]
        noise.append(
            tuple(
                torch.maximum(squares(field), 3 * floor**2 + m + 0 * squares(field)).sqrt()
                for field, floor, m in zip(each, least, wrong)
            )
        )
    return noise


def whitened(
    found: list[Fields],
    noise: list[tuple[Tensor, Tensor, Tensor]],
    counts: list[tuple[float, float, float]],
    forces: float = 1.0,
) -> Tensor:
    """One vector whose squared length is minus twice the log likelihood, up to a constant.
    forces: how often a measured force counts."""
    parts = []
    for each, scales, numbers in zip(found, noise, counts):
        for field, scale, count in zip(each, scales, numbers):
            parts.append(
                (field * ((count / field.shape[1]) ** 0.5 / scale)[:, None, None]).flatten()
            )
        if each.force is not None:
            parts.append((each.force * forces**0.5).to(parts[-1]))
    return torch.cat(parts)

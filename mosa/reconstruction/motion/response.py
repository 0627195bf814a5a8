"""What a motion that was seen about a prediction keeps of that prediction: the response of the second look, and how it is undone.

Where images tell much of how a body moved, the second look (`informed`) finds it whatever was predicted. Where they tell little it
stays near the prediction, so that a law compared with what was found is pulled towards the law that made the prediction, and
nothing in the residuals says so. To first order what is found is

    found = truth + U (predicted - truth),    U_t = (H_t + a Q)^-1 a Q,

with H_t the Gauss-Newton matrix of the images of frame t in the softest modes of motion, and Q = I + 3 diag(bending energies) for
what holds the motion where no image is: the penalties, and that a fit of few iterations ends before it has moved far along a
direction that hardly lowers its loss. The number a is not known beforehand. It is measured: the motion is seen about a second
prediction too, and a is the number under which U explains best how far what was found moved along.

A law's motion x is then compared with `found` as it would have been found itself, x + U (predicted - x).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from mosa.reconstruction.motion.dynamic import Target
from mosa.reconstruction.motion.informed import project
from mosa.reconstruction.motion.modes import Modes, coefficients_of
from mosa.reconstruction.motion.observed import Windows
from mosa.rendering.covariance import carried_covariance
from mosa.rendering.rasterizer import rasterize
from mosa.system.threads import threaded

MODES = 60
"""Softest modes in which the response is known: 180 directions of a frame. What moves in others counts as seen."""
STEP = 5e-4
"""[m] of a mode, of the differences that give the images' Jacobian."""
TOGETHER = 36
"""Directions in one batch of renderings."""
VALUES = 200_000
"""Of a picture at most, colours and matte, that the Jacobian is made of: 144 MB in 180 directions. Of more, every so many-th."""
ABSOLUTE = 0.01
"""Residuals of a pixel below which the absolute loss counts as quadratic."""
BENT = 3.0
"""Weight of the modes' bending energies beside 1 in Q. From chick2 and rainbowball, whose true motions fit best with 3 to 3.3."""
SHARES = (1e-3, 3.0)
"""Range of a over the median eigenvalue of H_t: it was .006 to .12 on eight bodies."""
UNEXPLAINED = 0.97
"""A response that leaves more than so much of what it is measured on unexplained says nothing, and cues count as they are. Most of
what is measured on is the order in which views were drawn: on the rabbit .88 is left, and 1.01 to 1.03 where the changes of the
predictions are dealt to the wrong frames; a is right there to a factor of three, and U explains 38 % of the true error."""


@dataclass(frozen=True)
class Response:
    """about: (T, N, 3) [m] the prediction; share: (T, 3 K, 3 K) U of every frame, of coefficients (K, 3) in a row; values (N, K),
    gradient (N, 3, K) [1/m]: of the modes, see `Modes`."""

    about: Tensor
    share: Tensor
    values: Tensor
    gradient: Tensor

    def coefficients(self, positions: Tensor, frame: int) -> Tensor:
        """(..., K, 3) [m] of the modes in U (positions - predicted); positions: (..., N, 3) [m] in that frame."""
        away = coefficients_of(positions - self.about[frame], self.values)
        left = torch.einsum("ij,...j->...i", self.share[frame], away.flatten(-2))
        return left.unflatten(-1, away.shape[-2:])

    def unseen(self, positions: Tensor, frame: int) -> Tensor:
        """(..., N, 3) [m]: the part of positions (..., N, 3) [m] that would not have been found, U (positions - predicted)."""
        c = self.coefficients(positions.to(self.values), frame)
        return torch.einsum("nk,...kd->...nd", self.values, c).to(positions)

    def seen(
        self, positions: Tensor, deformation: Tensor, rotation: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Positions (T, N, 3) [m] and deformation gradients (T, N, 3, 3) of a motion as it would have been found.

        rotation: (3, 3) that the sequence started with: the modes' gradients are relative to the pose of its frame 0."""
        c = torch.stack([self.coefficients(x, t) for t, x in enumerate(positions.to(self.values))])
        shift = torch.einsum("nk,tkd->tnd", self.values, c)
        gradient = torch.einsum("tki,njk->tnij", c, self.gradient) @ rotation.to(c)
        return positions - shift.to(positions), deformation - gradient.to(deformation)

    def written(self) -> dict[str, Tensor]:
        """Of a checkpoint; the modes are the body's."""
        return {"about": self.about.cpu(), "share": self.share.cpu()}


@torch.no_grad()
def image_matrices(
    target: Target, found: Tensor, *, views: int, progress: Callable[[int], None] | None = None
) -> Tensor:
    """(T - 1, D, D) Gauss-Newton matrices [1/m^2] of the loss of images (mean over pixels and matte, absolute values made
    quadratic) at positions found (T, N, 3) [m], in the first modes, frame after frame; of `views` views each, in turns."""
    motion, carried = target.modal(), target.carried
    project(motion, target.scaffold, found)
    splats, device, every = carried.splats, found.device, len(target.scaffold.modes.energy)
    size, matrices = 3 * min(MODES, every), []
    directions = torch.eye(size, 3 * every, device=device).unflatten(1, (every, 3))

    def images(c: Tensor, frame: Tensor, window: Windows) -> Tensor:
        """(S, P) pixels of a frame (1,) under S coefficients (S, K, 3)."""
        shift, deformation = motion.displaced(c, frame, carried.modes)
        shapes = carried_covariance(deformation, splats.scales, splats.rotations)
        cameras, states = window.cameras.select([0] * len(c)), torch.arange(len(c), device=device)
        colors, back = carried.colors(deformation), target.background
        at = splats.means + shift
        return some_of(*rasterize(at, shapes, splats.opacities, colors, cameras, states, back))

    def some_of(colour: Tensor, alpha: Tensor) -> Tensor:
        values = torch.cat([colour, alpha[..., None]], -1).flatten(1)
        # an odd step meets all four channels
        return values[:, :: 2 * (values.shape[1] // (2 * VALUES)) + 1]

    def gram(here: Tensor, at: Tensor, window: Windows) -> Tensor:
        """(D, D) of one view. Each of two threads holds one Jacobian at a time, which is made in place."""
        base = images(here, at, window)
        weight = ((base - some_of(window.images, window.mattes)).abs() + ABSOLUTE).rsqrt()
        J = base.new_empty(size, base.shape[1])
        for rows, some in zip(J.split(TOGETHER), directions.split(TOGETHER)):
            rows.copy_(images(here + STEP * some, at, window))
        J.sub_(base).div_(STEP).mul_(weight)
        return (J @ J.T).double() / J.shape[1]

    @torch.no_grad()  # a thread has its own switch
    def matrix(frame: int) -> Tensor:
        at = torch.tensor([frame], device=device)
        here = motion.coefficients(at)
        own = target.windows.of_frame(frame)
        step = max(1, len(own) // views)
        chosen = range(frame % step, len(own), step)
        H = torch.zeros(size, size, dtype=torch.float64, device=device)
        for view in chosen:
            H += gram(here, at, own.select(torch.tensor([view], device=device))) / len(chosen)
        return H

    for H in (threaded if found.is_cpu else map)(matrix, range(1, len(target.offsets))):
        matrices.append(H)
        if progress is not None:
            progress(1)
    return torch.stack(matrices)


def responses(matrices: Tensor, energies: Tensor) -> tuple[Callable[[float], Tensor], float]:
    """(U (T, D, D) of every frame as a function of a, the unit of a): 0 for frame 0, which is known.

    matrices: (T - 1, D, D) of the frames after it; energies: (D / 3,) of the modes."""
    scale = (1 + BENT * energies.double()).repeat_interleave(3).sqrt()
    values, vectors = torch.linalg.eigh(matrices / scale / scale[:, None])
    unit = float(torch.linalg.eigvalsh(matrices).median())

    def share(a: float) -> Tensor:
        kept = (vectors * (a / (values.clamp(min=0) + a))[:, None, :]) @ vectors.mT
        found = kept / scale[:, None] * scale
        return torch.cat([torch.zeros_like(found[:1]), found])

    return share, unit


def measured(
    share: Callable[[float], Tensor], unit: float, moved: Tensor, followed: Tensor
) -> tuple[float, float]:
    """(a, share of the squares that it leaves unexplained) under which U explains how what was found moved when its prediction did.

    moved, followed: (T, D) [m] changes of the predictions' and of the found motions' coefficients, of frames with contact."""

    def left(a: float) -> float:
        explained = torch.einsum("tij,tj->ti", share(a)[-len(moved) :], moved)
        rest = (followed - explained).square().sum()
        return float(rest / followed.square().sum().clamp(min=1e-30))

    ends = torch.tensor(SHARES).log10().tolist()
    tried = (unit * torch.logspace(*ends, 51, dtype=torch.float64)).tolist()
    costs = [left(a) for a in tried]
    best = min(range(len(tried)), key=costs.__getitem__)
    return tried[best], costs[best]


def response_of(
    modes: Modes, matrices: Tensor, about: Tensor, found: Tensor, other_about: Tensor,
    other_found: Tensor, first_contact: int,
) -> tuple[Response, float, float]:  # fmt: skip
    """(the response, a over its unit, what it leaves unexplained) of a motion `found` about a prediction, from the one that was
    found about another; all (T, N, 3) [m]. matrices: `image_matrices`. Until first contact predictions do not differ."""
    count = matrices.shape[-1] // 3
    values, late = modes.values[:, :count], slice(max(1, first_contact), None)

    def change(one: Tensor, other: Tensor) -> Tensor:
        return coefficients_of(one - other, values)[late].double().flatten(1)

    share, unit = responses(matrices, modes.energy[:count])
    a, left = measured(share, unit, change(other_about, about), change(other_found, found))
    return Response(about, share(a).to(values), values, modes.gradient[..., :count]), a / unit, left

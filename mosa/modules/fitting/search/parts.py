"""Parts of a learned law: anisotropy (`operator`), a stiffness that varies (`stiffness`), or neither.

A richer law always reproduces the film better, as it also explains errors of grid, contact and form.
So each law predicts frames that were held back from it: the frames after first contact are divided
into `FOLDS` stretches, and each stretch is left out in turn. The laws are nested in the fitted one,
whose Jacobian says how they move: no rollout is needed.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

PARTS = ("operator", "stiffness")
"""Blocks of numbers that a law may do without."""
FOLDS = 4
"""Stretches of the frames after contact. Errors of neighbouring frames are alike, so single frames
would be predicted by their neighbours."""
WORTH = 0.6
"""Share of the isotropic law's error of held-back frames below which a richer law is taken.

Bodies without anisotropy: 0.73 to 1.0, as the parts explain errors of grid and contact; bodies with
it: 0.18 to 0.45 (docs/identification.md)."""


def named(parts: Sequence[str]) -> str:
    """A law by its parts: isotropic, operator, stiffness or operator+stiffness."""
    return "+".join(parts) or "isotropic"


def chosen(errors: Mapping[str, float]) -> str:
    """The law with the smallest error [m] if that is below `WORTH` of the isotropic law's, else the
    isotropic one. errors: by `named`."""
    best, plain = min(errors, key=errors.__getitem__), named(())
    return best if errors[best] < WORTH * errors[plain] else plain


def held_back(
    squares: Sequence[Tensor], owners: Sequence[str], numbers: Tensor, mean: Tensor, precision: Tensor,
    stretches: Sequence[Sequence[int]], compared: Mapping[int, tuple[int, float]],
) -> dict[str, float]:  # fmt: skip
    """Error [m] of each law's predictions of held-back positions, by `named`: geometric mean over
    frames of the root mean square distance.

    squares: (D + 1, D + 1) matrix [J r]^T [J r] of each frame's whitened residuals, of what belongs
    to no frame, then of each frame's positions alone; compared: of each frame, the index of the latter in `squares` and the
    length [m] of its unit; owners: block of each of the D numbers; numbers, mean, precision: (D,)
    where they stand, and their prior; stretches: frames that are left out together."""
    whole = torch.stack(list(squares[: len(squares) - len(compared)])).sum(0)
    parts = [part for part in PARTS if part in owners]
    errors = {}
    for some in itertools.chain.from_iterable(
        itertools.combinations(parts, count) for count in range(len(parts) + 1)
    ):
        free = torch.tensor([owner not in PARTS or owner in some for owner in owners])
        logarithms = []
        for stretch in stretches:
            seen = whole - sum(squares[frame] for frame in stretch)
            step = torch.cat([_step(seen, free, numbers, mean, precision), torch.ones(1).double()])
            for frame in stretch:
                positions, scale = compared[frame]
                length = float(step @ squares[positions] @ step)
                logarithms.append(0.5 * math.log(max(length, 1e-12)) + math.log(scale))
        errors[named(some)] = math.exp(sum(logarithms) / len(logarithms))
    return errors


def _step(square: Tensor, free: Tensor, numbers: Tensor, mean: Tensor, precision: Tensor) -> Tensor:
    """(D,) from `numbers` to the minimum of the linear problem, numbers not `free` at their mean."""
    H, g = square[:-1, :-1], square[:-1, -1]
    step = torch.where(free, torch.zeros_like(numbers), mean - numbers)
    slope = g + H @ step + precision * (numbers - mean)
    matrix = (H + torch.diag(precision))[free][:, free]
    step[free] = -torch.linalg.solve(matrix, slope[free])
    return step

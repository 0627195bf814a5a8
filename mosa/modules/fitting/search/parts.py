"""Which parts a learned law has: anisotropy (`operator`), a stiffness that varies (`stiffness`), both or neither.

A richer model always reproduces the film better, and bends what it has to what grid, contact and form get wrong. So each model
predicts frames that were held back from it: the frames after first contact in `FOLDS` stretches, every one of which is left out
in turn. The models are nested in the fitted one, and its Jacobian says how they move: no rollout is needed.
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
"""Stretches of the frames after first contact: neighbouring frames err alike, so that single ones would be told by the others."""
WORTH = 0.6
"""Of the isotropic model's error of held-back frames, which a richer model has to come below. Where the truth is isotropic, parts
that are not there bring it to 0.73 to 1.0, as they explain some of what grid and contact get wrong; where it is not, to 0.18 to 0.45
(docs/identification.md)."""


def named(parts: Sequence[str]) -> str:
    """A model by its parts: isotropic, operator, stiffness or operator+stiffness."""
    return "+".join(parts) or "isotropic"


def chosen(errors: Mapping[str, float]) -> str:
    """The model with the smallest error [m] where that is `WORTH` its while, else the isotropic one. errors: by `named`."""
    best, plain = min(errors, key=errors.__getitem__), named(())
    return best if errors[best] < WORTH * errors[plain] else plain


def held_back(
    squares: Sequence[Tensor], owners: Sequence[str], numbers: Tensor, mean: Tensor, precision: Tensor,
    stretches: Sequence[Sequence[int]], compared: Mapping[int, tuple[int, float]],
) -> dict[str, float]:  # fmt: skip
    """Geometric mean over frames [m] of the root mean square distance of positions that each model predicts of frames it has not
    seen, by `named`.

    squares: of every frame the matrix [J r]^T [J r] (D + 1, D + 1) of all whitened residuals that are learned from; compared: the
    index among further such matrices, of its positions alone, and what makes metres of their length; owners: of the D numbers the
    name of their block; numbers, mean, precision: (D,) where they stand, and their prior; stretches: frames that are left out
    together."""
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
    """(D,) from `numbers` to the least of the linear problem whose numbers that are not `free` are at their mean."""
    H, g = square[:-1, :-1], square[:-1, -1]
    step = torch.where(free, torch.zeros_like(numbers), mean - numbers)
    slope = g + H @ step + precision * (numbers - mean)
    matrix = (H + torch.diag(precision))[free][:, free]
    step[free] = -torch.linalg.solve(matrix, slope[free])
    return step

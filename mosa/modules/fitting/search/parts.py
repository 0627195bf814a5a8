"""Parts of a learned law: anisotropy (`operator`), a stiffness that varies (`stiffness`), or neither.

A richer law always reproduces the film better, as it also explains errors of grid, contact and form. So each law predicts frames
that were held back from it: the frames after first contact are divided into `FOLDS` stretches, and each stretch is left out in
turn. What a second grid would predict differently counts as error of every law, so that a gain within what the grid gets wrong is
none. The laws are nested in the fitted one, whose Jacobian says how they move: no rollout is needed."""

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
WORTH = 0.8
"""Share of the isotropic law's error of held-back frames below which a richer law is taken.

Isotropic bodies (torus, fish, twins of rabbit and mandarin): 0.91 to 1.0; anisotropic ones (rabbit,
mandarin, chick1): 0.31 to 0.69, with 4000 and 14,000 particles (docs/uncertainty.md)."""

UNKNOWN = 0.65
"""Error of the grid over the isotropic law's error of a held-back frame, where no second grid tells
it. The eight bodies above then stand on the same sides of `WORTH` as with a second grid: richer laws
have 0.83 to 1.0 of the isotropic law's error on isotropic bodies, at most 0.77 on the others."""


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
    stretches: Sequence[Sequence[int]], compared: Mapping[int, tuple[int, float, float | None]],
) -> dict[str, float]:  # fmt: skip
    """Error [m] of each law's predictions of held-back positions, by `named`: geometric mean over frames of the root mean square
    distance, that between two grids included.

    squares: (D + 1, D + 1) matrix [J r]^T [J r] of each frame's whitened residuals, of what belongs to no frame, then of each
    frame's positions alone; owners: block of each of the D numbers; numbers: (D,) where they stand; mean (D,), precision (D, D): of
    their prior; stretches: frames that are left out together; compared: of each frame, the index of its positions in `squares`, the
    length [m] of their unit and the distance [m] between two grids, None where it is unknown."""
    whole = torch.stack(list(squares[: len(squares) - len(compared)])).sum(0)
    parts = [part for part in PARTS if part in owners]
    errors: dict[str, float] = {}
    plain: dict[int, float] = {}  # square [m^2] of each frame, of the isotropic law, which is first
    for some in itertools.chain.from_iterable(
        itertools.combinations(parts, count) for count in range(len(parts) + 1)
    ):
        free = torch.tensor([owner not in PARTS or owner in some for owner in owners])
        logarithms = []
        for stretch in stretches:
            seen = whole - sum(squares[frame] for frame in stretch)
            step = torch.cat([_step(seen, free, numbers, mean, precision), torch.ones(1).double()])
            for frame in stretch:
                positions, scale, wrong = compared[frame]
                square = scale**2 * float(step @ squares[positions] @ step)
                first = plain.setdefault(frame, square)
                square += UNKNOWN**2 * first if wrong is None else wrong**2
                logarithms.append(0.5 * math.log(max(square, 1e-18)))
        errors[named(some)] = math.exp(sum(logarithms) / len(logarithms))
    return errors


def _step(square: Tensor, free: Tensor, numbers: Tensor, mean: Tensor, precision: Tensor) -> Tensor:
    """(D,) from `numbers` to the minimum of the linear problem, numbers not `free` at their mean."""
    H, g = square[:-1, :-1], square[:-1, -1]
    step = torch.where(free, torch.zeros_like(numbers), mean - numbers)
    slope = g + H @ step + precision @ (numbers + step - mean)
    matrix = (H + precision)[free][:, free]
    step[free] = -torch.linalg.solve(matrix, slope[free])
    return step

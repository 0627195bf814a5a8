"""What an adapter departs from the prior by, as numbers, and the penalties that are made of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class OperatorStatistics(NamedTuple):
    """Of one or more evaluations, with gradients: what penalties and reports are made of.

    mean_abs_C: over particles, the four matrices and all entries of |C|. mean, within: (48,) mean and variance over particles
    (after `pool`: over evaluations too) of each entry of C_x, C_y, C_z, C_xyz (36), L_pre (6), L_post (6). Of an adapter without
    these: of the entries that it notes."""

    mean_abs_C: Tensor
    mean: Tensor
    within: Tensor

    @property
    def mean_square(self) -> Tensor:
        """Mean squared entry: penalises any departure from the prior."""
        return (self.within + self.mean.square()).mean()

    @property
    def variance(self) -> Tensor:
        """Mean variance over states: a constant operator, the simplest anisotropy, has none."""
        return self.within.mean()


Penalty = Callable[[OperatorStatistics, float], Tensor]
"""Value () of a penalty, without its weight, from the statistics of a rollout's evaluations and the distance between what was seen
and the model that the stage starts from, over the object's size."""


MISFIT = 0.01
"""Misfit of the calibrated prior, over the object's size, at which the penalty of a departure has its stated weight."""


def departure(found: OperatorStatistics, misfit: float) -> Tensor:
    """Root mean square of what an adapter departs from the prior by. What the prior leaves unexplained is what there is to learn:
    the size that one expects grows with it, and the pull of a loss that is a distance, not its square, does not fade as it should
    with a small misfit."""
    return (MISFIT / misfit) ** 2 * (found.mean_square + 1e-8).sqrt()


def variation(found: OperatorStatistics, misfit: float) -> Tensor:
    """Mean variance over particles and states."""
    return found.variance


PENALTIES: dict[str, Penalty] = {"operator": departure, "operator_variance": variation}
"""Those that an adapter has where it does not say otherwise."""


def statistics_of(entries: Tensor, mean_abs_C: Tensor | None = None) -> OperatorStatistics:
    """Of what N particles depart from the prior by, (N, K) dimensionless numbers. mean_abs_C: None for their mean size."""
    mean = entries.mean(0)
    size = entries.abs().mean() if mean_abs_C is None else mean_abs_C
    return OperatorStatistics(size, mean, (entries - mean).square().mean(0))


def statistics(C: Tensor, pre: Tensor, post: Tensor) -> OperatorStatistics:
    """Of the corrections C (N, 4, 3, 3) and the residuals (N, 6) of N particles."""
    return statistics_of(torch.cat([C.flatten(1), pre, post], 1), C.abs().mean())


def pool(parts: Sequence[OperatorStatistics]) -> OperatorStatistics:
    """Over evaluations of equally many particles: the variance is then over particles and time."""
    means, within = torch.stack([p.mean for p in parts]), torch.stack([p.within for p in parts])
    mean = means.mean(0)
    size = torch.stack([p.mean_abs_C for p in parts]).mean()
    return OperatorStatistics(size, mean, (within + (means - mean).square()).mean(0))

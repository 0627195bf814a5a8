"""The exact assignment between two clouds of equally many points, found from coarse to fine (`emd_m` of docs/figures.md)."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

SMALL = 256
"""Points from which on half of them are assigned first."""
SWEEPS, SETTLED = 1000, 1e-12
"""Of shortest paths, at most, and the change in mean costs that is rounding. Potentials that are not at their end are a worse
start, and no other result."""


def assigned(cost: np.ndarray) -> np.ndarray:
    """The column of every row (N,) with the least sum of cost (N, N).

    SciPy's solver takes the longer the farther the clouds are apart: 0.7 s for 2048 points of one body, 7 s where a third of its
    size lies between them. The potentials of an assignment of half of the points take most of that distance out of the costs
    beforehand. Subtracting a number from a row or a column changes no assignment's rank, so the result is the same (Kuhn 1955)."""
    half = len(cost) // 2
    if len(cost) <= SMALL:
        return linear_sum_assignment(cost)[1]
    coarse = cost[:half, :half]
    columns = potentials(coarse, assigned(coarse))
    reduced = cost - (cost[:, :half] - columns).min(1, keepdims=True)
    reduced -= reduced.min(0)
    # no cost is negative, and most partners of the end are near zero
    reduced -= reduced.min(1, keepdims=True)
    return linear_sum_assignment(reduced)[1]


def potentials(cost: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Prices v (N,) of the columns under which each row's column in `columns`, the best assignment, is its cheapest:
    cost[i, j] - v[j] is least over j at columns[i]. Shortest paths from all columns over exchanges of partners (Bellman, Ford)."""
    exchange = cost - np.take_along_axis(cost, columns[:, None], 1)
    found = np.zeros(len(cost))
    for _ in range(SWEEPS):
        shorter = np.minimum(found, (found[columns][:, None] + exchange).min(0))
        moved, found = float((found - shorter).max()), shorter
        if moved <= SETTLED * float(cost.mean()):
            break
    return found

"""The assignment from coarse to fine is SciPy's own, which is exact, however far apart the clouds are."""

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from mosa.evaluation.assignment import SMALL, assigned, potentials


def clouds(count: int, apart: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Two samples of one ellipsoid, the second sheared and moved by `apart` of its size."""
    generator = np.random.default_rng(seed)
    a, b = generator.normal(size=(2, count, 3)) * [1.0, 1.0, 0.6]
    return a, b @ np.array([[1, 0.5 * apart, 0], [0, 1, 0], [0, 0, 1]]) + apart


@pytest.mark.parametrize("count", [1, 2, SMALL, SMALL + 1, 601])
@pytest.mark.parametrize("apart", [0.0, 0.1, 3.0])
def test_no_assignment_costs_less(count, apart):
    cost = cdist(*clouds(count, apart, seed=count))
    columns = assigned(cost)
    rows, best = linear_sum_assignment(cost)
    assert sorted(columns) == list(range(count))
    assert cost[rows, columns].sum() == pytest.approx(cost[rows, best].sum(), rel=1e-12)


LINE = np.arange(300.0)
TIED = {"zeros": np.zeros((300, 300)), "equal": np.full((300, 300), 7.0), "on a line": np.abs(np.subtract.outer(LINE, LINE)),
        "whole numbers": np.random.default_rng(0).integers(0, 3, (300, 300)).astype(float)}  # fmt: skip


@pytest.mark.parametrize("cost", TIED.values(), ids=TIED)
def test_many_best_assignments_are_no_trouble(cost):
    rows, best = linear_sum_assignment(cost)
    assert cost[rows, assigned(cost)].sum() == pytest.approx(cost[rows, best].sum(), rel=1e-12)


def test_prices_make_every_partner_the_cheapest():
    cost = cdist(*clouds(200, 1.0, seed=5))
    rows, columns = linear_sum_assignment(cost)
    prices = potentials(cost, columns)
    left = cost - prices
    assert np.abs(left[rows, columns] - left.min(1)).max() < 1e-9 * cost.mean()

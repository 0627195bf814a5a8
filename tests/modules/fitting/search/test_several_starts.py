"""Calibrations of laws with several valleys: Gauss-Newton from several starts, of which the nearest go on."""

import math
from types import SimpleNamespace

import pytest
import torch
from small_bodies import small_body, start, take_of
from torch import nn

from mosa.errors import SimulationDiverged
from mosa.modules.body.material import Material
from mosa.modules.fitting.search import backbone as backbone_search
from mosa.modules.fitting.search.backbone import FIRST, LAST, Starts, moved, nearest_end
from tests.modules.fitting.test_identification import identification


class Valleys:
    """One number x, which every iteration moves half of the way to the bottom of its valley: 5 mm at x = -1, 1 mm at x = 2. Beyond
    4 it cannot be simulated. The state is the number of iterations."""

    def __init__(self):
        material, contact = nn.ParameterDict({"x": nn.Parameter(torch.zeros(()))}), nn.Linear(1, 1)
        self.body = SimpleNamespace(material=material, contact=contact)
        self.x, self.iterations, self.asked = material["x"], 0, 0

    @torch.no_grad()
    def start_at(self, row):
        self.x.fill_(row["x"])

    @torch.no_grad()
    def iterate(self):
        self.iterations, self.asked = self.iterations + 1, self.asked + 1
        if float(self.x) > 4:
            raise SimulationDiverged("too far")
        bottom = -1.0 if float(self.x) < 0.5 else 2.0
        self.x += 0.5 * (bottom - self.x)
        with torch.no_grad():
            self.body.contact.bias += 1

    def score(self):
        x = float(self.x)
        return 5e-3 + 1e-3 * abs(x + 1) if x < 0.5 else 1e-3 + 8e-3 * abs(x - 2)

    def state(self):
        return {"iterations": self.iterations}

    def restore(self, state):
        self.iterations = state["iterations"]


def test_the_valley_that_is_lowest_after_a_few_iterations_is_taken():
    found = Valleys()
    bias = float(found.body.contact.bias.detach())
    rows = [{"x": -1.0}, {"x": 0.4}, {"x": 3.0}, {"x": 5.0}]
    assert found.score() == pytest.approx(6e-3)  # the first start is nearest before any iteration
    distance = nearest_end(found, found.start_at, rows)
    assert distance == found.score() == pytest.approx(1e-3 + 8e-3 * 0.5 ** (FIRST + LAST))
    assert (
        float(found.x) == pytest.approx(2.0, abs=0.1) and found.iterations == 0
    )  # as if it had not begun
    assert float(found.body.contact.bias.detach()) == pytest.approx(
        bias + FIRST + LAST
    )  # each began with the contact as it was
    assert found.asked == 3 * FIRST + 1 + 3 * LAST  # the fourth ended at its first iteration


def test_starts_that_cannot_be_simulated_are_an_error_only_where_all_are():
    found = Valleys()
    with pytest.raises(SimulationDiverged, match="too far"):
        nearest_end(found, found.start_at, [{"x": 5.0}, {"x": 6.0}])


def test_several_seats_score_starts_as_one_does():
    """To the bit, each with a body of its own; a place that cannot be simulated is infinitely far."""
    take = take_of(small_body(adapter=False), start(turn=0.5), 6)
    rows = []
    for seats in (1, 2):
        found = identification(small_body(adapter=False), [take], "prior", seats=seats)
        starts = Starts(found)
        places = [starts.row(multiple, 0.3, {}) for multiple in (0.5, 1.0, 2.0, 1e9)]
        rows.append(starts.scores(places))
        assert len(starts._bodies) == seats and starts.score(places[1]) == rows[0][1]
    assert rows[0] == rows[1] and rows[0][3] == float("inf") and len(set(rows[0])) == 4


def yielding(law="herschel_bulkley_hencky", **numbers):
    made = small_body(adapter=False)
    made.material = Material(law, numbers).double()
    return made


def test_numbers_are_moved_alone_and_in_pairs_so_that_many_of_them_have_no_more_starts_than_can_be_tried():
    assert moved(["E", "nu"]) == [{}]
    two = moved(["mu", "kappa", "yield_stress", "viscosity"])
    assert (
        len(two) == 9
        and {"yield_stress": -1.1, "viscosity": 1.6} in two
        and {"viscosity": -1.6} in two
        and {} in two
    )
    assert len(moved(["E", "nu", "fibre_stiffness", "fibre_1", "fibre_2"])) == 19
    assert (
        len(moved(["E", "nu", *(f"n{i}" for i in range(8))])) == 1 + 2 * 8 + 4 * 28
    )  # all combinations: 6561


def test_a_law_of_four_numbers_is_calibrated_nearer_than_by_a_search_in_one_after_the_other(
    monkeypatch,
):
    """A soft body that yields early, begun at what the configuration of its law says."""
    truth = yielding(mu=2e4, kappa=6e4, yield_stress=300.0, viscosity=3.0)
    take, ends = take_of(truth, start(height=0.09, speed=-1.0), 8), {}
    for several in (True, False):
        if not several:
            monkeypatch.setattr(backbone_search, "MANY", 5)
        body = yielding(mu=3e4, kappa=2e5, yield_stress=2000.0, viscosity=10.0)
        found = identification(body, [take], "prior")
        assert found.search() == pytest.approx(found.score(), rel=1e-12)
        assert found.iteration == 0 and not found.converged
        ends[several] = found.distance()
    assert ends[True] < 0.5 * ends[False]


def test_a_yield_stress_far_from_the_truth_leads_to_no_wrong_stiffness(monkeypatch):
    """von Mises' law begun at a twelfth of the yield stress, and at eighty times: beside it, the best stiffness is a wrong one. A
    grid of fixed size reaches the first alone: the motion reaches none of its yield stresses in the second."""
    truth = yielding("von_mises", E=1e5, nu=0.3, yield_stress=2500.0)
    take = take_of(truth, start(height=0.09, speed=-1.5), 8)

    def error(configured: float) -> float:
        body = yielding("von_mises", E=3e4, nu=0.4, yield_stress=configured)
        found = identification(body, [take], "prior")
        found.search()
        for _ in range(4):
            found.iterate()
        return abs(math.log(float(body.material.physical()["E"].detach()) / 1e5))

    assert error(2e5) < 0.1
    monkeypatch.setattr(backbone_search, "FURTHEST", 1.0)
    assert error(200.0) < 0.1 < 1 < error(2e5)


def test_a_law_that_yields_is_calibrated_with_the_substeps_of_its_own_numbers():
    """With those of another stiffness the motion loses as much more or less as a wrong stiffness explains: with 8 substeps too many
    it ended at 0.76 of the true one."""
    truth = yielding("von_mises", E=1e6, nu=0.3, yield_stress=2500.0)
    take = take_of(truth, start(height=0.09, speed=-1.5), 8)
    body = yielding("von_mises", E=6e5, nu=0.35, yield_stress=3000.0)
    found = identification(body, [take], "prior")
    for _ in range(4):
        found.iterate()
    assert float(body.material.physical()["E"].detach()) == pytest.approx(1e6, rel=0.05)
    assert found.distance() < 5e-5

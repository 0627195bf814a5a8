"""Which parts a law has: nested models predict frames that were held back from them."""

import math

import pytest
import torch
from small_bodies import WORLD, E, small_body, start, take_of
from without_trainer import identify

from mosa.modules.fitting.gauss_newton import KNOWN, Posterior
from mosa.modules.fitting.identification import Identification
from mosa.modules.fitting.identification_settings import Criterion, IdentificationSettings
from mosa.modules.fitting.search.backbone import valleys
from mosa.modules.fitting.search.parts import UNKNOWN, WORTH, chosen, held_back
from mosa.modules.fitting.stages import Stage
from mosa.training.lit_mosa import LitMosa

OWNERS = ["E", "operator", "operator", "stiffness"]
FRAMES, ROWS = 8, 40


def errors_of(
    truth: torch.Tensor, noise: float = 0.01, grids: float | None = 0.0
) -> dict[str, float]:
    """Of linear data of numbers `truth` (4,), where the fit stands at 0; the rows are positions in
    units of 2 mm. grids: distance [m] between the predictions on two grids, None where it is unknown."""
    generator = torch.Generator().manual_seed(0)
    J = torch.randn(FRAMES, ROWS, 4, generator=generator, dtype=torch.float64)
    r = -J @ truth + noise * torch.randn(FRAMES, ROWS, generator=generator, dtype=torch.float64)
    table = torch.cat([J, r[..., None]], -1)
    squares = list(table.mT @ table)
    zero, one = torch.zeros(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64)
    stretches = [[0, 1], [2, 3], [4, 5], [6, 7]]
    compared = {k: (FRAMES + k, 2e-3, grids) for k in range(FRAMES)}
    return held_back(squares + squares, OWNERS, zero, zero, one, stretches, compared)


def test_the_parts_that_the_truth_has_are_found():
    """Left out, a part of size 1 leaves an error of sqrt(ROWS) rows of 2 mm, within the scatter of the draws."""
    assert chosen(errors_of(torch.tensor([1.0, 0, 0, 0]).double())) == "isotropic"
    assert chosen(errors_of(torch.tensor([1.0, 1, 1, 0]).double())).startswith("operator")
    both = errors_of(torch.tensor([1.0, 1, 1, 1]).double())
    assert set(both) == {"isotropic", "operator", "stiffness", "operator+stiffness"}
    assert chosen(both) == "operator+stiffness"
    missed = errors_of(torch.tensor([0.0, 0, 0, 1]).double())
    assert missed["operator"] == pytest.approx(2e-3 * math.sqrt(ROWS), rel=0.2)


def test_a_part_that_gains_little_is_left_out():
    errors = {"isotropic": 1e-3, "operator": 1.01 * WORTH * 1e-3}
    assert chosen(errors) == "isotropic"
    assert chosen(errors | {"operator+stiffness": 0.99 * WORTH * 1e-3}) == "operator+stiffness"


def test_a_gain_within_the_error_of_the_grid_is_none():
    truth = torch.tensor([1.0, 1, 1, 0]).double()
    sharp, blurred = errors_of(truth), errors_of(truth, grids=0.1)
    assert chosen(sharp).startswith("operator") and chosen(blurred) == "isotropic"
    for name, error in sharp.items():
        assert blurred[name] == pytest.approx(math.hypot(error, 0.1), rel=1e-2)


def test_without_a_second_grid_the_grid_is_not_taken_to_be_exact():
    """A gain of a quarter, which a grid gives an isotropic body, is none; half of the error is one."""
    truth = torch.tensor([1.0, 1, 1, 0]).double()
    alone, exact = errors_of(truth, grids=None), errors_of(truth)
    plain = exact["isotropic"]
    assert alone["isotropic"] == pytest.approx(plain * math.hypot(1, UNKNOWN), rel=1e-9)
    for name, error in exact.items():  # to what the frames' means of logarithms allow
        assert alone[name] == pytest.approx(math.hypot(error, UNKNOWN * plain), rel=0.1)
    gains = [math.hypot(gain, UNKNOWN) / math.hypot(1, UNKNOWN) for gain in (0.74, 0.65)]
    assert gains[1] < WORTH < gains[0]


def test_a_held_back_frame_is_not_learned_from():
    """One frame says something else than the others: it is predicted as wrongly as it differs, and they are not."""
    J = torch.ones(3, 1, 1, dtype=torch.float64)
    r = torch.tensor([0.0, 0.0, -2.0], dtype=torch.float64)[:, None, None]
    table = torch.cat([J, r], -1)
    squares = list(table.mT @ table)
    zero, loose = torch.zeros(1, dtype=torch.float64), torch.full((1, 1), 1e-9).double()
    found = held_back(
        squares * 2, ["E"], zero, zero, loose, [[2]], {k: (3 + k, 1.0, 0.0) for k in range(3)}
    )
    assert found == {"isotropic": pytest.approx(2.0)}


def test_valleys_of_a_grid_are_found_the_lowest_first():
    heights = [[5, 4, 5, 6], [4, 3, 5, 2], [5, 4, math.inf, 6]]
    grid = {(i, j): float(h) for i, row in enumerate(heights) for j, h in enumerate(row)}
    assert valleys(grid) == [(1, 3), (1, 1)]
    assert valleys({(0, 0): math.inf}) == []


def test_a_posterior_of_fewer_numbers_is_one_of_all():
    """What the model does without is 0, and known to be."""
    covariance = torch.tensor([[2.0, 0.5], [0.5, 1.0]], dtype=torch.float64)
    own = Posterior(["E", "contact"], torch.tensor([3.0, 4.0]).double(), covariance, torch.tensor([0.9, 0.8]).double(),
                    rivals={"stvk": torch.tensor([5.0, 6.0]).double()})  # fmt: skip
    whole = own.among(["E", "nu", "contact"])
    assert whole.mean.tolist() == [3, 0, 4] and whole.determined.tolist() == pytest.approx(
        [0.9, 0, 0.8]
    )
    assert torch.equal(whole.covariance[::2, ::2], covariance)
    assert float(whole.covariance[1, 1]) == pytest.approx(KNOWN**2)
    assert whole.rivals["stvk"].tolist() == [5, 0, 6]
    assert float(whole.draws(50)[:, 1].abs().max()) < 1e-5


def fallen(frames: int = 7, **body):
    """A film of a body's drop."""
    take = take_of(small_body(**body), start(turn=0.5, speed=-2.0), frames)
    take.again = None
    return take


def fitted(monkeypatch, errors: dict[str, float] | None, take=None) -> LitMosa:
    """A fit of a film, by default an anisotropic body's. errors: of held-back frames in place of its own."""
    if take is None:
        take = fallen(numbers=torch.linspace(-0.3, 0.4, 19, dtype=torch.float64))
    if errors is not None:
        monkeypatch.setattr(Identification, "held_back", lambda self: errors)
    stages = [
        Stage(name=name, iterations=3, lr=0.1, optimizer="gauss_newton")
        for name in ("prior", "joint")
    ]
    stages = [stages[0].but(iterations=1), stages[1]]
    module = LitMosa.of_parts(small_body(E=1.1 * E, on=False), takes=[take], world=WORLD,
                              background=torch.ones(3), weights={"position": 1.0}, stages=stages,
                              criterion=Criterion(name="corrected"),
                              settings=IdentificationSettings(grid_error=0.0))  # fmt: skip
    identify(module)
    return module


def test_a_law_without_the_operator_is_the_calibrated_prior(monkeypatch):
    """Its numbers are 0, and the posterior knows them to be."""
    module = fitted(monkeypatch, {"isotropic": 1e-3, "operator": 0.9e-3})
    assert module.parts == {"isotropic": 1e-3, "operator": 0.9e-3}
    assert not bool(module.body.adapter.numbers.any())
    posterior = module.posterior
    assert posterior.names == ["E", "nu", *(f"operator[{i}]" for i in range(19))]
    assert float(posterior.determined[0]) > 0.5 and not bool(posterior.determined[2:].any())
    moved = float((module.body.material.raw["E"].detach() - module.body.material.begins["E"]).abs())
    assert moved > 0.01


def test_an_isotropic_law_is_what_the_cues_of_both_looks_say(monkeypatch):
    """The mean of the two calibrations by their precisions, which is exact for linear problems; its deviations are those of the
    later cues alone, so that no image counts twice. A law that yields is what the later ones say."""
    first, later = fallen(), fallen(5, E=1.03 * E)

    def calibrated(take) -> Posterior:
        alone = Identification(small_body(E=1.1 * E, on=False), [take], WORLD, Stage(name="prior", iterations=6, lr=0.1),
                               Criterion(name="corrected"), IdentificationSettings(grid_error=0.0))  # fmt: skip
        alone.iterate_until_converged(6)
        return alone.posterior()

    def look(self, response: bool = True) -> None:
        self.takes, self.informed = [later], True

    one, other = calibrated(first), calibrated(later)
    assert float(other.mean[0] - one.mean[0]) == pytest.approx(math.log(1.03), rel=0.05)
    told = [torch.linalg.inv(each.covariance) for each in (one, other)]
    mean = torch.linalg.solve(sum(told), told[0] @ one.mean + told[1] @ other.mean)
    monkeypatch.setattr(LitMosa, "inform", look)
    found = fitted(monkeypatch, {"isotropic": 1e-3, "operator": 0.9e-3}, first).posterior
    assert float(found.mean[0]) == pytest.approx(float(mean[0]), abs=0.05 * math.log(1.03))
    assert torch.allclose(found.covariance[:2, :2], other.covariance, rtol=0.2)
    monkeypatch.setattr(LitMosa, "is_plastic", lambda self: True)
    found = fitted(monkeypatch, {"isotropic": 1e-3, "operator": 0.9e-3}, first).posterior
    assert float(found.mean[0]) == pytest.approx(float(other.mean[0]), abs=0.05 * math.log(1.03))


def test_an_operator_that_predicts_held_back_frames_is_kept(monkeypatch):
    """By its own errors: the truth is anisotropic and there is no noise."""
    module = fitted(monkeypatch, None)
    assert module.parts["operator"] < WORTH * module.parts["isotropic"]
    assert bool(module.body.adapter.numbers.any()) and len(module.posterior.names) == 21

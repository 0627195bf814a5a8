"""Identification of a small body from its own rollouts: what it finds, what it leaves alone, going on after a stop, threads."""

import copy
import math
from dataclasses import replace

import pytest
import torch
from small_bodies import DX, FRAME_DT, NU, WORLD, E, cues_of, small_body, start, take_of

from mosa.data.observations import Observations
from mosa.data.synthetic.renderer import ring_of_cameras
from mosa.errors import ConfigError, SimulationDiverged
from mosa.evaluation.analysis.anisotropy import dyads
from mosa.evaluation.analysis.stiffness import angle_between, stiffest
from mosa.modules.adapters.hyperelastic import anisotropic_basis
from mosa.modules.adapters.stress import StressAdapter
from mosa.modules.fitting import identification as identification_module
from mosa.modules.fitting import residuals
from mosa.modules.fitting.gauss_newton import Posterior, Seat
from mosa.modules.fitting.identification import (
    COARSER,
    EVIDENCE_ITERATIONS,
    NOISE_ITERATIONS,
    SOFTLY,
    Identification,
)
from mosa.modules.fitting.identification_settings import Criterion, IdentificationSettings
from mosa.modules.fitting.parameters import as_rival, read_numbers, write_numbers
from mosa.modules.fitting.search.backbone import compass
from mosa.modules.fitting.stages import Stage
from mosa.reconstruction.motion.response import Response
from mosa.training.lit_mosa import LitMosa

FRAMES = 12
AXIS = torch.nn.functional.normalize(torch.tensor([1.0, 0.6, 0.3], dtype=torch.float64), dim=0)


def fibres(strength: float, axis: torch.Tensor = AXIS) -> torch.Tensor:
    """(19,) numbers of a body that is stiffer along `axis`: strength times the anisotropic part of nnnn."""
    N = dyads(axis[None])[0]
    return strength * torch.einsum(
        "kij,i,j->k", anisotropic_basis(torch.float64, torch.device("cpu")), N, N
    )


def identification(
    body, takes, stage="joint", criterion=None, seats=1, kinds=(True, True, True), known=None, **settings
) -> Identification:  # fmt: skip
    return Identification(body, takes, WORLD, Stage(name=stage, iterations=40, lr=0.1), criterion or Criterion(name="corrected"),
                          IdentificationSettings(**settings), kinds, seats=seats, known=known)  # fmt: skip


def run(found: Identification, most: int = 8) -> int:
    for i in range(most):
        report = found.iterate()
        assert report["after"] <= report["before"]
        if found.converged:
            return i + 1
    return most


def test_outlines_tell_the_stiffness_where_cues_are_wrong(monkeypatch):
    """The cues are those of a body that is three times as stiff."""
    seen_from = {"distance": 0.6, "elevations": (0.1, 0.5), "field": 0.15, "turn": 0.2}
    cameras = ring_of_cameras(4, 96, target=(0.0, 0.06, 0.0), **seen_from)
    body, true, begins = (
        small_body(adapter=False, E=3 * E),
        small_body(adapter=False),
        start(speed=-2.0),
    )
    x = true.simulate(begins, WORLD, FRAMES, FRAME_DT).x.detach()
    film = Observations(None, torch.zeros(4, FRAMES, 96, 96).double(), None, cameras, 96)
    with monkeypatch.context() as whole:
        whole.setattr(residuals, "PIXELS", 1)
        edge = residuals.outlines(film.mattes)
        seen = residuals.silhouettes(x, true.spacing, film, edge).position  # nothing was filmed yet
    film.mattes[:, 1:] = seen.reshape(FRAMES - 1, 4, 96, 96).transpose(0, 1)
    take = take_of(body, begins, FRAMES)
    take.observations = film
    stage = Stage(name="prior", iterations=8, lr=0.1, silhouettes=True)
    found = Identification(body, [take], WORLD, stage, Criterion(), IdentificationSettings())
    found.iterate_until_converged(8)
    assert float(body.material.physical()["E"].detach()) == pytest.approx(E, rel=0.03)


@pytest.mark.parametrize("lowered, stops", [(0.4, 6), (0.6, None)])
def test_an_iteration_that_hardly_lowers_the_cost_is_the_last(monkeypatch, lowered, stops):
    """Though it goes far, along what the data do not tell; not while noise and sizes are still being found."""
    body = small_body()
    found = identification(body, [take_and_turn(small_body(), 0.5)])
    monkeypatch.setattr(
        found.newton,
        "iterate",
        lambda **_: {"before": 10.0, "after": 10.0 - lowered, "share": 1.0, "length": 3.0},
    )
    assert next((i + 1 for i in range(8) if found.iterate() and found.converged), None) == stops


def test_the_comparison_stage_makes_its_passes_with_one_jacobian(monkeypatch):
    found = identification(small_body(), [take_and_turn(small_body(), 0.5)])
    passes = []
    monkeypatch.setattr(found, "_served", lambda: "served")
    monkeypatch.setattr(
        found.newton,
        "iterate",
        lambda J, **_: (
            passes.append(J) or {"before": 10.0, "after": 9.0, "share": 1.0, "length": 3.0}
        ),
    )
    found.iterate()
    assert passes == [None]
    found.compares = True
    found.iterate()
    assert passes == [None, None, "served", "served"]


def test_a_jacobian_that_serves_again_is_that_of_the_noise_in_use(monkeypatch):
    found = identification(
        small_body(), [take_and_turn(small_body(numbers=fibres(0.3)), 0.5, frames=SHORT)]
    )
    found.newton.steps = 0  # it stays where it stands
    found.iterate()
    found.iteration, prepare = NOISE_ITERATIONS, found.prepare

    def with_other_noise() -> float:
        found.noise = [
            tuple(each * factor for each, factor in zip(scales, (2.0, 3.0, 0.5)))
            for scales in found.noise
        ]
        return prepare()

    monkeypatch.setattr(found, "prepare", with_other_noise)
    served = found._served().clone()
    fresh = found.newton.jacobian(found.newton.seats[0].read(), found._residuals)
    assert float((served - fresh).norm()) < 1e-6 * float(fresh.norm())


def test_rollouts_for_a_jacobian_begin_where_the_body_comes_near_the_ground():
    """Every frame of them until then is the flight's; their columns are those of whole rollouts but for the little that corrections
    deform the body in flight, and the contact's own is made of whole ones."""
    truth = small_body(numbers=fibres(0.3), contact=True)
    body = small_body(contact=True)
    take = take_of(truth, start(height=0.2, turn=0.5), 9)
    found = identification(body, [take], seats=2)
    found.prepare()
    ((_, flight),) = found._flown.values()
    assert 2 < len(flight.x) < take.first_contact + 1
    seat = found.newton.seats[0]
    numbers, r = seat.read(), seat.residuals()
    flown = found.newton.jacobian(numbers, r)
    found._flown = {}
    whole = found.newton.jacobian(numbers, r)
    contact = found.newton.names().index("contact")
    assert torch.equal(flown[:, contact], whole[:, contact])
    assert 0 < float((flown - whole).norm()) < 1e-2 * float(whole.norm())


@pytest.mark.parametrize("gain", [0.0, 0.5])
def test_a_rollout_goes_on_from_its_first_frames_bit_for_bit(gain):
    body, take = small_body(), take_and_turn(small_body(numbers=fibres(0.3)), 0.5, frames=SHORT)
    ready = body.ready(take.start, WORLD, SHORT, FRAME_DT)
    seen = take.cues.positions if gain else None
    with torch.no_grad():
        whole = ready.simulate(SHORT, observed=seen, gain=gain)
        begun = ready.simulate(4, observed=None if seen is None else seen[:4], gain=gain)
        again = ready.simulate(SHORT, observed=seen, gain=gain, begun=begun)
    for name in ("x", "v", "F", "F_tot"):
        assert torch.equal(getattr(again, name), getattr(whole, name)), name


def test_the_comparison_and_the_joint_stage_share_their_first_jacobian():
    """The comparison's columns are among those of the joint stage, which are what it would have made itself, to the bit."""
    take = take_and_turn(small_body(numbers=fibres(0.3), modes=True), 0.5, frames=SHORT)
    take.again = None
    body = small_body(modes=True, on=False)
    stages = [
        Stage(name=name, iterations=1, lr=0.1, optimizer="gauss_newton", start=begins)
        for name, begins in (("prior_eta", None), ("joint", "prior"))
    ]
    module = LitMosa.of_parts(
        body, takes=[take], world=WORLD, background=torch.ones(3), stages=stages,
        weights={"position": 1.0}, criterion=Criterion(name="corrected"),
    )  # fmt: skip
    compared = module.begun(stages[0])
    own = module.identifying(stages[0]).columns()
    assert compared.first.shape == own.shape
    assert float((compared.first - own).norm()) < 1e-6 * float(own.norm())
    module.end(stages[0])
    module.begin(stages[1])
    joint = module.begun(stages[1])
    assert torch.equal(joint.first, module.identifying(stages[1]).columns())
    assert module.columns is None


def test_the_first_iterations_on_several_drops_count_a_part_of_the_data():
    """Of one drop, in a calibration and in a stage too short for it all of it."""
    truth = small_body(numbers=fibres(0.3))
    several = [take_and_turn(truth, angle, frames=SHORT) for angle in (0.5, 1.6)]
    found = identification(small_body(), several)
    found.iterate()

    def counted(iteration: int) -> float:
        found.iteration = iteration
        return float(found.newton.seats[0].residuals().double().square().sum())

    whole = counted(len(SOFTLY))
    assert whole > 0 and counted(40) == whole
    assert [counted(i) / whole for i in range(len(SOFTLY))] == pytest.approx(SOFTLY, rel=1e-5)
    short = Identification(
        small_body(),
        several,
        WORLD,
        Stage(name="joint", iterations=3, lr=0.1),
        Criterion(name="corrected"),
        IdentificationSettings(),
    )
    assert identification(small_body(), several[:1]).softly == short.softly == ()
    assert identification(small_body(adapter=False), several, "prior").softly == ()


def test_a_fit_of_several_drops_is_not_over_before_all_data_count(monkeypatch):
    found = identification(
        small_body(), [take_and_turn(small_body(), angle) for angle in (0.5, 1.6)]
    )
    monkeypatch.setattr(
        found.newton,
        "iterate",
        lambda **_: {"before": 10.0, "after": 10.0, "share": 0.0, "length": 0.0},
    )
    assert next(i + 1 for i in range(9) if found.iterate() and found.converged) == len(SOFTLY) + 2


def values(body) -> dict[str, float]:
    return {name: float(value.detach()) for name, value in body.material.physical().items()}


SHORT = 7
"""Frames that are enough to touch the ground: where computations are compared with each other, not with the truth."""


def take_and_turn(body, angle, axis=(0.3, 0.5, 0.8), frames=FRAMES):
    return take_of(body, start(turn=angle, axis=axis), frames)


@pytest.mark.parametrize("begins", [{"E": 1e4, "nu": 0.25}, {"E": 7e4, "nu": 0.44}])
def test_a_calibration_finds_modulus_and_poisson_number_from_the_coarse_grid(begins):
    """Its own rollouts have no noise but the floor that cues are given; what is found is exact to the tolerance of the steps."""
    truth = small_body(adapter=False)
    body = small_body(adapter=False, E=begins["E"], nu=begins["nu"])
    found = identification(body, [take_and_turn(truth, 0.5)], "prior")
    before = found.score()
    score = found.search()
    assert score == found.score() < before
    assert (
        body.material.begins["E"] == small_body(adapter=False, **begins).material.begins["E"]
    )  # the prior's mean stays
    run(found)
    assert found.converged
    assert values(body)["E"] == pytest.approx(E, rel=1e-3) and values(body)["nu"] == pytest.approx(
        NU, abs=1e-3
    )
    assert found.distance() < 1e-5
    posterior = found.posterior()
    assert posterior.names == ["E", "nu"] and posterior.determined.min() > 0.99
    away = found.rollout(body, 0).x - found.takes[0].cues.positions
    seen = away[found.takes[0].first_contact :]
    assert posterior.model_error == pytest.approx(float((seen**2).sum(-1).mean().sqrt()), rel=1e-9)
    assert 0 < found.takes[0].first_contact < FRAMES - 3 and posterior.model_error < 1e-5


def test_a_calibration_stays_where_the_time_step_allows_it():
    """The truth is stiffer than the substeps that are allowed can bear: it comes near that bound, and ends. An iteration holds its
    substeps and did not see the bound; the next one ended the run with all that was found."""
    stiff = 100 * E
    truth, body = small_body(adapter=False, E=stiff), small_body(adapter=False, E=stiff / 12)
    found = identification(body, [take_and_turn(truth, 0.5)], "prior", Criterion(name="free"))
    body.settings = body.settings.but(max_substeps=32)

    def allowed(share: float) -> bool:
        try:
            small = small_body(adapter=False, E=share * stiff)
            small.settings = body.settings
            small.simulate(start(), WORLD, 2, FRAME_DT)
        except ConfigError:
            return False
        return True

    bound = max(share for share in (0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0) if allowed(share))
    assert 0.1 < bound < 1
    run(found)
    assert allowed(values(body)["E"] / stiff) and values(body)["E"] > bound / 2 * stiff
    assert math.isfinite(found.distance())


def test_a_contact_offset_is_found_with_them():
    truth = small_body(adapter=False, contact=True)
    with torch.no_grad():
        truth.contact.cells.fill_(0.42)
    body = small_body(adapter=False, contact=True, E=2e4, nu=0.3)
    found = identification(
        body, [take_and_turn(truth, 0.5), take_and_turn(truth, 1.5, (1.0, 0.0, 0.2))], "prior"
    )
    found.search()
    run(found)
    assert float(body.contact.cells.detach()) == pytest.approx(0.42, abs=0.01)
    assert values(body)["E"] == pytest.approx(E, rel=0.02) and values(body)["nu"] == pytest.approx(
        NU, abs=0.01
    )


def test_what_two_sequences_say_adds_up():
    """Minus the logarithm of the likelihood, and the precision of the numbers that it brings, are sums over the sequences."""
    truth = small_body(adapter=False)
    takes = [take_and_turn(truth, 0.5), take_and_turn(truth, 1.6, (1.0, 0.0, 0.2))]
    costs, precisions = [], []
    for some in (takes[:1], takes[1:], takes):
        found = identification(small_body(adapter=False, E=2e4, nu=0.3), some, "prior")
        costs.append(
            found.iterate()["before"]
        )  # the first iteration begins at the prior's mean, which costs nothing
        precisions.append(found.newton.data)
    assert costs[2] == pytest.approx(costs[0] + costs[1], rel=1e-9) and min(costs) > 0
    assert torch.allclose(precisions[2], precisions[0] + precisions[1], rtol=1e-9, atol=0)
    assert not torch.allclose(precisions[0], precisions[1], rtol=1e-2, atol=0)


@pytest.mark.parametrize("criterion", ["free", "corrected"])
def test_the_stiff_direction_of_a_body_is_found_from_its_drops(criterion):
    """It starts as the isotropic prior with the right E and nu; two drops on different sides."""
    truth = small_body(numbers=fibres(0.6))
    takes = [take_and_turn(truth, 0.5), take_and_turn(truth, 1.6, (1.0, 0.0, 0.2))]
    body = small_body()
    found = identification(body, takes, criterion=Criterion(name=criterion))
    missed = found.distance()
    run(found, 5)
    true_axis, true_ratio = stiffest(truth.adapter.stiffness().detach())
    axis, ratio = stiffest(body.adapter.stiffness().detach())
    assert float(angle_between(true_axis, AXIS)) < 1.5 and float(true_ratio) > 1.6
    # directions are tried 1.5 degrees apart; the ratio is drawn towards 1 by the prior and the floor of the noise
    assert float(angle_between(axis, AXIS)) < 6
    assert 1 + 0.5 * (float(true_ratio) - 1) < float(ratio) < 1.1 * float(true_ratio)
    assert values(body)["E"] == pytest.approx(E, rel=0.03)
    assert found.distance() < 0.4 * missed
    assert len(found.posterior().names) == 2 + 19


def test_the_papers_operator_without_its_networks_explains_what_no_isotropic_law_does():
    body = small_body(adapter=False, counts=(4, 3, 3))
    truth = small_body(numbers=fibres(0.6), counts=(4, 3, 3))
    body.adapter = StressAdapter(
        alpha=0.2, major_symmetry=True, state_dependence="constant", no_pre=True, no_post=True
    ).double()
    body.adapter.switch_on(E, NU)
    found = identification(body, [take_and_turn(truth, 0.5)])
    missed = found.distance()
    run(found, 3)
    assert found.distance() < 0.4 * missed
    assert len(found.posterior().names) == 2 + 48


def test_rivals_explain_the_drop_with_their_own_numbers(monkeypatch):
    """A neo-Hookean body, seen in a drop, identified with a corotated backbone: the laws of other forms come nearer to the
    drop than with the corotated law's numbers, and the body stays the corotated one."""
    truth = small_body(adapter=False, law="neo_hookean")
    body = small_body(law="corotated")
    found = identification(
        body, [take_of(truth, start(turn=0.5, axis=(0.3, 0.5, 0.8), speed=-1.5), FRAMES)]
    )
    run(found, 3)
    posterior, here = found.posterior(), read_numbers(body)
    assert set(posterior.rivals) == {"neo_hookean", "stvk"} and body.material.law == "corotated"
    costs = {}
    for law, numbers in posterior.rivals.items():
        assert len(numbers) == len(posterior.mean)
        for name, at in (("own", numbers), ("given", here)):
            with as_rival(body, law, at):
                assert body.material.law == law
                costs[law, name] = float(found.newton.seats[0].residuals().square().sum())
        assert costs[law, "own"] < 0.5 * costs[law, "given"]
    assert costs["neo_hookean", "own"] < costs["stvk", "own"]
    assert body.material.law == "corotated" and torch.equal(read_numbers(body), here)
    monkeypatch.setattr(identification_module, "IMPLAUSIBLE", 1e-9)
    assert not found.rivals()


def test_the_sizes_of_the_numbers_are_settled_after_a_few_iterations(monkeypatch):
    """Found anew in each of the first ones but the very first, and kept from then on: costs can be compared."""
    found = identification(
        small_body(), [take_and_turn(small_body(numbers=fibres(0.3)), 0.5, frames=SHORT)]
    )
    sizes, learn = [], found.newton._evidence
    monkeypatch.setattr(
        found.newton, "_evidence", lambda *given: (learn(*given), sizes.append(found.iteration))
    )
    for _ in range(EVIDENCE_ITERATIONS + 2):
        found.iterate()
    assert sizes == list(range(1, EVIDENCE_ITERATIONS))


def test_an_isotropic_body_stays_isotropic():
    """Even from an anisotropic start: the evidence finds that there is nothing, and the numbers go to zero."""
    take = take_and_turn(small_body(), 0.5)
    body = small_body(numbers=fibres(0.3, torch.tensor([0.0, 0.6, 0.8]).double()))
    found = identification(body, [take])
    run(found)
    ratio = stiffest(body.adapter.stiffness().detach())[1]
    assert float(ratio) < 1.001
    block = next(b for b in found.newton.blocks if b.name == "operator")
    assert block.factor == block.limits[0]
    assert found.posterior().determined[-19:].max() < 0.5


def test_stiffness_modes_find_which_end_is_stiffer():
    truth = small_body(adapter=False, modes=True)
    with torch.no_grad():
        truth.heterogeneity.coefficients[0] = 0.6
    body = small_body(adapter=False, modes=True)
    found = identification(
        body, [take_and_turn(truth, 0.5), take_and_turn(truth, 1.6, (1.0, 0.0, 0.2))], "prior_eta"
    )
    run(found)
    factors = [b.factor_of.detach() for b in map(Factors, (truth, body))]
    match = torch.corrcoef(torch.stack(factors))[0, 1]
    assert float(match) > 0.9 and float(factors[0].std()) > 0.05


class Factors:
    def __init__(self, body):
        self.factor_of = body.factor(body.heterogeneity)


def anisotropic_problem(seats=1):
    """Everything is learned: 2 + 1 + 19 numbers and the modes."""
    body = small_body(E=2.5e4, nu=0.3, contact=True, modes=True)
    truth = small_body(numbers=fibres(0.6), contact=True, modes=True)
    return identification(body, [take_of(truth, start(height=0.07, turn=0.5), 7)], seats=seats)


def numbers_of(found: Identification) -> torch.Tensor:
    return found.newton.seats[0].read()


@pytest.fixture(scope="module")
def uninterrupted():
    """(identification after five iterations, its reports, (state, numbers) before each)."""
    whole, kept, reports = anisotropic_problem(), [], []
    for _ in range(5):
        kept.append((whole.state(), numbers_of(whole).clone()))
        reports.append(whole.iterate())
    return whole, reports, kept


@pytest.mark.parametrize("after", [2, 4])
def test_going_on_from_its_state_gives_the_numbers_of_a_run_without_a_stop(uninterrupted, after):
    """Stopped within and after the iterations in which the noise is found."""
    whole, reports, kept = uninterrupted
    resumed = anisotropic_problem()
    resumed.newton.seats[0].write(kept[after][1])
    resumed.restore(kept[after][0])
    assert [resumed.iterate() for _ in range(5 - after)] == reports[after:]
    assert torch.equal(numbers_of(resumed), numbers_of(whole))
    assert resumed.iteration == whole.iteration == 5 and resumed.converged == whole.converged
    assert torch.equal(resumed.posterior().covariance, whole.posterior().covariance)
    forgetful = anisotropic_problem()  # the control: without its state it goes elsewhere
    forgetful.newton.seats[0].write(kept[after][1])
    assert forgetful.iterate() != reports[after]


def test_a_state_is_plain_and_survives_a_checkpoint(uninterrupted, tmp_path):
    state = uninterrupted[0].state()
    torch.save(state, tmp_path / "state.pt")
    read = torch.load(tmp_path / "state.pt", weights_only=True)
    assert (
        read.keys() == state.keys()
        and read["iteration"] == 5
        and read["factors"] == state["factors"]
    )
    assert all(
        torch.equal(a, b)
        for x, y in zip(read["noise"], state["noise"], strict=True)
        for a, b in zip(x, y, strict=True)
    )


def test_two_threads_find_what_one_does(uninterrupted):
    """Bodies side by side: launches of both at once, one capture at a time. Bit for bit."""
    two = anisotropic_problem(seats=2)
    assert len(two.newton.seats) == 2
    assert [two.iterate() for _ in range(2)] == uninterrupted[1][:2]
    assert torch.equal(numbers_of(two), uninterrupted[2][2][1])


def test_single_precision_finds_the_same_to_a_percent():
    truth = small_body(adapter=False, precision=32)
    begins = start(turn=0.5, dtype=torch.float32)
    rollout = truth.simulate(begins, WORLD, FRAMES, 1 / 60)
    take = take_of(truth, begins, FRAMES)
    take.cues = cues_of(rollout, begins.rotation)
    body = small_body(adapter=False, E=1e4, nu=0.25, precision=32)
    found = identification(body, [take], "prior")
    found.search()
    run(found, 6)
    assert values(body)["E"] == pytest.approx(E, rel=0.01) and values(body)["nu"] == pytest.approx(
        NU, abs=0.005
    )


def test_write_numbers_sets_what_the_posterior_names():
    body = small_body(contact=True, modes=True)
    found = identification(body, [take_and_turn(body, 0.5)])
    names = [b.name for b in found.newton.blocks]
    assert names == ["E", "nu", "contact", "operator", "stiffness", "grid"]
    drawn = numbers_of(found)[:-1] + 0.01 * torch.arange(
        len(numbers_of(found)) - 1
    )  # the grid's multiple is no part of a law
    write_numbers(body, drawn)
    assert torch.allclose(
        Seat(found.newton.seats[0].tensors[:-1], torch.empty).read(), drawn, rtol=0, atol=1e-15
    )


def test_a_grid_without_a_start_that_can_be_simulated_is_an_error():
    body = small_body(adapter=False)
    take = take_and_turn(body, 0.5)
    body.settings = body.settings.but(max_substeps=1)
    with pytest.raises(
        SimulationDiverged, match=r"none of the starts of the coarse grid.*\(.*max_substeps"
    ):
        identification(body, [take], "prior").search()


def test_what_it_refuses():
    with pytest.raises(ConfigError, match="use fit=adam"):
        body = small_body()
        identification(body, [take_and_turn(body, 0.5)], kinds=(False, False, False))
    for key, value in (("count", 0), ("operator_sd", -1.0), ("stiffness_sd", float("nan")), ("tolerance", True), ("threads", -1),
                       ("threads", 1.5), ("grid_error", -1.0), ("model_error", 2)):  # fmt: skip
        with pytest.raises(ConfigError, match=rf"identification\.{key}: expected"):
            IdentificationSettings(**{key: value})


def test_a_body_whose_grid_is_changed_is_simulated_on_that_one():
    """Its simulator is kept between rollouts, and kept the grid that it was made with."""
    body, fresh = small_body(adapter=False), small_body(adapter=False)
    body.simulate(start(), WORLD, FRAMES, FRAME_DT, substeps=40)
    for each in (body, fresh):
        each.settings = each.settings.but(dx=COARSER * each.settings.dx)
    moved = [
        each.simulate(start(), WORLD, FRAMES, FRAME_DT, substeps=40).x for each in (body, fresh)
    ]
    assert torch.equal(*moved)


def seen_on_a_coarser_grid(truth, angle=0.5):
    """What the law of `truth` does on a grid 1.25 times as coarse, as if it had been seen."""
    other = copy.deepcopy(truth)
    other.settings = other.settings.but(dx=COARSER * other.settings.dx)
    return take_and_turn(other, angle)


def test_what_a_grid_gets_wrong_is_not_taken_for_the_law():
    """An isotropic body was seen that differs from the model by its grid alone: E and the operator stay, the multiple is -1."""
    wrong = {}
    for known in (1.0, 0.0):
        body = small_body()
        found = identification(
            body, [seen_on_a_coarser_grid(small_body(adapter=False))], grid_error=known
        )
        run(found, 3)
        wrong[known] = abs(values(body)["E"] / E - 1) + float(body.adapter.numbers.detach().norm())
        assert (
            found.grid_share() == pytest.approx(-1.0, abs=0.1)
            if known
            else found.grid_share() == 0.0
        )
        assert "grid" not in found.posterior().names
    assert wrong[1.0] < 0.02 and wrong[0.0] > 3 * wrong[1.0]


def test_a_calibration_knows_what_a_grid_may_have_done_to_it():
    """A law that is seen on a grid 1.25 times as coarse is found off by more than two deviations of the noise, and by about one of
    those that know of the grid."""
    body = small_body(adapter=False)
    take = seen_on_a_coarser_grid(small_body(adapter=False))
    found = identification(body, [take], "prior", Criterion(name="free"))
    run(found)
    found.independent = lambda _: (
        1.0
    )  # all of what it counts, so that the grid alone is what widens
    aware = found.posterior()
    found.settings = found.settings.but(grid_error=0.0)
    unaware = found.posterior()
    off = (aware.mean - read_numbers(small_body(adapter=False))[: len(aware.mean)]).abs()
    sds = [each.covariance.diagonal().sqrt() for each in (aware, unaware)]
    assert torch.equal(aware.mean, unaware.mean) and bool((sds[0] >= sds[1]).all())
    assert float((off / sds[1]).max()) > 2 and bool(((off / sds[0] - 1).abs() < 0.2).all())


def seen_about_a_prediction(truth, prior, angle, frames=FRAMES):
    """A take whose cues stay half of the way at what the prior predicts, in the quadratic patterns of motion."""
    take = take_and_turn(truth, angle, frames=frames)
    seen = truth.simulate(take.start, WORLD, frames, FRAME_DT)
    predicted = prior.simulate(take.start, WORLD, frames, FRAME_DT).x.detach()
    rest = truth.rest @ take.start.rotation.T
    rest = rest / (2 * DX)
    x, y, z = rest.T
    one, none = torch.ones_like(x), torch.zeros_like(x)
    values = torch.stack([one, x, y, z, x * x, y * y, z * z, x * y, y * z, z * x], 1)
    slopes = torch.stack([torch.stack(row, 1) for row in (
        (none, none, none), (one, none, none), (none, one, none), (none, none, one), (2 * x, none, none), (none, 2 * y, none),
        (none, none, 2 * z), (y, x, none), (none, z, y), (z, none, x))], -1) / (2 * DX)  # fmt: skip
    values, turn = torch.linalg.qr(values)
    values, slopes = (
        values * len(x) ** 0.5,
        torch.linalg.solve(turn.T, slopes.mT).mT * len(x) ** 0.5,
    )
    share = (
        torch.diag(torch.tensor([0.0] * 4 + [0.5] * 6).repeat_interleave(3))
        .double()
        .expand(frames, -1, -1)
        .clone()
    )
    share[0] = 0
    take.response = Response(predicted, share, values, slopes)
    found = take.response.seen(seen.x.detach(), seen.F_tot.detach(), take.start.rotation)
    take.cues = cues_of(replace(seen, x=found[0], F_tot=found[1]), take.start.rotation)
    return take


@pytest.mark.parametrize("criterion", ["free", "corrected"])
def test_what_cues_keep_of_a_prediction_is_not_taken_for_the_law(criterion):
    wrong = {}
    for known in (True, False):
        take = seen_about_a_prediction(
            small_body(adapter=False), small_body(adapter=False, E=1.5e4, nu=0.3), 0.5
        )
        assert (
            take.cues.positions - take_and_turn(small_body(adapter=False), 0.5).cues.positions
        ).abs().max() > 1e-3
        take.response = take.response if known else None
        body = small_body(adapter=False, E=2e4, nu=0.3)
        found = identification(body, [take], criterion=Criterion(name=criterion), grid_error=0.0)
        run(found)
        wrong[known] = abs(values(body)["E"] / E - 1) + abs(values(body)["nu"] - NU)
    assert wrong[True] < 1e-3 and wrong[False] > 0.01


@pytest.mark.parametrize("criterion", ["free", "corrected"])
def test_how_far_a_single_camera_takes_a_body_to_be_is_not_taken_for_the_law(criterion):
    """Cues are moved along their lines of sight, by a tenth of their distance in the last frame."""
    eye, wrong = torch.tensor([1.0, 0.6, 0.4]).double(), {}
    for known in (True, False):
        take = take_and_turn(small_body(adapter=False), 0.5)
        farther = 1 + 0.1 * torch.linspace(0, 1, FRAMES).double()[:, None, None]
        moved = eye + farther * (take.cues.positions - eye)
        take.cues = replace(take.cues, positions=moved, eyes=eye[None] if known else None)
        body = small_body(adapter=False, E=2e4, nu=0.3)
        kinds = (True, known, known)  # of which one eye sees the first
        found = identification(
            body, [take], criterion=Criterion(name=criterion), grid_error=0.0, kinds=kinds
        )
        assert found.kinds == (True, False, False)
        run(found)
        wrong[known] = abs(values(body)["E"] / E - 1) + abs(values(body)["nu"] - NU)
    assert wrong[True] < 1e-3 and wrong[False] > 0.01


@pytest.mark.parametrize("criterion", ["free", "both"])
def test_columns_as_worlds_are_those_one_by_one(criterion):
    """On a CPU every world has the bits of its own rollout. What corrects a prediction goes through torch, whose vectors round the
    ends of a longer tensor otherwise on some processors: last bits of residuals, over the columns' steps."""
    truth = small_body(numbers=fibres(0.3), contact=True)
    body = small_body(contact=True, modes=True)
    takes = [
        seen_about_a_prediction(truth, small_body(contact=True), 0.5, SHORT),
        take_and_turn(truth, 1.5, frames=SHORT),
    ]
    assert max(take.first_contact for take in takes) < SHORT - 2
    found = identification(body, takes, criterion=Criterion(name=criterion))
    found.iterate()
    newton, seat = found.newton, found.newton.seats[0]
    numbers = seat.read()
    r, found._flown = seat.residuals(), {}
    alone = newton.jacobian(numbers, r)
    newton.many = found._many
    for together in (10**6, 3 * len(body.rest)):
        identification_module.PARTICLES_TOGETHER, kept = (
            together,
            identification_module.PARTICLES_TOGETHER,
        )
        try:
            rounded = 0.0 if criterion == "free" else 1e-12 * float(alone.abs().max())
            torch.testing.assert_close(newton.jacobian(numbers, r), alone, rtol=0, atol=rounded)
        finally:
            identification_module.PARTICLES_TOGETHER = kept
        assert torch.equal(seat.read(), numbers)


def test_a_stopped_stage_goes_on_with_what_it_knew_of_the_grid():
    take = take_and_turn(small_body(numbers=fibres(0.3)), 0.5, frames=SHORT)
    whole, part = (identification(small_body(), [take]) for _ in range(2))
    for _ in range(5):
        whole.iterate()
    for _ in range(4):
        part.iterate()
    again = identification(small_body(), [take])
    again.newton.seats[0].write(part.newton.seats[0].read())
    again.restore(part.state())
    again.iterate()
    assert again.grid_share() == whole.grid_share() != 0.0
    assert torch.equal(again.newton.seats[0].read(), whole.newton.seats[0].read())


def test_a_compass_search_goes_down_a_valley_in_every_number():
    def at(row):
        return (row["a"] - 2.3) ** 2 + 4 * (row["b"] + 1.1 + 0.3 * row["a"]) ** 2

    found = compass(at, {"a": 0.0, "b": 0.0}, {"a": 1.0, "b": 0.5})
    assert abs(found["a"] - 2.3) < 0.3 and at(found) < 0.05


def test_the_grid_of_starts_goes_on_where_its_best_is_at_an_end():
    """The body is 30 times as stiff as the configuration says; the grid's own last multiple is 7."""
    truth = small_body(adapter=False)
    body = small_body(adapter=False, E=E / 30)
    found = identification(body, [take_and_turn(truth, 0.5)], "prior")
    found.search()
    assert values(body)["E"] == pytest.approx(E, rel=0.35)


def test_a_calibration_whose_residuals_are_a_few_patterns_is_less_sure():
    """The same residuals' size, once one smooth error of the cues and once none: only the first is more than the cues' noise."""
    truth = small_body(adapter=False)
    take = take_and_turn(truth, 0.5)
    bent = copy.deepcopy(take)
    late = torch.linspace(0, 1, FRAMES, dtype=torch.float64)[:, None]
    bent.cues.positions[..., 0] += 0.02 * late * truth.rest[:, 1] / truth.rest[:, 1].abs().max()
    sure = []
    for each in (take, bent):
        body = small_body(adapter=False)
        found = identification(body, [each], "prior", grid_error=0)
        found.iterate()
        sure.append(
            (
                found.independent(),
                found.posterior().covariance[0, 0],
                found.newton.posterior().covariance[0, 0],
            )
        )
    assert sure[0][0] == 1.0 and sure[0][1] == sure[0][2]
    assert sure[1][0] < 0.1 and sure[1][1] > 5 * sure[1][2]
    # the bend is one pattern in all frames, and not one in each
    counted = 100 / 30 * found.settings.count * (FRAMES - bent.first_contact)
    assert 1 <= sure[1][0] * counted < 3


@pytest.mark.parametrize("turns", [(0.5,), (0.5, 1.2)])
def test_a_calibration_weighs_another_experiment_as_its_posterior_says(turns):
    """Cues with one smooth error say little of E, though they are many: a prior that is 30 % off moves
    by a part of its standard deviation, as the posterior has it almost to itself."""
    truth = small_body(adapter=False)
    takes = [take_and_turn(truth, turn) for turn in turns]
    late = torch.linspace(0, 1, FRAMES, dtype=torch.float64)[:, None]
    for take in takes:
        take.cues.positions[..., 0] += 0.02 * late * truth.rest[:, 1] / truth.rest[:, 1].abs().max()
    mean, sd = math.log(1.3 * E), 0.05
    known = Posterior(["E"], torch.tensor([mean]).double(), torch.tensor([[sd**2]]).double(), torch.ones(1))  # fmt: skip
    body = small_body(adapter=False)
    found = identification(body, takes, "prior", known=known, grid_error=0)
    found.iterate_until_converged(6)
    posterior = found.posterior()
    at = posterior.names.index("E")
    assert posterior.covariance[at, at].sqrt() == pytest.approx(sd, rel=0.1)
    assert 0 < mean - float(posterior.mean[at]) < 0.3 * sd  # 4 sd where all data count

"""Draws of a posterior in use: what they predict, what a drop would tell, and that the body is afterwards what it was."""

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from small_bodies import WORLD, small_body, start

from mosa.errors import ConfigError, SimulationDiverged
from mosa.evaluation import uncertainty as prediction
from mosa.evaluation.evaluate import Sequence
from mosa.evaluation.uncertainty import (
    DRAWN,
    ELSEWHERE,
    FORMS,
    GRID,
    INFLATION,
    among_forms,
    determined,
    physical_sd,
    total_spread,
)
from mosa.modules.body.material import NU_MAX
from mosa.modules.fitting.gauss_newton import Posterior
from mosa.modules.fitting.parameters import as_rival, each_law, limits_of, read_numbers
from mosa.twin.drop_planning import drawn_starts, information, plan, plan_text, press
from mosa.twin.twin import Twin


def posterior_of(body, sd: float, model_error: float = 0.004) -> Posterior:
    mean = read_numbers(body)
    names, one = [f"n{i}" for i in range(len(mean))], torch.ones(len(mean)).double()
    return Posterior(names, mean, sd**2 * torch.diag(one), one, model_error)


def twin_of(sd: float) -> Twin:
    body = small_body(numbers=0.1 * torch.ones(19))
    return Twin(body, WORLD, 0.01, None, start(height=0.05, speed=-1.0), posterior_of(body, sd))


def test_the_body_is_what_it_was_also_after_an_error():
    body = small_body(numbers=0.1 * torch.ones(19))
    before = read_numbers(body)
    laws = before + torch.arange(1, 4).double()[:, None] * 1e-2
    seen = [read_numbers(body) for _ in each_law(body, laws)]
    assert torch.allclose(torch.stack(seen), laws, atol=1e-6) and torch.equal(
        read_numbers(body), before
    )
    with pytest.raises(RuntimeError, match="half way"):
        for i, _ in enumerate(each_law(body, laws)):
            if i == 1:
                raise RuntimeError("half way")
    assert torch.equal(read_numbers(body), before)


def test_spread_of_known_draws():
    """Two draws 2 a apart along x have a variance of 2 a^2; the model's own error is added, more of it elsewhere."""
    a, wrong = 0.003, 0.004
    drawn = torch.zeros(2, 1, 1, 3)
    drawn[0, ..., 0], drawn[1, ..., 0] = -a, a
    for seen, times in ((True, 1.0), (False, ELSEWHERE)):
        expected = math.hypot(INFLATION * a * 2**0.5, times * wrong)
        assert float(total_spread(drawn, wrong, seen=seen)) == pytest.approx(expected, rel=1e-6)


def test_spread_of_known_rivals():
    """Two rivals, a to one side and 2 a to the other: with the law itself a third of 5 a^2; draws then count for little."""
    a, wrong = 0.003, 0.004
    base, step = torch.zeros(1, 1, 3), torch.tensor([[[0.0, 0.0, a]]])
    forms = among_forms(base, [base + step, base - 2 * step])
    assert float(forms) == pytest.approx(5 * a**2 / 3, rel=1e-6) and among_forms(base, []) is None
    drawn = torch.stack([base - step, base + step])
    assert float(total_spread(drawn, wrong, forms)) == pytest.approx(
        math.sqrt((DRAWN * 2**0.5 * a) ** 2 + FORMS**2 * 5 * a**2 / 3 + (ELSEWHERE * wrong) ** 2),
        rel=1e-6,
    )


def test_a_law_with_a_rival_is_less_sure_where_the_two_part():
    """The same numbers under another law: where the two start they agree."""
    sure, rival = twin_of(1e-7), twin_of(1e-7)
    numbers = read_numbers(rival.body)
    for twin, rivals in ((sure, {}), (rival, {"neo_hookean": numbers})):
        twin.posterior = replace(twin.posterior, rivals=rivals, model_error=1e-6)
    rollout, sd = rival.predict(draws=4, frames=9)
    _, alone = sure.predict(draws=4, frames=9)
    assert torch.allclose(sd[0], alone[0], rtol=1e-9)
    with as_rival(rival.body, "neo_hookean", numbers):
        apart = (rival.simulate(frames=9).x - rollout.x).square().sum(-1)
    assert torch.allclose(sd[-1] ** 2, FORMS**2 * apart[-1] / 2 + 1e-11, rtol=0.05)
    assert float(sd[-1].mean()) > 10 * float(alone[-1].mean())
    assert rival.body.material.law == "corotated"


def test_a_sure_law_is_off_by_the_models_error_alone_and_an_unsure_one_by_more():
    sure, unsure = (twin_of(sd) for sd in (1e-7, 0.05))
    rollout, sd = sure.predict(draws=4, frames=6)
    assert sd.shape == rollout.x.shape[:2] and float((sd - 0.004 * ELSEWHERE).abs().max()) < 1e-5
    before = read_numbers(unsure.body)
    _, wider = unsure.predict(draws=4, frames=9)
    assert float(wider[-1].mean()) > 0.00405 * ELSEWHERE and torch.equal(
        read_numbers(unsure.body), before
    )
    with pytest.raises(ConfigError, match=r"variant: expected adapted, .* found 'prior'"):
        unsure.predict(draws=4, frames=3, variant="prior")
    with pytest.raises(ConfigError, match="no posterior"):
        Twin(sure.body, WORLD, 0.01, None, start(height=0.05, speed=-1.0)).predict(frames=3)


def test_a_law_that_can_be_simulated_nowhere_has_no_draws_that_can(monkeypatch):
    """All of them were counted as simulated, on none of the drops."""

    def diverges(*_):
        raise SimulationDiverged("gone")

    monkeypatch.setattr(prediction, "_positions", diverges)
    body = small_body(numbers=0.1 * torch.ones(19))
    sequences = [Sequence("train", None, start(height=0.05, speed=-1.0), 2)]
    figures, spreads = prediction.predicted_spread(body, posterior_of(body, 0.05), sequences, WORLD)
    assert figures["posterior/draws"] == figures["posterior/rivals"] == 0 and spreads == {}


def test_draws_side_by_side_move_as_one_by_one(monkeypatch):
    """As worlds of one simulation, two at a time and all together, and none of them as another."""
    body = small_body(numbers=0.1 * torch.ones(19))
    scene = SimpleNamespace(frames=6, frame_dt=0.01)
    drop = partial(Sequence, scene=scene, contact=2)
    sequences = [drop(name, start=start(height=0.05, speed=v)) for name, v in (("train", -1.0), ("test", -2.0))]  # fmt: skip
    numbers = posterior_of(body, 0.02).draws(3)
    one_by_one = prediction.motions_under(
        body,
        [("corotated", each) for each in numbers],
        lambda own: {s.prefix: prediction._positions(own, s, WORLD) for s in sequences},
    )
    for particles in (10**6, 2 * len(body.rest)):
        monkeypatch.setattr(prediction, "PARTICLES_TOGETHER", particles)
        found = prediction.side_by_side(body, numbers, sequences, WORLD)
        for own, alone, other in zip(found, one_by_one, one_by_one[1:] + one_by_one[:1]):
            for name in ("train", "test"):
                assert torch.equal(own[name], alone[name])
                assert not torch.equal(own[name], other[name])


def said_of_nu(nu: float, sd: float) -> float:
    body = small_body(adapter=False, nu=nu)
    one = torch.ones(2).double()
    posterior = Posterior(
        ["E", "nu"], read_numbers(body), (sd / INFLATION) ** 2 * torch.diag(one), one
    )
    return determined(body, posterior)["posterior/nu_sd"]


def test_a_poisson_number_at_its_limit_is_as_unsure_as_what_lies_inside():
    """In the middle of its range the slope says it; at its limit, where the slope vanishes, all that the data leave open."""
    assert said_of_nu(0.3, 0.01) == pytest.approx(0.01 * 0.3 * (1 - 0.3 / NU_MAX), rel=0.01)
    # all unconstrained numbers between the limits are alike to a wide distribution
    low, high = limits_of("nu")
    even = NU_MAX * torch.linspace(low, high, 10001).double().sigmoid()
    wide = said_of_nu(0.02, 1e4)
    assert wide == pytest.approx(float((even - 0.02).square().mean().sqrt()), rel=0.01)
    slope = 2.6 * 0.02 * (1 - 0.02 / NU_MAX)
    assert slope < 0.05 < 0.1 < said_of_nu(0.02, 2.6) < wide


def test_forms_of_a_law_that_explain_the_data_make_its_moduli_less_sure():
    """Half of the forms have half the modulus: the deviation of that, `FORMS` times, beside the data's own."""
    body = small_body(adapter=False)
    numbers, one = read_numbers(body), torch.ones(2).double()
    own = Posterior(["E", "nu"], numbers, (0.03 / INFLATION) ** 2 * torch.diag(one), one)
    other = numbers - torch.tensor([math.log(2), 0.0]).double()
    with_rival = replace(own, rivals={"stvk": other})
    alone, both = (determined(body, p)["posterior/E_relative_sd"] for p in (own, with_rival))
    assert alone == pytest.approx(math.hypot(0.03, GRID), rel=0.01)
    assert both == pytest.approx(math.hypot(0.03, GRID, FORMS * math.log(2) / 2), rel=0.05)
    assert (
        determined(body, with_rival)["posterior/nu_sd"] == determined(body, own)["posterior/nu_sd"]
    )


@pytest.mark.parametrize("name", ["nu", "friction_angle"])
def test_a_bounded_number_beyond_its_limits_or_known_exactly_has_a_deviation_too(name):
    """A number that is continued to another grid may lie beyond the limits of the fit; from there they are the nearest."""
    low, high = limits_of(name)
    for end, beyond in ((max(low, -8.0), -1e-3), (min(high, 8.0), 1e-3)):
        at, past = (
            physical_sd(name, torch.tensor(end + step).double(), 0.03) for step in (0.0, beyond)
        )
        assert past == pytest.approx(at, rel=0.1) and 0 < past < 0.1
        exact, wide, widest = (
            physical_sd(name, torch.tensor(end).double(), sd) for sd in (0.0, 1e4, math.inf)
        )
        assert exact < 1e-6 and wide == pytest.approx(widest, rel=0.01)
    assert math.isnan(physical_sd(name, torch.tensor(0.0), math.nan))


@pytest.mark.parametrize("sd", [0.5, 1.5, 2.0])
def test_two_deviations_of_a_bounded_number_hold_the_truth_as_often_as_they_say(sd):
    """Truths anywhere between the limits, measured with a normal error in the unconstrained number, the estimate held within the
    limits: of those that end at a limit too, where a normal distribution with half its mass at the limit holds 82 to 90 %."""
    generator, (low, high) = torch.Generator().manual_seed(0), limits_of("nu")
    ends = NU_MAX * torch.tensor([low, high]).double().sigmoid()
    truth = ends[0] + (ends[1] - ends[0]) * torch.rand(20000, generator=generator).double()
    found = (truth / (NU_MAX - truth)).log() + sd * torch.randn(20000, generator=generator).double()
    raw = found.clamp(low, high)
    places = torch.linspace(low, high, 81).double()
    said = torch.tensor([physical_sd("nu", place, sd) for place in places])
    held = (NU_MAX * raw.sigmoid() - truth).abs() <= 2 * said[
        ((raw - low) / (high - low) * 80).round().long()
    ]
    at_limit = (raw == low) | (raw == high)
    assert at_limit.sum() > 300
    assert (
        0.92 <= float(held.double().mean()) <= 0.98
        and 0.88 <= float(held[at_limit].double().mean()) <= 0.98
    )


def test_information_of_known_draws():
    """One direction of variance k in units of the noise tells 1/2 log(1 + k); equal motions tell nothing."""
    moved = torch.zeros(2, 1, 10, 3)
    moved[0, ..., 1], moved[1, ..., 1] = -1e-3, 1e-3
    k = 10 * 3 * (2e-3 / 2) ** 2 * 2 / 2e-3**2  # particles, components of the noise, two draws
    assert information(moved, 2e-3) == pytest.approx(0.5 * math.log1p(k), rel=1e-6)
    assert information(torch.ones(5, 2, 10, 3), 2e-3) == 0.0


def test_candidates_begin_with_the_rest_pose_and_the_most_telling_is_first():
    found = drawn_starts(6, seed=3)
    assert found[0] == (0.0, 1.0, 0.0, 0.0) and found == drawn_starts(6, seed=3)
    assert all(math.hypot(*each[:3]) == pytest.approx(1) and 0 <= each[3] <= 180 for each in found)
    ranked = plan(twin_of(0.05), count=3, draws=4, frames=5)
    assert len(ranked) == 3 and [r.gain for r in ranked] == sorted(
        (r.gain for r in ranked), reverse=True
    )
    assert ranked[-1].gain > 0 and plan(twin_of(1e-7), count=2, draws=4, frames=5)[0].gain < 1e-3


def test_a_press_is_ranked_among_the_drops():
    """Its plate ends a fifth of the body's height below its top, and its gain is that of the motions under the plate."""
    twin = twin_of(0.05)
    ranked = plan(twin, count=2, draws=4, frames=6, presses=True)
    gains, pressed = [r.gain for r in ranked], [r for r in ranked if r.plate]
    assert len(ranked) == 4 and len(pressed) == 2 and gains == sorted(gains, reverse=True)
    for each in pressed:
        speed, given = press(twin, each.rotation, 6)
        start = {"rotation": each.rotation, "height": 0.0, "velocity": (0.0, 0.0, 0.0)}
        first = twin.simulate(**start, frames=2, **given).x[0] @ twin.world.up
        tall = float(first.max() - first.min())
        end = given["colliders"][0]["position"][1] - speed * 5 * 0.01
        assert speed == each.plate and end == pytest.approx(0.8 * tall, abs=1e-6)
        numbers = twin.posterior.draws(4, torch.Generator().manual_seed(0))
        drawn = [twin.simulate(**start, frames=6, **given).x for _ in each_law(twin.body, numbers)]
        assert each.gain == pytest.approx(information(torch.stack(drawn), 0.004), rel=1e-6)
        freely = [twin.simulate(**start, frames=6).x for _ in each_law(twin.body, numbers)]
        assert each.gain > information(torch.stack(freely), 0.004)
    assert f"at {pressed[0].plate:.3f} m/s" in plan_text(ranked)

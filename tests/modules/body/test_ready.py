"""The corrected prediction: its own motion needs none, an error in free flight follows a closed form, and it stays bounded."""

import pytest
import torch
from small_bodies import DX, FRAME_DT, FREE, WORLD, small_body, start

from mosa.errors import ConfigError
from mosa.modules.body.body import Ready
from mosa.modules.fitting.identification_settings import Criterion
from mosa.modules.fitting.parameters import each_law, read_numbers
from mosa.physics.adapters import interface


def simulated(body, begins, frames=10, world=WORLD, **options):
    with torch.no_grad():
        return body.simulate(begins, world, frames, FRAME_DT, **options)


@pytest.mark.parametrize("gain", [0.25, 1.0])
@pytest.mark.parametrize("contact", [False, True])
def test_a_motion_that_is_seen_as_it_is_predicted_is_not_corrected(gain, contact):
    """Through a bounce. The offset is added and taken off again: rounding of 1e-17 m, over a frame 1e-15 m/s."""
    body, begins = small_body(contact=contact), start(turn=0.6)
    free = simulated(body, begins)
    corrected = simulated(body, begins, observed=free.x, gain=gain)
    assert (
        free.x[:, :, 1].min() < 0.7 * DX
    )  # it has touched the ground, whose friction is felt a cell above it
    for name in ("x", "v", "F", "F_tot", "times"):
        assert torch.allclose(getattr(free, name), getattr(corrected, name), rtol=0, atol=1e-11), (
            name
        )
    assert corrected.inverted == free.inverted == 0 and corrected.counts == free.counts


def test_no_gain_is_the_free_rollout_bit_for_bit():
    body, begins = small_body(), start(turn=0.6)
    free = simulated(body, begins)
    other = simulated(body, begins, observed=torch.randn(free.x.shape).double(), gain=0.0)
    assert (
        torch.equal(free.x, other.x)
        and torch.equal(free.F, other.F)
        and torch.equal(free.v, other.v)
    )


@pytest.mark.parametrize("gain", [0.1, 0.5, 1.0])
def test_in_free_flight_an_error_follows_its_closed_form(gain):
    """A start that is too fast by d: per frame e' = e + T d, d' = d - gain e'/T for every particle, whatever the law is.

    That is an oscillator without damping: the correction bounds an error of the whole body and does not remove it."""
    body, frames = small_body(), 30
    truth = simulated(body, start(speed=0.5), frames, FREE)
    begins = start(speed=0.75)
    corrected = simulated(body, begins, frames, FREE, observed=truth.x, gain=gain)
    e, d, expected = 0.0, 0.25, [0.0]
    for _ in range(frames - 1):
        e = e + FRAME_DT * d
        expected.append(e)
        d = d - gain * e / FRAME_DT
    error = corrected.x - truth.x
    expected = torch.tensor(expected, dtype=torch.float64)
    assert torch.allclose(
        error[:, :, 1], expected[:, None].expand(error.shape[:2]), rtol=0, atol=1e-12
    )
    assert error[:, :, [0, 2]].abs().max() < 1e-12
    # the form's invariant gain e^2 + gain e D + D^2 with D = T d bounds it, where the free rollout's grows without end
    bound = FRAME_DT * 0.25 / (gain * (1 - gain / 4)) ** 0.5
    assert error.abs().max() <= bound * (1 + 1e-9)
    assert (simulated(body, begins, frames, FREE).x - truth.x)[-1].norm(dim=-1).min() > 2 * bound


def test_a_start_that_is_off_stays_nearer_through_the_bounce():
    """The free rollout of a wrong start and a wrong law ends far off; the corrected one's predictions stay near."""
    truth = small_body(E=3e4)
    seen = simulated(truth, start(turn=0.6), 24)
    body, wrong = small_body(E=2e4), start(turn=0.6, speed=-1.2)
    free = (simulated(body, wrong, 24).x - seen.x).norm(dim=-1).mean(1)
    corrected = (
        (simulated(body, wrong, 24, observed=seen.x, gain=0.5).x - seen.x).norm(dim=-1).mean(1)
    )
    assert torch.allclose(
        free[:2], corrected[:2], rtol=1e-12
    )  # frame 1 is predicted before anything is corrected
    assert corrected[12:].mean() < 0.5 * free[12:].mean()


def test_gradients_pass_through_corrections():
    """In E, through the bounce, against differences at a held number of substeps."""
    body, begins = small_body(adapter=False), start(turn=0.6, speed=-1.0, height=0.06)
    seen = simulated(small_body(adapter=False, E=4e4), begins, 7)
    raw = body.material.raw["E"]

    def value():
        rollout = body.simulate(begins, WORLD, 7, FRAME_DT, observed=seen.x, gain=0.5, substeps=16)
        return 1e3 * (rollout.x - seen.x).square().sum()

    slope = float(torch.autograd.grad(value(), raw)[0])

    def at(t):
        with torch.no_grad():
            raw.add_(t)
            found = float(value())
            raw.sub_(t)
        return found

    h = 1e-4
    difference = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
    assert slope == pytest.approx(difference, rel=1e-4) and abs(slope) > 1e-3


def test_one_frame_is_the_start():
    body, begins = small_body(), start(turn=0.6)
    rollout = simulated(body, begins, 1, observed=simulated(body, begins, 3).x, gain=0.5)
    assert torch.equal(rollout.x, simulated(body, begins, 1).x) and len(rollout.x) == 1


def test_what_a_criterion_compares_and_refuses():
    assert Criterion(name="free", gain=0.5).gains == (0.0,) and Criterion(
        name="corrected", gain=0.3
    ).gains == (0.3,)
    assert Criterion(name="both", gain=0.3).gains == (0.0, 0.3)
    with pytest.raises(
        ConfigError, match=r"criterion\.name: expected free or corrected or both, found 'open'"
    ):
        Criterion(name="open")
    for gain in (0.0, -0.1, 1.1, float("nan")):
        with pytest.raises(ConfigError, match=r"criterion\.gain: expected"):
            Criterion(name="corrected", gain=gain)


def test_laws_side_by_side_are_so_many_simulations(monkeypatch):
    """What differences of a residual need: a law in each world, free and corrected, to the last bit. The operator is the same in
    every state, so no state is found."""
    monkeypatch.setattr(interface, "material_state", None)
    body, begins = (
        small_body(numbers=0.1 * torch.linspace(-1, 1, 19).double(), contact=True),
        start(speed=-2.0),
    )
    laws = (
        read_numbers(body)
        + 0.02
        * torch.randn(
            3, len(read_numbers(body)), generator=torch.Generator().manual_seed(2)
        ).double()
    )
    with torch.no_grad():
        seen = body.simulate(begins, WORLD, 6, FRAME_DT).x + 1e-3
        for more in ({}, {"observed": seen, "gain": 0.5}):
            expected = [
                body.simulate(begins, WORLD, 6, FRAME_DT, substeps=12, **more)
                for _ in each_law(body, laws)
            ]
            parts = [
                body.ready(begins, WORLD, 6, FRAME_DT, substeps=12).answered()
                for _ in each_law(body, laws)
            ]
            found = Ready.stack(parts).simulate(6, **more).worlds()
            for own, other in zip(expected, found, strict=True):
                assert torch.equal(own.x, other.x) and torch.equal(own.F, other.F)
            assert (expected[0].x - expected[1].x).abs().max() > 1e-5
    with pytest.raises(
        ConfigError, match=r"worlds: expected equal fixed substeps, found \[12, 16\]"
    ):
        Ready.stack([parts[0], body.ready(begins, WORLD, 6, FRAME_DT, substeps=16)])

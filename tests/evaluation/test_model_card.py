"""The card beside a checkpoint says what the run knows, and leaves out what it does not."""

from types import SimpleNamespace

import pytest
import torch
from small_bodies import FRAME_DT, STICKY, small_body, start

from mosa.evaluation.evaluate import Sequence
from mosa.evaluation.model_card import model_card, stretches


def sequence(prefix, name):
    scene = SimpleNamespace(name="cube", sequence=name, synthetic=prefix != "train", frame_dt=FRAME_DT,
                            training_cameras=[0, 1], training_frames=[0, 1, 2, 3], cameras=[0, 1, 2], frames=6,
                            markers=None)  # fmt: skip
    return Sequence(prefix, scene, start(), 2)


def test_the_card_says_what_was_filmed_what_is_known_and_where_it_holds():
    body = small_body()
    with torch.no_grad():
        moved = body.simulate(start(), STICKY, 6, FRAME_DT)
    low, high = stretches([moved.F_tot[:4]])  # the others are held out
    assert low < 0.99 and high > 1.01
    figures = {"id_prior/E": 3.1e4, "id/E": 3e4, "posterior/draws": 12.0, "posterior/E_relative_sd": 0.04,
               "train/psnr_crop": 30.0, "train/rms_m": 0.002, "posterior/operator_numbers": 19.0,
               "posterior/operator_determined": 4.2}  # fmt: skip
    evaluated = [sequence("train", "a"), sequence("test/b", "b")]
    said = model_card(figures, body, evaluated, {"train": {"adapted": moved}}, STICKY, "1")
    for part in ("footage; 2 cameras, 4 frames at 60 a second", "simulated by this program, no capture; 3 cameras, 6 frames",
                 "speed at the start 1.5 m/s", "E = 3e+04 Pa, with a standard deviation of 4.0%", "determine 4.2;",
                 f"stretches from {low:.3g} to {high:.3g}", f"last {3 * FRAME_DT:.3g} s", "met as `sticky`",
                 "1000 kg/m^3 was given", "Twin.load",
                 "## Licence", "| rms [mm]"):  # fmt: skip
        assert part in said, part
    assert "nan" not in model_card({"id/E": 3e4}, body, evaluated, {}, STICKY, "1")
    unsure = model_card({}, body, evaluated, {}, STICKY, "1", "a smoke run")
    assert (
        "## Errors\na smoke run\n" in unsure
        and "keeps no posterior" in unsure
        and "stretches" not in unsure
    )


def test_parts_that_a_fit_left_out_are_not_said_to_be_learned():
    """The body has an adapter and a field, of which all numbers are 0."""
    body, evaluated = small_body(modes=True), [sequence("train", "a")]
    body.switch_on()
    said = model_card({"id/stiffness_ratio": 1.0}, body, evaluated, {}, STICKY, "1")
    assert "correction none; the stiffness is the same everywhere" in said
    with torch.no_grad():
        body.heterogeneity.coefficients[0] = body.adapter.numbers[3] = 0.3
    said = model_card({"id/stiffness_ratio": 1.4}, body, evaluated, {}, STICKY, "1")
    assert "correction HyperelasticAdapter; the stiffness varies over the body" in said


def test_who_reads_the_card_alone_is_told_what_the_run_was_told():
    """That the prior predicts better; and no number that was given is among those that were learned."""
    figures = {"id_prior/E": 3.1e4, "id/E": 3e4, "id_prior/nu": 0.31, "id/nu": 0.31,
               "test/rms_m": 0.0123, "prior/test/rms_m": 0.00987}  # fmt: skip
    given = small_body(), [sequence("train", "a")], {}, STICKY, "1"
    said = model_card(figures, *given, fixed=["nu"])
    assert "worse than its prior** (rms [mm]: 12.30 against 9.87)" in said
    assert "| E [Pa]" in said and "| nu" not in said and "Given, not learned: nu = 0.31." in said
    assert "`sticky`. Other surfaces" in said  # a friction says nothing of what sticks


def test_a_card_of_tracked_points_speaks_of_points():
    evaluated = [sequence("train", "a")]
    evaluated[0].scene.markers = SimpleNamespace(names=("tip", "base"))
    figures = {"train/rms_m": 0.001, "posterior/draws": 12, "posterior/test/sd_m": 0.004}
    said = model_card(figures, small_body(), evaluated, {}, STICKY, "1")
    assert "measured; 2 tracked points, 4 frames" in said and "after contact" not in said
    assert "distance of tracked points from their measured places after the release" in said


def test_an_affine_motion_has_the_stretches_of_its_gradient():
    F = torch.diag(torch.tensor([1.2, 1.0, 0.7])).expand(2, 500, 3, 3)
    assert stretches([F]) == pytest.approx((0.7, 1.2))

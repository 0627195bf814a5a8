"""Measured forces in a fit: what a curve says of a frame interval, and the stiffness of a block
from a press alone."""

import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from small_bodies import FREE, NU, E, cues_of, small_body, start, take_of

from mosa.data.io.forces import (
    ForceCurve,
    force_figures,
    force_residuals,
    forces_from_config,
    read_forces,
    warn_of_clock,
)
from mosa.errors import ConfigError, DataError
from mosa.evaluation.analysis.statements import force_lines
from mosa.modules.fitting.identification import Identification
from mosa.modules.fitting.identification_settings import Criterion, IdentificationSettings
from mosa.modules.fitting.stages import Stage
from mosa.physics.contact.driven import driven_from_config

FRAMES, FRAME_DT = 8, 1 / 60
LOW = {"name": "low", "type": "plane", "normal": [0, 1, 0], "position": [0, 0.065, 0]}
HIGH = {
    "name": "high",
    "type": "plane",
    "normal": [0, -1, 0],
    "position": [0, 0.115, 0],
    "motion": {"velocity": [0, -0.05, 0]},
}
PRESS = replace(FREE, driven=driven_from_config([LOW, HIGH]))


def pressed(world=PRESS, E=E, height=0.09):
    body = small_body(adapter=False, E=E, law="neo_hookean")
    begins = replace(start(height, speed=0.0), velocity=torch.zeros(3).double())
    return body, begins, body.simulate(begins, world, FRAMES, FRAME_DT)


def write(path, times, forces):
    rows = np.column_stack([times, forces])
    np.savetxt(path, rows, delimiter=",", header="time,fx,fy,fz", comments="")


def test_a_curve_says_the_mean_of_each_interval():
    times = torch.linspace(0, 0.5, 501, dtype=torch.float64)
    line = torch.stack([times, 2 * times, torch.full_like(times, torch.nan)], 1)
    mean, sd = ForceCurve("a", times, line, 0.01).means(8, 0.1)
    expected = torch.arange(5).double() * 0.1 + 0.05
    torch.testing.assert_close(mean[:5, :2], torch.stack([expected, 2 * expected], 1))
    assert bool(torch.isnan(mean[5:]).all()) and bool(torch.isnan(mean[:, 2]).all())
    assert float(sd[0, 0]) == pytest.approx((0.01**2 / 100 + 0.01**2) ** 0.5, rel=0.01)
    line[250] = torch.nan  # a sample that failed, at 0.25 s
    gap = ForceCurve("a", times, line, 0.01).means(8, 0.1)[0]
    assert torch.isnan(gap[:5, 0]).tolist() == [False, False, True, False, False]
    torch.testing.assert_close(gap[3:5, 0], expected[3:])
    line = torch.stack([times, 2 * times, times], 1)
    noisy = 0.03 * torch.randn(501, 3, generator=torch.Generator().manual_seed(0)).double()
    assert ForceCurve("a", times, line + noisy).noise() == pytest.approx(0.03, rel=0.1)


@torch.no_grad()
def test_the_stiffness_of_a_block_from_a_press_alone(tmp_path):
    """Both ends are driven, so that positions hardly tell it, and no cue counts; the load cell has
    noise of 2 %."""
    _, begins, truth = pressed()
    felt = truth.reactions.mean(1)[:, 1, :3]
    assert float(felt[-1, 1]) > 1.0  # the block presses the upper end up
    middle = FRAME_DT * (np.arange(FRAMES - 1) + 0.5)
    noise = 0.02 * float(felt.abs().max()) * np.random.default_rng(1).normal(size=felt.shape)
    path = tmp_path / "cell.csv"
    ends = np.concatenate([[0.0], middle, [FRAME_DT * (FRAMES - 1)]])
    values = felt.numpy() + noise
    write(path, ends, np.concatenate([values[:1], values, values[-1:]]))
    curves = forces_from_config(
        [{"of": "high", "file": str(path), "sd": 0.02 * float(felt.abs().max())}]
    )
    world = replace(PRESS, forces=curves)
    body, _, first = pressed(E=0.5 * E)
    take = take_of(body, begins, FRAMES, PRESS)
    take.cues = cues_of(first, begins.rotation)
    settings = IdentificationSettings(grid_error=0.0, threads=1)
    body.material.raw["nu"].requires_grad_(False)
    found = Identification(
        body,
        [take],
        world,
        Stage(name="prior", iterations=10, lr=0.1),
        Criterion(name="free"),
        settings,
        (False,) * 3,
    )
    found.iterate_until_converged(6)
    values = {k: float(v) for k, v in body.material.physical().items()}
    assert values["nu"] == pytest.approx(NU) and values["E"] == pytest.approx(E, rel=0.03)
    spread = float(found.posterior().covariance[0, 0].sqrt())
    assert abs(values["E"] / E - 1) < 3 * spread < 0.1


@torch.no_grad()
def test_a_fit_says_how_far_its_force_is_from_the_measured_one(recwarn):
    """The curve of the rollout itself, joined by lines, and the same curve of the wrong sign."""
    _, _, rollout = pressed()
    felt = rollout.reactions.mean(1)[:, 1, :3].double()
    middle = FRAME_DT * (torch.arange(FRAMES - 1).double() + 0.5)
    times = torch.cat([middle.new_zeros(1), middle, middle.new_full((1,), FRAME_DT * (FRAMES - 1))])
    curve = ForceCurve("high", times, torch.cat([felt[:1], felt, felt[-1:]]))
    right = force_figures(rollout, [curve], PRESS, FRAME_DT)
    assert right["forces/high/rms_share"] < 5 * right["forces/high/allowed_share"] < 0.5
    assert not [w for w in recwarn if "world.forces" in str(w.message)]
    with pytest.warns(UserWarning, match=r"world.forces: high: .* off by \d\d% .*check the sign"):
        wrong = force_figures(rollout, [replace(curve, forces=-curve.forces)], PRESS, FRAME_DT)
    assert wrong["forces/high/measured_N"] * wrong["forces/high/predicted_N"] < 0
    assert f"{wrong['forces/high/rms_share']:.1%} (rms) of the largest measured" in force_lines(
        wrong
    )


@pytest.mark.parametrize(
    ("kinds", "told", "recording"),
    [((True, False, False), True, "second"), ((False,) * 3, False, None)],
)
def test_held_back_frames_are_found_among_the_rows_of_forces(kinds, told, recording):
    """A force that says nothing changes no error, though its rows stand between those of two gains,
    or after those of another recording."""
    times = torch.linspace(0, 1, 5, dtype=torch.float64)
    numbers = 0.1 * torch.randn(19, generator=torch.Generator().manual_seed(0)).double()
    begins = pressed()[1]
    take = take_of(small_body(numbers=numbers), begins, 5, PRESS)
    takes = [take, SimpleNamespace(**vars(take) | {"name": "second"})][
        : 1 + (recording is not None)
    ]
    curve = ForceCurve("high", times, torch.zeros(5, 3).double(), 1e9, recording)
    found = {}
    for name, curves in {"with": (curve,), "without": ()}.items():  # fmt: skip
        if not (told or curves):
            continue
        joint = Identification(
            small_body(E=1.2 * E), takes, replace(PRESS, forces=curves),
            Stage(name="joint", iterations=1, lr=0.1), Criterion(name="both"),
            IdentificationSettings(grid_error=0.0, threads=1), kinds,
        )  # fmt: skip
        joint.iterate()
        felt = [each.force is not None for each in joint._fields(joint.body)]
        assert felt == [bool(curves) and take is takes[-1] for take in takes for _ in range(2)]
        found[name] = joint.held_back()
    if told:
        assert found["with"] == pytest.approx(found["without"], rel=1e-6)
    else:
        assert found["with"] == {}


def test_an_empty_cell_was_not_measured_and_notes_are_passed_over(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(
        "# load cell 3\ntime, fz, note\n0.1, 1.5, on\n0.2\n# a, b, c, d\n\n0.3, 2.5, on\n"
    )
    curve = read_forces(path, "clamp")
    assert curve.times.tolist() == [0.1, 0.2, 0.3] and curve.forces[::2, 2].tolist() == [1.5, 2.5]
    assert torch.isnan(curve.forces).sum() == 7


def test_a_clock_of_a_force_in_milliseconds_is_asked_about(tmp_path):
    """The fit read a force of nearly 0, and what was said after it asked for sign, axes and unit. A constant load has no clock."""
    path = tmp_path / "a.csv"
    for rows, count in (
        ("0,0\n33,1\n67,2\n100,3", 1), ("0,0\n0.033,1\n0.067,2\n0.1,3", 0), ("0,2\n100,2", 0), ("0.033,1\n0.1,3", 0),
    ):  # fmt: skip
        path.write_text(f"time,fy\n{rows}\n")
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            warn_of_clock(read_forces(path, "clamp"), 4, 1 / 30)
        assert len(said) == count
        assert all("found none between 0 and 33 s: a clock" in str(each.message) for each in said)


def test_a_force_of_nothing_is_refused(tmp_path):
    curve = ForceCurve("wall", torch.tensor([0.0, 1.0]).double(), torch.ones(2, 3).double())
    _, _, rollout = pressed()
    with pytest.raises(
        ConfigError, match=r"one collider or driven set \(low, high\), found 'wall'"
    ):
        force_residuals(rollout, [curve], PRESS, FRAME_DT)
    with pytest.raises(ConfigError, match=r"world.forces\[0\].sd: expected a number above 0"):
        forces_from_config([{"of": "low", "file": "a.csv", "sd": -1.0}])
    with pytest.raises(DataError, match=r"none.csv: expected a csv of time, fx, fy, fz"):
        forces_from_config([{"of": "low", "file": str(tmp_path / "none.csv")}])
    late = ForceCurve("low", torch.tensor([9.0, 10.0]).double(), torch.ones(2, 3).double())
    with pytest.raises(
        ConfigError, match=r"curve of 'low' that covers an interval .* found 9 to 10 s"
    ):
        force_residuals(rollout, [late], PRESS, FRAME_DT)
    for items in (5, "a", [5]):
        with pytest.raises(ConfigError, match=r"world\.forces: expected a list of sections"):
            forces_from_config(items)
    for text in ("", "time,fx\n0,0\n1,0\n", "time,fx\n0,1e300\n1,1\n", "time,fx\n0,inf\n1,1\n",
                 "time,fx,fx\n0,1,2\n1,1,2\n", "time;fx\n0;1\n1;1\n",
                 "time,fx\n0.0,1,5\n1.0,1,7\n"):  # fmt: skip
        (tmp_path / "bad.csv").write_text(text)
        with pytest.raises(DataError, match=r"bad.csv: expected"):
            forces_from_config([{"of": "low", "file": str(tmp_path / "bad.csv")}])
    for text, said in (
        ("0,1\n# a note\n1,n/a\n", "row 3: fx: expected a number or an empty cell, found 'n/a'"),
        ("0,1\n2,1\n2,1\n", "time: expected at least two ascending numbers .* found 2 in row 3"),
        ("0,1\n,1\n2,1\n", "time: expected at least two ascending numbers .* found nan in row 2"),
    ):
        (tmp_path / "bad.csv").write_text("time,fx\n" + text)
        with pytest.raises(DataError, match=r"bad\.csv: " + said):
            forces_from_config([{"of": "low", "file": str(tmp_path / "bad.csv")}])
    (tmp_path / "bad.csv").write_text("t,force\n0,1\n1,2\n")
    with pytest.raises(DataError, match=r"bad.csv: .*found the columns t, force"):
        forces_from_config([{"of": "low", "file": str(tmp_path / "bad.csv")}])


def test_a_body_that_is_met_later_has_finite_shares(tmp_path):
    """Frames in which the measured force is 0 throughout; and a clock that never ends."""
    _, _, rollout = pressed()
    times = torch.tensor([0.0, 1.0, 2.0]).double()
    curve = ForceCurve(
        "high", times, torch.tensor([[0.0] * 3, [0.0] * 3, [0.0, 5.0, 0.0]]).double()
    )
    with pytest.warns(UserWarning, match="world.forces: high"):
        found = force_figures(rollout, [curve], PRESS, FRAME_DT)
    felt = rollout.reactions.mean(1)[:, 1, :3].double()
    assert found["forces/high/rms_share"] == pytest.approx(float(felt.square().mean().sqrt()) / 5)
    for rows in ("0,1.0\ninf,1.0", "-inf,1.0\n0,1.0"):
        path = tmp_path / "a.csv"
        path.write_text(f"time,fy\n{rows}\n")
        with pytest.raises(DataError, match="time: expected at least two ascending"):
            read_forces(path, "high")

"""The rollout benchmark's check: ratios of times in one run against the stored ones."""

import importlib
import json
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def rollout(monkeypatch):
    """The benchmark as a module, as it is when run as a script."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("rollout")


def test_no_ratio_has_degraded_by_more_than_a_quarter(rollout):
    found, stored, bad = rollout.check()
    assert not bad, {name: (stored[name], found.get(name)) for name in bad}


def test_a_degraded_or_missing_ratio_is_named(rollout):
    stored = {"a": 2.0, "b": 4.0, "c": 1.0}
    assert rollout.degraded({"a": 2.49, "b": 5.01}, stored) == ["b", "c"]
    assert rollout.degraded({"a": float("nan"), "b": 4.0, "c": 0.5}, stored) == ["a"]


def test_the_stored_ratios_cover_every_variant(rollout):
    stored = json.loads(rollout.STORED.read_text())
    assert {key: stored[key] for key in rollout.CHECK} == rollout.CHECK
    best = {
        f"{variant} {what}": 1.0 for variant in rollout.VARIANTS for what in ("forward", "both")
    } | {"yardstick": 1.0}
    assert stored["ratios"].keys() == rollout.ratios(best).keys()


def test_a_partial_verification_leaves_the_published_table_alone(monkeypatch, tmp_path, capsys):
    """In a fresh clone `--only friction`, or a run without the reference data, would have dropped all other rows."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    verification = importlib.import_module("verification")
    page = tmp_path / "page.md"
    page.write_text("text\n<!-- table -->\n| old |\n<!-- end -->\nmore\n")
    results = {name: [["1", name, "a", "b"]] for name in verification.PARTS}
    verification.publish(results | {"probes": []}, page)
    assert "| old |" in page.read_text() and "not measured: probes" in capsys.readouterr().out
    verification.publish(results, page)
    assert "| old |" not in page.read_text() and "| 1 | probes | a | b |" in page.read_text()
    assert page.read_text().startswith("text\n") and page.read_text().endswith(
        "<!-- end -->\nmore\n"
    )


def test_an_error_of_the_level_is_told_from_one_of_the_shape(monkeypatch):
    """A law that is stiffer all over has no error of shape, and one whose directions are exchanged none of level."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    apart = importlib.import_module("directions").level_and_shape
    true = torch.tensor([1.0, 2.0, 4.0])
    stiffer, exchanged = apart(1.3 * true, true), apart(true.flip(0), true)
    assert stiffer["E_level"] == pytest.approx(1.3) and stiffer[
        "E_shape_off_largest"
    ] == pytest.approx(0, abs=1e-6)
    assert stiffer["E_off_mean"] == stiffer["E_off_largest"] == pytest.approx(0.3)
    assert exchanged["E_level"] == pytest.approx(1.0) and exchanged[
        "E_shape_off_largest"
    ] == pytest.approx(3.0)
    assert (
        exchanged["E_shape_off_mean"]
        == exchanged["E_off_mean"]
        == pytest.approx((3.0 + 0 + 0.75) / 3)
    )


@pytest.mark.parametrize(("name", "arguments"), [("rollout", ["--device", "cuda"]), ("renderer", ["--device", "cuda"]),
                                                 ("renderer", ["--parts"]), ("renderer", ["--parity"])])  # fmt: skip
def test_cuda_asked_for_where_there_is_none_is_said(monkeypatch, capsys, name, arguments):
    """It ended in torch's AssertionError, or in an empty table."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr("sys.argv", [f"{name}.py", *arguments])
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(name).main()
    assert ended.value.code == 2
    assert (
        "CUDA device on this machine" in (said := capsys.readouterr().err)
        or "a CUDA device, and torch finds none" in said
    )


def test_the_benchmark_of_worlds_checks_them_first(monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    worlds = importlib.import_module("worlds")
    worlds.check("cpu", particles=64, worlds=2)
    assert "differ by at most 0 cells" in capsys.readouterr().out
    rollout = worlds.Simulator.rollout

    def shifted(*arguments, **more):
        found = rollout(*arguments, **more)
        return replace(found, x=found.x + 1e-12 * found.x.shape[1])  # by the number of worlds

    monkeypatch.setattr(worlds.Simulator, "rollout", shifted)
    with pytest.raises(SystemExit, match="worlds are not their single rollouts"):
        worlds.check("cpu", particles=64, worlds=2)


def test_fits_of_cues_make_a_table(monkeypatch, tmp_path, capsys):
    """One row for each line that fits have written, what a scene has no truth for left empty."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    identification = importlib.import_module("identification")
    names = ("prior_mm", "learned_mm", "ratio", "floor_mm", "stiffness_ratio", "fibre_deg", "cone_deg", "coverage", "mean_abs_C",
             "eta", "grid", "seconds")  # fmt: skip
    record = dict.fromkeys(names, 1.26) | {
        "problem": "ball",
        "set": ["prior=stvk"],
        "fibre_deg": None,
    }
    (tmp_path / "fits.jsonl").write_text(json.dumps(record) + "\n")
    monkeypatch.setattr("sys.argv", ["identification.py", "table", str(tmp_path / "fits.jsonl")])
    identification.main()
    rows = capsys.readouterr().out.splitlines()
    assert (
        rows[2]
        == "| ball | prior=stvk | 1.3 | 1.3 | 1.26 | 1.3 | 1.26 |  | 1 | 1.26 | 1.260 | 1.26 | 1.26 | 1 |"
    )
    assert len({row.count("|") for row in rows}) == 1


def test_coverage_needs_runs_with_standard_deviations(monkeypatch, tmp_path):
    """A fit by Adam has none."""
    (tmp_path / "metrics.json").write_text('{"id/E": 1e5, "id/nu": 0.3}')
    runs = [str(tmp_path / "a.png"), f"{tmp_path}=1e5,0.3"]
    for words, said in ([], "PICTURE RUN"), (runs, "fits by Gauss-Newton"):
        monkeypatch.setattr("sys.argv", ["coverage.py", *words])
        with pytest.raises(SystemExit, match=said):
            runpy.run_path(str(BENCHMARKS / "coverage.py"), run_name="__main__")


def test_a_profile_ends_where_the_misfit_has_risen(monkeypatch):
    """A parabola about 0.5 that rises by 4 at a distance of 1, and one that goes on falling."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    ends = importlib.import_module("profiles").ends
    shifts = [0.5 * i for i in range(-4, 7)]
    low, high = ends(shifts, [4 * (shift - 0.5) ** 2 for shift in shifts])
    assert (low, high) == (pytest.approx(-0.5), pytest.approx(1.5))
    left, right = ends(shifts, [8.0 * (shift < 0) for shift in shifts])
    assert left == pytest.approx(-0.25) and right == np.inf


def test_the_errors_of_a_calibration_s_cues_are_smooth_and_as_large_as_asked(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    calibration = importlib.import_module("calibration")
    rng = np.random.default_rng(0)
    rest = rng.uniform(0, 0.5, (400, 3))
    rest[1] = rest[0] + 0.005
    positions = np.repeat(rest[None], 30, 0)
    errors = calibration.noisy(positions, rest, 0.002, rng) - positions
    assert np.abs(errors[0]).max() == 0 and errors[1:].std() == pytest.approx(0.002, rel=0.1)
    assert np.corrcoef(errors[1:, 0, 0], errors[1:, 1, 0])[0, 1] > 0.8
    assert abs(np.corrcoef(errors[1:-1, 0, 0], errors[2:, 0, 0])[0, 1]) < 0.5
    for name in ("torus", "trophy"):  # one with a cost in the table's file, and one without
        assert calibration.overrides_of(name)[:2] == ["scene=standin", f"scene.name={name}"]


def test_a_calibration_s_table_says_whether_its_posteriors_are_honest(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    calibration = importlib.import_module("calibration")
    numbers = {
        "E": {
            "true": 1e5,
            "start": 2e5,
            "found": 1e5 * np.exp(0.2),
            "error": 0.22,
            "sd_of_noise": 0.01,
            "sd": 0.1,
        },  # relative
        "nu": {
            "true": 0.3,
            "start": 0.2,
            "found": 0.34,
            "error": 0.13,
            "sd_of_noise": 0.002,
            "sd": 0.04,
        },
    }
    record = {"scene": "ball", "set": [], "particles": 9, "seed": 0, "parameters": numbers, "rms_mm": 1.0, "seconds": 2.0,
              "noise": 0.004, "commit": "1234567", "machine": "a card"}  # fmt: skip
    *rows, _, counted, _, last = calibration.table([record, record]).splitlines()
    assert [row.split(" | ")[-3] for row in rows[2:]] == ["2.00", "1.00"] * 2
    assert last.endswith("1.58 (4 numbers)") and len({row.count("|") for row in rows}) == 1
    assert counted == "of 4 numbers 0 met, 4 not determined, 0 missed"
    assert (
        calibration.verdict("E", numbers["E"] | {"sd": 0.09}) == "missed"
    )  # 2.2 of its standard deviations
    assert (
        calibration.verdict("nu", numbers["nu"] | {"error": 0.099})
        == "met"
        == calibration.verdict("kappa", {"error": 0.1})
    )
    assert calibration.verdict("mu", numbers["E"] | {"error": 0.06}) == "not determined"
    calibration.draw([record], tmp_path / "results")
    assert "| ball |" in (tmp_path / "results" / "calibration_from_motion.md").read_text()
    assert json.loads((tmp_path / "results" / "calibration_from_motion.json").read_text()) == [
        record
    ]


def test_directions_are_found_from_a_true_motion(monkeypatch, tmp_path):
    """A body and its twin from the files that `make` writes: the twin's truth has one modulus, the body's its largest along the
    fibre, the specimens of the true law have the law's moduli, and what was fitted makes a figure and a page."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    directions = importlib.import_module("directions")
    settings = [
        "heterogeneity.enabled=false",
        "fit.prior.newton_iterations=1",
        "fit.joint.newton_iterations=1",
    ]
    monkeypatch.setattr(directions, "PLATES", 3)
    records = []
    for name, plates in (("tiny", True), ("tiny_twin", False)):
        directions.make(name, tmp_path, 0, ["train"])
        path = tmp_path / f"{name}.npz"
        records.append(
            directions.fit(path, 150, settings, 0, 0.004, "cpu", plates, False, False, ["train"])
        )
    body, twin = records
    assert max(body["true_E_along"]) == body["true_E_along"][0] > 1.5 * min(body["true_E_along"])
    assert max(twin["true_E_along"]) == pytest.approx(min(twin["true_E_along"]))
    assert 0 <= body["fibre_deg"] <= 90 and twin["fibre_deg"] is None
    assert body["plates"]["true"][0] == pytest.approx(body["true_E_along"][0], rel=0.05)
    assert max(body["plates"]["prior"]["E"]) == pytest.approx(
        min(body["plates"]["prior"]["E"]), rel=0.02
    )
    directions.draw(records, tmp_path / "results")
    page = (tmp_path / "results" / "directions_from_motion.md").read_text()
    assert (tmp_path / "results" / "directions_from_motion.png").stat().st_size > 10_000
    assert (
        "| tiny " in page
        and "| tiny_twin " in page
        and "commit" in page
        and f"| {' '.join(settings)} |" in page
    )
    assert directions.settings({"set": [*settings, "identification.threads=1"]}) == " ".join(
        settings
    )


def test_the_planned_drop_is_compared_with_the_others(monkeypatch):
    """Each fit of a problem has the training drop, the held-out ones and one candidate; the table says which was planned."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    planned = importlib.import_module("planned")
    names = ("train", "test/test_60", "train/plan_1", "train/plan_10", "train/plan_2")
    problem = {"sequences": {name: {} for name in names}, "config": 5}
    assert list(planned.with_only(problem, None)["sequences"]) == ["train", "test/test_60"]
    assert list(planned.with_only(problem, 1)["sequences"]) == [
        "train",
        "test/test_60",
        "train/plan_1",
    ]
    assert planned.with_only(problem, 2)["config"] == 5 and len(problem["sequences"]) == 5
    record = {
        "problem": "rabbit",
        "prior_mm": 24.0,
        "one_drop_mm": 6.04,
        "gains": [0.5, None, 2.25],
        "errors_mm": [5.0, 6.0, 3.96],
        "planned_mm": 3.96,
        "others_mm": 5.5,
        "seconds": 60.0,
    }
    assert (
        planned.table([record]).splitlines()[-1]
        == "| rabbit | 24.0 | 6.0 | 4.0 | 5.5 | 0.50: 5.0, -: 6.0, 2.25: 4.0 | 60 |"
    )

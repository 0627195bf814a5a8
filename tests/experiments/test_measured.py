"""What an experiment reads beside metrics.json: specimens that were pressed, and identified parameters beside their truth."""

import csv
import json
from pathlib import Path

import pytest
from made_up import PAPER

from mosa.errors import DataError
from mosa.experiments import running
from mosa.experiments.analyses import directions, heterogeneity
from mosa.experiments.collecting import records_of
from mosa.experiments.parameters import parameters, verdict
from mosa.experiments.specification import jobs_of, load_experiment, narrowed
from mosa.experiments.specimens import ANGLES, compression, plane
from mosa.experiments.workers import Worker


def pressed(folder: Path, **models) -> None:
    """As `measured` leaves it for a complete run: E of 100 kPa times what is given, of a truth of 100, 120 and 100 kPa."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "metrics.json").write_text(json.dumps({"test/rms_m": 0.01, "prior/test/rms_m": 0.02}))
    kept = {"degrees": [0.0, 60.0, 120.0], "truth_Pa": [1e5, 1.2e5, 1e5], "models": {
        name: None if found is None else {"modulus_Pa": [1e5 * f for f in found[0]], "force_off": found[1]}
        for name, found in models.items()}}  # fmt: skip
    (folder / "pressed.json").write_text(json.dumps(kept))


def cylinder(tmp_path, methods=("prior only", "black box", "ours")):
    found = narrowed(
        load_experiment(PAPER, "figure_cylinder"),
        {"method": list(methods), "drops": ["one drop"]},
        (0,),
    )
    return found, jobs_of(found, tmp_path / "runs")


def test_what_was_pressed_is_a_table_without_its_checkpoints(tmp_path):
    found, jobs = cylinder(tmp_path)
    for job in jobs:
        own = any(place["method"].name == "ours" for place in job.places)
        pressed(
            job.folder,
            **(
                {"": ((1.0, 1.26, 0.98), 0.021), "prior/": ((1.1, 1.1, 1.1), 0.2)}
                if own
                else {"": None}
            ),
        )
    text, pictures = compression(found, records_of(jobs), tmp_path / "figure")
    rows = [
        [cell.strip() for cell in line.split("|")[1:-1]]
        for line in text.splitlines()
        if line.startswith("| one drop")
    ]
    assert rows == [["one drop", "prior only", "9.4", "10.0", "20.0"], ["one drop", "black box", "diverged", "", ""],
                    ["one drop", "ours", "2.3", "5.0", "2.1"]]  # fmt: skip
    assert pictures[0].is_file()
    lines = list(csv.DictReader(open(pictures[0].with_suffix(".csv"))))
    assert [(line["method"], float(line["degrees"]), float(line["E_Pa"])) for line in lines][
        -2
    ] == ("ours", 60.0, 1.26e5)


def test_of_a_run_that_was_stopped_nothing_is_measured(tmp_path):
    """Its checkpoint holds what the law was on its way."""
    found, jobs = cylinder(tmp_path, ("ours",))
    pressed(jobs[0].folder, **{"": ((1.0, 1.2, 1.0), 0.0)})
    (jobs[0].folder / "metrics.json").unlink()
    (jobs[0].folder / "checkpoints").mkdir()
    (jobs[0].folder / "checkpoints" / "last.ckpt").touch()
    for analysis in (compression, directions, heterogeneity):
        assert analysis(found, records_of(jobs), tmp_path / "figure") == ("", [])


def test_a_run_that_is_made_again_is_pressed_again(tmp_path, monkeypatch):
    """What was measured of the law that was here before, and why it failed, are not said of the new one."""
    _, (job,) = cylinder(tmp_path, ("ours",))
    pressed(job.folder, **{"": ((1.0, 1.2, 1.0), 0.0)})
    (job.folder / "failed.txt").write_text("SimulationDiverged")
    monkeypatch.setattr(running, "PROGRAM", "gc:collect")
    worker = Worker({})
    assert running.begin(job, worker).result(60) == 0
    worker.end()
    assert sorted(file.name for file in job.folder.iterdir()) == [
        "commit.txt",
        "metrics.json",
        "screen.log",
    ]


def test_a_damaged_file_of_what_was_pressed_is_named(tmp_path):
    found, jobs = cylinder(tmp_path, ("ours",))
    pressed(jobs[0].folder)
    (jobs[0].folder / "pressed.json").write_text("{}")
    with pytest.raises(DataError, match=r"pressed\.json.*remove it"):
        compression(found, records_of(jobs), tmp_path / "figure")
    (jobs[0].folder / "pressed.json").unlink()
    assert compression(found, records_of(jobs), tmp_path / "figure") == ("", [])


def test_a_body_is_pressed_over_half_a_turn_and_along_its_fibres_where_they_lie_in_the_plane():
    degrees, n = plane("cylinder")
    assert len(degrees) == ANGLES + 1 and degrees == sorted(degrees) and degrees[-1] < 180
    assert 21.8 == pytest.approx(degrees[2], abs=0.01) and float(
        n[2, 1] / n[2, 0]
    ) == pytest.approx(0.4)
    assert len(plane("peanut")[0]) == ANGLES


def test_parameters_stand_beside_their_truth_with_what_the_posterior_says(tmp_path):
    found = narrowed(
        load_experiment(PAPER, "table_identification"),
        {"scene": ["cat", "cat same grid", "droplet", "letter", "trophy"]},
        (0, 1),
    )
    jobs = jobs_of(found, tmp_path / "runs")
    figures = {
        "cat": {"E": (0.5e6, 0.6), "nu": (0.29, 0.01), "yield_stress": (3900.0, 0.02)},
        "cat same grid": {"E": (1.01e6, 0.005), "nu": (0.29, 0.01), "yield_stress": (3900.0, 0.02)},
        "droplet": {"mu": (230.0, 0.01), "kappa": (1.02e5, 2.0)},
        "letter": {"mu": (173.0, 0.4), "kappa": (0.27e5, 0.4)},
    }
    for job in jobs:
        scene = job.places[0]["scene"].name
        if scene == "trophy":
            continue  # not run
        written = {}
        for name, (value, sd) in figures[scene].items():
            relative = "" if name == "nu" else "relative_"
            written |= {
                f"id/{name}": value * (1 + 0.001 * job.seed),
                f"posterior/{name}_{relative}sd": sd,
            }
        job.folder.mkdir(parents=True)
        (job.folder / "metrics.json").write_text(json.dumps(written))
    text, pictures = parameters(found, records_of(jobs), tmp_path / "table")
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()]
    rows = {(row[0], row[1]): row[2:] for row in cells if len(row) == 7}
    assert rows["cat", "E [Pa]"] == ["1e+06", "5e+05 ± 3.5e+02", "-50.0", "60.0", "not determined"]
    assert rows["cat", "nu"][2:] == ["-3.3", "3.3", "met"] and rows["cat", "yield_stress [Pa]"][
        3:
    ] == ["2.0", "met"]
    # on the truth's own grid less is allowed
    assert rows["cat same grid", "E [Pa]"][4] == "met"
    assert rows["cat same grid", "nu"][2:] == ["-3.3", "3.3", "not determined"]
    assert (
        rows["droplet", "mu [Pa s]"][2:] == ["+15.1", "1.0", "missed"]
        and rows["droplet", "kappa [Pa]"][4] == "met, by chance"
    )
    # as many per cent off, but of the logarithm, whose deviation it is, twice as much
    assert rows["letter", "mu [Pa s]"][2:] == ["+73.1", "40.0", "not determined"]
    assert rows["letter", "kappa [Pa]"][2:] == ["-73.0", "40.0", "missed"]
    assert not any(scene == "trophy" for scene, _ in rows) and pictures == []
    lines = list(csv.DictReader(open(tmp_path / "table_parameters.csv")))
    assert (
        float(lines[0]["found"]) == pytest.approx(0.50025e6)
        and lines[0]["verdict"] == "not determined"
    )


def test_a_parameter_is_judged_by_what_is_asked_and_by_its_posterior():
    for off, sd, said in (
        (4.0, 2.0, "met"),
        (4.0, 3.0, "met, by chance"),
        (9.0, 5.0, "not determined"),
        (11.0, 5.0, "missed"),
    ):
        assert verdict(off, off, sd, 5.0) == said
    assert verdict(20.0, 9.0, 5.0, 5.0) == "not determined" and verdict(3.0, 3.0, 1.0, None) == ""

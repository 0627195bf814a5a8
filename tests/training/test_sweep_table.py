"""One table over all jobs of a sweep."""

import csv
import json

import pytest
from omegaconf import OmegaConf

from mosa.cli import sweep as command
from mosa.errors import DataError
from mosa.training.jobs import Failures, own_groups
from mosa.training.sweep_table import sweep_table, text_of


@pytest.fixture
def folder(tmp_path):
    """Three jobs: a complete one, a failed one, and one that was killed."""
    for number, law in enumerate(("stvk", "ogden", "linear")):
        job = tmp_path / f"{number}_prior-{law}"
        (job / ".hydra").mkdir(parents=True)
        (job / ".hydra" / "overrides.yaml").write_text(f"- prior={law}\n- scene=rabbit\n")
    figures = {"test/rms_m": 0.012345, "id/E": 3e4, "time/fit_s": 2.5, "time/data_s": 1.0, "time/device": "a CPU",
               "time/particle_substeps_per_s": 4e5,
               "posterior/E_relative_sd": 0.03}  # fmt: skip
    (tmp_path / "0_prior-stvk" / "metrics.json").write_text(json.dumps(figures))
    (tmp_path / "failed").mkdir()
    (tmp_path / "failed" / "1.txt").write_text("ConfigError: prior: two\nlines\n")
    return tmp_path


def test_a_row_for_each_job_with_overrides_figures_time_and_failure(folder):
    first, second, third = sweep_table(folder)
    assert (first["state"], first["prior"], first["time_s"]) == ("complete", "stvk", 3.5)
    assert first["test/rms_m"] == 0.012345 and first["time/device"] == "a CPU"
    assert (second["state"], second["message"]) == ("failed", "ConfigError: prior: two lines")
    assert third["state"] == "not complete" and third["prior"] == "linear"
    lines = text_of([first, second, third]).splitlines()
    assert lines[0].split() == ["job", "prior", "test/rms_m", "id/E", "posterior/E_relative_sd", "time_s", "state"]  # fmt: skip
    assert lines[1].split() == ["0", "stvk", "0.01235", "3e+04", "0.03", "3.5", "complete"]


def test_a_key_that_is_also_a_figure_keeps_its_column(folder):
    """The seed, over which most sweeps go, had none: a run says its own among its figures."""
    for number, law in enumerate(("stvk", "ogden")):
        job = folder / f"{number}_prior-{law}"
        (job / ".hydra" / "overrides.yaml").write_text(f"- seed={number}\n")
        (job / "metrics.json").write_text(json.dumps({"seed": number, "test/rms_m": 0.01}))
    assert text_of(sweep_table(folder)[:2]).splitlines()[0].split()[:2] == ["job", "seed"]


def test_the_table_stands_at_the_end_of_a_sweep_and_is_written_by_a_command(folder, capsys):
    Failures().on_multirun_end(OmegaConf.create({"hydra": {"sweep": {"dir": str(folder)}}}))
    ended = capsys.readouterr()
    assert "stvk" in ended.out and "1 jobs of the sweep failed" in ended.err
    with (folder / "sweep.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["state"] for row in rows] == ["complete", "failed", "not complete"]
    assert float(rows[0]["id/E"]) == 3e4 and rows[1]["id/E"] == ""
    command.main([str(folder)])
    assert "sweep.csv" in capsys.readouterr().out


def test_a_folder_without_jobs_and_a_damaged_file_are_named(folder, tmp_path_factory, capsys):
    with pytest.raises(DataError, match="expected the folder of a sweep"):
        sweep_table(tmp_path_factory.mktemp("empty"))
    (folder / "0_prior-stvk" / "metrics.json").write_text("{")
    with pytest.raises(SystemExit) as ended:
        command.main([str(folder)])
    assert ended.value.code == 2 and "0_prior-stvk: a damaged file" in capsys.readouterr().err


def test_help_lists_the_groups_of_the_command_alone():
    said = own_groups("splats")
    assert "prior: auto, corotated" in said and "scene" not in said and "hydra" not in said

"""What `resume` makes of a run folder."""

import json
import math

import pytest
from omegaconf import OmegaConf

from mosa.errors import ConfigError
from mosa.run import begins_from, finished, read_figures, write_figures


def config(resume, ckpt_path=None):
    return OmegaConf.create({"resume": resume, "ckpt_path": ckpt_path})


@pytest.fixture
def stopped(tmp_path):
    """A run folder with a checkpoint."""
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "last.ckpt").touch()
    return tmp_path


def test_an_empty_folder_begins_anew(tmp_path):
    assert finished(config("auto"), tmp_path) is None
    assert begins_from(config("auto"), tmp_path) is None
    assert begins_from(config("auto", "other.ckpt"), tmp_path) == "other.ckpt"


def test_a_stopped_run_goes_on_from_its_own_checkpoint(stopped):
    (stopped / "metrics.json.partial").touch()  # killed while it wrote its figures
    assert finished(config("auto"), stopped) is None
    assert begins_from(config("auto", "other.ckpt"), stopped) == str(stopped / "checkpoints" / "last.ckpt")


def test_a_complete_run_is_not_made_again(stopped):
    (stopped / "metrics.json").write_text(json.dumps({"test/rms_m": 0.5}))
    assert finished(config("auto"), stopped) == {"test/rms_m": 0.5}


def test_without_resume_the_folder_does_not_matter(stopped):
    (stopped / "metrics.json").write_text("{}")
    assert finished(config(None), stopped) is None
    assert begins_from(config(None), stopped) is None


def test_a_mistyped_value_is_named(tmp_path):
    with pytest.raises(ConfigError, match="resume: expected null or auto, found True"):
        finished(config(True), tmp_path)


def refuse(constant):
    raise ValueError(f"{constant} is no JSON")


def test_figures_are_strict_json_and_come_back_as_they_were(tmp_path):
    """An exact picture has an infinite PSNR, a law that bursts an infinite growth."""
    figures = {"train/psnr_full": math.inf, "b": -math.inf, "c": math.nan, "test/rms_m": 0.25, "time/device": "cpu", "n": 3}
    write_figures(tmp_path, figures)
    text = (tmp_path / "metrics.json").read_text()
    assert json.loads(text, parse_constant=refuse)["train/psnr_full"] == "Infinity"
    assert [float(json.loads(text)[k]) for k in ("train/psnr_full", "b")] == [math.inf, -math.inf]
    found = read_figures(tmp_path / "metrics.json")
    assert list(found) == sorted(figures)
    assert math.isnan(found.pop("c")) and found == {k: v for k, v in figures.items() if k != "c"}
    assert finished(config("auto"), tmp_path)["train/psnr_full"] == math.inf  # a sweep minimises a number


def test_figures_of_runs_before_are_read(tmp_path):
    (tmp_path / "metrics.json").write_text(json.dumps({"train/psnr_full": math.inf, "id/growth_per_period": math.nan}))
    found = finished(config("auto"), tmp_path)
    assert found["train/psnr_full"] == math.inf and math.isnan(found["id/growth_per_period"])

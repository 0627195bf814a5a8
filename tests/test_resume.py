"""What `resume` makes of a run folder."""

import json

import pytest
from omegaconf import OmegaConf

from mosa.errors import ConfigError
from mosa.run import begins_from, finished


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

"""The figure that a sweep minimises."""

import pytest
from lightning.pytorch.callbacks import EarlyStopping
from omegaconf import OmegaConf

from mosa.config.composition import compose
from mosa.errors import ConfigError
from mosa.training import fitting, outputs
from mosa.training.fitting import check_monitors
from mosa.training.outputs import optimized


def test_a_search_is_never_given_another_figure_than_the_one_it_minimises(monkeypatch):
    """The error on the test films would have stood in for a slip of the pen."""
    figures = {"test/rms_m": 0.01, "train/rms_m": 0.02}
    assert optimized(figures | {"val/loss": 3.0}, "val/loss") == 3.0
    assert optimized(figures, "val/loss") is None
    monkeypatch.setattr(outputs, "searching", lambda: True)
    assert optimized(figures, "train/rms_m") == 0.02
    with pytest.raises(ConfigError, match=r"a figure of metrics\.json, found test/rms"):
        optimized(figures, "test/rms")


def test_what_is_chosen_by_validation_needs_something_held_out(monkeypatch):
    """Optuna would begin twenty fits, none of which has the figure; with another default, by the test films, without a word."""
    chosen = OmegaConf.create({"scene": {}, "optimized_metric": compose().optimized_metric})
    check_monitors(chosen, [])  # a grid chooses nothing
    monkeypatch.setattr(fitting, "searching", lambda: True)
    with pytest.raises(ConfigError, match=r"optimized_metric is val/loss: expected something"):
        check_monitors(chosen, [])
    usual = OmegaConf.create({"scene": {"holdout_frames": None}, "optimized_metric": "test/rms_m"})
    check_monitors(usual, [])
    with pytest.raises(
        ConfigError, match=r"EarlyStopping\.monitor is val/loss: expected something"
    ):
        check_monitors(usual, [EarlyStopping("val/loss")])
    for held_out in {"holdout_frames": 1}, {"holdout_cameras": [0]}:
        whole = OmegaConf.merge(chosen, {"scene": held_out})
        for own in "val/loss", "val/frames/psnr", "val/own_loss", "fit/loss":
            check_monitors(whole, [EarlyStopping(own)])
        with pytest.raises(
            ConfigError, match=r"EarlyStopping\.monitor: .*val/loss, .*found val/los$"
        ):
            check_monitors(whole, [EarlyStopping("val/los")])


def test_results_are_cleared_where_a_run_was_and_nowhere_else(tmp_path):
    (tmp_path / "splats.ply").write_text("somebody's")
    outputs.clear(tmp_path)
    assert (tmp_path / "splats.ply").is_file()
    (tmp_path / "checkpoints").mkdir()
    for name in ("checkpoints/earlier.ckpt", "notes.md"):
        (tmp_path / name).touch()
    outputs.clear(tmp_path)
    assert not (tmp_path / "splats.ply").exists() and (tmp_path / "notes.md").is_file()
    assert (tmp_path / "checkpoints" / "earlier.ckpt").is_file()

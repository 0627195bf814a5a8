"""The figure that a sweep minimises."""

from pathlib import Path

import pytest
import yaml
from lightning.pytorch.callbacks import EarlyStopping
from omegaconf import OmegaConf

from mosa.config.composition import configuration
from mosa.errors import ConfigError
from mosa.training.fitting import check_monitors
from mosa.training.outputs import optimized


def test_a_sweep_that_chooses_by_validation_is_never_given_a_figure_of_the_test_films():
    figures = {"test/rms_m": 0.01, "train/rms_m": 0.02, "test/psnr_crop": 30.0}
    assert optimized(figures, "val/loss") is None
    assert optimized(figures | {"val/loss": 3.0}, "val/loss") == 3.0


def test_a_figure_that_a_run_does_not_have_has_fallbacks():
    assert optimized({"train/rms_m": 0.02}, "test/cd_sq_m2") == 0.02
    assert optimized({"test/psnr_crop": 30.0}, "test/rms_m") == -30.0
    assert optimized({}, "test/rms_m") is None


def test_what_is_chosen_by_validation_needs_something_held_out():
    """Optuna would begin twenty fits, none of which has the figure."""
    search = yaml.safe_load((Path(configuration()) / "hparams_search" / "optuna.yaml").read_text())
    chosen = OmegaConf.create({"scene": {}, "optimized_metric": search["optimized_metric"]})
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

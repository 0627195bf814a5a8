"""Loggers are chosen by name, several at once; a mistake shows before a run."""

import csv
from pathlib import Path

import pytest
import torch
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger

from mosa import compose
from mosa.errors import ConfigError
from mosa.training.callbacks import enlarged
from mosa.training.fitting import instantiated
from mosa.training.loggers import add_picture, log_outcome


def loggers(folder: Path, *overrides: str) -> list:
    """Of the configuration, writing into `folder`."""
    cfg = compose(*overrides)
    for entry in (cfg.logger or {}).values():
        entry.save_dir = str(folder)
    return instantiated(cfg, "logger")


@pytest.mark.parametrize("override, kinds", [
    ("logger=tensorboard", [TensorBoardLogger]), ("logger=csv", [CSVLogger]), ("logger=none", []),
    ("logger=[csv,tensorboard]", [TensorBoardLogger, CSVLogger]),
])  # fmt: skip
def test_a_group_or_several_name_the_loggers(tmp_path, override, kinds):
    found = loggers(tmp_path, override)
    assert len(found) == len(kinds) and all(
        any(isinstance(each, kind) for each in found) for kind in kinds
    )


@pytest.mark.parametrize("overrides, message", [
    (["+logger.mlflow.tracking_uri=x"], r"logger\.mlflow: expected a section with _target_"),
    (["+logger.mine._target_=nowhere_at_all.Logger"], r"logger\.mine: .*imported.* found nowhere_at_all\.Logger \(No module named"),
    (["+logger.mine._target_=mosa.types.Grund"], r"\(the module mosa\.types has no Grund; the nearest is Ground"),
    (["logger=csv", "+logger.csv.projekt=x"], r"logger\.csv\.projekt: unknown key"),
    (["+logger.mine={_target_: mosa.types.Ground, height: 0.0}"], r"logger\.mine: expected a Logger of Lightning, found Ground"),
])  # fmt: skip
def test_an_entry_that_cannot_be_made_is_named(tmp_path, overrides, message):
    with pytest.raises(ConfigError, match=message):
        instantiated(compose(*overrides), "logger")


def test_each_kind_writes_into_the_run_folder(tmp_path):
    found = loggers(tmp_path, "logger=[tensorboard,csv]")
    board, table = sorted(found, key=lambda each: isinstance(each, CSVLogger))
    for logger in (board, table):
        logger.log_metrics({"loss/total": 0.5}, step=3)
        logger.save()
        logger.finalize("success")
    log_outcome(found, {"seed": 4}, {"train/rms_m": 0.01, "id/E": 2e5, "time/fit_s": 3.0})
    with open(tmp_path / "csv" / "version_0" / "metrics.csv") as file:
        assert list(csv.DictReader(file)) == [{"loss/total": "0.5", "step": "3"}]
    assert "seed: 4" in (tmp_path / "tensorboard" / "hparams.yaml").read_text()
    again = loggers(tmp_path, "logger=csv")[0]  # of a run that goes on: the table before stays
    again.log_metrics({"loss/total": 0.4}, step=4)
    again.save()
    assert (tmp_path / "csv" / "version_0" / "metrics.csv").exists() and (
        tmp_path / "csv" / "version_1" / "metrics.csv"
    ).exists()


def test_pictures_go_where_they_can_be_seen_and_are_large_enough(tmp_path):
    picture = torch.rand(3, 59, 105)
    large = enlarged(picture)
    assert large.shape[1] >= 320 and large.shape[2] * 59 == large.shape[1] * 105
    assert torch.equal(large[:, :: large.shape[1] // 59, :: large.shape[2] // 105], picture)
    assert torch.equal(enlarged(large), large)
    add_picture(loggers(tmp_path, "logger=csv"), "strip", picture, 1)  # a table has no place for it
    assert not list(tmp_path.rglob("*.png"))

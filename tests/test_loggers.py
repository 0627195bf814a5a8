"""Loggers are chosen by name, several at once; a mistake shows before a run."""

import csv
import importlib.util
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger

from mosa.callbacks import enlarged
from mosa.config import plain
from mosa.errors import ConfigError
from mosa.loggers import add_picture, build_loggers, chosen, log_outcome

CONF = str(Path(__file__).parents[1] / "conf")


def settings(*overrides):
    with initialize_config_dir(CONF, version_base="1.3"):
        return plain(compose("train", overrides=list(overrides))).get("logger")


@pytest.mark.parametrize("override, kinds", [
    ("logger=tensorboard", ["tensorboard"]), ("logger=csv", ["csv"]), ("logger=none", []),
    ("logger=[csv,tensorboard]", ["tensorboard", "csv"]), ("logger.images_every=0", ["tensorboard"]),
])  # fmt: skip
def test_a_group_or_several_name_the_loggers(override, kinds):
    assert chosen(settings(override)) == kinds


def test_wandb_is_asked_for_before_a_run(monkeypatch):
    wanted = settings("logger=wandb", "logger.wandb.offline=true")
    find = importlib.util.find_spec
    with monkeypatch.context() as without:
        without.setattr(importlib.util, "find_spec", lambda name: None if name == "wandb" else find(name))
        with pytest.raises(ConfigError, match=r"logger=wandb: expected the package wandb, found none: pip install wandb"):
            chosen(wanted)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object() if name == "wandb" else find(name))
    assert chosen(wanted) == ["wandb"]


@pytest.mark.parametrize("key, message", [("mlflow", r"logger\.mlflow: unknown key; expected one of tensorboard, csv, wandb"),
                                          ("wandb", r"logger\.wandb\.projekt: unknown key")])
def test_an_unknown_key_is_named(key, message):
    with pytest.raises(ConfigError, match=message):
        chosen({key: {"projekt": "x"}})


def test_each_kind_writes_into_the_run_folder(tmp_path):
    wanted = {"tensorboard": {}, "csv": {}}
    board, table = build_loggers(wanted, tmp_path)
    assert isinstance(board, TensorBoardLogger) and isinstance(table, CSVLogger)
    for logger in (board, table):
        logger.log_metrics({"loss/total": 0.5}, step=3)
        logger.save()
        logger.finalize("success")
    log_outcome(wanted, tmp_path, {"seed": 4}, {"train/rms_m": 0.01, "id/E": 2e5, "time/fit_s": 3.0})
    with open(tmp_path / "csv" / "version_0" / "metrics.csv") as file:
        assert list(csv.DictReader(file)) == [{"loss/total": "0.5", "step": "3"}]
    assert "seed: 4" in (tmp_path / "tensorboard" / "hparams.yaml").read_text()
    again = build_loggers({"csv": {}}, tmp_path)[0]  # of a run that goes on: the table before stays
    again.log_metrics({"loss/total": 0.4}, step=4)
    again.save()
    assert (tmp_path / "csv" / "version_0" / "metrics.csv").exists() and (tmp_path / "csv" / "version_1" / "metrics.csv").exists()


def test_pictures_go_where_they_can_be_seen_and_are_large_enough(tmp_path):
    picture = torch.rand(3, 59, 105)
    large = enlarged(picture)
    assert large.shape[1] >= 320 and large.shape[2] * 59 == large.shape[1] * 105
    assert torch.equal(large[:, :: large.shape[1] // 59, :: large.shape[2] // 105], picture)
    assert torch.equal(enlarged(large), large)
    add_picture(build_loggers({"csv": {}}, tmp_path), "strip", picture, 1)  # a table has no place for it
    assert not list(tmp_path.rglob("*.png"))

"""Loggers are chosen by name, several at once; a mistake shows before a run."""

import csv
import importlib.util
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.compat.proto.summary_pb2 import DATA_CLASS_SCALAR

from mosa.callbacks import enlarged
from mosa.config import plain
from mosa.curves import described, table
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
    board, table = build_loggers(wanted, tmp_path, "neo_hookean")
    assert isinstance(board, TensorBoardLogger) and isinstance(table, CSVLogger)
    for logger in (board, table):
        logger.log_metrics({"loss/total": 0.5}, step=3)
        logger.save()
        logger.finalize("success")
    log_outcome(wanted, tmp_path, {"seed": 4}, {"train/rms_m": 0.01, "id/E": 2e5, "time/fit_s": 3.0}, "neo_hookean")
    with open(tmp_path / "csv" / "version_0" / "metrics.csv") as file:
        assert list(csv.DictReader(file)) == [{"loss/total": "0.5", "step": "3"}]
    assert "seed: 4" in (tmp_path / "tensorboard" / "hparams.yaml").read_text()
    again = build_loggers({"csv": {}}, tmp_path, "neo_hookean")[0]  # of a run that goes on: the table before stays
    again.log_metrics({"loss/total": 0.4}, step=4)
    again.save()
    assert (tmp_path / "csv" / "version_0" / "metrics.csv").exists() and (tmp_path / "csv" / "version_1" / "metrics.csv").exists()


def test_pictures_go_where_they_can_be_seen_and_are_large_enough(tmp_path):
    picture = torch.rand(3, 59, 105)
    large = enlarged(picture)
    assert large.shape[1] >= 320 and large.shape[2] * 59 == large.shape[1] * 105
    assert torch.equal(large[:, :: large.shape[1] // 59, :: large.shape[2] // 105], picture)
    assert torch.equal(enlarged(large), large)
    add_picture(build_loggers({"csv": {}}, tmp_path, "neo_hookean"), "strip", picture, 1)  # a table has no place for it
    assert not list(tmp_path.rglob("*.png"))


def scalars_of(folder):
    """{tag: ((step, value), ...)} of a folder of events, and {tag: metadata}, as TensorBoard's own reader has them."""
    events = EventAccumulator(str(folder))
    events.Reload()
    tags = events.Tags()["scalars"]
    return {tag: [(point.step, point.value) for point in events.Scalars(tag)] for tag in tags}, events.summary_metadata


def test_curves_carry_their_description(tmp_path):
    (board,) = build_loggers({"tensorboard": {}}, tmp_path, "newtonian")
    for step in range(3):
        board.log_metrics({"id/mu": torch.tensor(200.0 + step), "newton/sd/operator": 0.1, "unheard_of": 1.0}, step=step)
    board.finalize("success")
    log_outcome({"tensorboard": {}}, tmp_path, {"seed": 4}, {"test/rms_m": 0.01, "id/mu": 210.0, "id/v0_y": -1.0}, "newtonian")
    points, about = scalars_of(board.log_dir)
    assert points["id/mu"] == [(0, 200.0), (1, 201.0), (2, 202.0)]  # the first, which has the description, is one like others
    assert points["final/id/mu"] == [(0, 210.0)]
    assert about["id/mu"].summary_description == "parameter mu after the step, without eta [Pa s]"
    assert about["newton/sd/operator"].summary_description.startswith("Gauss-Newton: mean prior standard deviation of the numbers")
    for figure, unit in (("test/rms_m", "m"), ("id/mu", "Pa s"), ("id/v0_y", "m/s")):
        said = about[f"final/{figure}"].summary_description
        assert said.startswith(f"figure {figure} of `metrics.json`") and said.endswith(f" [{unit}]")
    assert "unheard_of" in points and "unheard_of" not in about
    # TensorBoard's fast reader, which is not Python, keeps the description of points that say their class alone
    assert {about[tag].data_class for tag in ("id/mu", "final/id/mu")} == {DATA_CLASS_SCALAR}


@pytest.mark.parametrize(("tag", "law", "text"), [
    ("id/mu", "herschel_bulkley", "parameter mu after the step, without eta [Pa]"),
    ("id/nu", "neo_hookean", "parameter nu after the step, without eta"),
    ("id/friction_angle", "drucker_prager", "parameter friction_angle after the step, without eta [degrees]"),
    ("id/contact_offset", "neo_hookean", "height above the ground at which the grid stops the body, after the step [m]"),
    ("time/step_s", "neo_hookean", "wall time of the step [s]"),
    ("loss/other", "neo_hookean", None),
])  # fmt: skip
def test_a_curve_is_described_in_its_unit(tag, law, text):
    assert described(tag, law) == text


def test_the_docs_have_the_same_table():
    page = (Path(__file__).parents[1] / "docs" / "figures.md").read_text()
    assert f"\n\n{table()}\n\n" in page.partition("## Curves of the fit")[2]

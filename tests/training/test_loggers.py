"""Loggers are chosen by name, several at once; a mistake shows before a run."""

import csv
from pathlib import Path

import pytest
import torch
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.compat.proto.summary_pb2 import DATA_CLASS_SCALAR

from mosa import compose
from mosa.errors import ConfigError
from mosa.training.callbacks import enlarged
from mosa.training.curves import described, table
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
    (["+logger.mine._target_=nowhere.Logger"], r"logger\.mine: .*imported.* found nowhere\.Logger \(No module named"),
    (["logger=csv", "+logger.csv.projekt=x"], r"logger\.csv: .*projekt"),
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


def scalars_of(folder):
    """{tag: ((step, value), ...)} of a folder of events, and {tag: metadata}, as TensorBoard's own reader has them."""
    events = EventAccumulator(str(folder))
    events.Reload()
    tags = events.Tags()["scalars"]
    return {
        tag: [(point.step, point.value) for point in events.Scalars(tag)] for tag in tags
    }, events.summary_metadata


def test_curves_carry_their_description(tmp_path):
    (board,) = loggers(tmp_path)
    board.law = "newtonian"
    for step in range(3):
        board.log_metrics(
            {"id/mu": torch.tensor(200.0 + step), "newton/sd/operator": 0.1, "unheard_of": 1.0},
            step=step,
        )
    board.finalize("success")
    log_outcome([board], {"seed": 4}, {"test/rms_m": 0.01, "id/mu": 210.0, "id/v0_y": -1.0})
    points, about = scalars_of(board.log_dir)
    assert points["id/mu"] == [
        (0, 200.0),
        (1, 201.0),
        (2, 202.0),
    ]  # the first, which has the description, is one like others
    assert points["final/id/mu"] == [(0, 210.0)]
    assert about["id/mu"].summary_description == "parameter mu after the step, without eta [Pa s]"
    assert about["newton/sd/operator"].summary_description.startswith(
        "Gauss-Newton: mean prior standard deviation of a kind"
    )
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
    page = (Path(__file__).parents[2] / "docs" / "figures.md").read_text()
    assert f"\n\n{table()}\n\n" in page.partition("## Curves of the fit")[2]

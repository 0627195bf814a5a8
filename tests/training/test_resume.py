"""What `resume` makes of a run folder."""

import json
import math
from types import SimpleNamespace

import pytest
import torch
from omegaconf import OmegaConf
from strangers import saved

from mosa.config.checkpoints import check_same_data, check_same_scene, read_checkpoint, record_of
from mosa.errors import ConfigError, DataError
from mosa.training import fitting
from mosa.training.callbacks import KeepLast
from mosa.training.run_folder import begins_from, finished, read_figures, write_figures


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
    assert begins_from(config("auto", "other.ckpt"), stopped) == str(
        stopped / "checkpoints" / "last.ckpt"
    )


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
    figures = {
        "train/psnr_full": math.inf,
        "b": -math.inf,
        "c": math.nan,
        "test/rms_m": 0.25,
        "time/device": "cpu",
        "n": 3,
    }
    write_figures(tmp_path, figures)
    text = (tmp_path / "metrics.json").read_text()
    assert json.loads(text, parse_constant=refuse)["train/psnr_full"] == "Infinity"
    assert [float(json.loads(text)[k]) for k in ("train/psnr_full", "b")] == [math.inf, -math.inf]
    found = read_figures(tmp_path / "metrics.json")
    assert list(found) == sorted(figures)
    assert math.isnan(found.pop("c")) and found == {k: v for k, v in figures.items() if k != "c"}
    assert (
        finished(config("auto"), tmp_path)["train/psnr_full"] == math.inf
    )  # a sweep minimises a number


def test_figures_of_runs_before_are_read(tmp_path):
    (tmp_path / "metrics.json").write_text(
        json.dumps({"train/psnr_full": math.inf, "id/growth_per_period": math.nan})
    )
    found = finished(config("auto"), tmp_path)
    assert found["train/psnr_full"] == math.inf and math.isnan(found["id/growth_per_period"])


def trained(folder, figures=True, **changed):
    """A run folder whose checkpoint and figures are of a configuration, with `changed` in it; the configuration."""
    cfg = OmegaConf.create({"resume": "auto", "ckpt_path": None, "seed": 0, "prior": {"law": "corotated", "parameters": {}},
                            "fit": {"views": 1},
                            "scene": {"path": "/a/duck", "cache": None}, "evaluation": {"video": True}})  # fmt: skip
    (folder / "checkpoints").mkdir()
    stored = OmegaConf.to_container(OmegaConf.merge(cfg, OmegaConf.create(changed)))
    known = saved()["mosa"] | {"settings": stored}
    torch.save({"mosa": known}, folder / "checkpoints" / "last.ckpt")
    if figures:
        write_figures(folder, {"test/rms_m": 0.5})
    return cfg


@pytest.mark.parametrize(("changed", "said"), [
    ({"seed": 1}, "seed: 1 there, 0 here"), ({"prior": {"law": "linear"}}, "prior.law: linear there, corotated here"),
    ({"fit": {"views": 2}}, "fit.views: 2 there, 1 here"), ({"scene": {"path": "/b/goose"}}, "scene.path: /b/goose there"),
])  # fmt: skip
@pytest.mark.parametrize("figures", [True, False])
def test_a_run_of_another_configuration_is_not_taken_for_this_one(tmp_path, changed, said, figures):
    """Two sweeps in one folder, whose jobs are numbered alike: the second had the figures of the first, or went on with its fit."""
    cfg = trained(tmp_path, figures, **changed)
    with pytest.raises(
        ConfigError, match=f"resume: expected in .* a run of this configuration, .*{said}"
    ):
        finished(cfg, tmp_path)
        begins_from(cfg, tmp_path)
    cfg.resume = None
    assert finished(cfg, tmp_path) is None and begins_from(cfg, tmp_path) is None


def test_a_fit_goes_on_with_the_data_that_it_began_with(tmp_path):
    """A body of as many particles, of another film, was found out when all was reconstructed, or never."""
    trained(tmp_path)
    last = tmp_path / "checkpoints" / "last.ckpt"
    found, path = record_of(read_checkpoint(last), last), "x.ckpt"
    scene = {"path": "/moved/duck", "cache": "/b"}
    check_same_scene(found, {"scene": scene | {"test": ["more"]}, "seed": 5}, path)
    with pytest.raises(
        ConfigError, match=r"in x\.ckpt a fit to this scene, .*scene\.path: /a/duck there, /a/goose"
    ):
        check_same_scene(found, {"scene": scene | {"path": "/a/goose"}}, path)


@pytest.mark.parametrize("stored, here, other", [
    ({"train": "a"}, {"train": "a"}, None), ({"train": "a"}, {"train": "b"}, r"\(train\)"),
    ({"train": "a", "test/x": "c"}, {"train": "a", "test/x": "d"}, r"\(test/x\)"), ({}, {"train": "b"}, None),
    ({"train": "a"}, {"train": "a", "test/new": "e"}, None),
    ({"train": "a", "train/x": "c"}, {"train": "b", "train/x": "d"}, "train, train/x"),
])  # fmt: skip
def test_films_are_known_by_their_bytes(tmp_path, stored, here, other):
    """Another film below the same path was evaluated as the training one, without a word."""
    trained(tmp_path)
    last = tmp_path / "checkpoints" / "last.ckpt"
    record = record_of(read_checkpoint(last), last).but(data=stored)
    if other is None:
        return check_same_data(record, here, "x.ckpt")
    with pytest.raises(DataError, match=rf"x\.ckpt: .*found other images.*{other}.*scene\.root="):
        check_same_data(record, here, "x.ckpt")


@pytest.mark.parametrize("changed", [
    {}, {"evaluation": {"video": False}}, {"scene": {"path": "/moved/duck", "cache": "/b"}}, {"an_older_key": 1},
])  # fmt: skip
def test_what_does_not_say_what_is_learned_may_differ(tmp_path, changed):
    cfg = trained(tmp_path, **changed)
    assert finished(cfg, tmp_path) == {"test/rms_m": 0.5} and begins_from(cfg, tmp_path).endswith(
        "last.ckpt"
    )


def begin(folder, checkpoint=None):
    last, trainer = KeepLast(), SimpleNamespace(default_root_dir=str(folder), ckpt_path=checkpoint)
    last.setup(trainer, None, "fit")
    last.on_fit_start(trainer, SimpleNamespace(stage=None))


def test_a_fit_that_begins_takes_away_the_figures_of_the_run_before(tmp_path):
    """They would say that it is complete, were it killed."""
    write_figures(tmp_path, {"test/rms_m": 0.5})
    begin(tmp_path)
    assert not (tmp_path / "metrics.json").exists()


@pytest.mark.parametrize("goes_on", [False, True])
def test_a_fit_that_begins_anew_keeps_the_checkpoint_of_one_that_did_not_end(
    tmp_path, caplog, goes_on
):
    last, earlier = (tmp_path / "checkpoints" / name for name in ("last.ckpt", "earlier.ckpt"))
    last.parent.mkdir()
    last.write_text("step 179 of 200")
    begin(tmp_path, str(last) if goes_on else None)
    assert (last if goes_on else earlier).read_text() == "step 179 of 200"
    assert (f"ckpt_path={earlier} goes on with it" in caplog.text) != goes_on


def test_a_checkpoint_that_is_removed_before_the_fit_reads_it_is_named(tmp_path, monkeypatch):
    """Lightning reads it once more, after the reconstruction."""

    def removed(*_, **__):
        raise FileNotFoundError("Checkpoint file not found")

    for name in ("read_checkpoint", "check_same", "check_numbers", "read_numbers"):
        monkeypatch.setattr(fitting, name, lambda *_: [])
    body = SimpleNamespace(material=SimpleNamespace(law="corotated"), rest=torch.zeros(1))
    trainer = SimpleNamespace(callbacks=[], loggers=[], fit=removed)
    with pytest.raises(
        DataError,
        match=r"ckpt_path: gone/last\.ckpt: the fit cannot go on from it \(FileNotFoundError",
    ):
        fitting.fit(trainer, SimpleNamespace(body=body), None, "gone/last.ckpt")

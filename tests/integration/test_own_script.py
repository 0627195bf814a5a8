"""docs/own_training_script.md: a plain Trainer with callbacks of Lightning's does what train.py does."""

import json
import os
import pickle
from pathlib import Path

import forked
import lightning as L
import pytest
import torch
from assembled import ROUGHLY
from lightning.pytorch.callbacks import EarlyStopping, LearningRateMonitor, ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger
from run_page import written
from starts_once import start_once

from mosa import LitMosa, SceneDataModule, compose
from mosa.errors import ConfigError
from mosa.modules.fitting import newton_steps
from mosa.training import datamodule

ROOT = Path(__file__).parents[2]
HELD = [
    "scene.holdout_cameras=[1]",
    "scene.holdout_frames=1",
    "heterogeneity.enabled=false",
    *ROUGHLY,
]
QUIET = {
    "logger": False,
    "enable_progress_bar": False,
    "enable_model_summary": False,
    "accelerator": "cpu",
}


@pytest.fixture(scope="module", autouse=True)
def starts(cache):
    """Found once for the scripts here and for the command."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(datamodule, "sequence_start", start_once)
        yield


@pytest.fixture(scope="module")
def cfg(cache):
    return compose(
        "debug=default",
        f"scene.cache={cache}",
        "adapter=mosa",
        "fit.views=1",
        "fit.joint.iterations=5",
        *HELD,
    )


@pytest.fixture(scope="module")
def fitted(cfg, tmp_path_factory):
    """(folder, data, module, trainer) of a script of one's own."""
    folder = tmp_path_factory.mktemp("own")
    stopping = EarlyStopping("val/loss", patience=50)
    best = ModelCheckpoint(folder, filename="best", monitor="val/loss", save_last=True)
    trainer = L.Trainer(
        max_epochs=-1,
        callbacks=[stopping, best, LearningRateMonitor()],
        profiler="simple",
        accelerator="cpu",
        logger=CSVLogger(folder, name="csv"),
        log_every_n_steps=1,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=folder,
    )
    data, module = SceneDataModule(cfg), LitMosa(cfg)
    trainer.fit(module, datamodule=data)
    return folder, data, module, trainer


def test_the_data_stand_alone(cache):
    data = SceneDataModule("tiny", "debug=default", f"scene.cache={cache}", *HELD, held_out=False)
    data.prepare_data()
    data.setup("fit")
    batch = next(iter(data.train_dataloader()))
    (own,) = batch.sequences
    V, T, h, w, _ = own.observations.images.shape
    assert own.observations.mattes.shape == (V, T, h, w) and own.observations.flow.shape == (
        V,
        T - 1,
        h,
        w,
        2,
    )
    assert own.cues.positions.shape == own.cues.stretch.shape == (
        T,
        own.cues.rotation.shape[1],
        3,
    ) and T == len(own.frames)
    assert f"images ({V}, {T}, {h}, {w}, 3)" in repr(batch)
    cameras, frames = (each.sequences[0] for each in data.val_dataloader())
    assert cameras.views == [1] and len(cameras.frames) == T and frames.frames == [T]


def test_a_plain_trainer_fits_as_the_command_does(fitted, cfg, cache, tmp_path):
    _, _, module, trainer = fitted
    written(ROOT / "docs" / "own_training_script.md", tmp_path)
    words = ["train.py", "--config-dir", f"{tmp_path}/my_conf", f"hydra.run.dir={tmp_path}", "debug=default",
             f"scene.cache={cache}", "adapter=mosa", "fit.views=1", "fit.joint.iterations=5", *HELD, "evaluation.video=false",
             "evaluation.floor=false", "evaluation.samples=64", "evaluation.assignment=16", "logger=none",
             "+trainer.profiler=simple", "callbacks=[default,early_stopping,learning_rate,young]", "+callbacks.young.digits=6",
             "callbacks.early_stopping.patience=50", "callbacks.learning_rate=null"]  # fmt: skip
    path = os.pathsep.join(map(str, (tmp_path, ROOT)))
    result = forked.call(*words, environment=os.environ | {"PYTHONPATH": path})
    assert result.returncode == 0, result.stderr[-3000:]
    found = (tmp_path / "young.txt").read_text().split()  # the callback of the page
    assert len(found) == module.steps_done and float(found[-1]) == pytest.approx(
        float(trainer.callback_metrics["id/E"]), rel=1e-5
    )
    theirs = torch.load(tmp_path / "checkpoints" / "last.ckpt", weights_only=True)
    for name, value in module.state_dict().items():
        assert torch.equal(value, theirs["state_dict"][name]), name
    assert (
        module.stage is None and trainer.global_step == module.steps_done == theirs["global_step"]
    )
    figures = json.loads((tmp_path / "metrics.json").read_text())
    assert figures["val/loss"] == pytest.approx(
        float(trainer.callback_metrics["val/loss"]), rel=1e-6
    )
    assert not {"trainer", "callbacks", "logger"} & set(
        theirs["mosa"]["settings"]
    )  # what it holds is data


def test_what_lightning_s_callbacks_left(fitted):
    folder, _, module, trainer = fitted
    rows = (folder / "csv" / "version_0" / "metrics.csv").read_text()
    assert (
        "lr/material" in rows
        and "val/loss" in rows
        and "val/cameras/psnr" in rows
        and "id/E" in rows
    )
    assert (folder / "best.ckpt").is_file() and (folder / "last.ckpt").is_file()
    # the one that `ckpt_path="best"` asks, not the module's own callback
    assert Path(trainer.checkpoint_callback.best_model_path) == folder / "best.ckpt"
    assert trainer.current_epoch >= sum(stage.iterations for stage in module.stages if stage.newton)


def test_data_that_were_fitted_reach_other_processes(fitted):
    data = fitted[1]
    other = pickle.loads(pickle.dumps(data))
    found, expected = (next(iter(each.train_dataloader())).sequences[0] for each in (other, data))
    assert torch.equal(found.cues.positions, expected.cues.positions)


def test_a_callback_whose_state_could_not_be_read_is_named(fitted, tmp_path):
    trainer = fitted[3]

    class Mine(L.Callback):
        def state_dict(self):
            return {"where": tmp_path}

    trainer.callbacks.append(mine := Mine())
    with pytest.raises(ConfigError, match=r"callbacks\..*Mine\.where: expected .*found PosixPath"):
        trainer.save_checkpoint(tmp_path / "a.ckpt")
    trainer.callbacks.remove(mine)


def test_a_checkpoint_is_fitted_on_validated_tested_and_predicts(fitted, cfg, tmp_path):
    _, data, module, _ = fitted
    begun = L.Trainer(
        **QUIET,
        max_epochs=2,
        default_root_dir=tmp_path,
        callbacks=[ModelCheckpoint(tmp_path, save_last=True)],
    )
    begun.fit(LitMosa(cfg), datamodule=data)
    loaded = LitMosa.load_from_checkpoint(tmp_path / "last.ckpt")
    assert 0 < loaded.steps_done < module.steps_done and loaded.stage is not None
    L.Trainer(**QUIET, max_epochs=-1, enable_checkpointing=False).fit(loaded, datamodule=data)
    assert loaded.stage is None and loaded.steps_done == module.steps_done
    for name, value in module.state_dict().items():
        assert torch.allclose(value, loaded.state_dict()[name], rtol=1e-4, atol=1e-6), name
    trainer = L.Trainer(**QUIET, enable_checkpointing=False)
    (validated,) = trainer.validate(loaded, datamodule=data, verbose=False)[:1]
    assert validated["val/loss"] > 0
    (tested,) = trainer.test(loaded, datamodule=data, verbose=False)
    assert tested["test/rms_m"] > 0 and not any(key.startswith("train/") for key in tested)
    data.predict = [{"height": 0.2, "velocity": (0.0, -1.0, 0.0), "frames": 3}]
    (rollout,) = trainer.predict(loaded, datamodule=data)
    assert rollout.x.shape == (3, len(loaded.body.rest), 3)
    with pytest.raises(ConfigError, match=r"predict: expected starts.*'height'.*data\.predict ="):
        L.Trainer(**QUIET).predict(loaded, dataloaders=[{"height": 0.2}])


def test_the_last_validation_is_of_the_law_that_is_kept(cache, tmp_path, monkeypatch):
    """A sweep was given `val/loss` of a law with parts that the joint stage's end then drops."""
    once = [f"fit.{stage}.newton_iterations=1" for stage in ("prior", "joint")]
    cfg = compose("debug=default", f"scene.cache={cache}", "adapter=operator", *HELD, *once,
                  "reconstruction.informed.iterations=0")  # fmt: skip
    monkeypatch.setattr(newton_steps, "chosen", lambda errors: "isotropic")
    seen = []

    class Seen(L.Callback):
        def on_validation_end(self, trainer, module):
            seen.append(float(trainer.callback_metrics["val/loss"]))

    every = ModelCheckpoint(tmp_path, monitor="val/loss", save_top_k=-1, save_last=True)
    data, module = SceneDataModule(cfg, held_out=False), LitMosa(cfg)
    trainer = L.Trainer(**QUIET, max_epochs=-1, callbacks=[Seen(), every])
    trainer.fit(module, datamodule=data)
    assert module.parts and not module.body.adapter.numbers.any()
    found = float(trainer.callback_metrics["val/loss"])
    assert found == seen[-1] == float(every.current_score) and found != seen[-2]
    again = L.Trainer(**QUIET, max_epochs=-1, enable_checkpointing=False)
    kept = LitMosa.load_from_checkpoint(tmp_path / "last.ckpt")
    (figures,) = again.validate(kept, datamodule=data, verbose=False)[:1]
    assert figures["val/loss"] == pytest.approx(found, rel=1e-6)
    again.fit(kept, datamodule=data)  # complete: a sweep that goes on is given the same figure
    assert float(again.callback_metrics["val/loss"]) == pytest.approx(found, rel=1e-6)


def test_what_cannot_be_done_is_named(cfg):
    with pytest.raises(ConfigError, match=r"expected a SceneDataModule.*docs/extending\.md"):
        L.Trainer(**QUIET, enable_checkpointing=False).fit(LitMosa(cfg), train_dataloaders=[0])
    with pytest.raises(ConfigError, match=r"expected scenes that the configuration names"):
        type("Own", (SceneDataModule,), {"scenes": None})
    with pytest.raises(
        ConfigError, match=r"trainer\.accumulate_grad_batches: expected 1, found 2: fit\.views"
    ):
        L.Trainer(**QUIET, enable_checkpointing=False, accumulate_grad_batches=2).fit(
            LitMosa(cfg), datamodule=SceneDataModule(cfg)
        )
    with pytest.raises(ConfigError, match=r"trainer\.precision: expected 32-true, found '64-true'"):
        L.Trainer(**QUIET, enable_checkpointing=False, precision="64-true").fit(
            LitMosa(cfg), datamodule=SceneDataModule(cfg)
        )


def test_a_stopper_ends_a_stage_and_not_the_fit(cache):
    """Validation that never improves: each stage ends after as many epochs as the stopper waits."""
    cfg = compose("debug=default", f"scene.cache={cache}", "adapter=mosa", "fit.joint.iterations=30", "fit.prior.iterations=5",
                  "fit.prior.newton_iterations=5", *HELD)  # fmt: skip
    stopper = EarlyStopping("val/loss", patience=1, min_delta=1e9)
    module, trainer = (
        LitMosa(cfg),
        L.Trainer(**QUIET, max_epochs=-1, enable_checkpointing=False, callbacks=[stopper]),
    )
    begun, begin = [], module.begin
    module.begin = lambda stage: (begun.append(stage.name), begin(stage))
    trainer.fit(module, datamodule=SceneDataModule(cfg, held_out=False))
    assert begun == [stage.name for stage in module.stages] and module.stage is None
    assert trainer.current_epoch == 2 * len(begun)

"""What the callbacks of a fit say and log, on a module that does nothing else."""

import logging
from collections import OrderedDict, defaultdict
from pathlib import Path
from types import SimpleNamespace

import lightning as L
import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from lightning.pytorch.callbacks import EarlyStopping, Timer
from lightning.pytorch.callbacks.early_stopping import EarlyStoppingReason
from lightning.pytorch.loggers import TensorBoardLogger

from mosa import compose
from mosa.config.checkpoints import check_plain
from mosa.errors import ConfigError
from mosa.modules.fitting.stages import Stage
from mosa.modules.fitting.stages_callback import Stages
from mosa.training.callbacks import ImageStrips, KeepLast, Pace, StageNotes
from mosa.training.fitting import build_trainer
from mosa.training.run_folder import quiet


class Fit:
    """A module of two stages with one optimiser each, and what a trainer shows of it."""

    def __init__(self, first="adam", second="adam"):
        self.stages = [
            Stage(name="prior", iterations=2, lr=0.1, optimizer=first),
            Stage(name="joint", iterations=1, lr=0.01, optimizer=second),
        ]
        self.stage_index, self.losses, self.logged, self.stage_over = 0, [], [], False
        self.last = {"loss/total": 0.25, "id/E": 2e5, "gradient_norm/material": 3.0}
        self.trainer = SimpleNamespace(optimizers=[self.optimizer(0.1)])

    @staticmethod
    def optimizer(lr):
        return torch.optim.SGD([{"params": [torch.zeros(1)], "lr": lr, "name": "material"}])

    @property
    def stage(self):
        return self.stages[self.stage_index] if self.stage_index < 2 else None

    def log_dict(self, values, **_):
        self.logged.append({k: float(v) for k, v in values.items()})

    def run(self, callback, steps):
        """So many steps of the fit, in order as Lightning and `Stages` have them."""
        for _ in range(steps):
            callback.on_train_batch_start(self.trainer, self, None, 0)
            self.losses.append(0.0)
            self.stage_over = len(self.losses) == self.stage.iterations
            callback.on_train_batch_end(self.trainer, self, None, None, 0)
            if self.stage_over:
                self.stage_index, self.losses, self.stage_over = self.stage_index + 1, [], False
                self.trainer.optimizers = [self.optimizer(0.01)]


def test_a_rate_is_that_of_the_stage_a_step_was_made_in():
    fit = Fit("adam")
    fit.run(Pace(), 3)
    assert [values["lr/material"] for values in fit.logged] == pytest.approx([0.1, 0.1, 0.01])
    assert all(values["time/step_s"] >= 0 for values in fit.logged)


def test_a_step_of_gauss_newton_has_no_rate():
    fit = Fit("gauss_newton", "adam")
    fit.run(Pace(), 3)
    assert [set(values) for values in fit.logged] == [{"time/step_s"}] * 2 + [
        {"time/step_s", "lr/material"}
    ]


def test_tracked_points_have_no_strip(tmp_path):
    logger = TensorBoardLogger(str(tmp_path))
    take = SimpleNamespace(observations=SimpleNamespace(cameras=()))
    module = SimpleNamespace(loggers=[logger], steps_done=10, takes=[take])
    ImageStrips(10).on_train_batch_end(SimpleNamespace(), module)  # says nothing, simulates nothing


def test_stages_are_noted_when_they_begin_and_end(caplog):
    caplog.set_level(logging.INFO, "mosa")
    fit = Fit()
    fit.losses = [0.0]  # of a run that goes on
    fit.run(StageNotes(), 2)
    said = [record.getMessage() for record in caplog.records]
    assert (
        said[0] == "stage prior: at most 2 steps, going on after 1"
        and said[2] == "stage joint: at most 1 steps"
    )
    assert said[1].startswith("stage prior: ended after 1 steps, ") and said[1].endswith(
        " s: loss 0.25000, E 2e+05"
    )
    assert said[3].startswith("stage joint: ended after 1 steps, ") and len(said) == 4


def ended_epoch(fit, stage_over, metric, **stopper):
    """(callback, trainer) after the epoch's end of a fit, whose stopper has just seen a metric."""
    each = EarlyStopping("val/loss", **stopper)
    each.best_score, seen = torch.tensor(0.5), torch.tensor(metric)
    trainer = SimpleNamespace(callbacks=[each], enable_validation=False)
    trainer.should_stop = each._evaluate_stopping_criteria(seen)[0]
    fit.stage_over = stage_over

    def finish():
        fit.stage_index, fit.stage_over = fit.stage_index + 1, False

    fit.finish, trainer.strategy = finish, SimpleNamespace(setup_optimizers=lambda _: None)
    trainer.should_stop = trainer.should_stop or metric == 0.1  # as by a limit of time
    Stages().on_train_epoch_end(trainer, fit)
    return each, trainer


@pytest.mark.parametrize(
    "metric, how", [(0.4, {"stopping_threshold": 0.45}), (9.0, {"divergence_threshold": 1.0}), (float("inf"), {}),
                    (0.6, {"patience": 1})]
)  # fmt: skip
def test_whatever_a_stopper_stops_for_ends_the_stage(metric, how):
    """Its thresholds, and an infinite loss of a law that cannot be simulated, ended the fit."""
    each, trainer = ended_epoch(fit := Fit(), False, metric, **how)
    assert fit.stage_index == 1 and not trainer.should_stop
    assert each.stopping_reason == EarlyStoppingReason.NOT_STOPPED and each.wait_count == 0


@pytest.mark.parametrize("stage_over", [True, False])
def test_what_others_stop_for_ends_the_fit(stage_over):
    """A stop in the last epoch of a stage was forgotten."""
    _, trainer = ended_epoch(fit := Fit(), stage_over, 0.1)
    assert fit.stage_index == stage_over and trainer.should_stop


@pytest.mark.parametrize("value", [Path("a"), np.float64(1), np.ones(1), {1.0}, defaultdict(int)])
def test_a_state_that_a_checkpoint_could_not_be_read_with_is_named(value):
    plain = OrderedDict(seen=[1, 2.0, "text", None, True, (torch.ones(1),)], more={})
    check_plain("", {"callbacks": {"Mine": plain}})
    with pytest.raises(
        ConfigError, match=rf"callbacks\.Mine\.more\.0: expected .*{type(value).__name__}"
    ):
        check_plain("", {"callbacks": {"Mine": plain | {"more": [value]}}})


@pytest.mark.parametrize("override, message", [
    ("trainer.precision=64-true", r"trainer\.precision: expected 32-true, found '64-true'"),
    ("trainer.precision=16-mixed", r"trainer\.precision: .*found '16-mixed'"),
    ("trainer.max_epochs=many", r"trainer\.max_epochs: expected a whole number, or null, found 'many'"),
    ("+trainer.accumulate_grad_batches=2", r"trainer\.accumulate_grad_batches: expected 1, found 2"),
    ("+callbacks.more={_target_: lightning.pytorch.callbacks.GradientAccumulationScheduler, scheduling: {0: 2}}",
     r"trainer\.accumulate_grad_batches: expected 1, found GradientAccumulationScheduler: fit\.views"),
    ("+trainer.min_steps=9", r"trainer\.min_steps: expected none, found 9: the last stage ends"),
    ("+trainer.min_epochs=2", r"trainer\.min_epochs: expected none, found 2"),
    ("+trainer.limit_train_batches=0.5", r"trainer\.limit_train_batches: expected a whole number of batches, found 0\.5"),
    ("+trainer.val_check_interval=0.5", r"trainer\.val_check_interval: expected a whole number of batches, found 0\.5"),
    ("+trainer.logger=false", r"trainer\.logger: expected none.*found False; logger=<option>"),
    ("+trainer.callbacks=[]", r"trainer\.callbacks: expected none.*; callbacks=<option>"),
    ("+trainer.default_root_dir=a", r"trainer\.default_root_dir: expected none.*'a'; hydra\.run\.dir"),
    ("+trainer.plugins=[a]", r"trainer\.plugins: expected none.*own_training_script"),
    ("+trainer.maxtime=1", r"trainer\.maxtime: unknown key; .*nearest is trainer\.max_time"),
])  # fmt: skip
def test_a_trainer_that_no_fit_can_do_with_is_refused_before_the_data(tmp_path, override, message):
    with pytest.raises(ConfigError, match=message):
        build_trainer(compose("debug=default", "logger=none", override), tmp_path)


def test_an_argument_may_be_a_section(tmp_path):
    """Lightning's own form of a duration; it was a DictConfig, which ended in "Missing key total_seconds"."""
    cfg = compose(
        "debug=default", "logger=none", "+trainer.max_time={hours: 1}", "+trainer.min_epochs=1"
    )
    (timer,) = (c for c in build_trainer(cfg, tmp_path).callbacks if isinstance(c, Timer))
    assert timer._duration == 3600


def test_a_profiler_that_was_asked_for_is_heard():
    quiet()
    assert not logging.getLogger("lightning.pytorch.trainer").isEnabledFor(logging.INFO)
    assert logging.getLogger("lightning.pytorch.profilers.profiler").isEnabledFor(logging.INFO)


class Ended(L.LightningModule):
    """A fit that was complete where it goes on."""

    stage, stage_over = None, True

    def training_step(self, batch, batch_idx):
        pytest.fail("a step")

    def configure_optimizers(self):
        return None


def test_a_complete_fit_leaves_its_checkpoint_in_a_new_folder(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    trainer = L.Trainer(
        accelerator="cpu", max_epochs=0, logger=False, default_root_dir=tmp_path,
        callbacks=[KeepLast()], enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(Ended(), torch.utils.data.DataLoader([0]))
    assert (tmp_path / "checkpoints" / "last.ckpt").is_file()
    assert "the fit was complete: no further step" in caplog.text


def test_the_best_checkpoint_has_its_name_in_a_folder_of_an_earlier_run_too(tmp_path):
    """That run's best.ckpt was kept under the name that the documentation gives, and the new one written as best-v1.ckpt."""
    entry = compose("callbacks=[default,model_checkpoint]")["callbacks"]["model_checkpoint"]
    callback = instantiate(entry, dirpath=str(tmp_path))
    (tmp_path / "best.ckpt").touch()
    trainer = L.Trainer(accelerator="cpu", logger=False, enable_progress_bar=False)
    found = callback._get_metric_interpolated_filepath_name({}, trainer)
    assert Path(found) == tmp_path / "best.ckpt"

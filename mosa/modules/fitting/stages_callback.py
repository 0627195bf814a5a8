"""The callback that leads a fit from one stage to the next, as Lightning's own callbacks for staged fine-tuning do."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Checkpoint, EarlyStopping
from lightning.pytorch.callbacks.early_stopping import EarlyStoppingReason

from mosa.data.batches import Epochs


def asked(stoppers: Iterable[EarlyStopping]) -> bool:
    """Whether one of them asks for a stop: its patience is over, or its metric is beyond a threshold or not finite."""
    return any(each.stopping_reason != EarlyStoppingReason.NOT_STOPPED for each in stoppers)


class Stages(Checkpoint):
    """Begins stages, ends them, and stops the trainer after the last.

    `LitMosa` brings it along (`configure_callbacks`). A stage has an optimiser and a schedule of its own. Callbacks that stop a
    training (`EarlyStopping`) end the running stage; the next one begins with their counters at zero.

    A stage may leave another law than its last epoch validated: with fewer parts, of the step
    before, or not fitted where all begins again. So validation runs once more at its end.

    It is a `Checkpoint` only because Lightning calls these after the callbacks that stop a training; it saves nothing."""

    def __init__(self) -> None:
        self.begun = -1  # number of the stage that has begun in this process
        self.unseen = False  # whether a stage has ended whose law was not validated

    def on_fit_start(self, trainer: L.Trainer, pl_module: Any) -> None:
        self.begun = -1
        self.announce(trainer, pl_module)  # the first batch is fetched before the training starts

    def on_train_start(self, trainer: L.Trainer, pl_module: Any) -> None:
        if pl_module.stage is None:  # a run that was stopped after its fit
            trainer.should_stop = True
            self.validate(trainer)

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: Any) -> None:
        self.announce(trainer, pl_module)

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: Any, batch: Any, batch_idx: int
    ) -> None:
        # of a checkpoint that was written before the stage was ended
        if pl_module.stage_over and batch_idx == 0:
            self.advance(trainer, pl_module)
        if (
            pl_module.stage is not None
            and self.begun != pl_module.stage_index
            and not pl_module.stage_over
        ):
            self.begun = pl_module.stage_index
            if not pl_module.losses:
                pl_module.begin(pl_module.stage)

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: Any) -> None:
        callbacks: list[L.Callback] = trainer.callbacks  # type: ignore[attr-defined]  # Lightning declares no type
        stoppers = [each for each in callbacks if isinstance(each, EarlyStopping)]
        if trainer.should_stop and asked(stoppers):
            pl_module.stage_over = True
        over = pl_module.stage_over
        if over:
            self.advance(trainer, pl_module)
        if self.unseen:
            self.validate(trainer)
        if over and pl_module.stage is not None:
            # the validation above may have asked too; what others ask for, as a limit of time, ends the fit
            if asked(stoppers):
                trainer.should_stop = False
            for each in stoppers:
                each.wait_count, each.stopped_epoch = 0, 0
                each.stopping_reason = EarlyStoppingReason.NOT_STOPPED
                each.best_score = torch.tensor(
                    torch.inf if each.monitor_op == torch.lt else -torch.inf
                )
        if over:
            self.announce(trainer, pl_module)

    def teardown(self, trainer: L.Trainer, pl_module: Any, stage: str) -> None:
        """Leaves with the run: the first `Checkpoint` is `trainer.checkpoint_callback`, whose path `ckpt_path="best"` takes."""
        trainer.callbacks = [each for each in trainer.callbacks if each is not self]  # type: ignore[attr-defined]  # as above

    def advance(self, trainer: L.Trainer, pl_module: Any) -> None:
        """Ends the running stage; the next one gets its optimiser."""
        pl_module.finish()
        self.begun, self.unseen = -1, True
        if pl_module.stage is None:
            trainer.should_stop = True
        else:
            trainer.strategy.setup_optimizers(trainer)

    def validate(self, trainer: L.Trainer) -> None:
        """Validation of the law as it stands, as Lightning runs it at the end of an epoch."""
        self.unseen = False
        if trainer.enable_validation:
            trainer.validating = True
            trainer.fit_loop.epoch_loop.val_loop.run()
            trainer.training = True

    @staticmethod
    def announce(trainer: L.Trainer, pl_module: Any) -> None:
        """Tells the training data what the next epoch is."""
        epochs = getattr(getattr(trainer, "datamodule", None), "epochs", None)
        stage = pl_module.stage
        if isinstance(epochs, Epochs) and stage is not None:
            done = len(pl_module.losses)
            left = max(1, stage.iterations - done)
            epochs.begin(whole=stage.newton, step=pl_module.steps_done, done=done, left=left)

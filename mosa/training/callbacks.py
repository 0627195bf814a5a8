"""What accompanies a fit: atomic checkpoints after every step, progress and notes on the stages, rates and times, image strips."""

from __future__ import annotations

import errno
import logging
import math
import os
import time
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import Tensor

from mosa.modules.fitting.stages import Stage
from mosa.system.progress import tqdm
from mosa.training.loggers import PICTURED, add_picture

log = logging.getLogger(__name__)


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes beside the target, flushes to the disk and renames: a run killed while it saves leaves the last checkpoint whole."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(path.name + ".partial")
        try:
            with open(partial, "wb") as file:
                torch.save(checkpoint, file)
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, path)
        except RuntimeError as error:  # what torch makes of a disk that is full
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path)) from error
        finally:
            partial.unlink(missing_ok=True)


class KeepLast(Checkpoint):
    """Saves `last.ckpt` after every step, so that an interruption costs no more than that."""

    def setup(self, trainer: L.Trainer, module: Any, stage: str) -> None:
        self.path = Path(trainer.default_root_dir, "checkpoints", "last.ckpt")

    def on_fit_start(self, trainer: L.Trainer, module: Any) -> None:
        """The figures of an earlier run in this folder go: they would say that this one is complete. The checkpoint of one that did
        not end is kept."""
        figures = Path(trainer.default_root_dir, "metrics.json")
        if self.path.is_file() and not figures.is_file() and trainer.ckpt_path is None:
            earlier = self.path.replace(self.path.with_name("earlier.ckpt"))
            log.warning(
                "a run in this folder did not end, and this one begins anew; ckpt_path=%s goes on with it",
                earlier,
            )
        figures.unlink(missing_ok=True)
        if module.stage is None:
            log.info("the fit was complete: no further step")

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *_: Any) -> None:
        """Within an epoch; at its end, and at that of a stage, the next hook saves what the next epoch begins with."""
        if not (trainer.fit_loop.epoch_loop.batch_progress.is_last_batch or module.stage_over):
            trainer.save_checkpoint(self.path)

    def on_train_epoch_end(self, trainer: L.Trainer, module: Any) -> None:
        trainer.save_checkpoint(self.path)

    def on_fit_end(self, trainer: L.Trainer, module: Any) -> None:
        """Of a fit that was complete where it went on, and had no epoch."""
        if not self.path.is_file():
            trainer.save_checkpoint(self.path)


class FitProgress(L.Callback):
    """One tqdm bar per stage with loss and parameters."""

    def __init__(self) -> None:
        self.bar: tqdm | None = None
        self.shown: int | None = None  # number of the stage

    def on_train_batch_start(self, trainer: L.Trainer, module: Any, *_: Any) -> None:
        if module.stage is not None and self.shown != module.stage_index:
            self._close()
            self.shown = module.stage_index
            count = {"total": module.stage.iterations, "initial": len(module.losses)}
            look = {"unit": "it", "dynamic_ncols": True, "mininterval": 2.0}
            self.bar = tqdm(desc=f"fit {module.stage.name}", **count, **look)

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *_: Any) -> None:
        if self.bar is not None:
            self.bar.set_postfix(figures_of(module.last), refresh=False)
            self.bar.update()

    def on_train_end(self, trainer: L.Trainer, module: Any) -> None:
        self._close()

    def on_exception(self, trainer: L.Trainer, module: Any, exception: BaseException) -> None:
        self._close()

    def _close(self) -> None:
        if self.bar is not None:
            self.bar.close()
            self.bar = None


def figures_of(last: dict[str, float]) -> dict[str, str]:
    """Loss and parameters of the last step, as they are shown."""
    found = {"loss": f"{last['loss/total']:.5f}"} if "loss/total" in last else {}
    return found | {k[len("id/") :]: f"{v:.4g}" for k, v in last.items() if k.startswith("id/")}


class StageNotes(L.Callback):
    """A line in the run's log when a stage begins, and one with its figures when it ends."""

    def __init__(self) -> None:
        self.stage: Stage | None = None
        self.began, self.steps = 0.0, 0

    def on_train_batch_start(self, trainer: L.Trainer, module: Any, *_: Any) -> None:
        if self.stage is not None and module.stage is not self.stage:  # ended by a callback
            self._note(module)
        if module.stage is not None and self.stage is None:
            self.stage, self.began, self.steps = module.stage, time.perf_counter(), 0
            done = f", going on after {len(module.losses)}" if module.losses else ""
            log.info("stage %s: at most %d steps%s", self.stage.name, self.stage.iterations, done)

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *_: Any) -> None:
        self.steps += 1
        if self.stage is not None and module.stage_over:
            self._note(module)

    def on_train_end(self, trainer: L.Trainer, module: Any) -> None:
        self._note(module)

    def _note(self, module: Any) -> None:
        if self.stage is None:
            return
        figures = ", ".join(f"{name} {value}" for name, value in figures_of(module.last).items())
        log.info("stage %s: ended after %d steps, %.1f s: %s", self.stage.name, self.steps, time.perf_counter() - self.began,
                 figures)  # fmt: skip
        self.stage = None


class Pace(L.Callback):
    """Logs what a step took (`time/step_s`) and the learning rate of each group of parameters in it (`lr/<group>`). Gauss-Newton
    has no rates."""

    def __init__(self) -> None:
        self.began, self.rates = 0.0, dict[str, float]()

    def on_train_batch_start(self, trainer: L.Trainer, module: Any, *_: Any) -> None:
        self.began = time.perf_counter()
        rated = module.stage is not None and not module.stage.newton
        groups = [g for each in trainer.optimizers if rated for g in each.param_groups]
        self.rates = {f"lr/{group['name']}": group["lr"] for group in groups}

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *_: Any) -> None:
        values = {"time/step_s": time.perf_counter() - self.began} | self.rates
        tensors = {k: torch.tensor(v, dtype=torch.float32) for k, v in values.items()}
        module.log_dict(tensors, on_step=True, on_epoch=False)


class ImageStrips(L.Callback):
    """Adds a strip of real (above) and rendered (below) frames to the loggers every `every` iterations, where
    there are images."""

    def __init__(self, every: int) -> None:
        self.every = every

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *_: Any) -> None:
        shown = [each for each in module.loggers if isinstance(each, PICTURED)]
        due = self.every > 0 and module.steps_done % self.every == 0
        if shown and due and len(module.takes[0].observations.cameras):
            picture = enlarged(strip(module))
            add_picture(shown, "real_above_rendered_below", picture, module.steps_done)


@torch.no_grad()
def strip(module: Any) -> Tensor:
    """(3, 2 h, T w) of the first view of the first sequence: real above, rendered below, every frame from left to right."""
    take, body = module.takes[0], module.body
    frames = len(take.cues.positions)
    rollout = body.simulate(take.start, module.world, frames, take.frame_dt)
    targets = take.observations.select([0], frames)
    seen = module.shown(rollout.x, rollout.F_tot, targets)
    rows = [torch.cat(list(images[0]), 1) for images in (targets.images, seen.images)]
    return torch.cat(rows, 0).clamp(0, 1).permute(2, 0, 1)


LEGIBLE = 320  # [px] least height of a strip of two rows


def enlarged(picture: Tensor) -> Tensor:
    """A picture (3, H, W) in [0, 1] whose pixels are repeated until it is `LEGIBLE` high."""
    times = max(1, math.ceil(LEGIBLE / picture.shape[1]))
    return picture.repeat_interleave(times, 1).repeat_interleave(times, 2)

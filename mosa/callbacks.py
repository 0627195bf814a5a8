"""What accompanies a fit: atomic checkpoints after every step, a progress bar over the stages, image strips."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import lightning as L
import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO
from tqdm import tqdm


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes beside the target, flushes to the disk and renames: a run killed while it saves leaves the last checkpoint whole."""

    def save_checkpoint(self, checkpoint, path, storage_options=None) -> None:
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


class KeepLast(L.Callback):
    """Saves `last.ckpt` after every `every` steps and at the end, so that an interruption costs no more than that."""

    def __init__(self, folder: str | Path, every: int = 1) -> None:
        self.path, self.every = Path(folder) / "last.ckpt", every

    def on_train_epoch_end(self, trainer, module) -> None:
        if module.steps_done % self.every == 0 or module.stage is None:
            trainer.save_checkpoint(self.path)


class FitProgress(L.Callback):
    """One tqdm bar per stage with loss and parameters."""

    def __init__(self) -> None:
        self.bar, self.shown = None, None

    def on_train_batch_start(self, trainer, module, batch, batch_idx) -> None:
        if module.stage is not None and self.shown != module.stage.name:
            self._close()
            self.shown = module.stage.name
            self.bar = tqdm(total=module.stage.iterations, initial=len(module.losses), desc=f"fit {self.shown}", unit="it",
                            dynamic_ncols=True, mininterval=2.0)

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx) -> None:
        if self.bar is not None:
            values = {k.removeprefix("id/"): f"{v:.4g}" for k, v in module.last.items() if k.startswith("id/")}
            self.bar.set_postfix({"loss": f"{module.last['loss/total']:.5f}", **values}, refresh=False)
            self.bar.update()

    def on_train_end(self, trainer, module) -> None:
        self._close()

    def on_exception(self, trainer, module, exception) -> None:
        self._close()

    def _close(self) -> None:
        if self.bar is not None:
            self.bar.close()
            self.bar = None


class ImageStrips(L.Callback):
    """Adds a strip of real (above) and rendered (below) frames to TensorBoard every `every` iterations."""

    def __init__(self, every: int) -> None:
        self.every = every

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx) -> None:
        if trainer.is_global_zero and self.every > 0 and module.steps_done % self.every == 0:
            module.logger.experiment.add_image("real_above_rendered_below", module.strip(), module.steps_done)

"""The staged fit under Lightning: how long it will take, and the optimisation itself, which goes on from a checkpoint."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import lightning as L
import torch
from lightning.pytorch.callbacks import LambdaCallback
from lightning.pytorch.plugins.environments import LightningEnvironment

from mosa import parallel
from mosa.callbacks import AtomicCheckpointIO, FitProgress, ImageStrips, KeepLast, Pace, StageNotes
from mosa.checkpoints import check_same, checked_posterior, read_checkpoint
from mosa.config import plain
from mosa.costs import Costs, duration, seconds_of_fit, speed_of_rollouts
from mosa.data.datamodule import MultiViewDataModule
from mosa.errors import DataError, MosaError, SimulationDiverged
from mosa.loggers import build_loggers
from mosa.modules.learned_numbers import read_numbers
from mosa.modules.lit_mosa import LitMosa
from mosa.refused import lacks_memory
from mosa.run import device_names


def fit_estimate(module: LitMosa, costs: Costs, processes: int = 1) -> str:
    """One line on how long the fit will take, from rollouts of the body that was found, which `costs` takes over."""
    first, body = module.takes[0], module.body
    frames = len(first.cues.positions)
    frame = speed_of_rollouts(body, first.frame_dt, module.world.gravity, module.world.up)
    speeds = replace(costs.speeds, frame=frame)
    seconds = seconds_of_fit(module, speeds, frames, processes)
    costs.known("fit", seconds)
    return (f"fit: {len(body.rest)} particles, {frames} frames of {body.last_substeps} substeps, at most "
            f"{sum(s.iterations for s in module.stages)} steps, about {duration(seconds)}; the run takes about "
            f"{costs.memory / 1e9:.1f} GB")


def fit(cfg, module: LitMosa, data: MultiViewDataModule, folder: Path, device: str) -> None:
    """The staged optimisation under Lightning; resumes from cfg.ckpt_path. Errors: DataError for a checkpoint of another run."""
    if cfg.ckpt_path is not None:
        stored = read_checkpoint(cfg.ckpt_path)
        check_same(stored, module, cfg.ckpt_path)
        checked_posterior(stored, len(read_numbers(module.body)), cfg.ckpt_path)
    settings = plain(cfg.logger)
    logger = build_loggers(settings, folder, module.body.material.law)
    callbacks = [KeepLast(folder / "checkpoints"), FitProgress(), StageNotes(), *([Pace()] if logger else [])]
    if logger and settings.get("images_every"):
        callbacks.append(ImageStrips(settings["images_every"]))
    shared = {"strategy": parallel.SharedSteps()} if len(device_names(cfg)) > 1 else {}
    trainer = L.Trainer(accelerator=cfg.trainer.accelerator, devices=plain(cfg.trainer)["devices"], max_epochs=-1,
                        logger=logger or False, callbacks=callbacks, plugins=[AtomicCheckpointIO(), LightningEnvironment()],
                        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False, log_every_n_steps=1,
                        reload_dataloaders_every_n_epochs=1, default_root_dir=folder, use_distributed_sampler=False, **shared)
    begun: list[bool] = []
    trainer.callbacks.append(LambdaCallback(on_train_start=lambda *_: begun.append(True)))
    try:
        trainer.fit(module, datamodule=data, ckpt_path=cfg.ckpt_path, weights_only=True)
    except MosaError as error:
        if parallel.launched_rank() != 0:  # what stops the fit stops it everywhere, and the first process says what it was
            sys.exit(2)
        if isinstance(error, parallel.RankLost) and (reason := trainer.strategy.launcher.wait_ended()):
            raise parallel.RankLost(parallel.LOST.format(reason)) from error
        raise
    except SystemExit:  # Lightning's answer to Ctrl-C
        raise KeyboardInterrupt from None
    except torch.linalg.LinAlgError as error:
        if lacks_memory(error):
            raise
        raise SimulationDiverged(f"the fit came to numbers that cannot be solved with ({' '.join(str(error).split())[:200]}); "
                                 "check the checkpoint that it goes on from, or lower simulation.courant") from error
    except (ArithmeticError, AttributeError, FileNotFoundError, LookupError, RuntimeError, TypeError, ValueError) as error:
        if begun or cfg.ckpt_path is None or lacks_memory(error):
            raise
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:300]  # Lightning takes its own entries as they are
        raise DataError(f"ckpt_path: {cfg.ckpt_path}: the fit cannot go on from it ({reason})") from error
    finally:
        parallel.disconnect()
    if module.stage is not None:
        raise KeyboardInterrupt
    module.body.to(device)

"""The staged fit under Lightning: how long it will take, and the optimisation itself, which goes on from a checkpoint."""

from __future__ import annotations

import inspect
import logging
import re
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import lightning as L
import torch
from hydra.errors import InstantiationException
from hydra.utils import get_object, instantiate
from lightning.pytorch.callbacks import LambdaCallback
from lightning.pytorch.loggers import Logger
from lightning.pytorch.plugins.environments import LightningEnvironment
from omegaconf import DictConfig, OmegaConf

from mosa.config.build import plain
from mosa.config.checkpoints import check_numbers, check_same, read_checkpoint
from mosa.config.composition import searching
from mosa.errors import ConfigError, DataError, MosaError, SimulationDiverged
from mosa.modules.fitting.parameters import read_numbers
from mosa.settings import arguments_of, nearest, untold
from mosa.system.machine_errors import short_of_memory
from mosa.training.callbacks import AtomicCheckpointIO
from mosa.training.datamodule import SceneDataModule
from mosa.training.lit_mosa import LitMosa, check_trainer
from mosa.training.run_folder import VALIDATED, VALIDATION

log = logging.getLogger(__name__)


KINDS = {"callbacks": L.Callback, "logger": Logger}


def instantiated(cfg: DictConfig, section: str) -> list[Any]:
    """The objects of a section whose entries have `_target_`. Errors: ConfigError naming the entry."""
    found = []
    for name, entry in (cfg.get(section) or {}).items():
        if entry is None:  # switched off: callbacks.pictures=null
            continue
        if not OmegaConf.is_dict(entry) or "_target_" not in entry:
            raise ConfigError(
                f"{section}.{name}: expected a section with _target_, the class to make, found {str(entry)[:80]!r}"
            )
        found.append(made(f"{section}.{name}", entry))
        if not isinstance(found[-1], KINDS[section]):
            raise ConfigError(
                f"{section}.{name}: expected a {KINDS[section].__name__} of Lightning, found {type(found[-1]).__name__}"
            )
    return found


def made(where: str, entry: DictConfig, **arguments: Any) -> Any:
    """What `entry` describes, by Hydra. Only conf/ and the command line are ever made so, never what a checkpoint holds. Errors:
    ConfigError."""
    try:
        return instantiate(entry, _convert_="all", **arguments)
    except Exception as error:
        hydras = isinstance(error, InstantiationException)
        cause = error.__cause__ or error if hydras else error
        if str(error).startswith("Error locating target"):
            target, why = str(entry.get("_target_")), str(cause.__cause__ or cause)
            module, _, name = target.rpartition(".")
            if (there := sys.modules.get(module)) is not None:
                why = f"the module {module} has no {name}{nearest(name, dir(there), '')}"
            raise ConfigError(
                f"{where}: expected a class that can be imported (installed, or in PYTHONPATH), found {target} ({why})"
            ) from error
        if found := re.search(r"unexpected keyword argument '(\w+)'", str(cause)):
            key, target = found[1], str(entry.get("_target_"))
            known = list(inspect.signature(get_object(target)).parameters)
            raise ConfigError(
                f"{where}.{key}: unknown key; expected an argument of {target}"
                f"{nearest(key, known, where)}"
            ) from error
        lines = [each for each in str(cause).splitlines() if each and "full_key" not in each]
        lacks = isinstance(cause, ModuleNotFoundError) and cause.name
        way = f"; pip install {cause.name}" if lacks else ""
        if where == "trainer" and "gpu" in str(cause):
            way = "; trainer=cpu runs without one"
        raise ConfigError(
            f"{where}: expected what {entry.get('_target_')} takes, found: {' '.join(lines)[:300]}{way}"
        ) from error


def build_trainer(cfg: DictConfig, folder: Path) -> L.Trainer:
    """Lightning's Trainer of conf/trainer, with the callbacks of conf/callbacks and the loggers of conf/logger. Errors: ConfigError
    naming the section."""
    given, begin = plain(cfg.trainer), L.Trainer.__init__
    arguments_of(begin, "trainer", "precision", *untold(begin)).part(given)
    loggers, callbacks = instantiated(cfg, "logger"), instantiated(cfg, "callbacks")
    own = {"logger": loggers or False, "callbacks": callbacks, "default_root_dir": str(folder)}
    own["plugins"] = [AtomicCheckpointIO(), LightningEnvironment()]
    ways = {
        "logger": "logger=<option>",
        "callbacks": "callbacks=<option>",
        "default_root_dir": "hydra.run.dir=<folder>",
    }
    for name in own.keys() & given.keys():
        way = ways.get(name, "a script of your own takes any (docs/own_training_script.md)")
        raise ConfigError(
            f"trainer.{name}: expected none, as the run gives its own, found {given[name]!r}; {way}"
        )
    trainer = made("trainer", cfg.trainer, **own)
    check_trainer(trainer, given.get("precision"))
    check_monitors(cfg, callbacks)
    return trainer


def check_monitors(cfg: DictConfig, callbacks: Sequence[L.Callback]) -> None:
    """Errors: ConfigError where a callback or a sweep's objective is of validation and nothing is held out, or is a slip of the
    pen."""
    held_out = cfg.scene.get("holdout_cameras") or cfg.scene.get("holdout_frames")
    monitors = [
        (f"callbacks: {type(c).__name__}.monitor", getattr(c, "monitor", None)) for c in callbacks
    ]
    monitors += [("optimized_metric", cfg.optimized_metric)] if searching() else []
    for where, figure in monitors:
        # a callback of a user's own may log others, which are less like these
        slip = get_close_matches(str(figure), VALIDATED, 1, 0.9)
        if slip and str(figure) not in VALIDATED:
            raise ConfigError(f"{where}: expected one of {', '.join(VALIDATED)}, found {figure}")
        if str(figure).startswith(VALIDATION) and not held_out:
            raise ConfigError(
                f"{where} is {figure}: expected something that is held out of the training sequence, found nothing; "
                "scene.holdout_cameras=[0] or scene.holdout_frames=2"
            )


def fit(trainer: L.Trainer, module: LitMosa, data: SceneDataModule, ckpt_path: str | None) -> str:
    """The staged optimisation under Lightning; goes on from ckpt_path. What is to be said of stages that did not end, else "".
    Errors: DataError for a checkpoint of another run."""
    if ckpt_path is not None:
        stored = read_checkpoint(ckpt_path)
        check_numbers(
            check_same(stored, module, ckpt_path), len(read_numbers(module.body)), ckpt_path
        )
    device = module.body.rest.device
    begun: list[bool] = []
    trainer.callbacks.append(LambdaCallback(on_train_start=lambda *_: begun.append(True)))
    try:
        trainer.fit(module, datamodule=data, ckpt_path=ckpt_path, weights_only=True)
    except SystemExit:  # Lightning's answer to Ctrl-C
        raise KeyboardInterrupt from None
    except torch.linalg.LinAlgError as error:
        if short_of_memory(error):
            raise
        raise SimulationDiverged(
            f"the fit came to numbers that cannot be solved with ({' '.join(str(error).split())[:200]}); "
            "check the checkpoint that it goes on from, or lower simulation.courant"
        ) from error
    except Exception as error:
        if begun or ckpt_path is None or isinstance(error, MosaError) or short_of_memory(error):
            raise
        # Lightning takes its own entries as they are
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        raise DataError(
            f"ckpt_path: {ckpt_path}: the fit cannot go on from it ({reason})"
        ) from error
    if trainer.interrupted:
        raise KeyboardInterrupt
    module.body.to(device)
    if module.stage is None:
        return ""
    cut = (
        f"the trainer ended the fit after {module.steps_done} steps, in stage {module.stage.name} of "
        f"{', '.join(stage.name for stage in module.stages)}: what follows is of the law as it stands, and of the priors "
        "as they were before stages that did not end"
    )
    log.warning(cut)
    return cut

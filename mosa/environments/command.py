"""What `python -m mosa.environments` does with its configuration (conf/environments.yaml)."""

from __future__ import annotations

import logging
import os
import warnings
from pathlib import Path
from typing import Literal

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from mosa.config.build import plain
from mosa.config.leaf_settings import EnvironmentsSettings
from mosa.environments.arena import SIMULATORS
from mosa.environments.policies import SEARCHES, Search
from mosa.environments.study import UNTRAINED, Bench, Setting, make_jobs, one, table
from mosa.environments.tasks import TASKS
from mosa.errors import ConfigError
from mosa.evaluation.analysis.figures import ffmpeg
from mosa.settings import arguments_of, check
from mosa.system.limits import named_device

log = logging.getLogger(__name__)

AT_A_TIME = 8
"""Worlds on a CPU: more would only wait for its cores."""


def setting_of(values: dict) -> Setting:
    """Errors: ConfigError naming the key."""
    EnvironmentsSettings.read(values)
    device, worlds = named_device(values["device"]), values["worlds"]
    if worlds == "auto":
        worlds = AT_A_TIME if device == "cpu" else values["trials"]
    check("task", values["task"], Literal[tuple(TASKS)])
    check("policy", values["policy"], Literal[tuple(SEARCHES)])
    values["options"] = {
        key: value for key, value in values["options"].items() if value is not None
    }
    arguments_of(TASKS[values["task"]], "options", "extents").read(values["options"])
    return Setting(
        **{key: values[key] for key in ("task", "checkpoint", "policy", "trials", "options")}, **values["truth"],
        device=device, search=Search(**values["search"]), worlds=min(worlds, values["trials"]),
    )  # fmt: skip


def train_and_test(cfg: DictConfig) -> None:
    """Errors: ConfigError naming the key."""
    values = plain(cfg)
    setting = setting_of(values)
    names = values["simulator"] if isinstance(values["simulator"], list) else [values["simulator"]]
    many, known = isinstance(values["simulator"], list), SIMULATORS
    if values["jobs_only"] and not many:
        raise ConfigError(
            f"jobs_only: expected a list of simulators with it, found simulator={values['simulator']!r}"
        )
    if values["jobs_only"]:
        known = (*SIMULATORS, UNTRAINED)
    for name in names:
        check("simulator", name, Literal[known])
    if setting.device == "cpu":
        torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1").split(",")[0]))
    # a body that rolls off the box may fold over itself for a moment; the trial is lost either way
    warnings.filterwarnings("ignore", message=".*det F <= 0.*")
    if values["films"]:
        ffmpeg("films")
    folder = Path(values["out"] or HydraConfig.get().runtime.output_dir)
    # what cannot be written is said before hours are spent
    folder.mkdir(parents=True, exist_ok=True)
    bench = Bench(setting)
    if values["jobs_only"]:
        make_jobs(bench, [(name, seed) for seed in values["seeds"] for name in names], folder)
        return
    if many:
        page = table(bench, names, values["seeds"], folder, values["films"])
        log.info("\n%s", page.read_text())
        return
    one(bench, names[0], values["seed"], folder, values["films"])
    log.info("results in %s", folder)

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
from mosa.config.extensions import load_extensions
from mosa.config.leaf_settings import EnvironmentsSettings
from mosa.environments.arena import SIMULATORS
from mosa.environments.policies import SEARCHES
from mosa.environments.study import UNTRAINED, Bench, make_jobs, one, table
from mosa.environments.task import TASKS
from mosa.errors import ConfigError
from mosa.evaluation.analysis.figures import ffmpeg
from mosa.settings import arguments_of, check
from mosa.system.limits import named_device

log = logging.getLogger(__name__)

AT_A_TIME = 8  # worlds on a CPU: more would only wait for its cores


def setting_of(values: dict) -> EnvironmentsSettings:
    """Checked, with the worlds and the task's options that it takes. Errors: ConfigError naming the key."""
    load_extensions(values.get("extensions"))
    setting = EnvironmentsSettings.read(values)
    device, worlds = named_device(setting.device), setting.worlds
    if worlds == "auto":
        worlds = AT_A_TIME if device == "cpu" else setting.trials
    check("task", setting.task, Literal[tuple(TASKS)])
    check("policy", setting.policy, Literal[tuple(SEARCHES)])
    options = {key: value for key, value in setting.options.items() if value is not None}
    arguments_of(TASKS[setting.task], "options", "extents").read(options)
    return setting.but(worlds=min(worlds, setting.trials), options=options)


def train_and_test(cfg: DictConfig) -> None:
    """Errors: ConfigError naming the key."""
    setting = setting_of(plain(cfg))
    many = isinstance(setting.simulator, list)
    names = setting.simulator if many else [setting.simulator]
    if setting.jobs_only and not many:
        found = f"simulator={setting.simulator!r}"
        raise ConfigError(f"jobs_only: expected a list of simulators with it, found {found}")
    known = (*SIMULATORS, *[UNTRAINED] * setting.jobs_only)
    for name in names:
        check("simulator", name, Literal[known])
    if setting.device == "cpu":
        torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1").split(",")[0]))
    # a body that rolls off the box may fold over itself for a moment; the trial is lost either way
    warnings.filterwarnings("ignore", message=".*det F <= 0.*")
    if setting.films:
        ffmpeg("films")
    folder = Path(setting.out or HydraConfig.get().runtime.output_dir)
    # what cannot be written is said before hours are spent
    folder.mkdir(parents=True, exist_ok=True)
    bench = Bench(setting)
    if setting.jobs_only:
        make_jobs(bench, [(name, seed) for seed in setting.seeds for name in names], folder)
    elif many:
        page = table(bench, names, setting.seeds, folder, setting.films)
        log.info("\n%s", page.read_text())
    else:
        one(bench, names[0], setting.seed, folder, setting.films)
        log.info("results in %s", folder)

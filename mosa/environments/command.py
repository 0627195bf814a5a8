"""What `python -m mosa.environments` does with its configuration (conf/environments.yaml)."""

from __future__ import annotations

import logging
import os
import warnings
from pathlib import Path

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from mosa.config.build import plain
from mosa.environments.arena import SIMULATORS
from mosa.environments.policies import METHODS, Search
from mosa.environments.study import UNTRAINED, Bench, Setting, make_jobs, one, put_into, table
from mosa.environments.tasks import TASKS
from mosa.errors import ConfigError
from mosa.system.limits import named_device
from mosa.training.preflight import check_environments

log = logging.getLogger(__name__)

AT_A_TIME = 8
"""Worlds on a CPU: more would only wait for its cores."""


def setting_of(values: dict) -> Setting:
    """Errors: ConfigError naming the key."""
    check_environments(values)
    device, worlds = named_device(values["device"]), values["worlds"]
    if worlds == "auto":
        worlds = AT_A_TIME if device == "cpu" else values["trials"]
    for key, found, known in (
        ("task", values["task"], tuple(TASKS)),
        ("policy", values["policy"], METHODS),
    ):
        if found not in known:
            raise ConfigError(f"{key}: expected one of {', '.join(known)}, found {found!r}")
    fields = TASKS[values["task"]].__dataclass_fields__
    values["options"] = {
        key: value for key, value in values["options"].items() if value is not None
    }
    if unknown := sorted(set(values["options"]) - (set(fields) - {"extents"})):
        raise ConfigError(
            f"options.{unknown[0]}: expected one of {', '.join(f for f in fields if f != 'extents')}, found it"
        )
    return Setting(
        **{key: values[key] for key in ("task", "checkpoint", "policy", "decisions", "trials", "options")}, **values["truth"],
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
    if values["page"] is not None and (not many or values["jobs_only"]):
        raise ConfigError(
            "page: expected a list of simulators and jobs_only=false with it: it takes the table"
        )
    if values["jobs_only"]:
        known = (*SIMULATORS, UNTRAINED)
    for name in names:
        if name not in known:
            raise ConfigError(
                f"simulator: expected {', '.join(SIMULATORS)}, or a list of them, found {name!r}"
            )
    if setting.device == "cpu":
        torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1").split(",")[0]))
    # a body that rolls off the box may fold over itself for a moment; the trial is lost either way
    warnings.filterwarnings("ignore", message=".*det F <= 0.*")
    folder = Path(values["out"] or HydraConfig.get().runtime.output_dir)
    folder.mkdir(
        parents=True, exist_ok=True
    )  # what cannot be written is said before hours are spent
    bench = Bench(setting)
    if values["jobs_only"]:
        make_jobs(bench, [(name, seed) for seed in values["seeds"] for name in names], folder)
        return
    if many:
        page = table(bench, names, values["seeds"], folder, values["films"])
        if values["page"] is not None:
            put_into(Path(values["page"]), page, setting.task)
        log.info("\n%s", page.read_text())
        return
    one(bench, names[0], values["seed"], folder, values["films"])
    log.info("results in %s", folder)

"""A command that is configured by a file of conf/ and overrides on its command line, by Hydra."""

from __future__ import annotations

import importlib
from collections.abc import Callable

import hydra
from omegaconf import DictConfig

from mosa.config.composition import configuration
from mosa.system.console import begin_log
from mosa.training.jobs import attempt, held_back, run_command


def command(module: str, job: str) -> Callable[[], None]:
    """What runs `job`, a "module:function" of the configuration conf/<name>.yaml, name being the last part of `module`.

    The job's module is imported when it runs: that takes seconds, and a mistake in an override is said before.
    """
    where, _, function = job.partition(":")

    def imported(cfg: DictConfig) -> float | None:
        with held_back():
            module = importlib.import_module(where)
        return getattr(module, function)(cfg)

    def run(cfg: DictConfig) -> float | None:
        begin_log()
        return attempt(imported, cfg)

    run.__module__ = module  # Hydra names the job, and with it the run's folder, after the module of its function
    configured = hydra.main(
        version_base="1.3", config_path=configuration(), config_name=module.rpartition(".")[2]
    )(run)

    def main() -> None:
        run_command(configured)

    return main

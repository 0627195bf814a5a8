"""Worker processes of experiments that are forked from the tests' own: to import the libraries takes each of the program's workers
six CPU-seconds. tests/experiments/test_workers.py and other jobs of test_experiments.py are run by the program's own.

Where there is a GPU, which a fork cannot use, they are the program's own too."""

import multiprocessing
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor

import torch

from mosa.experiments import workers


class Forked(ProcessPoolExecutor):
    def __init__(
        self, count: int, *, timeout: float, env: Mapping[str, str], initializer: Callable
    ) -> None:
        super().__init__(
            count, multiprocessing.get_context("fork"), begun, (dict(env), initializer)
        )

    def shutdown(self, wait: bool = True, kill_workers: bool = False) -> None:
        for process in self._processes.values() if kill_workers else ():
            process.kill()
        super().shutdown(wait)


def begun(environment: dict[str, str], initializer: Callable) -> None:
    os.environ.update(environment)
    initializer()


def fork() -> type:
    """What takes the place of `workers.ProcessPoolExecutor`."""
    return workers.ProcessPoolExecutor if torch.cuda.is_available() else Forked

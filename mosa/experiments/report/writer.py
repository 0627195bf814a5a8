"""Results of an experiment as soon as the last of its jobs has ended, while those of others still run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from mosa.experiments.specification import Job


class Writer:
    """Calls write(name) of each experiment, one after the other in a thread. What is stopped leaves the results of those that are
    complete; what is being written then comes to its end. planned: jobs by experiment."""

    def __init__(self, planned: Mapping[str, Sequence[Job]], write: Callable[[str], None]) -> None:
        self.write = write
        self.left: dict[str, set[Path]] = {
            name: {j.folder for j in jobs if not j.finished} for name, jobs in planned.items()
        }
        self.pool = ThreadPoolExecutor(1)
        self.begun: dict[str, Future] = {}

    def __enter__(self) -> Writer:
        return self

    def __exit__(self, *_) -> None:
        self.pool.shutdown(cancel_futures=True)

    def ended(self, job: Job) -> None:
        """A job has, complete or failed."""
        for name, left in self.left.items():
            if job.folder in left:
                left.discard(job.folder)
                if not left:
                    self.begin(name)

    def finish(self) -> None:
        """Write those that are left, in the order in which they were planned. Errors: those of write."""
        for name in self.left:
            if name not in self.begun:
                self.begin(name)
        failed = [
            error for future in self.begun.values() if (error := future.exception()) is not None
        ]
        if failed:  # the others are written
            raise failed[0]

    def begin(self, name: str) -> None:
        self.begun[name] = self.pool.submit(self.write, name)

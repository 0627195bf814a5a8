"""Worker processes of `running`: each runs one job after the other, and so imports torch, Lightning and the rest only once."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import traceback
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from pathlib import Path

from loky.process_executor import ProcessPoolExecutor

from mosa.system.machine_errors import free_gpu_cache

IDLE_SECONDS = 300.0  # after which a worker process ends; a running job ends first


class Worker:
    """A place for one job at a time, with a process of its own: a job that is killed takes no other job with it.

    environment: variables of the process, beside those of this one."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self.environment = dict(environment)
        self.pool: ProcessPoolExecutor | None = None
        self.number: Future[int] | None = None

    def begin(self, program: str, words: Sequence[str], screen: Path) -> Future[int]:
        """Run `program`, a "module:function", with `words` as its command line and its output in the file `screen`.

        Returns: the exit code, once the job has ended. Errors of the Future: of loky, where the process was killed."""
        # the output of an earlier run in this folder is not read as this one's
        screen.write_bytes(b"")
        try:
            pool = self.started()
        except BrokenProcessPool:  # the process was killed since its last job
            self.end()
            pool = self.started()
        return pool.submit(work, program, list(words), str(screen))

    def started(self) -> ProcessPoolExecutor:
        if self.pool is None:
            self.pool = ProcessPoolExecutor(1, timeout=IDLE_SECONDS, env=self.environment, initializer=await_jobs)  # fmt: skip
        self.number = self.pool.submit(os.getpid)
        return self.pool

    def stop(self) -> None:
        """SIGTERM to the job, which writes its checkpoint and ends."""
        if self.number is not None and self.number.exception() is None:
            with suppress(ProcessLookupError):  # it has ended by itself
                os.kill(self.number.result(), signal.SIGTERM)

    def end(self, at_once: bool = False) -> None:
        """End the process, after its job or at once; the next job has a new one."""
        if self.pool is not None:
            self.pool.shutdown(wait=at_once, kill_workers=at_once)
            self.pool = self.number = None


def await_jobs() -> None:
    """Initialises a worker process, which has no screen."""
    nothing = os.open(os.devnull, os.O_RDWR)
    for number in range(3):
        os.dup2(nothing, number)
    # the command may have been started without a screen; lines are read while the job runs
    sys.stdout, sys.stderr = (open(number, "w", buffering=1, closefd=False) for number in (1, 2))
    end_at_a_stop()


def end_at_a_stop() -> None:
    """Until a job has begun to answer signals, a stop ends the process."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)


def work(program: str, words: list[str], screen: str) -> int:
    """One job in a worker process; its exit code."""
    written = os.open(screen, os.O_WRONLY)
    for number in (1, 2):
        os.dup2(written, number)
    os.close(written)
    where, _, function = program.partition(":")
    sys.argv = [where, *words]
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        getattr(importlib.import_module(where), function)()
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except BaseException:
        traceback.print_exc()
        return 1
    finally:
        end_at_a_stop()
        sys.stdout.flush()
        sys.stderr.flush()
        free_gpu_cache()
    return 0

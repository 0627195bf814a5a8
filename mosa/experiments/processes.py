"""Processes of jobs that begin with the libraries imported. That takes 6 to 15 s of a core, as much as a tenth of what a small job
takes on a GPU: a server imports them once, and every job is a fork of it."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path

PRELOADED = ["mosa.experiments.waiting_signals", "mosa.experiments.preloading"]
"""What the server imports, in this order."""
STOPS = (signal.SIGINT, signal.SIGTERM)
"""Signals that the server never answers, and a job from the beginning of `work` on."""


def begun(
    program: str, words: Sequence[str], screen: Path, environment: Mapping[str, str]
) -> BaseProcess:
    """A process of `program`, a "module:function", with its words on the command line and its output in the file `screen`.
    environment: all of it. On a system that cannot fork it imports for itself."""
    server = "forkserver" in multiprocessing.get_all_start_methods()
    context = multiprocessing.get_context("forkserver" if server else "spawn")
    if server:
        context.set_forkserver_preload(PRELOADED)  # which counts for the first process
    screen.write_bytes(b"")  # whoever reads it finds nothing of a run that was there before
    process = context.Process(
        target=work, args=(program, list(words), str(screen), dict(environment))
    )
    process.start()
    return process


def work(program: str, words: list[str], screen: str, environment: dict[str, str]) -> None:
    """What a process of `begun` does."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPS)  # what was sent since the fork comes now
    os.environ.clear()
    os.environ.update(environment)
    written, nothing = os.open(screen, os.O_WRONLY), os.open(os.devnull, os.O_RDONLY)
    for number, source in ((0, nothing), (1, written), (2, written)):
        os.dup2(source, number)
    # the server may have been begun without a screen; lines are read while the job runs
    sys.stdout, sys.stderr = (open(number, "w", buffering=1, closefd=False) for number in (1, 2))
    where, _, function = program.partition(":")
    sys.argv = [where, *words]
    getattr(importlib.import_module(where), function)()

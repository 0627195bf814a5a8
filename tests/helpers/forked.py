"""A script of the program in a process of its own, forked from a server that has imported the libraries: that takes seconds.

Where there is a GPU, which a fork cannot use, it is a process like any other."""

import atexit
import gc
import importlib
import json
import os
import runpy
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import torch
from compiled_sooner import compile_sooner
from composed_once import compose_once
from starts_once import start_once

ROOT = Path(__file__).parents[2]
IMPORTED = (
    "mosa.training.workflow",
    "lightning.pytorch.loggers",
    "torch.utils.tensorboard",
    "tensorboard.compat.proto.event_pb2",
)
SERVE = "import sys; sys.path.insert(0, sys.argv.pop(1)); import forked; forked.serve()"
servers: list[subprocess.Popen] = []
"""Of this process, at most one; it ends with its standard input."""


def call(script: str, *words: str, environment: Mapping[str, str] | None = None,
         timeout: float = 400) -> subprocess.CompletedProcess:  # fmt: skip
    """The script, from the repository's folder, with its words on the command line; environment: all of it, default this one."""
    environment = dict(os.environ if environment is None else environment)
    if torch.cuda.is_available() or not hasattr(os, "fork"):
        return subprocess.run(
            [sys.executable, script, *words],
            cwd=ROOT,
            env=environment,
            capture_output=True,
            text=True,
            timeout=timeout,
        )
    if not servers:
        given = os.environ | {
            "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        }
        servers.append(
            subprocess.Popen(
                [sys.executable, "-c", SERVE, str(Path(__file__).parent)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                cwd=ROOT,
                env=given,
                text=True,
                bufsize=1,
            )
        )
    (server,) = servers
    with tempfile.TemporaryDirectory() as folder:
        screens = [Path(folder, name) for name in ("out", "err")]
        server.stdin.write(
            json.dumps([script, words, environment, [str(screen) for screen in screens]]) + "\n"
        )
        process = int(server.stdout.readline())
        late = not select.select([server.stdout], [], [], timeout)[0]
        if late:
            os.kill(process, signal.SIGKILL)
        code = int(server.stdout.readline())
        out, err = (screen.read_text() for screen in screens)
    if late:
        raise subprocess.TimeoutExpired([script, *words], timeout, out, err)
    return subprocess.CompletedProcess([script, *words], code, out, err)


def serve() -> None:
    """A line for each script: its number as a process, and, once it has ended, its exit code."""
    gc.disable()
    for name in IMPORTED:
        importlib.import_module(name)
    from mosa import compose
    from mosa.training import datamodule

    datamodule.sequence_start = start_once
    compose_once()
    compile_sooner()
    compose("debug=default")  # which most scripts are given
    gc.freeze()  # what is looked through by no fork
    gc.enable()
    while line := sys.stdin.readline():
        process = os.fork()
        if process == 0:
            break
        print(process, flush=True)
        print(os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]), flush=True)
    else:
        os._exit(0)
    script, words, environment, screens = json.loads(line)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for number, source in enumerate(
        [nothing, *(os.open(screen, os.O_WRONLY | os.O_CREAT) for screen in screens)]
    ):
        os.dup2(source, number)
    os.environ.clear()
    os.environ.update(environment)
    sys.path[:0] = [
        place
        for place in environment.get("PYTHONPATH", "").split(os.pathsep)
        if place and place not in sys.path
    ]
    sys.argv = [script, *words]
    code = 0
    try:
        runpy.run_path(str(ROOT / script), run_name="__main__")
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except BaseException:
        code = 1
        sys.excepthook(*sys.exc_info())
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # to take down what the server imported takes a second more

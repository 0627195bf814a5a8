"""Worker processes run one job after the other."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mosa.experiments.workers import Worker

ROOT = Path(__file__).parents[2]
LOOK = """
import os, signal, sys, time

def main():
    print("words", sys.argv[1:], "colour", os.environ.get("COLOUR"), "process", os.getpid(), flush=True)
    os.write(2, b"below python\\n")
    if "wait" in sys.argv:
        time.sleep(60)
    if "die" in sys.argv:
        os.kill(os.getpid(), signal.SIGKILL)
    if "raise" in sys.argv:
        raise ValueError("a mistake")
    sys.exit(7 if "fail" in sys.argv else 0)
"""
AT_ONCE = 5.0
SOON = 60


@pytest.fixture
def program(tmp_path, monkeypatch):
    (tmp_path / "looking_job.py").write_text(LOOK)
    monkeypatch.syspath_prepend(str(tmp_path))
    return "looking_job:main"


@pytest.fixture
def worker():
    made = Worker({"COLOUR": "green"})
    yield made
    made.end(at_once=True)


def test_jobs_share_a_process_and_have_their_own_words_and_screens(tmp_path, program, worker):
    processes = set()
    for words, code in (["a=1"], 0), (["fail"], 7), (["raise"], 1), (["a=2"], 0):
        log = tmp_path / "screen.log"
        assert worker.begin(program, words, log).result(SOON) == code
        said = log.read_text()  # that of the last one alone
        assert said.startswith(f"words {words} colour green") and "below python\n" in said
        assert said.endswith("ValueError: a mistake\n") == ("raise" in words)
        processes.add(said.split("process ")[1].split()[0])
    assert len(processes) == 1


def test_a_worker_whose_process_was_killed_has_a_new_one(tmp_path, program, worker):
    """By the system where memory runs out, say: in the middle of a job, or between two."""
    log = tmp_path / "screen.log"
    assert worker.begin(program, ["die"], log).exception(SOON) is not None
    assert worker.begin(program, [], log).result(SOON) == 0
    os.kill(worker.number.result(), signal.SIGKILL)
    time.sleep(0.5)
    assert worker.begin(program, [], log).result(SOON) == 0


def test_a_job_that_is_stopped_ends_at_once_also_before_it_answers_a_signal(
    tmp_path, program, worker
):
    log = tmp_path / "screen.log"
    for wait in (True, False):
        job = worker.begin(program, ["wait"], log)
        while wait and "below" not in log.read_text():
            time.sleep(0.05)
        worker.stop()
        began = time.perf_counter()
        assert job.exception(SOON) is not None
        assert time.perf_counter() - began < AT_ONCE
        worker.end()


SAVING = """
import signal, sys, time
from pathlib import Path

def stopped(*_):
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    time.sleep(0.5)
    Path("saved").touch()
    sys.exit(143)

def main():
    signal.signal(signal.SIGTERM, stopped)
    print("ready", file=sys.stderr, flush=True)
    time.sleep(60)
"""
PARENT = """
import os, signal
from pathlib import Path
from mosa.experiments.workers import Worker
from mosa.system.screen import tolerant_output

def stop(*_):
    raise KeyboardInterrupt

with tolerant_output():
    signal.signal(signal.SIGTERM, stop)
    worker = Worker({})
    job = worker.begin("saving_job:main", [], Path("screen.log"))
    try:
        job.result()
    except KeyboardInterrupt:
        worker.stop()
        os.write(3, str(job.result()).encode())
"""


@pytest.mark.parametrize("screen", ["3>code", "3>code >&- 2>&-"])
def test_a_stop_of_the_whole_group_of_processes_waits_for_what_jobs_save(tmp_path, screen):
    """As `timeout` and batch systems send it; also where the command has no screen, which its jobs have still."""
    (tmp_path / "saving_job.py").write_text(SAVING)
    (tmp_path / "parent.py").write_text(PARENT)
    places = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path}"}
    command = ["sh", "-c", f"exec {sys.executable} parent.py {screen}"]
    with subprocess.Popen(command, cwd=tmp_path, start_new_session=True, env=places) as parent:
        log, until = tmp_path / "screen.log", time.monotonic() + SOON
        while (
            "ready" not in (log.read_text() if log.is_file() else "") and time.monotonic() < until
        ):
            time.sleep(0.05)
        os.killpg(parent.pid, signal.SIGTERM)
        parent.wait(SOON)
    assert (tmp_path / "saved").is_file() and (tmp_path / "code").read_text() == "143"

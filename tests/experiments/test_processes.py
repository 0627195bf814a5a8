"""Jobs are forks of a server that has the libraries imported."""

import os
import subprocess
import sys
import time

import pytest

from mosa.experiments import processes

LOOK = """
import os, sys, time

def main():
    import threading
    print("words", sys.argv[1:], "colour", os.environ.get("COLOUR"), "preloaded", "statistics" in sys.modules, flush=True)
    os.write(2, b"below python\\n")
    if "wait" in sys.argv:
        time.sleep(60)
    sys.exit(7 if "fail" in sys.argv else 0)
"""
AT_ONCE = 3.0


@pytest.fixture
def program(tmp_path, monkeypatch):
    (tmp_path / "looking_job.py").write_text(LOOK)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(processes, "PRELOADED", processes.PRELOADED[:1])  # no libraries
    return "looking_job:main"


def test_a_job_has_its_words_its_environment_and_its_screen(tmp_path, program):
    for words, code in (["a=1"], 0), (["fail"], 7):
        process = processes.begun(
            program, words, tmp_path / "screen.log", os.environ | {"COLOUR": "green"}
        )
        process.join(60)
        assert process.exitcode == code
        said = (tmp_path / "screen.log").read_text()  # that of the last one alone
        assert said.startswith(f"words {words} colour green") and said.endswith("below python\n")


def test_what_its_parent_no_longer_has_set_a_job_does_not_have_either(
    tmp_path, program, monkeypatch
):
    monkeypatch.delenv("COLOUR", raising=False)
    process = processes.begun(program, [], tmp_path / "screen.log", os.environ)
    process.join(60)
    assert "colour None" in (tmp_path / "screen.log").read_text()


def test_a_job_that_is_stopped_ends_at_once(tmp_path, program):
    process = processes.begun(program, ["wait"], tmp_path / "screen.log", os.environ)
    while "below" not in (
        (tmp_path / "screen.log").read_text() if (tmp_path / "screen.log").is_file() else ""
    ):
        time.sleep(0.05)
    began = time.perf_counter()
    process.terminate()
    process.join(60)
    assert process.exitcode == -15 and time.perf_counter() - began < AT_ONCE


def test_what_the_server_imports_begins_neither_threads_nor_warp_nor_cuda():
    """With which a process cannot be forked: a child would find locks that nobody holds, and a CUDA that does not answer."""
    code = (
        "import importlib, threading, torch\n"
        f"for name in {processes.PRELOADED!r}: importlib.import_module(name)\n"
        "from warp._src import context\n"
        "tasks = [line for line in open('/proc/self/status') if line.startswith('Threads')]\n"
        "print(context.runtime is None, torch.cuda.is_initialized(), threading.active_count(), tasks[0].split()[1])"
    )
    found = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    assert found.stdout.split() == ["True", "False", "1", "1"], found.stderr[-500:]


def test_a_job_finds_what_the_server_imported(tmp_path):
    """In a process of its own: the server begins with the first job, and this one may have begun another."""
    (tmp_path / "looking_job.py").write_text(LOOK)
    code = (
        "import os, sys\nfrom pathlib import Path\nfrom mosa.experiments import processes\n"
        "processes.PRELOADED = ['statistics']\n"
        "if __name__ == '__main__':\n"
        "    process = processes.begun('looking_job:main', [], Path('screen.log'), os.environ)\n"
        "    process.join(60)\n"
    )
    (tmp_path / "parent.py").write_text(code)
    subprocess.run([sys.executable, "parent.py"], cwd=tmp_path, check=True, timeout=120)
    assert "preloaded True" in (tmp_path / "screen.log").read_text()


AT_ONCE_STOPPED = """
import os
from pathlib import Path
from mosa.experiments import processes

if __name__ == "__main__":
    processes.PRELOADED = processes.PRELOADED[:1]
    for _ in range(5):
        process = processes.begun("looking_job:main", ["wait"], Path("screen.log"), os.environ)
        process.terminate()
        process.join(10)
        print(process.exitcode)
        process.kill()
"""


def test_a_stop_that_a_job_is_sent_before_it_answers_any_is_not_lost(tmp_path):
    """Its server answers none, and a fork begins as its server is."""
    (tmp_path / "looking_job.py").write_text(LOOK)
    (tmp_path / "parent.py").write_text(AT_ONCE_STOPPED)
    found = subprocess.run(
        [sys.executable, "parent.py"], cwd=tmp_path, capture_output=True, text=True, timeout=500
    )
    assert found.stdout.split() == ["-15"] * 5, found.stderr[-500:]


SAVING = """
import signal, sys, time
from pathlib import Path

def stopped(*_):
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    time.sleep(1)
    Path("saved").touch()
    sys.exit(143)

def main():
    signal.signal(signal.SIGTERM, stopped)
    print("ready", file=sys.stderr, flush=True)
    time.sleep(60)
"""
PARENT = """
import os, signal, sys
from pathlib import Path
from mosa.experiments import processes

def stop(*_):
    raise KeyboardInterrupt

if __name__ == "__main__":
    signal.signal(signal.SIGTERM, stop)
    process = processes.begun("saving_job:main", [], Path("screen.log"), os.environ)
    try:
        process.join()
    except KeyboardInterrupt:
        process.terminate()
        process.join()
    os.write(3, str(process.exitcode).encode())
"""


@pytest.mark.parametrize("shown", [True, False])
def test_a_stop_of_the_whole_group_of_processes_waits_for_what_jobs_save(tmp_path, shown):
    """As `timeout` and batch systems send it; also where the command has no screen (`>&- 2>&-`), which its jobs have still."""
    (tmp_path / "saving_job.py").write_text(SAVING)
    (tmp_path / "parent.py").write_text(PARENT)
    screen = "3>code" if shown else "3>code >&- 2>&-"
    with subprocess.Popen(["sh", "-c", f"exec {sys.executable} parent.py {screen}"], cwd=tmp_path, start_new_session=True,
                          env=os.environ | {"PYTHONPATH": str(tmp_path)}) as parent:  # fmt: skip
        log = tmp_path / "screen.log"
        began = time.perf_counter()
        while (
            "ready" not in (log.read_text() if log.is_file() else "")
            and time.perf_counter() - began < 60
        ):
            time.sleep(0.05)
        os.killpg(parent.pid, 15)
        parent.wait(30)
    assert (tmp_path / "saved").is_file() and (tmp_path / "code").read_text() == "143"

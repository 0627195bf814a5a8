"""Attacks on whole processes while they run: kills, disks, screens, folders and limits; of the smallest run of the tiny scene. What
is asked of each is said by its name; quarter of an hour on two cores.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from attacks import ROOT, Attack, refuse
from drawn_runs import RESUMED, leftovers
from drawn_runs import SMALL as SHORT

from mosa.errors import ConfigError
from mosa.evaluation.analysis.figures import ffmpeg

try:
    ffmpeg("")
    VIDEO = []
except ConfigError:  # then everything but the video is attacked
    VIDEO = ["evaluation.video=false"]
SMALL = [*(key for key in SHORT if "video" not in key), *VIDEO, "reconstruction.dynamic.iterations=15",
         "reconstruction.carried.iterations=20", "reconstruction.informed.iterations=5",
         "simulation.particles=100", "fit.joint.newton_iterations=1"]  # fmt: skip
FILES = ("results.md", "splats.ply", "strip.png", "video.mp4")
FULL = "No space left on device"


def program(*arguments: str, disturbed: tuple[str, str] | None = None, script: str = "train.py", shell: str = "{}",
            seconds: float | None = None, sign: int = signal.SIGKILL, wanted: int | None = 0, cwd: Path = ROOT) -> str:  # fmt: skip
    """Run it to its end, or until a signal after some seconds; what was on its screen. An exit code that was not `wanted`, or a
    traceback, is an AssertionError. disturbed: see disturbed.py; shell: around the command."""
    words = [str(ROOT / script), *arguments]
    words = [
        sys.executable,
        *([str(ROOT / "benchmarks" / "disturbed.py"), *disturbed] if disturbed else []),
        *words,
    ]
    quoted = " ".join(
        f"'{word.replace(chr(39), chr(39) + chr(92) + chr(39) * 2)}'" for word in words
    )
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}",
    }
    command = [
        "bash",
        "-o",
        "pipefail",
        "-c",
        ("exec " if shell == "{}" else "") + shell.format(quoted),
    ]
    process = subprocess.Popen(command, cwd=cwd, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                               preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler))  # fmt: skip
    if seconds is not None:
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            process.send_signal(sign)
    told = process.communicate()[0]
    if "Traceback" in told or (wanted is not None and process.returncode != wanted):
        raise AssertionError(f"exit code {process.returncode}: {told[-500:]}")
    return told


def contents(folder: Path) -> dict[str, object]:
    """What a run leaves, without what depends on the clock."""
    found: dict[str, object] = {k: v for k, v in json.loads((folder / "metrics.json").read_text()).items()
                                if not k.startswith("time/")}  # fmt: skip
    for file in sorted(folder.glob("*.npz")):
        with np.load(file) as arrays:
            found |= {f"{file.name}:{key}": arrays[key].tobytes() for key in arrays.files}
    return found | {
        name: (folder / name).read_bytes() for name in FILES if (folder / name).is_file()
    }


def equal(wanted: dict[str, object], folder: Path, *others: Path) -> None:
    """As an undisturbed run, with nothing left of the disturbance."""
    found = contents(folder)
    if differ := [key for key in sorted({*wanted, *found}) if wanted.get(key) != found.get(key)]:
        raise AssertionError(f"{len(differ)} differ: {', '.join(differ[:5])}")
    if left := leftovers(folder, *others):
        raise AssertionError(f"left: {', '.join(left)}")
    refuse("as an undisturbed run")


def running(folder: Path) -> Iterator[Attack]:
    cache, base, generator = folder / "cache", folder / "base", random.Random(0)
    program(*SMALL, f"hydra.run.dir={base}", f"scene.cache={cache}")
    whole = contents(base)

    def arguments(run: Path, used: Path = cache) -> list[str]:
        return [*SMALL, f"hydra.run.dir={run}", f"scene.cache={used}", "resume=auto"]

    def fitted(name: str) -> Path:
        """A folder with the checkpoint of a complete fit, whose evaluation and export are left to do."""
        shutil.copytree(base / "checkpoints", folder / name / "checkpoints")
        return folder / name

    def stopped(name: str, sign: int, fresh: bool) -> None:
        run, used, most = (
            folder / name,
            folder / f"{name}_cache" if fresh else cache,
            25.0 if fresh else 12.0,
        )
        for _ in range(2 if fresh else 3):
            program(
                *arguments(run, used), seconds=generator.uniform(3.0, most), sign=sign, wanted=None
            )
        program(*arguments(run, used))
        equal(whole, run, used)

    def at_a_file(how: str, number: int, code: int | None) -> None:
        run = fitted(f"{how}_{number}")
        told = program(*arguments(run), disturbed=(f"{how}:{number}", str(run)), wanted=code)
        if f"disturbed: {how} {number}" not in told:
            raise AssertionError(f"it writes fewer than {number} files")
        if how == "full" and FULL not in told:
            raise AssertionError(f"not said: {told[-300:]}")
        program(*arguments(run))
        equal(whole, run)

    for sign in (signal.SIGKILL, signal.SIGTERM, signal.SIGINT):
        for fresh in (True, False):
            yield (f"{sign.name} at drawn moments, {'from' if fresh else 'after'} the reconstruction",
                   lambda s=sign, f=fresh: stopped(f"{s.name}_{f}", s, f))  # fmt: skip
    told = program(*arguments(fitted("listed")), disturbed=("list:0", str(folder / "listed")))
    writes = [
        int(line.split()[2])
        for line in told.splitlines()
        if line.startswith("disturbed: list")
        and ".hydra" not in line
        and line.split()[3] in ("open", "os.rename")
    ]  # a folder that is there already may fail to be made
    writes = [n for n in writes if n > 3]  # Hydra's own first ones are its
    for how, code, share in (("kill", None, 3), ("full", 2, 3), ("term", 143, 6), ("int", 130, 6)):
        for number in writes[::share]:
            yield (
                f"{how} at write {number} of the evaluation",
                lambda h=how, n=number, c=code: at_a_file(h, n, c),
            )

    def screen(name: str, shell: str) -> None:
        run = fitted(name)
        program(*arguments(run), shell=shell)
        equal(whole, run)

    for name, shell in {"head": "{} 2>&1 | head -1", "head_out": "{} | head -1", "closed": "{} >&- 2>&-",
                        "full_log": "{} > /dev/full", "ascii": "LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0 {}",
                        "few_files": "ulimit -n 30; {}",
                        "no_home": "env -u HOME {}", "no_temporary": "TMPDIR=/nonexistent {}"}.items():  # fmt: skip
        yield f"goes on: {name}", lambda n=name, s=shell: screen(n, s)

    def read_only(name: str, used: Path, code: int) -> None:
        run = fitted(name)
        program(*arguments(run, used), disturbed=("read_only:1", str(used)), wanted=code)
        equal(whole, run) if code == 0 else refuse("one message")

    yield "a read-only cache that has all", lambda: read_only("shared", cache, 0)
    yield "a read-only cache that has nothing", lambda: read_only("bare", folder / "no_cache", 2)

    def other(name: str, *changed: str) -> None:
        run = fitted(name)
        shutil.copy(base / "metrics.json", run)
        told = program(*arguments(run), *changed, wanted=2)
        refuse("one message") if "another one's" in told else None

    yield "another seed in a complete run's folder", lambda: other("seed", "seed=1")
    yield "another law in a complete run's folder", lambda: other("law", "prior=linear")

    def moved() -> None:
        fitted("here").rename(folder / "ü 'there' [1] = %s")
        run = folder / "ü 'there' [1] = %s"
        program(*[*arguments(Path(".")), "scene.cache=../cache"], cwd=run)
        equal(whole, run)

    yield "moved to a name with quotes and an umlaut, from within", moved

    def gone(name: str, line: str) -> None:
        """Once the run's log has the line."""
        run = fitted(name)
        process = subprocess.Popen([sys.executable, str(ROOT / "train.py"), *arguments(run)], cwd=ROOT, stdout=subprocess.DEVNULL,
                                   stderr=subprocess.PIPE, text=True)  # fmt: skip
        log = run / "train.log"
        while not (log.is_file() and line in log.read_text()) and process.poll() is None:
            time.sleep(0.05)
        shutil.rmtree(run)
        told = process.communicate()[1]
        refuse(
            "one message"
        ) if process.returncode == 2 and "Traceback" not in told else refuse_not(told)

    def refuse_not(told: str) -> None:
        raise AssertionError(told[-500:])

    for name, line in {"early": "mosa", "late": "fit: "}.items():
        yield f"the folder is removed while it runs, {name}", lambda n=name, x=line: gone(n, x)

    def beside(waits: bool) -> None:
        """The second one is refused; with resume=auto it waits, and finds the run complete."""
        run = fitted(f"twice_{waits}")
        first = subprocess.Popen([sys.executable, str(ROOT / "train.py"), *arguments(run)], cwd=ROOT, stdout=subprocess.DEVNULL,
                                 stderr=subprocess.DEVNULL)  # fmt: skip
        while not (run / "train.log").is_file() and first.poll() is None:
            time.sleep(0.05)
        time.sleep(1.0)
        given = [word for word in arguments(run) if waits or word != "resume=auto"]
        told = program(*given, wanted=0 if waits else 2)
        if waits and not ("is at work in" in told and RESUMED["skipped"] in told):
            raise AssertionError(f"it did not wait: {told[-300:]}")
        if first.wait():
            raise AssertionError(f"the first ended with {first.returncode}")
        equal(whole, run)

    for waits in (False, True):
        yield (
            f"a second process in the folder{', which waits' if waits else ''}",
            lambda w=waits: beside(w),
        )

    def limited(name: str, limit: str) -> None:
        run = fitted(name)
        try:
            program(*arguments(run), shell=f"ulimit {limit}; {{}}", wanted=2)
        except AssertionError:  # another Python may need fewer handles than are left
            if not (run / "metrics.json").is_file():
                raise
            equal(whole, run)
        else:
            refuse("one message")

    for name, limit in {
        "memory": "-v 1200000",
        "more_memory": "-v 1800000",
        "file_size": "-f 200",
        "handles": "-n 9",
    }.items():
        yield f"ulimit {limit}", lambda n=name, x=limit: limited(n, x)

    def sweep() -> None:
        told = program("-m", *SMALL, "evaluation.video=false", f"scene.cache={cache}", f"hydra.sweep.dir={folder}/sweep",
                       "hydra.sweep.subdir=${hydra.job.num}", "identification.count=30.0,1e99,20.0", wanted=1)  # fmt: skip
        made = [(folder / "sweep" / str(k) / "metrics.json").is_file() for k in range(3)]
        if made != [True, False, True] or "1 jobs of the sweep failed" not in told:
            raise AssertionError(f"{made}: {told[-300:]}")
        refuse("the others complete, exit code 1")

    yield "a sweep whose second job fails", sweep

    def evaluated() -> None:
        words = [f"ckpt_path={base}/checkpoints/last.ckpt", f"cache={cache}", *VIDEO]
        program(*words, f"hydra.run.dir={folder}/e", script="eval.py")
        for number in (5, 12, 20):
            run = folder / f"e_{number}"
            program(
                *words,
                f"hydra.run.dir={run}",
                script="eval.py",
                disturbed=(f"kill:{number}", str(run)),
                wanted=None,
            )
            program(*words, f"hydra.run.dir={run}", script="eval.py")
            if contents(run) != contents(folder / "e") or leftovers(run):
                raise AssertionError(f"killed at write {number}: {leftovers(run)}")
        refuse("as an undisturbed one")

    yield "eval.py killed while it writes", evaluated

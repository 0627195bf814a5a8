"""Attacks of a third look at command lines and processes: values that pass a configuration's checks and cannot be computed, files
of a run that are something else, stages at which it is stopped, caches that are damaged. Whole processes.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from attacks import ROOT, Attack, refuse
from attacks_on_running import SMALL, contents, equal, program

STAGES = {"data": "] data: ", "reconstruction": "] this run takes", "starts": "] reconstruction took", "fit": "] stage prior:",
          "joint stage": "] stage joint:", "evaluation": "] fit took", "export": "] evaluation took"}  # fmt: skip
"""Stage -> what a run's log says when it has just begun."""


def afresh_keys(folder: Path) -> Iterator[Attack]:
    """Values that a schema lets pass: one message, a run to its end with finite figures, or minutes that are said at its start."""
    cache = folder / "cache"

    def attack(number: int, words: str) -> None:
        run = folder / str(number)
        told = program(*SMALL, "evaluation.video=false", f"scene.cache={cache}", f"hydra.run.dir={run}", *words.split(),
                       wanted=None, seconds=150.0)  # fmt: skip
        if (run / "metrics.json").is_file():
            found = json.loads((run / "metrics.json").read_text())
            if bad := [
                key
                for key, value in found.items()
                if isinstance(value, float) and not math.isfinite(value)
            ]:
                raise AssertionError(f"figures that are not finite: {', '.join(bad[:5])}")
            refuse("to its end, with finite figures")
        said = [
            line for line in told.splitlines() if "Error: " in line or "HYDRA_FULL_ERROR" in line
        ]  # or Hydra's own
        log = (run / "train.log").read_text() if (run / "train.log").is_file() else ""
        if expected := re.search(r"this run takes about [^:]* (min|h)\b", log):
            refuse(f"said before: {expected[0]}")
        if len(said) != 1:
            raise AssertionError(f"{len(said)} messages, or more than 150 s: {told[-400:]}")
        refuse(said[0])

    values = """reconstruction.neighbours=100000 reconstruction.neighbours=1 fit.views=1000000 reconstruction.margin=1000000
        reconstruction.static.views=1000 evaluation.samples=1 evaluation.samples=1000000000 evaluation.assignment=1000000000
        reconstruction.dynamic.modes=1000000000 reconstruction.dynamic.modes=1 reconstruction.informed.response=1000000
        reconstruction.ridge_passes=1000000000 fit.joint.newton_iterations=1000000000 prior.parameters.E=1e-12
        prior.parameters.E=1e15 identification.count=1e-300 identification.model_error=0 heterogeneity.wavelength=1e-9
        losses.mask=1e-308 extensions=[os] extensions=[mosa] extensions=[../x] extensions=['os;x'] extensions=['']
        ckpt_path=/dev/zero ckpt_path=/dev/stdin ckpt_path='' ckpt_path=. ckpt_path=/ scene.cache=/dev/null scene.cache=''
        resume=always world.walls={friction:0.1} reconstruction.dynamic.iterations=0 reconstruction.appearance.iterations=0
        scene.holdout_cameras=[0,1,2,3,4,5] scene.frames=[0,1] scene.holdout_frames=[0] scene.name=tiny2 scene.sequence=test_60
        scene.format=null scene.scale=1e-9 optimized_metric=time/fit_s trainer.devices=0 trainer.devices=1000000
        seed=${seed} seed=${oc.env:NOPE} losses=${fit} world.colliders=${world.colliders} seed=glob(*) seed=choice(1,2)
        seed=??? scene@x=rabbit hydra.run.dir=/proc/x hydra.run.dir=/dev/null hydra.job.chdir=true
        hydra.output_subdir=null hydra.verbose=true hydra/job_logging=none hydra/job_logging=nothing""".split()
    for number, words in enumerate(values):
        yield words, lambda n=number, w=words: attack(n, w)
    several = ("losses.position=0 losses.image=0 losses.mask=0 losses.flow=0", "fit.prior.optimizer=adam fit.prior.lr=0",
               "adapter=none heterogeneity.enabled=false fit.prior.looks=1000000")  # fmt: skip
    for number, words in enumerate(several, len(values)):
        yield words, lambda n=number, w=words: attack(n, w)


def afresh_running(folder: Path) -> Iterator[Attack]:
    cache, base = folder / "cache", folder / "base"
    program(*SMALL, f"hydra.run.dir={base}", f"scene.cache={cache}")
    whole = contents(base)

    def fitted(name: str) -> Path:
        shutil.copytree(base / "checkpoints", folder / name / "checkpoints")
        return folder / name

    def words(run: Path | str, used: Path = cache) -> list[str]:
        return [*SMALL, f"hydra.run.dir={run}", f"scene.cache={used}", "resume=auto"]

    def same(run: Path, *more: str, **told) -> None:
        program(*words(run), *more, **told)
        equal(whole, run)

    def message(*given: str, **told) -> None:
        said = [
            line for line in program(*given, wanted=2, **told).splitlines() if "Error: " in line
        ]
        if len(said) != 1:
            raise AssertionError(f"{len(said)} messages: {said}")
        refuse(said[0])

    yield from stopped_at_stages(folder, words, whole)
    yield from changed_files(fitted, words, message, same)
    yield from changed_keys(fitted, words, message, same)
    yield from other_folders(folder, fitted, words, same)
    yield from damaged_kernels(folder, fitted, words, whole)
    yield from sweeps(folder, cache)


def stopped_at_stages(folder: Path, words: Callable, whole: dict) -> Iterator[Attack]:
    def stopped(stage: str, line: str, sign: int) -> None:
        run, used = folder / f"{stage}_{sign}", folder / f"{stage}_{sign}_cache"
        process = subprocess.Popen([sys.executable, str(ROOT / "train.py"), *words(run, used)], cwd=ROOT, stdout=subprocess.DEVNULL,
                                   stderr=subprocess.PIPE, text=True,
                                   preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler))  # fmt: skip
        log = run / "train.log"
        while process.poll() is None and not (log.is_file() and line in log.read_text()):
            time.sleep(0.02)
        process.send_signal(sign)
        told = process.communicate()[1]
        if process.returncode not in (0, 130, 143, -sign) or "Traceback" in told:
            raise AssertionError(f"exit code {process.returncode}: {told[-400:]}")
        program(*words(run, used))
        equal(whole, run, used)

    for stage, line in STAGES.items():
        for sign in (signal.SIGINT, signal.SIGKILL):
            yield (
                f"{sign.name} as the {stage} begins",
                lambda s=stage, x=line, n=sign: stopped(s, x, n),
            )


def changed_files(
    fitted: Callable, words: Callable, message: Callable, same: Callable
) -> Iterator[Attack]:
    """In the place of a run's files."""

    def put(name: str, place: str, make: Callable[[Path], object]) -> Path:
        run = fitted(name)
        target = run / place
        if target.is_dir():
            shutil.rmtree(target)
        elif target.exists():
            target.unlink()
        make(target)
        return run

    for place in ("checkpoints/last.ckpt", "metrics.json", "train.log"):
        for kind, make in {"a pipe": os.mkfifo, "a folder": Path.mkdir, "a link to /dev/zero": lambda p: p.symlink_to("/dev/zero"),
                           "a link to itself": lambda p: p.symlink_to(p)}.items():  # fmt: skip
            name = f"{place.replace('/', '_')}_{kind.replace(' ', '_').replace('/', '_')}"
            yield (
                f"{place} is {kind}",
                lambda n=name, p=place, m=make: message(*words(put(n, p, m))),
            )
    for place in ("results.md", "rollout.npz", "strip.png"):
        yield (
            f"{place} is a folder",
            lambda p=place: message(*words(put(f"folder_{p}", p, Path.mkdir))),
        )
    for place in ("checkpoints", ".hydra"):
        yield (
            f"{place} is a file",
            lambda p=place: message(*words(put(f"file_{p}", p, lambda f: f.write_text("x")))),
        )
    yield (
        "metrics.json is empty",
        lambda: message(*words(put("empty", "metrics.json", lambda p: p.write_text("")))),
    )
    yield (
        "last.ckpt is empty",
        lambda: message(
            *words(put("empty_ckpt", "checkpoints/last.ckpt", lambda p: p.write_text("")))
        ),
    )


def changed_keys(
    fitted: Callable, words: Callable, message: Callable, same: Callable
) -> Iterator[Attack]:
    """A fit that goes on with another configuration."""
    for number, key in enumerate(("simulation.particles=120", "fit.joint.newton_iterations=2", "scene.scale=0.4", "scene=rabbit",
                                  "reconstruction.points=2000", "identification.count=20", "adapter=none",
                                  "heterogeneity.enabled=false", "prior.parameters.E=2e5", "world.walls={mode: separate}",
                                  "deterministic=true", "scene.seed=3")):  # fmt: skip
        yield f"goes on with {key}", lambda k=key, n=number: message(*words(fitted(f"key_{n}")), k)
    yield "goes on with another logger", lambda: same(fitted("logger"), "logger=csv")
    yield "ckpt_path of another scene", lambda: message(
        *[word for word in words(fitted("from")) if word != "resume=auto"], "scene=rabbit",
        f"ckpt_path={fitted('another')}/checkpoints/last.ckpt")  # fmt: skip


def other_folders(
    folder: Path, fitted: Callable, words: Callable, same: Callable
) -> Iterator[Attack]:
    for number, name in enumerate(
        ("-x", "a b", "x" * 200, "ü\u0308", "a,b", "#1", "~", "a'b", "100%")
    ):
        run = f"{folder}/named_{number}/{name}"

        def named(run=run, number=number):
            shutil.copytree(fitted(f"source_{number}") / "checkpoints", Path(run) / "checkpoints")
            quoted = "'" + run.replace("'", "\\'") + "'"
            program(
                *[
                    word if not word.startswith("hydra.run.dir") else f"hydra.run.dir={quoted}"
                    for word in words(run)
                ]
            )
            if not (Path(run) / "metrics.json").is_file():
                raise AssertionError("its files are elsewhere")
            refuse("the same")

        yield f"a folder named {name[:20]}", named

    def linked() -> None:
        (folder / "link").symlink_to(fitted("real"))
        same(folder / "link")

    yield "a folder that is a link", linked
    late = 2**32
    yield "a cache of the future", lambda: ([os.utime(file, (late, late)) for file in (folder / "cache").rglob("*")],
                                            same(fitted("late")))  # fmt: skip
    for name, shell in {"relative_cache_home": "XDG_CACHE_HOME=.cache_here {}", "isolated": "PYTHONSAFEPATH=1 {}",
                        "nice": "nice -n 19 {}", "no_locale": "env -u LANG -u LC_ALL {}", "utc": "TZ=Pacific/Kiritimati {}",
                        "pipe": "{} | cat", "stdbuf": "PYTHONUNBUFFERED=1 {}", "stack": "ulimit -s 1024; {}"}.items():  # fmt: skip
        yield f"goes on: {name}", lambda n=name, s=shell: same(fitted(n), shell=s)


def damaged_kernels(
    folder: Path, fitted: Callable, words: Callable, whole: dict
) -> Iterator[Attack]:
    """The cache of compiled kernels, as a killed compiler, a full disk or another user leave it."""

    def with_cache(name: str, change: Callable[[Path], object]) -> None:
        home, run = folder / f"home_{name}", fitted(f"kernels_{name}")
        source = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
        shutil.copytree(source / "warp", home / "warp")
        for file in sorted((home / "warp").rglob("*")):
            if file.is_file():
                change(file)
        given = {"shell": f"XDG_CACHE_HOME='{home}' {{}}"}
        if name != "gone":
            found = [
                line
                for line in program(*words(run), **given, wanted=2).splitlines()
                if "Error: " in line
            ]
            if len(found) != 1 or str(home) not in found[0]:
                raise AssertionError(f"not said: {found}")
            shutil.rmtree(home / "warp")
        program(*words(run), **given)
        equal(whole, run)

    def compiled(change: Callable[[Path], object]) -> Callable[[Path], object]:
        return lambda file: change(file) if file.suffix == ".o" else None

    changes = {"cut in half": compiled(lambda f: f.write_bytes(f.read_bytes()[: f.stat().st_size // 2])),
               "empty": compiled(lambda f: f.write_bytes(b"")), "gone": compiled(Path.unlink),
               "zeros": compiled(lambda f: f.write_bytes(bytes(f.stat().st_size))),
               "without descriptions": lambda f: f.write_bytes(b"") if f.suffix == ".meta" else None}  # fmt: skip
    for name, change in changes.items():
        yield (
            f"compiled kernels: {name}",
            lambda n=name, c=change: with_cache(n.replace(" ", "_"), c),
        )


def sweeps(folder: Path, cache: Path) -> Iterator[Attack]:
    def sweep(name: str, *more: str, code: int, complete: int, message: str = "") -> None:
        told = program("-m", *SMALL, "evaluation.video=false", f"scene.cache={cache}", f"hydra.sweep.dir={folder}/{name}", *more,
                       wanted=code)  # fmt: skip
        made = len(list((folder / name).rglob("metrics.json")))
        if made != complete or message not in told:
            raise AssertionError(f"{made} complete: {told[-400:]}")
        refuse(f"{made} complete, exit code {code}")

    yield (
        "the same job twice",
        lambda: sweep(
            "twice", "seed=0,0", "hydra.sweep.subdir=${hydra.job.num}", code=0, complete=2
        ),
    )
    yield "all jobs in one folder", lambda: sweep("one", "seed=0,1", "hydra.sweep.subdir=here", code=2, complete=0,
                                                  message="hydra.sweep.subdir")  # fmt: skip
    (folder / "taken").write_text("x")
    yield "the sweep's folder is a file", lambda: sweep("taken", "seed=0,1", code=2, complete=0)

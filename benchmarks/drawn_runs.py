"""The part `runs` of long_runs.py: drawn small runs, each in a process of its own, and the same ones as sweeps that are killed and
resumed. What was found is written into a record after each run, so that a later call goes on where this one was stopped.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from mosa.training.run_folder import device_label

ROOT = Path(__file__).parents[1]
SMALL = ["debug=default", "evaluation.video=false", "logger=none", "reconstruction.static.iterations=60",
         "reconstruction.appearance.iterations=60", "reconstruction.dynamic.iterations=30", "identification.threads=1"]  # fmt: skip
CHOICES = {
    "prior": ["corotated", "neo_hookean", "linear", "stvk"], "criterion": ["corrected", "free"], "adapter": ["operator", "none"],
    "fit.joint.newton_iterations": [1, 2], "identification.count": [20.0, 30.0], "seed": [0, 1, 2, 3],
}  # fmt: skip
MARKS = (".partial", ".tmp", ".lock")
SWEEPS = ("joblib", "submitit_local")
RESUMED = {"skipped": "skipped: ", "went on": "going on from "}
"""What a run says in its log that finds itself complete, or a checkpoint of its own."""


class Row(NamedTuple):
    what: str
    asked: str
    found: str
    met: bool


def told(row: Row) -> Row:
    print(
        f"[{time.strftime('%H:%M:%S')}] {row.what}: {row.found}{'' if row.met else '   <- NOT AS ASKED'}",
        flush=True,
    )
    return row


def drawn(count: int, generator: random.Random) -> list[list[str]]:
    """So many different sets of overrides, as far as there are. Those of a smaller count are the first ones of a larger."""
    found: list[list[str]] = []
    for _ in range(100 * count):
        one = [f"{key}={generator.choice(values)}" for key, values in CHOICES.items()]
        if one not in found:
            found.append(one)
        if len(found) == count:
            break
    return found


def environment(gpu: int | None = None) -> dict[str, str]:
    path = f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    seen = {} if gpu is None else {"CUDA_VISIBLE_DEVICES": str(gpu)}
    return {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": path, **seen}


def started(arguments: list[str], log: Path, gpu: int | None = None) -> subprocess.Popen:
    with open(log, "a") as file:
        return subprocess.Popen([sys.executable, str(ROOT / "train.py"), *arguments], cwd=ROOT, env=environment(gpu), stdout=file,
                                stderr=file, start_new_session=True)  # fmt: skip


def figures(folder: Path) -> dict:
    """Of a run, without what depends on the clock and the machine."""
    path = folder / "metrics.json"
    if not path.is_file():
        return {"metrics.json": "none"}
    return {
        key: value
        for key, value in json.loads(path.read_text()).items()
        if not key.startswith("time/")
    }


def processes_with(text: str) -> list[int]:
    """Of this machine's processes, those whose command line or folder names `text`, but this one and those that run parts."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            words = (place / "cmdline").read_bytes().decode(errors="ignore")
            folder = os.readlink(place / "cwd")
        except OSError:
            continue
        if text in words + folder and "long_runs.py" not in words:
            found.append(int(place.name))
    return found


def ended(numbers: Iterable[int]) -> None:
    """SIGKILL to each of these processes that is still there."""
    for number in numbers:
        try:
            os.kill(number, signal.SIGKILL)
        except ProcessLookupError:
            continue


def leftovers(*folders: Path) -> list[str]:
    return [
        str(file) for folder in folders for file in folder.rglob("*") if file.name.endswith(MARKS)
    ]


def version() -> str:
    """Of what computes the figures: this machine's processor and the program's files. Only runs of one version are compared, as
    another processor may take another branch of a library, and so other last bits."""
    sums = hashlib.sha256()
    for file in sorted([*(ROOT / "mosa").rglob("*.py"), *(ROOT / "conf").rglob("*.yaml")]):
        sums.update(file.relative_to(ROOT).as_posix().encode() + file.read_bytes())
    return f"{device_label('cpu')}, {sums.hexdigest()[:8]}"


class Record:
    """What was found so far, in a file where one is named: figures of runs by version, kind (alone | joblib | submitit_local) and
    number, each sweep's end, and what was left behind."""

    def __init__(self, path: Path | None, of: dict) -> None:
        self.path, self.lock, self.version = path, threading.Lock(), version()
        self.seconds: list[float] = []  # of runs by themselves, this call's
        self.content: dict = {"of": of, "figures": {}, "sweeps": [], "left": []}
        if path is not None and path.is_file():
            self.content = json.loads(path.read_text())
            if self.content["of"] != of:
                raise SystemExit(
                    f"{path}: expected a record of {of}, found one of {self.content['of']}"
                )

    def put(self, kind: str, number: int, found: dict) -> None:
        with self.lock:
            self.content["figures"].setdefault(self.version, {}).setdefault(kind, {})[
                str(number)
            ] = found
            self.write()

    def note(self, part: str, what: object) -> None:
        with self.lock:
            self.content[part].append(what)
            self.write()

    def write(self) -> None:
        if self.path is not None:
            beside = self.path.with_name(self.path.name + ".beside")
            beside.write_text(json.dumps(self.content))
            beside.replace(self.path)

    def of_kind(self, kind: str) -> dict[int, dict]:
        """Of this version."""
        return {
            int(k): v
            for k, v in self.content["figures"].get(self.version, {}).get(kind, {}).items()
        }

    def complete(self) -> list[int]:
        """Runs by themselves that came to their end, of any version."""
        return sorted(
            {
                int(k)
                for kinds in self.content["figures"].values()
                for k, v in kinds.get("alone", {}).items()
                if good(v)
            }
        )

    def wrong(self) -> list[tuple[int, dict]]:
        return [
            (int(k), v)
            for kinds in self.content["figures"].values()
            for k, v in kinds.get("alone", {}).items()
            if not good(v)
        ]

    def compared(self, kind: str) -> dict[int, list[str]]:
        """Number of a run that a sweep has made too, by the same version -> names of the figures that differ."""
        found: dict[int, list[str]] = {}
        for kinds in self.content["figures"].values():
            alone = kinds.get("alone", {})
            for k, again in kinds.get(kind, {}).items():
                if k in alone:
                    names = {*alone[k], *again}
                    found[int(k)] = sorted(
                        name for name in names if alone[k].get(name) != again.get(name)
                    )
        return found


def good(found: dict) -> bool:
    return "exit code" not in found and "metrics.json" not in found


def by_themselves(sets: list[list[str]], numbers: list[int], folder: Path, common: list[str], workers: int, until: float,
                  record: Record) -> None:  # fmt: skip
    """Those of the runs, each in a process of its own, `workers` beside each other. One that has not ended at `until` (of
    time.perf_counter) is stopped and not recorded."""

    def one(k: int) -> None:
        if time.perf_counter() > until:
            return
        log, began = folder / f"{k}.log", time.perf_counter()
        process = started([*common, *sets[k], f"hydra.run.dir={folder}/{k}"], log)
        try:
            code = process.wait(max(0.0, min(900.0, until - time.perf_counter())))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            return
        if code:
            print(f"run {k} failed: {' '.join(sets[k])}: {log.read_text()[-1500:]}", flush=True)
        record.seconds.append(time.perf_counter() - began)
        record.put("alone", k, {"exit code": code} if code else figures(folder / str(k)))

    # the first of each law first, alone with the kernels that it compiles
    laws = [
        next(k for k in numbers if sets[k][0] == law)
        for law in sorted({sets[k][0] for k in numbers})
    ]
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(one, laws))
        list(pool.map(one, [k for k in numbers if k not in laws]))


def experiments(sets: list[list[str]], folder: Path) -> str:
    """One experiment file per set: what a sweep goes through, as its override."""
    conf = folder / "conf" / "experiment"
    conf.mkdir(parents=True)
    for k, overrides in enumerate(sets):
        pairs = [override.split("=") for override in overrides]
        groups = [
            f"  - override /{key}: {value}"
            for key, value in pairs
            if "." not in key and key != "seed"
        ]
        tree: dict = {}
        for key, value in pairs:
            if "." in key or key == "seed":
                *path, last = key.split(".")
                at = tree
                for part in path:
                    at = at.setdefault(part, {})
                at[last] = json.loads(value)
        lines = [
            "# @package _global_",
            "defaults:",
            *groups,
            *(f"{key}: {json.dumps(value)}" for key, value in tree.items()),
        ]
        (conf / f"drawn_{k}.yaml").write_text("\n".join(lines) + "\n")
    return "experiment=" + ",".join(f"drawn_{k}" for k in range(len(sets)))


class Kills(NamedTuple):
    """At most so many, each after a time [s] that is drawn from the span."""

    most: int
    span: tuple[float, float]
    generator: random.Random


def killed_sweep(sets: list[list[str]], numbers: list[int], folder: Path, common: list[str], launcher: str, workers: int,
                 kills: Kills, until: float, record: Record) -> None:  # fmt: skip
    """Those of the runs as a sweep, killed and given again, which is stopped at `until`. Recorded are the figures of all jobs, of
    the complete ones where it was stopped."""
    folder.mkdir()
    sweep = ["-m", "--config-dir", str(folder / "conf"), *common, f"hydra/launcher={launcher}", "resume=auto",
             *([f"hydra.launcher.n_jobs={workers}"] if launcher == "joblib" else []),
             experiments([sets[k] for k in numbers], folder),
             f"hydra.sweep.dir={folder}/sweep", "hydra.sweep.subdir=${hydra.job.num}"]  # fmt: skip
    met, began, code = [], time.perf_counter(), None
    while code is None:
        process = started(sweep, folder / "sweep.log")
        pause = kills.generator.uniform(*kills.span) if len(met) < kills.most else 1800.0
        pause = max(0.0, min(pause, until - time.perf_counter()))
        try:
            code = process.wait(pause)
        except subprocess.TimeoutExpired:
            done = len(list((folder / "sweep").glob("*/metrics.json")))
            # as when the machine goes down: submitit's jobs are no children of the process that launched them
            os.killpg(
                process.pid, signal.SIGKILL
            )  # joblib's workers, which name no folder and would end their jobs first
            ended(processes_with(str(folder)))
            process.wait()
            time.sleep(0.5)
            if time.perf_counter() > until:
                break
            met.append(len(numbers) - done)
            print(
                f"{launcher}: kill {len(met)} with {done} of {len(numbers)} jobs complete",
                flush=True,
            )
    logs = [(folder / "sweep" / str(k) / "train.log") for k in range(len(numbers))]
    texts = [log.read_text() if log.is_file() else "" for log in logs]
    resumed = {name: sum(line in text for text in texts) for name, line in RESUMED.items()}
    for place, number in enumerate(numbers):
        found = figures(folder / "sweep" / str(place))
        if code is not None or good(found):
            record.put(launcher, number, found)
    if code:
        print((folder / "sweep.log").read_text()[-3000:], flush=True)
    record.note("sweeps", {"launcher": launcher, "jobs": len(numbers), "code": code, "met": met, "resumed": resumed,
                           "took": time.perf_counter() - began})  # fmt: skip


def runs(options: argparse.Namespace, folder: Path) -> list[Row]:
    """Portion by portion: the runs by themselves, then the same ones as a sweep; the first ones by submitit's local executor, then
    all of them by joblib."""
    began = time.perf_counter()
    until = began + options.until
    sets = drawn(options.runs, random.Random(options.seed))
    own = [*SMALL, "simulation.particles=100", *options.smaller]
    record = Record(options.record, {"seed": options.seed, "overrides": own})
    common = [*own, f"scene.cache={folder}/cache"]
    (folder / "alone").mkdir()
    generator = random.Random(f"{options.seed} {len(record.content['sweeps'])}")
    portion, place = options.portion or len(sets), 0
    while time.perf_counter() < until:
        asked = {
            "joblib": range(len(sets)),
            "submitit_local": range(min(options.launched, len(sets))),
        }
        missing = {
            kind: [k for k in asked[kind] if k not in record.compared(kind)] for kind in SWEEPS
        }
        if not any(missing.values()):
            break
        # the one whose runs by themselves are there
        launcher = min((kind for kind in SWEEPS if missing[kind]),
                       key=lambda kind: len(set(missing[kind]) - set(record.of_kind("alone"))))  # fmt: skip
        # submitit's local executor starts all of its jobs at once
        numbers = missing[launcher][
            : portion if launcher == "joblib" else min(portion, options.workers)
        ]
        by_themselves(sets, [k for k in numbers if k not in record.of_kind("alone")], folder / "alone", common, options.workers,
                      until, record)  # fmt: skip
        numbers = [k for k in numbers if k in record.of_kind("alone")]
        if numbers and time.perf_counter() < until:
            kills = Kills(options.kills, tuple(options.between), generator)
            if (
                launcher == "submitit_local" and record.seconds
            ):  # and so is at its end when one run is
                kills = Kills(1, (0.3 * min(record.seconds), 0.9 * min(record.seconds)), generator)
            killed_sweep(sets, numbers, folder / f"{launcher}_{place}", common, launcher, options.workers, kills, until,
                         record)  # fmt: skip
        place += 1
    time.sleep(2.0)  # for what ends by itself: joblib's trackers
    # at a stop nobody has had the time to clear up
    alive, left = (
        processes_with(str(folder)),
        leftovers(folder) if time.perf_counter() < until else [],
    )
    print("\n".join(left))
    record.note("left", [len(alive), len(left)])
    return [told(row) for row in rows_of(record, options)]


def rows_of(record: Record, options: argparse.Namespace) -> list[Row]:
    complete, wrong, versions = record.complete(), record.wrong(), len(record.content["figures"])
    rows = [Row("drawn runs, each in a process of its own", f"{options.runs}, all complete",
                f"{len(complete)} complete, {len(wrong)} failed ({versions} versions)",
                not wrong and len(complete) >= options.runs)]  # fmt: skip
    for launcher, count in (("joblib", options.runs), ("submitit_local", options.launched)):
        if not count:
            continue
        sweeps = [s for s in record.content["sweeps"] if s["launcher"] == launcher]
        compared = record.compared(launcher)
        differ = {k: names for k, names in compared.items() if names}
        for k, names in differ.items():
            print(f"run {k} differs: {names[:8]}")
        codes = sorted({s["code"] for s in sweeps if s["code"] is not None})
        stopped = sum(s["code"] is None for s in sweeps)
        met = [m for s in sweeps for m in s["met"]]
        resumed = ", ".join(f"{sum(s['resumed'][name] for s in sweeps)} {name}" for name in RESUMED)
        found = (f"{len(compared)} made again, {len(differ)} with figures that differ, exit codes {codes}, {stopped} sweeps "
                 f"stopped; {len(met)} kills met {sum(met)} unfinished jobs; when given again {resumed}; "
                 f"{sum(s['took'] for s in sweeps):.0f} s")  # fmt: skip
        killed = sum(met) > 0 or not (options.kills if launcher == "joblib" else 1)
        rows.append(Row(f"the same as a sweep of {launcher}, killed and resumed",
                        f"{count}, 0 differ, exit code 0" + (", a kill met some" if options.kills else ""), found,
                        len(compared) >= count and not differ and codes == [0] and killed))  # fmt: skip
    alive, left = (sum(each) for each in zip(*record.content["left"]))
    rows.append(Row("left behind by them", "nothing", f"{alive} processes, {left} half-written files or locks",
                    not alive and not left))  # fmt: skip
    return rows

"""Many runs: in a row, side by side, killed and resumed; and many rollouts in one process.

    OMP_NUM_THREADS=1 python benchmarks/long_runs.py                     # small: about ten minutes on two cores
    OMP_NUM_THREADS=1 python benchmarks/long_runs.py --runs 60 --kills 40 --rollouts 20000
    OMP_NUM_THREADS=1 python benchmarks/long_runs.py --launcher submitit_local

Runs are drawn (law, criterion, adapter, numbers of the fit) on the tiny scene. The same ones are made one after the other, then as
a sweep of a launcher (the extra `sweep`), which is killed with SIGKILL, with all of its processes, at drawn moments and started
again with resume=auto until it is complete. Told: exit codes, which figures differ between the two (times apart), what is left
behind (processes, half-written files, locks), and by how much a process's memory grows over rollouts.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch

ROOT = Path(__file__).parents[1]
SMALL = ["debug=default", "evaluation.video=false", "logger=none", "simulation.particles=100",
         "reconstruction.static.iterations=60", "reconstruction.appearance.iterations=60",
         "reconstruction.dynamic.iterations=30"]  # fmt: skip
CHOICES = {
    "prior": ["corotated", "neo_hookean", "linear", "stvk"], "criterion": ["corrected", "free"], "adapter": ["operator", "none"],
    "fit.joint.newton_iterations": [1, 2], "identification.count": [20.0, 30.0],
}  # fmt: skip


def drawn(count: int, generator: random.Random) -> list[list[str]]:
    """So many different sets of overrides, as far as there are."""
    found: list[list[str]] = []
    for _ in range(100 * count):
        one = [f"{key}={generator.choice(values)}" for key, values in CHOICES.items()]
        if one not in found:
            found.append(one)
        if len(found) == count:
            break
    return found


def environment() -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}


def started(arguments: list[str], log: Path) -> subprocess.Popen:
    with open(log, "a") as file:
        return subprocess.Popen([sys.executable, str(ROOT / "train.py"), *arguments], cwd=ROOT, env=environment(), stdout=file,
                                stderr=file, start_new_session=True)  # fmt: skip


def figures(folder: Path) -> dict:
    """Of a run, without what depends on the clock and the machine."""
    found = json.loads((folder / "metrics.json").read_text())
    return {key: value for key, value in found.items() if not key.startswith("time/")}


def processes_with(text: str) -> list[int]:
    """Of this machine's processes, those whose command line or folder names `text`."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            told = (place / "cmdline").read_bytes().decode(errors="ignore") + os.readlink(place / "cwd")
        except OSError:
            continue
        if text in told and int(place.name) != os.getpid():
            found.append(int(place.name))
    return found


def leftovers(*folders: Path) -> list[str]:
    marks = (".partial", ".tmp", ".lock")
    return [str(file) for folder in folders for file in folder.rglob("*") if file.name.endswith(marks)]


def in_a_row(sets: list[list[str]], folder: Path, common: list[str]) -> list[dict]:
    """The runs one after the other; their figures."""
    made = []
    for k, overrides in enumerate(sets):
        began = time.perf_counter()
        code = started([*common, *overrides, f"hydra.run.dir={folder}/{k}"], folder / f"{k}.log").wait(900)
        print(f"run {k}: exit {code}, {time.perf_counter() - began:.0f} s: {' '.join(overrides)}", flush=True)
        made.append(figures(folder / str(k)) if code == 0 else {"exit": code})
    return made


def killed_sweep(sets: list[list[str]], folder: Path, common: list[str], launcher: str, kills: int, span: tuple[float, float],
                 generator: random.Random) -> tuple[list[dict], int]:  # fmt: skip
    """The same runs as a sweep, killed `kills` times, then left alone; (their figures, jobs that a kill met unfinished)."""
    # one experiment file per set: a sweep goes through them
    conf = folder / "conf" / "experiment"
    conf.mkdir(parents=True)
    for k, overrides in enumerate(sets):
        groups = [f"  - override /{key}: {value}" for key, value in (o.split("=") for o in overrides) if "." not in key]
        lines = ["# @package _global_", "defaults:", *groups]
        tree: dict = {}
        for key, value in (o.split("=") for o in overrides if "." in o.split("=")[0]):
            at = tree
            *path, last = key.split(".")
            for part in path:
                at = at.setdefault(part, {})
            at[last] = json.loads(value)
        lines += [f"{key}: {json.dumps(value)}" for key, value in tree.items()]
        (conf / f"drawn_{k}.yaml").write_text("\n".join(lines) + "\n")
    names = ",".join(f"drawn_{k}" for k in range(len(sets)))
    sweep = ["-m", "--config-dir", str(folder / "conf"), *common, f"hydra/launcher={launcher}", "resume=auto",
             *(["hydra.launcher.n_jobs=2"] if launcher == "joblib" else []), f"experiment={names}",
             f"hydra.sweep.dir={folder}/sweep", "hydra.sweep.subdir=${hydra.job.num}"]
    met = 0
    for _ in range(kills):
        process, wait = started(sweep, folder / "sweep.log"), generator.uniform(*span)
        try:
            process.wait(wait)
            break  # it was faster than the kill
        except subprocess.TimeoutExpired:
            done = len(list((folder / "sweep").glob("*/metrics.json")))
            met += len(sets) - done
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            time.sleep(1.0)
            print(f"killed after {wait:.0f} s with {done} of {len(sets)} jobs complete; processes left: "
                  f"{len(processes_with(str(folder / 'sweep')))}", flush=True)  # fmt: skip
    code = started(sweep, folder / "sweep.log").wait(1800)
    print(f"sweep resumed: exit {code}", flush=True)
    made = [folder / "sweep" / str(k) for k in range(len(sets))]
    return [figures(f) if (f / "metrics.json").is_file() else {} for f in made], met


def growth_of_rollouts(checkpoint: Path, count: int) -> tuple[float, float]:
    """(MB of this process's memory that `count` drawn rollouts add after a tenth of them, rollouts a second)."""
    from mosa.twin import Twin

    def resident() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

    twin, generator = Twin.load(checkpoint), torch.Generator().manual_seed(0)
    early, began = 0.0, time.perf_counter()
    for k in range(count):
        if k == count // 10:
            early = resident()
        speed, turn = torch.randn(3, generator=generator), torch.randn(4, generator=generator)
        height = 0.1 + 0.2 * float(torch.rand(1, generator=generator))
        twin.simulate(rotation=[*turn[:3].tolist(), 90 * float(turn[3])], height=height, velocity=speed.tolist(), frames=8)
    return resident() - early, count / (time.perf_counter() - began)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=4)
    parser.add_argument("--kills", type=int, default=3)
    parser.add_argument("--rollouts", type=int, default=400)
    parser.add_argument("--between", type=float, nargs=2, default=(15.0, 60.0), help="seconds until a kill")
    parser.add_argument("--launcher", default="joblib", help="joblib | submitit_local")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    generator = random.Random(options.seed)
    sets = drawn(options.runs, generator)
    with tempfile.TemporaryDirectory(prefix="mosa_long_") as place:
        folder = Path(place)
        common = [*SMALL, f"scene.cache={folder}/cache"]
        first = in_a_row(sets, folder, common)
        second, met = killed_sweep(sets, folder, common, options.launcher, options.kills, tuple(options.between), generator)
        wrong = [k for k, (a, b) in enumerate(zip(first, second)) if a != b or "exit" in a]
        left = leftovers(folder)
        alive = processes_with(place)
        added, rate = growth_of_rollouts(folder / "0" / "checkpoints" / "last.ckpt", options.rollouts)
        print(f"\n{len(sets)} runs in a row and as a sweep ({options.launcher}): {len(wrong)} with figures that differ\n"
              f"{options.kills} kills met {met} unfinished jobs\n"
              f"left: {len(alive)} processes, {len(left)} half-written files or locks\n"
              f"{options.rollouts} rollouts in one process: {added:.1f} MB added after the first tenth, {rate:.1f} a second")
        for k in wrong:
            told = {key for key in {*first[k], *second[k]} if first[k].get(key) != second[k].get(key)}
            print(f"run {k} differs: {' '.join(sets[k])}: {sorted(told)[:8]}")
        print("\n".join(left))
    sys.exit(1 if wrong or alive or left else 0)


if __name__ == "__main__":
    main()

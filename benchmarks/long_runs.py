"""Many runs, killed and resumed, many rollouts in one process, and equal runs on a GPU: what leaks, differs or is left behind.

    OMP_NUM_THREADS=1 python benchmarks/long_runs.py                     # small: about fifteen minutes on two cores
    OMP_NUM_THREADS=1 python benchmarks/long_runs.py --runs 200 --workers 30 --kills 2 --between 70 110 --launched 24 \\
        --rollouts 21600 --frames 4 --particles 1000 --device cuda       # all of it, on 32 cores and two GPUs
    OMP_NUM_THREADS=1 python benchmarks/long_runs.py --parts rollouts --rollouts 2000

Three parts, side by side where there are GPUs:

- runs: drawn ones (law, criterion, adapter, numbers of the fit, seed) on the tiny scene, each in a process of its own, `workers`
  beside each other. The same ones then as a sweep of joblib, and the first `launched` of them also of submitit's local executor.
  Every process of a sweep is killed with SIGKILL at drawn moments, and the same command is given again, with resume=auto, until
  it has come to its end. One after the other, or all three beside each other (--abreast).
- rollouts: `rollouts` drawn drops of one body in one process, of `frames` frames. 21,600 are a day of them on a CPU, of 4 s each.
  Every hundredth is made twice and compared.
- equality (with --device cuda): two runs that are given the same, and two with deterministic=true; and what that costs a rollout
  with and without gradient. Without it two runs are to agree within what each says that it does not know (`apart`). The first two
  alone: --parts equality --pairs plain.

One table at the end; exit code 1 where a row is not as asked: figures that differ, a process, half-written file or lock that is
left, memory, file handles or threads that grow. The launchers are the extra `sweep`; a part whose launcher is not installed fails.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

ROOT = Path(__file__).parents[1]
SMALL = ["debug=default", "evaluation.video=false", "logger=none", "reconstruction.static.iterations=60",
         "reconstruction.appearance.iterations=60", "reconstruction.dynamic.iterations=30", "identification.threads=1"]  # fmt: skip
CHOICES = {
    "prior": ["corotated", "neo_hookean", "linear", "stvk"], "criterion": ["corrected", "free"], "adapter": ["operator", "none"],
    "fit.joint.newton_iterations": [1, 2], "identification.count": [20.0, 30.0], "seed": [0, 1, 2, 3],
}  # fmt: skip
MARKS = (".partial", ".tmp", ".lock")
PARTS = ("runs", "rollouts", "equality")
GROWTH = 20.0
"""MB that a process's memory may differ by after thousands of rollouts: an allocator's pools, not a leak of each."""
FASTEST = 2.0
"""[m/s] along each axis, of drawn drops."""
AGREE = 0.05
"""Share that two equal runs on a GPU, where sums are added in any order, may add to what a run says it does not know, and share by
which their errors may differ."""
SPREADS = (2 * ((1 + AGREE) ** 2 - 1)) ** 0.5
"""Standard deviations that two equal runs may be apart, 0.45: each is then off their middle by that over the root of two, and such
a scatter of its own widens a standard deviation s to s (1 + SPREADS^2 / 2)^(1/2) = (1 + AGREE) s."""


class Row(NamedTuple):
    what: str
    asked: str
    found: str
    met: bool


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
    return {key: value for key, value in json.loads(path.read_text()).items() if not key.startswith("time/")}


def processes_with(text: str) -> list[int]:
    """Of this machine's processes, those whose command line or folder names `text`, but this one and those that run parts."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            told = (place / "cmdline").read_bytes().decode(errors="ignore")
            folder = os.readlink(place / "cwd")
        except OSError:
            continue
        if text in told + folder and "long_runs.py" not in told:
            found.append(int(place.name))
    return found


def leftovers(*folders: Path) -> list[str]:
    return [str(file) for folder in folders for file in folder.rglob("*") if file.name.endswith(MARKS)]


class Swept(NamedTuple):
    """Of the runs with these numbers what a sweep left, after `kills` kills that met so many unfinished jobs."""

    launcher: str
    numbers: list[int]
    found: list[dict]
    code: int
    kills: int
    met: int
    took: float


def told(row: Row) -> Row:
    print(f"[{time.strftime('%H:%M:%S')}] {row.what}: {row.found}{'' if row.met else '   <- NOT AS ASKED'}", flush=True)
    return row


# -------------------------------------------------------------------------------------------------------------------------- runs


def by_themselves(sets: list[list[str]], folder: Path, common: list[str], workers: int, within: float,
                  compiled: threading.Event) -> list[dict | None]:  # fmt: skip
    """The runs, each in a process of its own, `workers` beside each other; their figures, None for one that would have begun after
    `within` seconds. `compiled` is set once the first of each law is complete."""

    began = time.perf_counter()

    def one(k: int) -> dict | None:
        if time.perf_counter() - began > within:
            return None
        code = started([*common, *sets[k], f"hydra.run.dir={folder}/{k}"], folder / f"{k}.log").wait(900)
        return figures(folder / str(k)) if code == 0 else {"exit code": code}

    # the first of each law first, alone with the kernels that it compiles
    laws = [next(k for k, s in enumerate(sets) if s[0] == law) for law in sorted({s[0] for s in sets})]
    with ThreadPoolExecutor(workers) as pool:
        try:
            found = dict(zip(laws, pool.map(one, laws)))
        finally:  # whoever waits for it would wait for ever
            compiled.set()
        others = [k for k in range(len(sets)) if k not in found]
        found |= dict(zip(others, pool.map(one, others)))
    return [found[k] for k in range(len(sets))]


def experiments(sets: list[list[str]], folder: Path) -> str:
    """One experiment file per set: what a sweep goes through, as its override."""
    conf = folder / "conf" / "experiment"
    conf.mkdir(parents=True)
    for k, overrides in enumerate(sets):
        pairs = [override.split("=") for override in overrides]
        groups = [f"  - override /{key}: {value}" for key, value in pairs if "." not in key and key != "seed"]
        tree: dict = {}
        for key, value in pairs:
            if "." in key or key == "seed":
                *path, last = key.split(".")
                at = tree
                for part in path:
                    at = at.setdefault(part, {})
                at[last] = json.loads(value)
        lines = ["# @package _global_", "defaults:", *groups, *(f"{key}: {json.dumps(value)}" for key, value in tree.items())]
        (conf / f"drawn_{k}.yaml").write_text("\n".join(lines) + "\n")
    return "experiment=" + ",".join(f"drawn_{k}" for k in range(len(sets)))


def killed_sweep(sets: list[list[str]], folder: Path, common: list[str], launcher: str, workers: int, kills: int,
                 span: tuple[float, float], generator: random.Random) -> tuple[list[dict], int, int, int]:  # fmt: skip
    """The same runs as a sweep, killed at most `kills` times and given again.

    Returns (their figures, exit code of the last, kills, jobs that a kill met unfinished)."""
    folder.mkdir()
    sweep = ["-m", "--config-dir", str(folder / "conf"), *common, f"hydra/launcher={launcher}", "resume=auto",
             *([f"hydra.launcher.n_jobs={workers}"] if launcher == "joblib" else []), experiments(sets, folder),
             f"hydra.sweep.dir={folder}/sweep", "hydra.sweep.subdir=${hydra.job.num}"]  # fmt: skip
    met = count = 0
    while True:
        process = started(sweep, folder / "sweep.log")
        try:
            code = process.wait(generator.uniform(*span) if count < kills else 1800)
            break
        except subprocess.TimeoutExpired:
            done = len(list((folder / "sweep").glob("*/metrics.json")))
            met, count = met + len(sets) - done, count + 1
            # as when the machine goes down: submitit's jobs are no children of the process that launched them
            for number in {process.pid, *processes_with(str(folder))}:
                try:
                    os.kill(number, signal.SIGKILL)
                except ProcessLookupError:
                    continue
            process.wait()
            time.sleep(0.5)
            print(f"{launcher}: kill {count} with {done} of {len(sets)} jobs complete", flush=True)
    return [figures(folder / "sweep" / str(k)) for k in range(len(sets))], code, count, met


def runs(options: argparse.Namespace, folder: Path) -> list[Row]:
    sets = drawn(options.runs, random.Random(options.seed))
    common = [*SMALL, "simulation.particles=100", *options.smaller, f"scene.cache={folder}/cache"]
    (folder / "alone").mkdir()
    compiled = threading.Event()

    def timed_alone() -> tuple[list[dict | None], float]:
        began = time.perf_counter()
        return by_themselves(sets, folder / "alone", common, options.workers, options.within, compiled), time.perf_counter() - began

    def swept(launcher: str, count: int, kills: int) -> Swept:
        compiled.wait()
        # beside each other nobody knows yet which of the runs begin too late
        numbers = [k for k in range(len(sets)) if options.abreast or alone.result()[0][k] is not None][:count]
        began, generator = time.perf_counter(), random.Random(f"{options.seed} {launcher}")
        found = killed_sweep([sets[k] for k in numbers], folder / launcher, common, launcher, options.workers, kills,
                             tuple(options.between), generator)  # fmt: skip
        return Swept(launcher, numbers, *found, time.perf_counter() - began)

    sweeps = [sweep for sweep in (("joblib", len(sets), options.kills), ("submitit_local", options.launched, 1)) if sweep[1]]
    with ThreadPoolExecutor(1 + len(sweeps) if options.abreast else 1) as pool:
        alone = pool.submit(timed_alone)
        jobs = [pool.submit(swept, *sweep) for sweep in sweeps]
        (found, took), again = alone.result(), [job.result() for job in jobs]
    complete = [k for k, each in enumerate(found) if each is not None]
    wrong = [k for k in complete if "exit code" in found[k] or "metrics.json" in found[k]]
    for k in wrong:
        print(f"run {k} failed: {' '.join(sets[k])}: {(folder / 'alone' / f'{k}.log').read_text()[-1500:]}")
    rows = [told(Row(f"drawn runs, {options.workers} beside each other", f"{options.runs}, all complete",
                     f"{len(complete) - len(wrong)} of {len(complete)}, {took:.0f} s",
                     not wrong and len(complete) == options.runs))]  # fmt: skip
    rows += [against(sweep, sets, found, folder) for sweep in again]
    time.sleep(2.0)  # for what ends by itself: joblib's trackers
    alive, left = processes_with(str(folder)), leftovers(folder)
    print("\n".join(left))
    rows.append(told(Row("left behind by them", "nothing", f"{len(alive)} processes, {len(left)} half-written files or locks",
                         not alive and not left)))  # fmt: skip
    return rows


def against(sweep: Swept, sets: list[list[str]], alone: list[dict | None], folder: Path) -> Row:
    """A sweep's figures beside those of the same runs by themselves."""
    differ = [k for k, found in zip(sweep.numbers, sweep.found) if alone[k] is not None and found != alone[k]]
    for k, again in zip(sweep.numbers, sweep.found):
        if k in differ:
            names = sorted(name for name in {*alone[k], *again} if alone[k].get(name) != again.get(name))
            print(f"run {k} differs: {' '.join(sets[k])}: {names[:8]}")
    if sweep.code or differ:
        print((folder / sweep.launcher / "sweep.log").read_text()[-3000:])
    count = len(sweep.numbers)
    what = f"the {'same' if count == len(sets) else f'first {count}'} as a sweep of {sweep.launcher}, killed and resumed"
    asked = "0 differ, exit code 0" + (", a kill met some" if sweep.kills else "")
    found = (f"{len(differ)} with figures that differ, exit code {sweep.code}, {sweep.kills} kills met {sweep.met} unfinished "
             f"jobs, {sweep.took:.0f} s")  # fmt: skip
    return told(Row(what, asked, found, not differ and sweep.code == 0 and (sweep.met > 0 or not sweep.kills)))


# ---------------------------------------------------------------------------------------------------------------------- rollouts


def resident() -> float:
    """MB of this process's memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def on_device(device: str) -> float:
    """MB of the GPU that this process has, or all of its processes where the driver tells no more."""
    if device == "cpu":
        return 0.0
    with contextlib.suppress(ImportError):
        import pynvml

        pynvml.nvmlInit()
        card = pynvml.nvmlDeviceGetHandleByUUID(f"GPU-{torch.cuda.get_device_properties(0).uuid}")
        own = [each.usedGpuMemory for each in pynvml.nvmlDeviceGetComputeRunningProcesses(card) if each.pid == os.getpid()]
        if own and own[0] is not None:
            return own[0] / 1e6
    free, total = torch.cuda.mem_get_info()
    return (total - free) / 1e6


def checkpoint(folder: Path, particles: int, device: str, gpu: int | None) -> Path:
    """Of a small run whose body has so many particles."""
    where = [] if device == "cpu" else ["trainer=gpu"]
    size, places = f"simulation.particles={particles}", [f"scene.cache={folder}/cache", f"hydra.run.dir={folder}/run"]
    code = started([*SMALL, *where, size, *places], folder / "run.log", gpu).wait(900)
    if code:
        raise SystemExit(f"the run that makes the body ended with {code}:\n{(folder / 'run.log').read_text()[-3000:]}")
    return folder / "run" / "checkpoints" / "last.ckpt"


def rollouts(options: argparse.Namespace, folder: Path) -> list[Row]:
    """In this process: it is the one whose memory is looked at."""
    from mosa.twin import Twin

    path = checkpoint(folder, options.particles, options.device, None)
    twin, generator = Twin.load(path, options.device), torch.Generator().manual_seed(options.seed)
    counts = {"MB of memory": resident, "MB of the GPU": lambda: on_device(options.device),
              "file handles": lambda: len(os.listdir("/proc/self/fd")), "threads": threading.active_count}  # fmt: skip
    early, differ, apart, made, began = {}, 0, 0.0, 0, time.perf_counter()
    temporary = set(Path(tempfile.gettempdir()).glob("*"))
    for k in range(options.rollouts):
        if k == max(1, options.rollouts // 10):
            early = {name: count() for name, count in counts.items()}
        # one drop in thousands is so fast that it leaves the world's box, and is refused
        speed, turn = torch.randn(3, generator=generator).clamp(-FASTEST, FASTEST), torch.randn(4, generator=generator)
        height = 0.1 + 0.2 * float(torch.rand(1, generator=generator))
        start = {"rotation": [*turn[:3].tolist(), 90 * float(turn[3])], "height": height, "velocity": speed.tolist(),
                 "frames": options.frames}  # fmt: skip
        found = twin.simulate(**start).x
        if k % 100 == 0:
            distance = float((twin.simulate(**start).x - found).norm(dim=-1).max()) / twin.body.settings.dx
            differ, apart = differ + (distance > 0), max(apart, distance)
        made = k + 1
        if time.perf_counter() - began > options.seconds:
            break
    took = time.perf_counter() - began
    grown = {name: count() - early.get(name, count()) for name, count in counts.items()}
    new = sorted(p.name for p in set(Path(tempfile.gettempdir()).glob("*")) - temporary if p.stat().st_uid == os.getuid())
    what = f"{made} rollouts of {options.frames} frames, {len(twin.body.rest)} particles, one process on {options.device}"
    asked = f"{options.rollouts}; at most {GROWTH:g} MB, 0 handles, 0 threads added"
    rows = [told(Row(what, asked, f"{made / took:.1f} a second; after the first tenth " + ", ".join(
        f"{value:+.1f} {name}" if "MB" in name else f"{value:+d} {name}" for name, value in grown.items()),
        made == options.rollouts and max(grown["MB of memory"], grown["MB of the GPU"]) <= GROWTH
        and grown["file handles"] <= 0 and grown["threads"] <= 0))]  # fmt: skip
    bound = "bit for bit" if options.device == "cpu" else "within 0.01 cells"
    found = f"{differ} of {-(-made // 100)} differ, at most {apart:.2g} cells"
    met = differ == 0 if options.device == "cpu" else apart < 0.01
    rows.append(told(Row("every hundredth of them made twice", bound, found, met)))
    what = "left in the temporary folder while they ran (by anyone)"
    rows.append(told(Row(what, "reported", ", ".join(new[:5]) or "nothing", True)))
    return rows


# ---------------------------------------------------------------------------------------------------------------------- equality


class Compared(NamedTuple):
    """A figure of two equal runs. far: how far they are apart in `unit`s of which at most `bound` are allowed."""

    name: str
    values: str
    far: float
    unit: str
    bound: float

    @property
    def line(self) -> str:
        return f"{self.name} {self.values}, {self.far:.3g} {self.unit} apart (bound {self.bound:.2g})"


def rms(vectors: np.ndarray) -> float:
    """Root of the mean square length."""
    return float(np.sqrt(np.square(vectors).sum(-1).mean()))


def arrays(path: Path) -> dict[str, np.ndarray]:
    if not path.is_file():
        return {}
    with np.load(path) as stored:
        return {key: stored[key] for key in stored.files}


def apart(a: Path, b: Path) -> tuple[list[str], list[Compared]]:
    """(names of the figures and motions of two runs that are not the same bits, what is compared of them, the worst first).

    A number of the law is counted in the standard deviations that the runs' own posterior gives it, a motion in those that it
    predicts for the positions, an error of positions in that error: relative differences of a number that is near 0 (nu is) would
    say nothing."""
    one, other = figures(a), figures(b)
    differ = sorted(name for name in {*one, *other} if one.get(name) != other.get(name))
    found: list[Compared] = []
    for name, key in {"E": "E_relative_sd", "nu": "nu_sd", "stiffness_ratio": "stiffness_ratio_sd"}.items():
        x, y, sd = one.get(f"id/{name}"), other.get(f"id/{name}"), one.get(f"posterior/{key}")
        if x is not None and y is not None and sd is not None:
            sd = sd * x if key == "E_relative_sd" else sd
            found.append(Compared(name, f"{x:.4g} and {y:.4g}", abs(x - y) / sd, "standard deviations", SPREADS))
    for name in ("train/rms_m", "test/rms_m", "prior/train/rms_m", "prior/test/rms_m"):
        if name in one and name in other:
            x, y = one[name], other[name]
            found.append(Compared(name, f"{1e3 * x:.2f} and {1e3 * y:.2f} mm", abs(x - y) / x, "of the error", AGREE))
    for name in ("rollout.npz", "prior.npz"):
        x, y, spread = arrays(a / name), arrays(b / name), arrays(a / "uncertainty.npz")
        same = [key for key in x if key in y and x[key].shape == y[key].shape]
        differ += [f"{name}:{key}" for key in {*x, *y} if key not in same or not np.array_equal(x[key], y[key])]
        for key in same:
            sd = spread.get(f"{key.removesuffix('/x')}/sd")
            if name == "rollout.npz" and key.endswith("/x") and sd is not None:
                far, most = x[key].astype(float) - y[key], float(np.sqrt(np.square(sd).mean()))
                said = f"{1e3 * rms(far):.2f} mm rms, {1e3 * np.linalg.norm(far, axis=-1).max():.2f} at most"
                found.append(Compared(f"motion {key}", said, rms(far) / most, "standard deviations", SPREADS))
    return differ, sorted(found, key=lambda c: -c.far / c.bound)


def price(gpu: int | None = None) -> str:
    """What exact sums cost a rollout, with and without gradient: benchmarks/rollout.py's body, in a process each."""
    seconds = {}
    for exact in (False, True):
        code = (f"import sys; sys.path.insert(0, {str(ROOT / 'benchmarks')!r}); import long_runs; "
                f"long_runs.timed({exact})")  # fmt: skip
        made = subprocess.run([sys.executable, "-c", code], env=environment(gpu), cwd=ROOT, capture_output=True, text=True)
        if made.returncode:
            return f"not measured: {' '.join(made.stderr.split())[-300:]}"
        seconds[exact] = json.loads(made.stdout.splitlines()[-1])
    return "; ".join(f"{name} {1e3 * plain:.2f} -> {1e3 * seconds[True][name]:.2f} ms ({seconds[True][name] / plain:.2f} times)"
                     for name, plain in seconds[False].items())  # fmt: skip


def timed(exact: bool, device: str = "cuda") -> None:
    """Print the seconds of a frame of 64 substeps, by particles, forward and with gradient, as JSON."""
    from mosa import exact_sums
    from mosa.physics.contact.planes import Plane
    from mosa.physics.engine.simulator import Simulator
    from mosa.types import ParticleState

    exact_sums.use(exact)
    found = {}
    for edge in (16, 32):
        dx, axis = 1.0 / (1.2 * edge), torch.arange(edge)
        x = (0.1 + dx / 2 * (torch.cartesian_prod(axis, axis, axis) + 0.5)).to(device)
        eye = torch.eye(3, device=device).expand(len(x), 3, 3).contiguous()
        state = ParticleState(x, torch.zeros_like(x), 0 * eye, eye, eye)
        simulator = Simulator("corotated", dx=dx, substeps=64, frame_dt=64 * 2e-4 / edge * 16, gravity=(0, -9.8, 0), up=(0, 1, 0),
                              planes=[Plane((0, 0.1, 0), (0, 1, 0))], device=device)  # fmt: skip
        volume = torch.full((len(x),), (dx / 2) ** 3, device=device)
        for name, wanted in (("forward", False), ("with gradient", True)):
            times = []
            for _ in range(6):
                mu = torch.tensor(4e4, device=device, requires_grad=wanted)
                if device != "cpu":
                    torch.cuda.synchronize()
                began = time.perf_counter()
                out = simulator.rollout(state, {"mu": mu, "lam": 5e4}, volume, 1000.0, 6)
                if wanted:
                    out.x.square().sum().backward()
                if device != "cpu":
                    torch.cuda.synchronize()
                times.append((time.perf_counter() - began) / 5)
            found[f"{len(x)} particles {name}"] = min(times)
    print(json.dumps(found))


def equality(options: argparse.Namespace, folder: Path) -> list[Row]:
    """Two runs of each kind (`--pairs`), all beside each other so that their times compare."""
    where = ["trainer=gpu"] if options.device != "cpu" else []
    common = [*(options.equal or ["debug=default"]), *where, "evaluation.video=false", "logger=none"]
    began, pairs = time.perf_counter(), [(kind, k) for kind in options.pairs for k in (0, 1)]
    if len(options.pairs) > 1:  # kernels: the time to compile them is no price of anything
        short = ["fit.prior.iterations=1", "fit.joint.iterations=0", "fit.prior_eta.iterations=0", "evaluation.floor=false"]
        places = [f"scene.cache={folder}/warm_cache", f"hydra.run.dir={folder}/warm"]
        started([*common, *short, *places], folder / "warm.log").wait(900)

    def one(pair: tuple[str, int]) -> int:
        name = f"{pair[0]}_{pair[1]}"
        # XDG_CACHE_HOME stays: of kernels; a reconstruction that is found in a cache would be the same without any merit
        return started([*common, f"deterministic={str(pair[0] == 'exact').lower()}", f"scene.cache={folder}/{name}_cache",
                        f"hydra.run.dir={folder}/{name}"], folder / f"{name}.log").wait(900)  # fmt: skip

    with ThreadPoolExecutor(len(pairs)) as pool:
        codes = list(pool.map(one, pairs))
    if any(codes):
        logs = "\n".join((folder / f"{kind}_{k}.log").read_text()[-1500:] for kind, k in pairs)
        return [told(Row("equal runs on a GPU", "complete", f"exit codes {codes}\n{logs}", False))]
    rows = []
    if "plain" in options.pairs:
        differ, compared = apart(folder / "plain_0", folder / "plain_1")
        print("two equal runs:\n" + "\n".join(f"  {each.line}" for each in compared), flush=True)
        asked = f"the law and the motions within {SPREADS:.2f} of their own standard deviations, errors within {AGREE:.0%}"
        over = [each for each in compared if each.far > each.bound]
        found = (f"{len(over)} of {len(compared)} beyond; nearest to its bound: {compared[0].line if compared else 'nothing'}; "
                 f"{len(differ)} figures and arrays are not bit-equal, {time.perf_counter() - began:.0f} s")  # fmt: skip
        rows.append(Row(f"two equal runs on {options.device}", asked, found, bool(compared) and not over))
    if "exact" in options.pairs:
        differ, _ = apart(folder / "exact_0", folder / "exact_1")
        names = f": {', '.join(differ[:6])}" if differ else ""
        rows.append(Row("two with deterministic=true", "all figures and motions bit for bit", f"{len(differ)} differ{names}",
                        not differ))  # fmt: skip
    if len(options.pairs) > 1:
        rows += prices(folder)
    return [told(row) for row in rows]


def prices(folder: Path) -> list[Row]:
    """Of deterministic=true: seconds of the runs, two of each kind, and of a frame."""
    stages = ("reconstruction", "starts", "fit", "evaluation")
    spent = {kind: np.mean([[json.loads((folder / f"{kind}_{k}" / "metrics.json").read_text()).get(f"time/{stage}_s", 0.0)
                             for stage in stages] for k in (0, 1)], axis=0) for kind in ("plain", "exact")}  # fmt: skip
    each = ", ".join(f"{stage} {a:.0f} -> {b:.0f}" for stage, a, b in zip(stages, spent["plain"], spent["exact"]))
    whole = f"{spent['plain'].sum():.0f} -> {spent['exact'].sum():.0f} s {each}"
    return [Row("price of it: a whole run, four beside each other", "reported", whole, True),
            Row("price of it: a frame of 64 substeps", "reported", price(), True)]  # fmt: skip


# -------------------------------------------------------------------------------------------------------------------------- main


def beside(part: str, folder: Path, gpu: int) -> list[Row]:
    """A part in a process of its own, on a GPU of its own."""
    words = [word for word in sys.argv[1:] if word not in PARTS and word != "--parts"]
    code = subprocess.run([sys.executable, __file__, *words, "--parts", part, "--rows", str(folder / "rows.json")], cwd=ROOT,
                          env=environment(gpu)).returncode  # fmt: skip
    if not (folder / "rows.json").is_file():
        return [Row(part, "its rows", f"exit code {code}", False)]
    return [Row(*row) for row in json.loads((folder / "rows.json").read_text())]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=None, help="default: all, without a GPU runs and rollouts")
    parser.add_argument("--device", default="cpu", help="of rollouts and equality: cpu | cuda")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", type=int, default=4)
    parser.add_argument("--within", type=float, default=1e9, help="seconds after which no further run begins; fewer runs fail")
    parser.add_argument("--smaller", nargs="+", default=[], metavar="KEY=VALUE", help="further overrides of the drawn runs")
    parser.add_argument("--workers", type=int, default=2, help="runs beside each other")
    parser.add_argument("--abreast", action="store_true", help="the runs and the sweeps of them beside each other")
    parser.add_argument("--kills", type=int, default=2, help="of joblib's sweep; submitit's is killed once")
    parser.add_argument("--between", type=float, nargs=2, default=(15.0, 60.0), help="seconds until a kill")
    parser.add_argument("--launched", type=int, default=2, help="of the runs, by submitit's local executor")
    parser.add_argument("--rollouts", type=int, default=400)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--particles", type=int, default=100, help="of the body that is rolled out")
    parser.add_argument("--seconds", type=float, default=1e9, help="for rollouts; fewer than asked fail")
    parser.add_argument("--equal", nargs="+", default=None, metavar="KEY=VALUE", help="overrides of the runs that are compared")
    parser.add_argument("--pairs", nargs="+", choices=("plain", "exact"), default=("plain", "exact"),
                        help="equality: runs without, with deterministic=true; the price is measured where both run")
    parser.add_argument("--rows", type=Path, default=None, help="write the rows there, as JSON")
    options = parser.parse_args()
    if options.device != "cpu" and not torch.cuda.is_available():
        parser.error(f"--device {options.device}: torch finds no CUDA device on this machine")
    chosen = options.parts or [part for part in PARTS if part != "equality" or options.device != "cpu"]
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="mosa_long_", ignore_cleanup_errors=True) as place:
        folders = {part: Path(place) / part for part in chosen}
        for folder in folders.values():
            folder.mkdir()
        own = [part for part in chosen if part == "runs" or options.device == "cpu" or len(chosen) == 1]
        gpus = max(1, torch.cuda.device_count()) if options.device != "cpu" else 1
        with ThreadPoolExecutor(len(chosen)) as pool:
            elsewhere = [part for part in chosen if part not in own]
            others = [pool.submit(beside, part, folders[part], i % gpus) for i, part in enumerate(elsewhere)]
            for part in own:
                rows += {"runs": runs, "rollouts": rollouts, "equality": equality}[part](options, folders[part])
            rows += [row for other in others for row in other.result()]
    if options.rows is not None:  # whoever asked for them prints them
        options.rows.write_text(json.dumps(rows))
        return
    print("\n| what | asked | found |\n|---|---|---|")
    for row in rows:
        print(f"| {row.what} | {row.asked} | {'' if row.met else '**NOT AS ASKED:** '}{row.found} |")
    sys.exit(0 if all(row.met for row in rows) else 1)


if __name__ == "__main__":
    main()

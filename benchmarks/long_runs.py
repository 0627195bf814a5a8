"""Many runs, killed and resumed, many rollouts in one process, and equal runs on a GPU: what leaks, differs or is left behind.

    OMP_NUM_THREADS=1 python benchmarks/long_runs.py                     # small: about fifteen minutes on two cores
    OMP_NUM_THREADS=1 python benchmarks/long_runs.py --runs 200 --workers 30 --kills 2 --between 70 110 --launched 24 \\
        --rollouts 21600 --frames 4 --particles 1000 --device cuda       # all of it, on 32 cores and two GPUs
    OMP_NUM_THREADS=1 python benchmarks/long_runs.py --parts runs --runs 200 --workers 14 --portion 100 --launched 28 \\
        --between 70 110 --until 530 --record found.json                 # as far as it comes; the same once more goes on
    OMP_NUM_THREADS=1 python benchmarks/long_runs.py --parts rollouts --rollouts 2000

Three parts, side by side where there are GPUs:

- runs (drawn_runs.py): drawn ones (law, criterion, adapter, numbers of the fit, seed) on the tiny scene, each in a process of its
  own, `workers` beside each other. The same ones then as a sweep of joblib, whose processes make one after the other, and the
  first `launched` of them also of submitit's local executor. Every process of a sweep is killed with SIGKILL at drawn moments, and
  the same command is given again, with resume=auto, until it has come to its end. With --record each figure is kept as it comes,
  --until stops all after so many seconds, and the same command goes on with what is missing; figures are compared where both are
  of the same processor and the same program.
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
from drawn_runs import SMALL, Row, environment, figures, runs, started, told

ROOT = Path(__file__).parents[1]
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
        own = [
            each.usedGpuMemory
            for each in pynvml.nvmlDeviceGetComputeRunningProcesses(card)
            if each.pid == os.getpid()
        ]
        if own and own[0] is not None:
            return own[0] / 1e6
    free, total = torch.cuda.mem_get_info()
    return (total - free) / 1e6


def checkpoint(folder: Path, particles: int, device: str, gpu: int | None) -> Path:
    """Of a small run whose body has so many particles."""
    where = [] if device == "cpu" else ["trainer=gpu"]
    size, places = (
        f"simulation.particles={particles}",
        [f"scene.cache={folder}/cache", f"hydra.run.dir={folder}/run"],
    )
    code = started([*SMALL, *where, size, *places], folder / "run.log", gpu).wait(900)
    if code:
        raise SystemExit(
            f"the run that makes the body ended with {code}:\n{(folder / 'run.log').read_text()[-3000:]}"
        )
    return folder / "run" / "checkpoints" / "last.ckpt"


def rollouts(options: argparse.Namespace, folder: Path) -> list[Row]:
    """In this process: it is the one whose memory is looked at."""
    from mosa.twin.twin import Twin

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
        speed, turn = (
            torch.randn(3, generator=generator).clamp(-FASTEST, FASTEST),
            torch.randn(4, generator=generator),
        )
        height = 0.1 + 0.2 * float(torch.rand(1, generator=generator))
        start = {"rotation": [*turn[:3].tolist(), 90 * float(turn[3])], "height": height, "velocity": speed.tolist(),
                 "frames": options.frames}  # fmt: skip
        found = twin.simulate(**start).x
        if k % 100 == 0:
            distance = (
                float((twin.simulate(**start).x - found).norm(dim=-1).max()) / twin.body.settings.dx
            )
            differ, apart = differ + (distance > 0), max(apart, distance)
        made = k + 1
        if time.perf_counter() - began > options.seconds:
            break
    took = time.perf_counter() - began
    grown = {name: count() - early.get(name, count()) for name, count in counts.items()}
    new = sorted(
        p.name
        for p in set(Path(tempfile.gettempdir()).glob("*")) - temporary
        if p.stat().st_uid == os.getuid()
    )
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
        return (
            f"{self.name} {self.values}, {self.far:.3g} {self.unit} apart (bound {self.bound:.2g})"
        )


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
    for name, key in {
        "E": "E_relative_sd",
        "nu": "nu_sd",
        "stiffness_ratio": "stiffness_ratio_sd",
    }.items():
        x, y, sd = one.get(f"id/{name}"), other.get(f"id/{name}"), one.get(f"posterior/{key}")
        if x is not None and y is not None and sd is not None:
            sd = sd * x if key == "E_relative_sd" else sd
            found.append(
                Compared(
                    name, f"{x:.4g} and {y:.4g}", abs(x - y) / sd, "standard deviations", SPREADS
                )
            )
    for name in ("train/rms_m", "test/rms_m", "prior/train/rms_m", "prior/test/rms_m"):
        if name in one and name in other:
            x, y = one[name], other[name]
            found.append(
                Compared(
                    name,
                    f"{1e3 * x:.2f} and {1e3 * y:.2f} mm",
                    abs(x - y) / x,
                    "of the error",
                    AGREE,
                )
            )
    for name in ("rollout.npz", "prior.npz"):
        x, y, spread = arrays(a / name), arrays(b / name), arrays(a / "uncertainty.npz")
        same = [key for key in x if key in y and x[key].shape == y[key].shape]
        differ += [
            f"{name}:{key}"
            for key in {*x, *y}
            if key not in same or not np.array_equal(x[key], y[key])
        ]
        for key in same:
            sd = spread.get(f"{key.removesuffix('/x')}/sd")
            if name == "rollout.npz" and key.endswith("/x") and sd is not None:
                far, most = x[key].astype(float) - y[key], float(np.sqrt(np.square(sd).mean()))
                said = f"{1e3 * rms(far):.2f} mm rms, {1e3 * np.linalg.norm(far, axis=-1).max():.2f} at most"
                found.append(
                    Compared(f"motion {key}", said, rms(far) / most, "standard deviations", SPREADS)
                )
    return differ, sorted(found, key=lambda c: -c.far / c.bound)


def price(gpu: int | None = None) -> str:
    """What exact sums cost a rollout, with and without gradient: benchmarks/rollout.py's body, in a process each."""
    seconds = {}
    for exact in (False, True):
        code = (f"import sys; sys.path.insert(0, {str(ROOT / 'benchmarks')!r}); import long_runs; "
                f"long_runs.timed({exact})")  # fmt: skip
        made = subprocess.run(
            [sys.executable, "-c", code],
            env=environment(gpu),
            cwd=ROOT,
            capture_output=True,
            text=True,
        )
        if made.returncode:
            return f"not measured: {' '.join(made.stderr.split())[-300:]}"
        seconds[exact] = json.loads(made.stdout.splitlines()[-1])
    return "; ".join(f"{name} {1e3 * plain:.2f} -> {1e3 * seconds[True][name]:.2f} ms ({seconds[True][name] / plain:.2f} times)"
                     for name, plain in seconds[False].items())  # fmt: skip


def timed(exact: bool, device: str = "cuda") -> None:
    """Print the seconds of a frame of 64 substeps, by particles, forward and with gradient, as JSON."""
    from mosa.physics import exact_sums
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
    common = [
        *(options.equal or ["debug=default"]),
        *where,
        "evaluation.video=false",
        "logger=none",
    ]
    began, pairs = time.perf_counter(), [(kind, k) for kind in options.pairs for k in (0, 1)]
    if len(options.pairs) > 1:  # kernels: the time to compile them is no price of anything
        short = [
            "fit.prior.iterations=1",
            "fit.joint.iterations=0",
            "fit.prior_eta.iterations=0",
            "evaluation.floor=false",
        ]
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
        rows.append(
            Row(f"two equal runs on {options.device}", asked, found, bool(compared) and not over)
        )
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
    each = ", ".join(
        f"{stage} {a:.0f} -> {b:.0f}" for stage, a, b in zip(stages, spent["plain"], spent["exact"])
    )
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
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--parts",
        nargs="+",
        choices=PARTS,
        default=None,
        help="default: all, without a GPU runs and rollouts",
    )
    parser.add_argument("--device", default="cpu", help="of rollouts and equality: cpu | cuda")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", type=int, default=4)
    parser.add_argument(
        "--until",
        type=float,
        default=1e9,
        help="seconds after which the runs are stopped; fewer fail",
    )
    parser.add_argument(
        "--record",
        type=Path,
        default=None,
        help="of the runs: where what was found is kept, to go on with it",
    )
    parser.add_argument(
        "--portion", type=int, default=None, help="runs that are made and then swept; default: all"
    )
    parser.add_argument(
        "--smaller",
        nargs="+",
        default=[],
        metavar="KEY=VALUE",
        help="further overrides of the drawn runs",
    )
    parser.add_argument("--workers", type=int, default=2, help="runs beside each other")
    parser.add_argument(
        "--kills", type=int, default=2, help="of each of joblib's sweeps; submitit's is killed once"
    )
    parser.add_argument(
        "--between", type=float, nargs=2, default=(15.0, 60.0), help="seconds until a kill"
    )
    parser.add_argument(
        "--launched", type=int, default=2, help="of the runs, by submitit's local executor"
    )
    parser.add_argument("--rollouts", type=int, default=400)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--particles", type=int, default=100, help="of the body that is rolled out")
    parser.add_argument(
        "--seconds", type=float, default=1e9, help="for rollouts; fewer than asked fail"
    )
    parser.add_argument(
        "--equal",
        nargs="+",
        default=None,
        metavar="KEY=VALUE",
        help="overrides of the runs that are compared",
    )
    parser.add_argument(
        "--pairs",
        nargs="+",
        choices=("plain", "exact"),
        default=("plain", "exact"),
        help="equality: runs without, with deterministic=true; the price is measured where both run",
    )
    parser.add_argument("--rows", type=Path, default=None, help="write the rows there, as JSON")
    options = parser.parse_args()
    if options.device != "cpu" and not torch.cuda.is_available():
        parser.error(f"--device {options.device}: torch finds no CUDA device on this machine")
    chosen = options.parts or [
        part for part in PARTS if part != "equality" or options.device != "cpu"
    ]
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="mosa_long_", ignore_cleanup_errors=True) as place:
        folders = {part: Path(place) / part for part in chosen}
        for folder in folders.values():
            folder.mkdir()
        own = [
            part for part in chosen if part == "runs" or options.device == "cpu" or len(chosen) == 1
        ]
        gpus = max(1, torch.cuda.device_count()) if options.device != "cpu" else 1
        with ThreadPoolExecutor(len(chosen)) as pool:
            elsewhere = [part for part in chosen if part not in own]
            others = [
                pool.submit(beside, part, folders[part], i % gpus)
                for i, part in enumerate(elsewhere)
            ]
            for part in own:
                rows += {"runs": runs, "rollouts": rollouts, "equality": equality}[part](
                    options, folders[part]
                )
            rows += [row for other in others for row in other.result()]
    if options.rows is not None:  # whoever asked for them prints them
        options.rows.write_text(json.dumps(rows))
        return
    print("\n| what | asked | found |\n|---|---|---|")
    for row in rows:
        print(
            f"| {row.what} | {row.asked} | {'' if row.met else '**NOT AS ASKED:** '}{row.found} |"
        )
    sys.exit(0 if all(row.met for row in rows) else 1)


if __name__ == "__main__":
    main()

"""Time and memory of rollouts, forward and forward + backward, without and with each adapter.

    OMP_NUM_THREADS=1 python benchmarks/rollout.py [--device cpu|cuda] [--counts 10000 30000] [--substeps 40] [--frames 5]
                                                   [--repeats 5] [--variants none constant stride1 ...] [--forward-only]
                                                   [--set fused=true]
    python benchmarks/rollout.py --check           a small CPU run against benchmarks/rollout_ratios.json; --store rewrites it

A block of corotated material falls for `--frames` intervals of `--substeps` (five on CUDA, one on a CPU where not given): what a
rollout costs once, whatever its length, is spread over all of them. Variants: `none`; `operator`, the default adapter (a stiffness
added to the energy of the whole body); `constant`, adapter=linear (one operator on the stress of the whole body); `stride1`,
`mosa`: the paper's networks asked at every substep, at the default stride. Forward is timed without a graph; forward + backward
gives gradients with respect to modulus, velocity and all weights, the networks' activations recomputed (`--store-activations` keeps
them). Milliseconds per substep: median (least to most) of the repeats, wall time between
synchronisations on CUDA, CPU time on one thread elsewhere. Memory: most that torch and Warp held at once on CUDA, most that the
process held beyond its start on a CPU. The first runs compile kernels and capture graphs; they are not counted.

    python benchmarks/rollout.py --device cuda --counts 30000 --variants none constant --frames 50 --forward-only

is the forward rollout of 30k particles over 2000 substeps, in seconds in the last column. `--block`: threads of a CUDA block in the
substeps, in place of the program's own. `--order`: of the particles in memory, for what the order costs.

The check compares ratios of times in one run, of one interval, which the machine's speed cancels out of, and fails when one is more
than a quarter above the stored one. `none forward / yardstick` has a kernel of scattered sums below it, as many as P2G has. Best
CPU times are used, of rounds that go through all variants, so that other work on the machine disturbs them little.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import importlib.metadata
import importlib.util
import json
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import warp as wp
from omegaconf import OmegaConf
from substep import body

from mosa.config.build import build_adapter
from mosa.modules.body.body import SimulationSettings
from mosa.physics import launching
from mosa.physics.engine.simulator import Simulator
from mosa.types import Ground, ParticleState

HERE = Path(__file__).parent
STORED = HERE / "rollout_ratios.json"
YARDSTICK_ROUNDS = 10
"""Of the sums of a substep: long enough to be timed."""
ALLOWED = 1.25
"""Factor by which a ratio may exceed the stored one."""
DX, DT, DENSITY, MU, LAM = 1 / 32, 1e-4, 1000.0, 4e4, 6e4
STRIDE = SimulationSettings.model_fields["stride"].default
VARIANTS = {
    "none": (None, 1),
    "operator": ("operator", None),
    "constant": ("linear", None),
    "stride1": ("mosa", 1),
    "mosa": ("mosa", STRIDE),
}
"""Name: (file of conf/adapter, substeps between evaluations, None for one evaluation in all)."""
ORDERS = ("lattice", "cell", "shuffled")
"""Of the particles in memory: as a filling makes them, by the cell they lie in, by chance."""
CHECK = {"particles": 2000, "substeps": 16, "rounds": 5}


def adapter_of(name: str | None, device: str, settings: dict) -> torch.nn.Module | None:
    """The adapter of conf/adapter, every output drawn a little off zero. settings: keys that replace those of the file."""
    if name is None:
        return None
    config = OmegaConf.load(HERE.parent / "conf" / "adapter" / f"{name}.yaml")
    config = config.get("adapter", config)
    known = {key: value for key, value in settings.items() if name == "mosa" or key in config}
    adapter = build_adapter({**OmegaConf.to_container(config), **known})
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for p in adapter.parameters():
            p.add_(0.02 * torch.randn(p.shape, generator=generator))
    adapter.switch_on(2.6 * MU)
    return adapter.to(device)


@dataclass
class Case:
    """One rollout of one variant, ready to run."""

    forward: Callable[[], None]
    both: Callable[[], None]


def ordered(x: torch.Tensor, order: str) -> torch.Tensor:
    """(N,) indices that put the particles x (N, 3) in an order of ORDERS."""
    if order == "shuffled":
        return torch.randperm(len(x), generator=torch.Generator().manual_seed(1))
    if order == "cell":
        i, j, k = (x / DX - 0.5).floor().long().T
        return torch.argsort((i * 1024 + j) * 1024 + k, stable=True)
    return torch.arange(len(x))


def case(
    variant: str,
    particles: int,
    substeps: int,
    frames: int,
    device: str,
    settings: dict,
    order: str = ORDERS[0],
) -> Case:
    name, stride = VARIANTS[variant]
    adapter = adapter_of(name, device, settings)
    arrays = body(particles, DX, torch.float32)
    index = ordered(arrays[0], order)
    state = ParticleState(*(t[index].to(device) for t in arrays))
    volume = torch.full((particles,), (DX / 2) ** 3, device=device)
    sim = Simulator(
        "corotated",
        dx=DX,
        substeps=substeps,
        frame_dt=substeps * DT,
        ground=Ground(2 * DX),
        device=device,
    )
    leaves = [torch.tensor(MU, device=device), torch.zeros(3, device=device)]
    weights = [] if adapter is None else [p for p in adapter.parameters() if p.requires_grad]

    def rollout(mu, velocity):
        start = ParticleState(state.x, state.v + velocity, state.C_affine, state.F, state.F_tot)
        return sim.rollout(
            start,
            {"mu": mu, "lam": LAM},
            volume,
            DENSITY,
            frames + 1,
            adapter=adapter,
            stride=stride,
        )

    def forward() -> None:
        with torch.no_grad():
            rollout(*leaves)

    def both() -> None:
        wanted = [leaf.clone().requires_grad_() for leaf in leaves]
        torch.autograd.grad(rollout(*wanted).x[-1].square().sum(), wanted + weights)

    return Case(forward, both)


def clock(device: str) -> float:
    """Seconds: wall time after all launched work on CUDA, else CPU time."""
    if device == "cuda":
        torch.cuda.synchronize()
        return time.perf_counter()
    return time.process_time()


def timed(call: Callable[[], None], device: str) -> float:
    began = clock(device)
    call()
    return clock(device) - began


def resident(field: str) -> float:
    """GiB of this process's memory: VmRSS now, VmHWM at most; nan where the system does not tell."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return float("nan")
    return next(
        (int(line.split()[1]) / 2**20 for line in lines if line.startswith(field)), float("nan")
    )


class PeakMemory:
    """GiB held at most inside a `with` block: by torch and Warp on CUDA, by the process beyond its start on a CPU."""

    def __init__(self, device: str) -> None:
        self.device, self.start, self.peak = device, resident("VmRSS"), float("nan")

    def __enter__(self) -> PeakMemory:
        gc.collect()
        if self.device == "cuda":
            torch.cuda.synchronize()
            torch.cuda.reset_peak_memory_stats()
            return self
        try:
            ctypes.CDLL(None).malloc_trim(0)  # what earlier cases freed goes back to the system
            Path("/proc/self/clear_refs").write_text("5")  # sets VmHWM back to VmRSS
        except (OSError, AttributeError):
            self.start = float("nan")
        return self

    def __exit__(self, *_) -> None:
        if self.device == "cuda":
            torch.cuda.synchronize()
            warp = wp.get_mempool_used_mem_high("cuda") if wp.is_mempool_supported("cuda") else 0
            self.peak = (torch.cuda.max_memory_allocated() + warp) / 2**30
        else:
            self.peak = resident("VmHWM") - self.start


def spread(seconds: list[float], substeps: int) -> str:
    milli = [1e3 * s / substeps for s in seconds]
    return f"{statistics.median(milli):.3f} ({min(milli):.3f} to {max(milli):.3f})"


def measured(run: Case, options: argparse.Namespace) -> list[list[float]]:
    """Seconds of each repeat, forward and, unless --forward-only, forward + backward."""
    figures = []
    for call in (run.forward, run.both)[: 1 if options.forward_only else 2]:
        for _ in range(3 if options.device == "cuda" else 1):
            call()
        figures.append([timed(call, options.device) for _ in range(options.repeats)])
    return figures


def table(options: argparse.Namespace, settings: dict) -> None:
    unit, total = "ms" if options.device == "cuda" else "CPU-ms", options.frames * options.substeps
    length = f"{options.frames} x {options.substeps} substeps"
    print(f"\n{unit} per substep, median (least to most) of {options.repeats} rollouts of {length}")
    names = ["forward"] if options.forward_only else ["forward", "forward + backward"]
    columns = ["particles", "adapter", *names, "over none", "peak GiB", "forward of all [s]"]
    print(f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
    memory = PeakMemory(options.device)
    for particles in options.counts:
        bases: list[float] = []
        for variant in options.variants:
            run = case(
                variant,
                particles,
                options.substeps,
                options.frames,
                options.device,
                settings,
                options.order,
            )
            with memory:
                figures = measured(run, options)
            del run  # with its buffers: the next one's memory is its own
            medians = [statistics.median(f) for f in figures]
            bases = medians if variant == "none" else bases
            over = ", ".join(f"{a / b:.2f}" for a, b in zip(medians, bases)) if bases else "-"
            shown = " | ".join(spread(f, total) for f in figures)
            print(
                f"| {particles} | {variant} | {shown} | {over} | {memory.peak:.2f} | {medians[0]:.3f} |",
                flush=True,
            )


@wp.kernel(enable_backward=False)
def scatter(
    base: wp.array(dtype=wp.int32), values: wp.array(dtype=wp.vec4), grid: wp.array(dtype=wp.vec4)
):
    p = wp.tid()
    value, x = values[p], base[p]
    for i in range(27):
        w = wp.float32(0.01) * wp.float32(i + 1)
        wp.atomic_add(grid, x + i, (w * w - w) * value)


def yardstick(particles: int, substeps: int) -> Callable[[], None]:
    """27 weighted sums of four floats per particle and substep, to nodes beside each other: the work of P2G without an MPM, by the
    same compiler, so that a processor which is faster at one is so at both."""
    base = wp.array((torch.arange(particles) // 4).int().numpy(), dtype=wp.int32, device="cpu")
    values, grid = (
        wp.ones(particles, dtype=wp.vec4, device="cpu"),
        wp.zeros(particles + 27, dtype=wp.vec4, device="cpu"),
    )

    def run() -> None:
        for _ in range(YARDSTICK_ROUNDS * substeps):
            wp.launch(scatter, particles, inputs=[base, values, grid], device="cpu")

    return run


def ratios(best: dict[str, float]) -> dict[str, float]:
    """Of best times, by name: `variant forward`, `variant both` and `yardstick`."""
    result = {"none forward / yardstick": best["none forward"] / best["yardstick"]}
    for variant in VARIANTS:
        if variant != "none":
            result[f"{variant} forward / none forward"] = (
                best[f"{variant} forward"] / best["none forward"]
            )
        result[f"{variant} both / {variant} forward"] = (
            best[f"{variant} both"] / best[f"{variant} forward"]
        )
    return result


class Check:
    """Best CPU times over rounds; more rounds only sharpen them."""

    def __init__(self) -> None:
        particles, substeps = CHECK["particles"], CHECK["substeps"]
        self.calls = {"yardstick": yardstick(particles, substeps)}
        for variant in VARIANTS:
            run = case(variant, particles, substeps, 1, "cpu", {"recompute": True})
            self.calls |= {f"{variant} forward": run.forward, f"{variant} both": run.both}
        for call in self.calls.values():
            call()
        self.best = dict.fromkeys(self.calls, float("inf"))

    def measure(self, rounds: int) -> dict[str, float]:
        """Ratios after `rounds` more rounds."""
        for _ in range(rounds):
            for name, call in self.calls.items():
                self.best[name] = min(self.best[name], timed(call, "cpu"))
        return ratios(self.best)


def degraded(found: dict[str, float], stored: dict[str, float]) -> list[str]:
    """Names of the stored ratios that are exceeded by more than a quarter, or that were not measured."""
    return [
        name
        for name, value in stored.items()
        if not found.get(name, float("inf")) <= ALLOWED * value
    ]


def check(attempts: int = 8) -> tuple[dict[str, float], dict[str, float], list[str]]:
    """(ratios found, stored, names of degraded ones). Rounds are added while one looks degraded, `attempts` times at most."""
    stored = json.loads(STORED.read_text())["ratios"]
    measurement = Check()
    for _ in range(attempts):
        found = measurement.measure(CHECK["rounds"])
        bad = degraded(found, stored)
        if not bad:
            break
    return found, stored, bad


def versions() -> str:
    cuda = (
        f", {torch.cuda.get_device_name()}, CUDA {torch.version.cuda}"
        if torch.cuda.is_available()
        else ", no CUDA device"
    )
    found = importlib.util.find_spec("triton") is not None
    triton = f", triton {importlib.metadata.version('triton')}" if found else ", no triton"
    return f"{platform.processor() or platform.machine()}, torch {torch.__version__}, warp {wp.__version__}{triton}{cuda}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--device", choices=("cpu", "cuda"), default="cuda" if torch.cuda.is_available() else "cpu"
    )
    parser.add_argument(
        "--counts",
        type=int,
        nargs="+",
        help="particles; 10k to 1M on CUDA, 10k on a CPU where not given",
    )
    parser.add_argument("--variants", nargs="+", choices=tuple(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--substeps", type=int, default=40)
    parser.add_argument(
        "--frames", type=int, help="intervals of a rollout; 5 on CUDA, 1 on a CPU where not given"
    )
    parser.add_argument("--forward-only", action="store_true", help="no backward pass")
    parser.add_argument(
        "--block", type=int, default=launching.BLOCK, help="threads of a CUDA block in the substeps"
    )
    parser.add_argument(
        "--order", choices=ORDERS, default=ORDERS[0], help="of the particles in memory"
    )
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument(
        "--store-activations", action="store_true", help="no recomputation of the networks"
    )
    parser.add_argument(
        "--set", nargs="*", default=[], metavar="KEY=VALUE", help="settings of the paper's adapter"
    )
    parser.add_argument(
        "--check", action="store_true", help="small CPU run against the stored ratios"
    )
    parser.add_argument(
        "--store", action="store_true", help="measure and store the ratios of --check"
    )
    options = parser.parse_args()
    if options.device == "cuda" and not torch.cuda.is_available():
        parser.error("--device cuda: torch finds no CUDA device on this machine; use --device cpu")
    wp.config.quiet = True
    torch.set_num_threads(1)
    launching.BLOCK = options.block
    print(versions())
    if options.store:
        found = {
            name: round(value, 3) for name, value in Check().measure(3 * CHECK["rounds"]).items()
        }
        STORED.write_text(
            json.dumps({"machine": versions(), **CHECK, "ratios": found}, indent=2) + "\n"
        )
        print(STORED.read_text())
    elif options.check:
        found, stored, bad = check()
        print("| ratio of CPU times | stored | found |\n|---|---|---|")
        for name, value in stored.items():
            print(
                f"| {name} | {value:.2f} | {found.get(name, float('nan')):.2f}{' DEGRADED' if name in bad else ''} |"
            )
        if bad:
            raise SystemExit(
                f"more than a factor {ALLOWED} above the stored ratios: {', '.join(bad)}"
            )
    else:
        if options.device == "cpu":
            options.counts = options.counts or [10_000]
        options.counts = options.counts or [10_000, 30_000, 100_000, 1_000_000]
        options.frames = options.frames or (5 if options.device == "cuda" else 1)
        settings = OmegaConf.to_container(OmegaConf.from_dotlist(options.set))
        table(options, {"recompute": not options.store_activations, **settings})


if __name__ == "__main__":
    main()

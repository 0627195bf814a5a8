"""Particle-substeps a second of ours and of the same scheme in Taichi (`taichi_mpm`), in one run.

    python benchmarks/beside_others.py [--device cuda|cpu] [--counts 10000 100000 1000000 10000000]
                                       [--orders cell shuffled] [--substeps 200] [--repeats 5]
                                       [--programs ours taichi] [--memory 16] [--check]

with `pip install taichi`. Both: a block of neo-Hookean material, two particles per cell and axis,
on a sticky ground; MLS-MPM with APIC and quadratic B-splines, float32 states, one grid spacing and
time step, no adapter. Gradients: of sum |x|^2 at the end, with respect to the particles' moduli and
first velocities. Ours keeps as many states as its own rule allows; Taichi's reverse mode keeps
all of them, and gets fewer substeps where they would take more than `--memory` GiB. Orders: of the
particles in memory, by the cell they lie in or by chance. Times: median of the repeats, wall time
between synchronisations on CUDA, CPU time of one thread elsewhere.

Shares of peaks need no counters: bytes that the scheme must move, over the time, over the peak.
Per particle and substep, forward: DRAM 256 (P2G reads x, v, C, F and four constants, 112; G2P reads
x and F, 48, and writes x, v, C, F, 96) and 64 per node (momentum and mass, then velocity, each
written and read); L2 864 more (27 nodes of 16 bytes, added to and read). Forward and backward: DRAM
868 and 192 per node, L2 2592 more (P2G again, the adjoint of G2P reads and adds, that of P2G
reads). DRAM peaks are NVIDIA's, which publishes none for the L2 of these cards: 6.6 TB/s is what
the shares that `ncu` counts on an H200 imply (docs/lab/2026-11-performance.md).

`--check` compares motions and gradients after 100 substeps of 5000 particles, on the device given,
and fails if they differ by more than float32 allows. The table is printed as Markdown; if the
variable OUT names a folder, `beside_others.json` there holds the figures.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import statistics
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
import warp as wp
from rollout import DENSITY, DT, DX, LAM, MU, ORDERS, ordered, timed, versions
from substep import body

from mosa.physics.engine.simulator import Simulator
from mosa.types import Ground, ParticleState

GROUND, GRAVITY, VOLUME = 4 * DX, -9.8, (DX / 2) ** 3
"""The block's lowest particles are an eighth to three eighths of a cell above the ground."""
FRAMES = 5
"""Intervals of a rollout of ours."""
MARGIN = 3
"""Cells of Taichi's grid around the block, which moves by less than one."""
CHECKED = {"particles": 5000, "substeps": 100}
ALLOWED = {"center [m]": 1e-6, "rms [m]": 1e-6, "gradient": 1e-4}
"""Differences of the check; the gradient's is relative. A coordinate of 0.5 m has a resolution of
3e-8 m in float32, and each substep adds a rounding."""
DRAM = {"H200": 4.8e12, "H100 PCIe": 2.0e12, "H100": 3.35e12, "A100": 2.039e12}
"""Bytes a second, as NVIDIA's data sheets have them; the first name that fits counts."""
L2 = {"H200": 6.6e12, "H100": 6.6e12}
SHOWN = {"forward": "forward", "both": "forward + backward"}
MOVED = {"forward": (256, 64, 864), "both": (868, 192, 2592)}
"""Bytes: per particle and per node through DRAM, per particle more through L2."""


class Ours:
    """A block that `Simulator` advances."""

    def __init__(self, arrays: tuple[torch.Tensor, ...], substeps: int, device: str) -> None:
        self.state = ParticleState(*(a.to(device) for a in arrays))
        count = len(self.state.x)
        self.substeps, self.volume = substeps, torch.full((count,), VOLUME, device=device)
        self.simulator = Simulator(
            "neo_hookean",
            dx=DX,
            substeps=substeps // FRAMES,
            frame_dt=substeps // FRAMES * DT,
            gravity=(0.0, GRAVITY, 0.0),
            ground=Ground(GROUND),
            device=device,
        )
        self.mu = torch.full((count,), MU, device=device)

    def rollout(self, v: torch.Tensor, mu: torch.Tensor) -> torch.Tensor:
        start = ParticleState(self.state.x, v, self.state.C_affine, self.state.F, self.state.F_tot)
        values = {"mu": mu, "lam": LAM}
        made = self.simulator.rollout(start, values, self.volume, DENSITY, FRAMES + 1)
        return made.x[-1]

    def forward(self) -> torch.Tensor:
        with torch.no_grad():
            return self.rollout(self.state.v, self.mu)

    def both(self) -> tuple[torch.Tensor, ...]:
        wanted = [a.clone().requires_grad_() for a in (self.state.v, self.mu)]
        return torch.autograd.grad(self.rollout(*wanted).square().sum(), wanted)


def window(x: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """(lowest node, nodes per axis) of a grid that has room for the block."""
    low, high = (
        np.floor(a.numpy(force=True) / DX - 0.5).astype(int) for a in (x.amin(0), x.amax(0))
    )
    return low - MARGIN, high - low + 3 + 2 * MARGIN


def taichi_body(arrays: tuple[torch.Tensor, ...], states: int, gradients: bool, device: str):
    """A new Taichi program with one block. Errors: ImportError where taichi is not installed."""
    import taichi as ti
    from taichi_mpm import Scheme, TaichiBody

    ti.init(
        arch=ti.cuda if device == "cuda" else ti.cpu,
        default_fp=ti.f32,
        log_level=ti.ERROR,
        cpu_max_num_threads=1,
    )
    if (device == "cuda") != (ti.cfg.arch == ti.cuda):
        raise SystemExit(f"taichi: expected {device}, found {ti.cfg.arch}")
    scheme = Scheme(DX, DT, GRAVITY, GROUND, DENSITY * VOLUME, VOLUME, LAM)
    return TaichiBody(scheme, len(arrays[0]), *window(arrays[0]), states, gradients)


def numbers(arrays: tuple[torch.Tensor, ...]) -> list[np.ndarray]:
    """x, v, C, F for Taichi, F advanced by C as a rollout of ours begins."""
    x, v, C, F = arrays[:4]
    return [a.numpy() for a in (x, v, C, F + DT * (C @ F))]


def put(arrays: tuple[torch.Tensor, ...], order: str) -> tuple[torch.Tensor, ...]:
    """The particles in an order of ORDERS."""
    index = ordered(arrays[0], order)
    return tuple(a[index] for a in arrays)


def repeated(
    call: Callable[[], object],
    options: argparse.Namespace,
    restart: Callable[[], object] = lambda: None,
) -> list[float]:
    """Seconds of each call after two that are not counted; restart: before each, not timed."""
    seconds = []
    for _ in range(2 + options.repeats):
        restart()
        seconds.append(timed(call, options.device))
    return seconds[2:]


def of_ours(count: int, options: argparse.Namespace, add: Callable[..., None]) -> None:
    arrays = body(count, DX, torch.float32)
    for order in options.orders:
        run = Ours(put(arrays, order), options.substeps, options.device)
        add(order, "forward", options.substeps, repeated(run.forward, options))
        add(order, "both", options.substeps, repeated(run.both, options))
        del run
        gc.collect()
        if options.device == "cuda":
            torch.cuda.empty_cache()


def of_taichi(count: int, options: argparse.Namespace, add: Callable[..., None]) -> None:
    import taichi as ti
    from taichi_mpm import PER_STATE

    arrays = body(count, DX, torch.float32)
    kept = min(options.substeps, int(options.memory * 2**30 / (2 * PER_STATE * count)) - 1)
    for name, states in (("forward", 2), ("both", kept + 1)):
        if states < 2:
            print(f"(no gradient by Taichi at {count} particles within {options.memory} GiB)")
            continue
        run = taichi_body(arrays, states, name == "both", options.device)
        for order in options.orders:
            start = numbers(put(arrays, order))
            substeps = kept if name == "both" else options.substeps

            def restart(run=run, start=start) -> None:
                run.load(*start, MU)
                ti.sync()

            def call(run=run, name=name) -> None:
                if name == "both":
                    run.both()
                else:
                    run.forward(options.substeps)
                ti.sync()

            add(order, name, substeps, repeated(call, options, restart))
        del run
        ti.reset()


def share(moved: float, seconds: float, table: dict[str, float], device: str) -> float | None:
    """Of the peak of this device, None where it is not in the table."""
    name = torch.cuda.get_device_name() if device == "cuda" else ""
    peak = next((value for key, value in table.items() if key in name), None)
    return None if peak is None else moved / seconds / peak


def row(
    count: int, nodes: int, program: str, order: str, name: str, substeps: int,
    seconds: list[float], device: str,
) -> dict:  # fmt: skip
    """One line of the table."""
    each = statistics.median(seconds) / substeps
    particle, node, near = MOVED[name]
    dram = particle * count + node * nodes
    return {
        "particles": count, "program": program, "order": order, "pass": name, "substeps": substeps,
        "milliseconds": 1e3 * each, "least": 1e3 * min(seconds) / substeps,
        "most": 1e3 * max(seconds) / substeps, "particle_substeps_per_s": count / each,
        "dram_share": share(dram, each, DRAM, device),
        "l2_share": share(dram + near * count, each, L2, device),
    }  # fmt: skip


COLUMNS = (
    "particles", "order", "pass", "program", "substeps", "ms per substep (least to most)",
    "1e9 particle-substeps/s", "DRAM", "L2",
)  # fmt: skip


def line(found: dict) -> str:
    shares = [
        "-" if found[k] is None else f"{100 * found[k]:.0f} %" for k in ("dram_share", "l2_share")
    ]
    milli = f"{found['milliseconds']:.4f} ({found['least']:.4f} to {found['most']:.4f})"
    cells = [
        found["particles"],
        found["order"],
        SHOWN[found["pass"]],
        found["program"],
        found["substeps"],
    ]
    rate = f"{found['particle_substeps_per_s'] / 1e9:.4g}"
    return f"| {' | '.join(map(str, [*cells, milli, rate, *shares]))} |"


def record(
    rows: list[dict], count: int, nodes: int, program: str, device: str, order: str, name: str,
    substeps: int, seconds: list[float],
) -> None:  # fmt: skip
    """Adds a line and prints it; all so far are written where OUT says."""
    rows.append(row(count, nodes, program, order, name, substeps, seconds, device))
    print("done:", line(rows[-1]), flush=True)
    if folder := os.environ.get("OUT"):
        text = json.dumps({"machine": versions(), "rows": rows}, indent=2)
        (Path(folder) / "beside_others.json").write_text(text)


def compared(device: str) -> dict[str, float]:
    """Differences of the two motions and gradients after `CHECKED` substeps."""
    count, substeps = CHECKED["particles"], CHECKED["substeps"]
    arrays = body(count, DX, torch.float32)
    ours = Ours(arrays, substeps, device)
    x, gradients = ours.forward().cpu(), [g.cpu() for g in ours.both()]
    run = taichi_body(arrays, 2, False, device)
    run.load(*numbers(arrays), MU)
    run.forward(substeps)
    there = torch.from_numpy(run.x.to_numpy()[0])
    run = taichi_body(arrays, substeps + 1, True, device)
    run.load(*numbers(arrays), MU)
    run.both()
    kept = torch.from_numpy(run.x.to_numpy()[substeps])
    others = [torch.from_numpy(run.v.grad.to_numpy()[0]), torch.from_numpy(run.mu.grad.to_numpy())]
    moved = float((x - arrays[0]).square().sum(1).mean().sqrt())
    print(f"the particles moved by {1e3 * moved:.2f} mm (rms)")
    return {
        "center [m]": float((x.mean(0) - there.mean(0)).norm()),
        "rms [m]": max(float((x - y).square().sum(1).mean().sqrt()) for y in (there, kept)),
        "gradient": max(float((a - b).norm() / a.norm()) for a, b in zip(gradients, others)),
    }


def check(device: str) -> None:
    found = compared(device)
    print("| ours and Taichi | difference | allowed |\n|---|---|---|")
    for name, value in found.items():
        print(f"| {name} | {value:.2e} | {ALLOWED[name]:.0e} |")
    if not all(value <= ALLOWED[name] for name, value in found.items()):
        raise SystemExit("the two programs do not compute the same motion")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--device", choices=("cpu", "cuda"), default="cuda" if torch.cuda.is_available() else "cpu"
    )
    parser.add_argument("--counts", type=int, nargs="+", default=[10**4, 10**5, 10**6, 10**7])
    parser.add_argument("--orders", nargs="+", choices=ORDERS, default=["cell", "shuffled"])
    parser.add_argument("--substeps", type=int, default=200, help="a multiple of 20")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument(
        "--programs", nargs="+", choices=("ours", "taichi"), default=["ours", "taichi"]
    )
    parser.add_argument("--memory", type=float, default=16.0, help="GiB of Taichi's states")
    parser.add_argument("--check", action="store_true", help="compare the motions, no times")
    options = parser.parse_args()
    if options.substeps < 20 or options.substeps % 20:
        parser.error(f"--substeps: expected a multiple of 20, found {options.substeps}")
    wp.config.quiet = True
    torch.set_num_threads(1)
    print(versions())
    if options.check:
        return check(options.device)
    rows: list[dict] = []
    for program, measure in (("ours", of_ours), ("taichi", of_taichi)):
        for count in options.counts if program in options.programs else ():
            nodes = int(window(body(count, DX, torch.float32)[0])[1].prod())
            measure(count, options, partial(record, rows, count, nodes, program, options.device))
    rows.sort(
        key=lambda found: (found["particles"], found["pass"], found["order"], found["program"])
    )
    print(f"\n| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    print("\n".join(map(line, rows)))


if __name__ == "__main__":
    main()

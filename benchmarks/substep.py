"""CPU time of one substep of the transfers, stress given: 10k particles, one thread, forward and backward.

    OMP_NUM_THREADS=1 python benchmarks/substep.py [--particles 10000] [--grid 32] [--substeps 20] [--repeats 15]

Warp's CPU kernels run on one thread and CPU time is what is counted, so other work on the machine matters little (caches and
clock aside). Forward is clearing the grid, P2G, grid update with a ground, G2P; backward is their adjoints (the recomputation of
the segment before it is another forward). Laws add the stress kernel, timed in the last columns. Aim (one server core): 2.0 ms
forward, 5.5 ms backward at 10k particles on a 32^3 grid.
"""

from __future__ import annotations

import argparse
import statistics
import time

import torch

from mosa.physics.engine.simulator import Simulator
from mosa.physics.engine.solver import SegmentSolver, grid_window
from mosa.types import Ground


def body(count: int, dx: float, dtype: torch.dtype) -> tuple[torch.Tensor, ...]:
    """(x, v, C_affine, F, F_tot) of a jittered block of `count` particles, eight per cell, a little in motion."""
    side = round(count ** (1 / 3) - 0.5)
    layers = -(-count // side**2)
    g = torch.Generator().manual_seed(0)
    axes = torch.meshgrid(
        torch.arange(side), torch.arange(layers), torch.arange(side), indexing="ij"
    )
    x = torch.stack(axes, -1).reshape(-1, 3)[:count].double()
    x = (
        x + 0.5 + 0.2 * (torch.rand(x.shape, generator=g, dtype=torch.float64) - 0.5)
    ) * dx / 2 + 4 * dx
    v = 0.1 * torch.randn(count, 3, generator=g, dtype=torch.float64)
    C = torch.randn(count, 3, 3, generator=g, dtype=torch.float64)
    F = torch.eye(3).double() + 0.01 * torch.randn(count, 3, 3, generator=g, dtype=torch.float64)
    return tuple(t.to(dtype).contiguous() for t in (x, v, C, F, F))


def timed(call, substeps: int, repeats: int) -> float:
    """Median CPU milliseconds per substep."""
    call()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        times.append(1e3 * (time.process_time() - start) / substeps)
    return statistics.median(times)


def measure(
    dtype: torch.dtype,
    particles: int,
    grid: int | None,
    substeps: int,
    repeats: int,
    law: str | None,
):
    """(forward, backward) ms per substep; grid: nodes per axis, None for the body's box; law: None leaves the stress as given."""
    dx = 1.0 / 32
    sim = Simulator(
        law or "corotated",
        dx=dx,
        substeps=substeps,
        frame_dt=substeps * 1e-4,
        ground=Ground(2 * dx),
        dtype=dtype,
    )
    state = body(particles, dx, dtype)
    volume = torch.full((particles,), (dx / 2) ** 3, dtype=dtype)
    solver = SegmentSolver(sim.numerics, volume, 1000.0, 0.0)
    held = {
        "parameters": sim.pack({"mu": 4e4, "lam": 6e4}, particles),
        "G": None,
        "h": None,
        "plastic_G": None,
        "plastic_h": None,
    }
    window = (
        grid_window(state[0], state[1], dx, substeps * sim.dt, 2)
        if grid is None
        else ((0, 0, 0), (grid,) * 3)
    )
    results = []
    for with_adjoint in (False, True):
        work = solver.workspace({}, substeps, False, False, with_adjoint)
        work.set_window(*window)
        work.load(state, held, volume, solver.mass, 0.0)
        if law is None:
            launch = work.run
            work.run = lambda kernel, *rest, launch=launch, skip=work.stress: (
                None if kernel is skip else launch(kernel, *rest)
            )
            for tau in work.tau:
                tau.copy_(
                    100.0
                    * torch.randn(tau.shape, generator=torch.Generator().manual_seed(1)).to(dtype)
                )
        if with_adjoint:
            work.advance()

        def call(work=work, with_adjoint=with_adjoint):
            if not with_adjoint:
                return work.advance()
            for seed in (work.adj_x, work.adj_v, work.adj_C_affine, work.adj_F):
                seed[substeps % 2].fill_(1e-3)
            return work.adjoint()

        results.append(timed(call, substeps, repeats))
        if min(work.flags.tolist()) < 2**62:
            raise SystemExit("a particle left the grid: the times are not those of a substep")
    return results


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, value in (("particles", 10_000), ("grid", 32), ("substeps", 20), ("repeats", 15)):
        parser.add_argument(f"--{name}", type=int, default=value)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(
        f"{options.particles} particles, ms of CPU time per substep, median of {options.repeats} x {options.substeps} substeps\n"
    )
    print("| fields | grid | stress given: forward | backward | corotated: forward | backward |")
    print("|---|---|---|---|---|---|")
    for dtype in (torch.float32, torch.float64):
        for grid in (options.grid, None):
            row = []
            for law in (None, "corotated"):
                row += measure(
                    dtype, options.particles, grid, options.substeps, options.repeats, law
                )
            name = f"{grid}^3" if grid else "the body's box"
            print(
                f"| {str(dtype).split('.')[1]} | {name} | "
                + " | ".join(f"{t:.2f}" for t in row)
                + " |",
                flush=True,
            )


if __name__ == "__main__":
    main()

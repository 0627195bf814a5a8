"""Many worlds at once against one: rollouts forward and forward + backward, and steps per second of a stepping body.

    OMP_NUM_THREADS=1 python benchmarks/worlds.py [--device cpu|cuda] [--worlds 1 32 256] [--particles 4040]
                                                  [--substeps 48] [--frames 5] [--steps 50] [--repeats 5]
                                                  [--parts rollouts steps] [--check-only]

A block of corotated material with the default adapter (an anisotropic stiffness) falls on the ground with friction; every world
has a start, a shear modulus and, in the check, gravity and a moving ball of its own. `--substeps` are those of 0.02 s: 48 are as
long as the 40 of the README's rabbit in 1/60 s. Rollouts have `--frames` intervals; forward + backward gives gradients with respect
to every world's velocity and modulus and the adapter's numbers. Steps are those of `Twin.step`: 0.02 s
each, with a paddle that an action drives, each step with its own look at the result.

Wall times, best of the repeats after those that compile and capture. On a CPU (default worlds 1 and 8) the many worlds run on as
many threads as there are cores, and are compared with the same worlds one after another on one thread. First it is checked that
each world is its single rollout: to the last bit on a CPU; on CUDA, where sums of particles have no order, in float64, where the
order changes a sum by some 1e-16 of it, to 1e-9 cells and 1e-6 of the largest gradient. Everything needed is torch, Warp and numpy.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable

import torch
from substep import body as block

from mosa.modules.adapters.hyperelastic import NUMBERS, HyperelasticAdapter
from mosa.modules.body.body import Body, SimulationSettings, Start, World
from mosa.modules.body.material import Material
from mosa.physics.contact.colliders import Box, Collider, Sphere
from mosa.physics.contact.motion import Motion
from mosa.physics.engine.law_options import LawOptions
from mosa.physics.engine.simulator import Simulator
from mosa.twin.episode import Episode
from mosa.types import Ground, ParticleState

DX, STEP, DENSITY, MU, LAM = 1 / 32, 0.02, 1000.0, 1.2e4, 3e4
GROUND = Ground(3 * DX, "separate", 0.3)
CELLS, GRADIENT = 1e-9, 1e-6
"""Allowed on CUDA in float64: a position's difference in cells, a gradient's relative to the largest."""


def adapter_of(device: str) -> HyperelasticAdapter:
    adapter = HyperelasticAdapter()
    with torch.no_grad():
        adapter.numbers.copy_(0.2 * torch.linspace(-1, 1, NUMBERS))
    adapter.switch_on(2.8 * MU, 0.36)
    return adapter.to(device)


class Case:
    """`worlds` blocks of so many particles, each thrown its own way, with a modulus of its own."""

    def __init__(
        self,
        worlds: int,
        particles: int,
        substeps: int,
        frames: int,
        device: str,
        dtype: torch.dtype,
        more: bool,
    ) -> None:
        self.worlds, self.frames, self.more = worlds, frames, more
        solids = [Collider(Sphere(3 * DX), "separate", 0.2)] if more else []
        self.simulator = Simulator(
            "corotated", dx=DX, substeps=substeps, frame_dt=STEP, ground=GROUND, dtype=dtype, device=device, colliders=solids,
            energetic=True, up=(0, 1, 0), options=LawOptions(on_inversion="ignore"),
        )  # fmt: skip
        state = ParticleState(*(t.to(device) for t in block(particles, DX, dtype)))
        self.states = ParticleState.stack([state] * worlds)
        index = torch.arange(worlds, dtype=torch.float64)
        thrown = torch.stack(
            [0.5 * torch.sin(index), -1.0 - 0.5 * torch.cos(index), 0.3 * torch.cos(2 * index)], 1
        )
        self.velocity = thrown.to(device, dtype)
        self.mu = (MU * (1 + 0.2 * torch.sin(3 * index)))[:, None].to(device, dtype)
        self.volume = torch.full((particles,), (DX / 2) ** 3, dtype=dtype, device=device)
        self.adapter = adapter_of(device)
        self.gravity = torch.tensor([[0.3 * b % 1, -9.8, 0.1 * b % 1] for b in range(worlds)])
        centre = state.x.mean(0).tolist()
        low = float(state.x[:, 1].min()) - 3.5 * DX
        place = (centre[0], low, centre[2])
        self.motions = (
            [[Motion(place, velocity=(0.0, 0.1 * (b % 3), 0.0))] for b in range(worlds)]
            if more
            else None
        )

    def together(self, velocity: torch.Tensor, mu: torch.Tensor, together: int | None = None):
        start = ParticleState(self.states.x, self.states.v + velocity[:, None], *self._rest())
        more = {"motions": self.motions, "gravity": self.gravity} if self.more else {}
        return self.simulator.rollout(
            start,
            {"mu": mu, "lam": LAM},
            self.volume,
            DENSITY,
            self.frames + 1,
            self.adapter,
            None,
            together=together,
            **more,
        )

    def alone(self, b: int, velocity: torch.Tensor, mu: torch.Tensor):
        """World b by itself; its gravity is the simulator's only where it is the same in all."""
        start = ParticleState(
            self.states.x[b], self.states.v[b] + velocity[b], *(t[b] for t in self._rest())
        )
        return self.simulator.rollout(
            start,
            {"mu": mu[b, 0], "lam": LAM},
            self.volume,
            DENSITY,
            self.frames + 1,
            self.adapter,
            None,
        )

    def _rest(self) -> tuple[torch.Tensor, ...]:
        return self.states.C_affine, self.states.F, self.states.F_tot

    def leaves(self) -> list[torch.Tensor]:
        return [self.velocity.clone().requires_grad_(), self.mu.clone().requires_grad_()]

    def forward(self) -> None:
        with torch.no_grad():
            self.together(self.velocity, self.mu)

    def both(self) -> None:
        leaves = self.leaves()
        loss = self.together(*leaves).x[-1].square().sum()
        torch.autograd.grad(loss, [*leaves, self.adapter.numbers])

    def forward_alone(self) -> None:
        with torch.no_grad():
            for b in range(self.worlds):
                self.alone(b, self.velocity, self.mu)

    def both_alone(self) -> None:
        for b in range(self.worlds):
            leaves = self.leaves()
            loss = self.alone(b, *leaves).x[-1].square().sum()
            torch.autograd.grad(loss, [*leaves, self.adapter.numbers])


def gradients(rollout, leaves: list[torch.Tensor]) -> list[torch.Tensor]:
    loss = rollout.x[1:].square().sum() + rollout.v[1:].square().sum()
    if rollout.reactions is not None:
        loss = loss + 1e-6 * rollout.reactions.square().sum()
    return list(torch.autograd.grad(loss, leaves))


def check(device: str, particles: int = 500, worlds: int = 4) -> None:
    """Errors: SystemExit where a world is not its single rollout."""
    dtype, worst, steepest = torch.float64, 0.0, 0.0
    case = Case(worlds, particles, 40, 4, device, dtype, more=True)
    moved = []
    for together in (None, worlds, 2, 1):
        leaves = case.leaves()
        found = case.together(*leaves, together=together)
        found_gradients = gradients(found, leaves)
        for b in range(worlds):
            own = Case(1, particles, 40, 4, device, dtype, more=True)
            own.velocity, own.mu = case.velocity[b : b + 1], case.mu[b : b + 1]
            own.gravity, own.motions = case.gravity[b : b + 1], case.motions[b : b + 1]
            own_leaves = own.leaves()
            single = own.together(*own_leaves)
            x, expected = found.x[:, b].detach(), single.x[:, 0].detach()
            worst = max(worst, float((x - expected).abs().max()) / DX)
            moved.append(float((expected[-1] - expected[0]).norm(dim=-1).max()) / DX)
            for part, expected in zip(found_gradients, gradients(single, own_leaves)):
                difference = float((part[b] - expected[0]).abs().max() / expected.abs().max())
                steepest = max(steepest, difference)
    allowed = (CELLS, GRADIENT) if device == "cuda" else (0.0, 1e-12)
    print(
        f"check, {worlds} worlds, so many, 2 or 1 in a launch, float64: positions that moved {min(moved):.2f} to "
        f"{max(moved):.2f} cells differ by at most {worst:.2g} cells (allowed {allowed[0]:g}), gradients by {steepest:.2g} "
        f"(allowed {allowed[1]:g})"
    )
    if not (worst <= allowed[0] and steepest <= allowed[1] and min(moved) > 0.5):
        raise SystemExit("worlds are not their single rollouts")


def learned_body(particles: int, device: str) -> Body:
    x = block(particles, DX, torch.float32)[0]
    ones, n = torch.ones(particles, 3), particles
    made = Body(
        rest=x, volume=torch.full((n,), (DX / 2) ** 3), colors=ones, opacities=torch.ones(n),
        covariances=torch.eye(3).expand(n, 3, 3), density=DENSITY, material=Material("corotated", {"E": 2.7 * MU, "nu": 0.36}),
        heterogeneity=None, adapter=adapter_of("cpu"), settings=SimulationSettings(dx=DX),
    )  # fmt: skip
    return made.to(device).eval()


def episode(worlds: int | None, particles: int, substeps: int, device: str) -> Episode:
    made = learned_body(particles, device)
    center, up = made.center, torch.tensor([0.0, 1.0, 0.0], device=device)
    size = made.size
    paddle = Collider(Box((2 * DX, 4 * DX, 8 * DX)), "separate", 0.3, Motion((float(center[0]) - size, 4 * DX, float(center[2]))),
                      name="paddle")  # fmt: skip
    world = World(
        GROUND,
        torch.tensor([0.0, -9.8, 0.0]),
        up.cpu(),
        torch.tensor([[-9.0] * 3, [9.0] * 3]),
        colliders=(paddle,),
    )
    low = float(made.rest[:, 1].min())
    starts = []
    for b in range(worlds or 1):
        velocity = torch.tensor([0.1 * (b % 7), -0.2 * (b % 5), 0.1 * (b % 3)], device=device)
        place = center + (GROUND.height + 0.05 - low) * up
        starts.append(
            Start(torch.eye(3, device=device), place, velocity, torch.zeros(3, device=device))
        )
    return Episode(made, world, STEP, starts[0] if worlds is None else starts, substeps=substeps)


def synchronised(device: str) -> float:
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()


def best(call: Callable[[], None], device: str, repeats: int, warm: int) -> float:
    for _ in range(warm):
        call()
    seconds = []
    for _ in range(repeats):
        began = synchronised(device)
        call()
        seconds.append(synchronised(device) - began)
    return min(seconds)


def rollouts(options: argparse.Namespace) -> list[str]:
    """Rows of the table."""
    rows, one, warm = [], None, 3 if options.device == "cuda" else 1
    substeps = options.frames * options.substeps
    for worlds in options.worlds:
        case = Case(
            worlds,
            options.particles,
            options.substeps,
            options.frames,
            options.device,
            torch.float32,
            more=False,
        )
        if options.device == "cuda":
            torch.cuda.reset_peak_memory_stats()
        times = [
            best(call, options.device, options.repeats, warm) for call in (case.forward, case.both)
        ]
        if options.device == "cuda":
            one = one or times
            ratios, memory = (
                [t / first for t, first in zip(times, one)],
                f"{torch.cuda.max_memory_allocated() / 2**30:.2f}",
            )
            shown = [f"{r:.2f}" for r in ratios]
        else:
            after = [
                best(call, options.device, options.repeats, warm)
                for call in (case.forward_alone, case.both_alone)
            ]
            shown, memory = [f"{a / t:.2f}" for a, t in zip(after, times)], "-"
        each = [f"{1e3 * t / substeps:.3f}" for t in times]
        rows.append(f"| {worlds} | {each[0]} | {shown[0]} | {each[1]} | {shown[1]} | {memory} |")
        print("done:", rows[-1], flush=True)
        del case
    return rows


def steps(options: argparse.Namespace) -> list[str]:
    rows = []
    for worlds in [None, *(w for w in options.worlds if w > 1)]:
        made = episode(worlds, options.particles, options.substeps, options.device)

        def go(made=made) -> None:
            for k in range(options.steps):
                state, _ = made.step(
                    {"paddle": {"velocity": (0.3 if k % 20 < 10 else -0.3, 0.0, 0.0)}}
                )
            float(state.x.sum())

        began = made.state
        for _ in range(2):
            made.state = began
            go()
        seconds = []
        for _ in range(options.repeats):
            made.state = began
            start = synchronised(options.device)
            go()
            seconds.append(synchronised(options.device) - start)
        each = min(seconds) / options.steps
        rows.append(
            f"| {worlds or 1} | {1e3 * each:.2f} | {1 / each:.1f} | {(worlds or 1) / each:.0f} |"
        )
        print("done:", rows[-1], flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--device", choices=("cpu", "cuda"), default="cuda" if torch.cuda.is_available() else "cpu"
    )
    parser.add_argument("--worlds", type=int, nargs="+")
    for name, value in (
        ("particles", 4040),
        ("substeps", 48),
        ("frames", 5),
        ("steps", 50),
        ("repeats", 5),
    ):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument(
        "--parts", nargs="+", choices=("rollouts", "steps"), default=["rollouts", "steps"]
    )
    parser.add_argument("--check-only", action="store_true")
    options = parser.parse_args()
    options.worlds = options.worlds or ([1, 32, 256] if options.device == "cuda" else [1, 8])
    torch.set_num_threads(1)
    check(options.device)
    if options.check_only:
        return
    where = (
        torch.cuda.get_device_name()
        if options.device == "cuda"
        else f"{len(os.sched_getaffinity(0))} cores"
    )
    found = {part: {"rollouts": rollouts, "steps": steps}[part](options) for part in options.parts}
    print(
        f"\n{where}, float32, {options.particles} particles a world, {options.substeps} substeps in {STEP} s, best of "
        f"{options.repeats}"
    )
    if "rollouts" in found:
        compared = (
            "over one world" if options.device == "cuda" else "one after another over together"
        )
        print(
            f"\nrollouts of {options.frames} intervals, ms per substep of all worlds\n| worlds | forward | {compared} "
            f"| forward + backward | {compared} | peak GiB |\n|{'---|' * 6}\n"
            + "\n".join(found["rollouts"])
        )
    if "steps" in found:
        print(
            f"\nsteps of {STEP} s with a driven paddle\n| worlds | ms per step | steps per second | in all worlds |\n"
            f"|{'---|' * 4}\n" + "\n".join(found["steps"])
        )


if __name__ == "__main__":
    main()

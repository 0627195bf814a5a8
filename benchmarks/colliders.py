"""What contact costs: seconds per substep, forward and backward, with planes only and with moving colliders.

    python benchmarks/colliders.py [--edge 21] [--repeats 5]

The variants take turns, so that a machine's changing load meets them alike; the fastest repeat counts.
"""

import argparse
import time

import torch

from mosa.physics.contact.colliders import Box, Capsule, Collider, Cylinder, HalfSpace, Sphere
from mosa.physics.contact.motion import Motion
from mosa.physics.contact.planes import Plane
from mosa.physics.engine.simulator import Simulator
from mosa.types import ParticleState

SUBSTEPS, FRAMES = 32, 3
FLOOR = Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), "separate", 0.3)


def colliders(kinds: list) -> list[Collider]:
    """One moving collider of each shape below the body."""
    motion = Motion((0.3, -0.08, 0.3), (0.1, 0.0, 0.0), (0.1, 0.2, 0.0), (0.0, 1.0, 0.0))
    return [Collider(kind, "separate", 0.3, motion) for kind in kinds]


VARIANTS = {
    "planes only": {"planes": [FLOOR]},
    "floor as a half space": {"colliders": [Collider(HalfSpace(), "separate", 0.3, Motion(rotation=(-torch.pi / 2, 0.0, 0.0)))]},
    "planes and a sphere": {"planes": [FLOOR], "colliders": colliders([Sphere(0.1)])},
    "planes and four shapes": {
        "planes": [FLOOR], "colliders": colliders([Sphere(0.1), Capsule(0.05, 0.3), Cylinder(0.1, 0.3), Box((0.2, 0.2, 0.2))]),
    },
}  # fmt: skip


def run(simulator: Simulator, state: ParticleState, volume: torch.Tensor) -> tuple[float, float]:
    """Seconds per substep of a rollout without gradients, and of the backward pass (with its recomputation)."""
    mu = torch.tensor(4e4, dtype=state.x.dtype, requires_grad=True)
    count = SUBSTEPS * (FRAMES - 1)
    with torch.no_grad():
        start = time.perf_counter()
        simulator.rollout(state, {"mu": mu, "lam": 5e4}, volume, 1000.0, FRAMES)
        forward = time.perf_counter() - start
    loss = simulator.rollout(state, {"mu": mu, "lam": 5e4}, volume, 1000.0, FRAMES).x.square().sum()
    start = time.perf_counter()
    loss.backward()
    return forward / count, (time.perf_counter() - start) / count


def main(edge: int = 21, repeats: int = 5) -> None:
    dx = 1.0 / 32
    axis = 0.1 + dx / 2 * (torch.arange(edge) + 0.5)
    x = torch.cartesian_prod(axis, axis - 0.09, axis).contiguous()
    eye = torch.eye(3).expand(len(x), 3, 3).contiguous()
    state = ParticleState(x, torch.zeros_like(x), torch.zeros_like(eye), eye, eye)
    volume = torch.full((len(x),), (dx / 2) ** 3)
    simulators = {name: Simulator("corotated", dx=dx, substeps=SUBSTEPS, frame_dt=SUBSTEPS * 5e-4, **options)
                  for name, options in VARIANTS.items()}  # fmt: skip
    best = {name: [float("inf")] * 2 for name in VARIANTS}
    for _ in range(repeats + 1):  # the first one loads the kernels
        for name, simulator in simulators.items():
            best[name] = [min(a, b) for a, b in zip(best[name], run(simulator, state, volume))]
    print(
        f"{len(x)} particles, dx {dx:.4f} m, float32, {torch.get_num_threads()} thread(s), ms per substep"
    )
    base = best["planes only"]
    for name, (forward, backward) in best.items():
        ratios = forward / base[0], backward / base[1]
        print(
            f"{name:26s} forward {1e3 * forward:6.2f} ({ratios[0]:.3f})   backward {1e3 * backward:6.2f} ({ratios[1]:.3f})"
        )


if __name__ == "__main__":
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--edge", type=int, default=21, help="particles along an edge of the body")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    main(options.edge, options.repeats)

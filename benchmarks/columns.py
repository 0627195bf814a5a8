"""Run-out of sand columns in a channel against experiments.

    OMP_NUM_THREADS=1 python benchmarks/columns.py                          # five aspect ratios, two friction angles, minutes
    OMP_NUM_THREADS=1 python benchmarks/columns.py --aspects 1 --cells 24   # a finer grid
    OMP_NUM_THREADS=1 python benchmarks/columns.py --aspects 5 --young 2e6 --width 0.5 --rubbing 0.3    # stiffer grains, side walls

A column of base d and height a d stands against a wall that does not rub and is let go at once, on a rough (sticking) ground,
between slipping side walls. Run-out: (front - d)/d, the front being where 99 % of the mass lies behind it. Experiments in a
channel: 1.2 a up to a = 2.3, 1.9 a^(2/3) beyond (Lube, Huppert, Sparks and Freundt, Physical Review E 72, 2005); Lajeunesse,
Monnier and Homsy (Physics of Fluids 17, 2005) have the same powers.

A channel is plane strain. There Drucker-Prager's cone, whose angle is that of triaxial compression, is steeper: flow without
dilation makes the middle principal stress the mean of the others, so that sin(plane) = 2 sqrt(3) sin(angle)/(3 - sin(angle)).
30 degrees are 43.9 in a channel, and 22.8 are 31, the experiments' sand.
"""

from __future__ import annotations

import argparse
import math
import time

import torch

from mosa.physics.contact.planes import Plane
from mosa.physics.engine.simulator import Simulator
from mosa.types import ParticleState

BASE, DENSITY, E, NU, GRAVITY = 0.2, 1500.0, 5e5, 0.3, 9.8


def plane_angle(angle: float) -> float:
    """Friction angle in plane strain [degrees] of the cone whose angle in triaxial compression is `angle` [degrees]."""
    s = math.sin(math.radians(angle))
    return math.degrees(math.asin(min(1.0, 2 * math.sqrt(3) * s / (3 - s))))


def triaxial_angle(plane: float) -> float:
    """The inverse of `plane_angle`."""
    s = math.sin(math.radians(plane))
    return math.degrees(math.asin(3 * s / (2 * math.sqrt(3) + s)))


def published(aspect: float) -> float:
    return 1.2 * aspect if aspect < 2.3 else 1.9 * aspect ** (2 / 3)


def run_out(
    aspect: float,
    angle: float,
    cells: int,
    young: float = E,
    width: float | None = None,
    rubbing: float = 0.0,
) -> tuple[float, float, float]:
    """(run-out of 99 % of the mass, slope of the heap's middle [degrees], speed left [m/s]) after 6 sqrt(height/g). young [Pa]: of
    the grains; width: of the channel over the base, None for two cells; rubbing: friction of its side walls."""
    dx, depth = BASE / cells, 2 if width is None else max(2, round(width * cells))
    h = dx / 2
    axes = [(torch.arange(n) + 0.5) * h for n in (2 * cells, round(2 * cells * aspect), 2 * depth)]
    x = torch.cartesian_prod(*axes)
    eye = torch.eye(3).expand(len(x), 3, 3).contiguous()
    state = ParticleState(x, torch.zeros_like(x), torch.zeros_like(eye), eye, eye)
    lam, mu = young * NU / ((1 + NU) * (1 - 2 * NU)), young / (2 * (1 + NU))
    s = math.sin(math.radians(angle))
    alpha = math.sqrt(2 / 3) * 2 * s / (3 - s)
    duration, frame_dt = 6 * math.sqrt(aspect * BASE / GRAVITY), 0.01
    side = ("slip", 0.0) if rubbing == 0 else ("separate", rubbing)
    planes = [Plane((0, 0, 0), (0, 1, 0)), Plane((0, 0, 0), (1, 0, 0), "slip"), Plane((0, 0, 0), (0, 0, 1), *side),
              Plane((0, 0, depth * dx), (0, 0, -1), *side)]  # fmt: skip
    substeps = math.ceil(frame_dt * (math.sqrt((lam + 2 * mu) / DENSITY) + 3) / (0.5 * dx))
    simulator = Simulator(
        "drucker_prager",
        dx=dx,
        substeps=substeps,
        frame_dt=frame_dt,
        gravity=(0, -GRAVITY, 0),
        planes=planes,
    )
    parameters = {"mu": mu, "lam": lam, "friction_alpha": alpha, "cohesion": 0.0}
    with torch.no_grad():
        out = simulator.rollout(
            state, parameters, torch.full((len(x),), h**3), DENSITY, round(duration / frame_dt) + 1
        )
    last = out.x[-1]
    front = float(last[:, 0].quantile(0.99))
    there = [
        last[(last[:, 0] > a) & (last[:, 0] < a + dx), 1] for a in (0.5 * BASE, front - 2 * dx)
    ]
    columns = [
        float(heights.max()) if len(heights) else 0.0 for heights in there
    ]  # grains may have flown on
    slope = math.degrees(math.atan2(columns[0] - columns[1], front - 2 * dx - 0.5 * BASE))
    return (front - BASE) / BASE, slope, float(out.v[-1].norm(dim=1).mean())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--aspects", type=float, nargs="+", default=[0.5, 1, 2, 3, 5])
    angles = [30.0, triaxial_angle(31.0)]
    parser.add_argument(
        "--angles", type=float, nargs="+", default=angles, help="of the cone [degrees]"
    )
    parser.add_argument("--cells", type=int, default=16, help="of the base")
    parser.add_argument("--young", type=float, default=E, help="of the grains [Pa]")
    parser.add_argument(
        "--width",
        type=float,
        default=None,
        help="of the channel, over the base; default: two cells",
    )
    parser.add_argument(
        "--rubbing", type=float, default=0.0, help="friction of its side walls; 0: they slip"
    )
    options = parser.parse_args()
    print(
        "| aspect | published | cone [degrees] | in the channel | run-out | over published | slope [degrees] | speed [m/s] | s |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for angle in options.angles:
        for aspect in options.aspects:
            began = time.perf_counter()
            reach, slope, speed = run_out(
                aspect, angle, options.cells, options.young, options.width, options.rubbing
            )
            print(
                f"| {aspect:g} | {published(aspect):.2f} | {angle:.1f} | {plane_angle(angle):.1f} | {reach:.2f} | "
                f"{reach / published(aspect):.2f} | {slope:.0f} | {speed:.3f} | {time.perf_counter() - began:.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()

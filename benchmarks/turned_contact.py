"""The same drop in a world that is turned against the grid: how far the motion is from that of the world as it stands.

A soft ball (radius 0.1 m, neo-Hookean, E 0.2 MPa, nu 0.3, density 1000 kg/m^3) comes down at 2.4 m/s, the speed of 0.3 m of fall,
on a solid in each mode; world and gravity are turned about a horizontal axis. Printed: root mean square over particles of the
distance to the unturned motion after 0.2 s, the rebound included, in cells; and the speed upwards where nothing is turned.

    python benchmarks/turned_contact.py --particles 1000 4000
"""

from __future__ import annotations

import argparse
import math

import torch

from mosa.errors import MosaError
from mosa.physics.contact.colliders import Box, Collider, HalfSpace, Sphere
from mosa.physics.contact.mesh import SignedDistanceField
from mosa.physics.contact.motion import Motion, exponential
from mosa.physics.engine.simulator import Simulator
from mosa.types import ParticleState

RADIUS, SPEED, E, NU, DENSITY, SECONDS, FRAMES = 0.1, 2.4, 2e5, 0.3, 1000.0, 0.2, 8
MODES = (("sticky", 0.0), ("slip", 0.0), ("separate", 0.4), ("touch", 0.4))
ANGLES = (10, 20, 30, 45)


def bump() -> SignedDistanceField:
    """Lattice of distances, as of a mesh: a ball of 0.2 m with a flat top at z = 0."""
    wide, high = 0.01 * torch.arange(-28, 29).double(), 0.01 * torch.arange(-30, 13).double()
    x, y, z = torch.meshgrid(wide, wide, high, indexing="ij")
    return SignedDistanceField(
        torch.maximum((x**2 + y**2 + (z + 0.1) ** 2).sqrt() - 0.2, z),
        (-0.28, -0.28, -0.3),
        0.01,
        0.08,
    )


SOLIDS = {
    "plane": (HalfSpace(), 0.0),
    "box": (Box((0.3, 0.3, 0.2)), 0.1),
    "sphere": (Sphere(0.2), 0.2),
    "lattice": (bump(), 0.0),
}
"""Shapes, and how far their origin is below their top [m]."""


def ball(particles: int) -> tuple[torch.Tensor, float]:
    """(particles (N, 3) [m] on the ground, their spacing [m])."""
    s = RADIUS * (4 / 3 * math.pi / particles) ** (1 / 3)
    axis = s * (torch.arange(-40, 40).double() + 0.5)
    x = torch.cartesian_prod(axis, axis, axis)
    x = x[x.norm(dim=1) < RADIUS] @ exponential(torch.tensor([0.4, 0.2, 0.1]).double()).T
    return x + torch.tensor([0.03, 0.01, 0.6 * s - float(x[:, 2].min())]).double(), s


def drop(
    solid: str, mode: str, friction: float, degrees: float, particles: int
) -> tuple[torch.Tensor, float, float]:
    """(particles at the end, turned back; speed upwards [m/s]; cell [m])."""
    x, s = ball(particles)
    dx, lam, mu = 1.6 * s, E * NU / (1 + NU) / (1 - 2 * NU), E / 2 / (1 + NU)
    R = exponential(math.radians(degrees) * torch.tensor([0.6, 0.8, 0.0]).double())
    shape, below = SOLIDS[solid]
    collider = Collider(
        shape, mode, friction, Motion(R @ torch.tensor([0.0, 0.0, -below]).double(), R)
    )
    eye = torch.eye(3).double().expand(len(x), 3, 3).contiguous()
    v = R @ torch.tensor([0.3, 0.0, -SPEED]).double()
    start = ParticleState((x @ R.T).contiguous(), v.expand_as(x).contiguous(), 0 * eye, eye, eye)
    substeps = math.ceil(
        SECONDS / FRAMES * (math.sqrt((lam + 2 * mu) / DENSITY) + SPEED) / (0.4 * dx)
    )
    simulator = Simulator("neo_hookean", dx=dx, substeps=substeps, frame_dt=SECONDS / FRAMES, colliders=[collider],
                          gravity=R @ torch.tensor([0.0, 0.0, -9.8]).double(), dtype=torch.float64)  # fmt: skip
    with torch.no_grad():
        end = simulator.rollout(
            start, {"mu": mu, "lam": lam}, torch.full((len(x),), s**3).double(), DENSITY, FRAMES + 1
        ).final
    return end.x @ R, float((end.v @ R)[:, 2].mean()), dx


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--particles", type=int, nargs="+", default=[1000, 4000])
    parser.add_argument("--solids", nargs="+", default=list(SOLIDS), choices=SOLIDS)
    given = parser.parse_args()
    print(
        f"| particles | solid, mode | speed after 0.2 s [m/s] | {' | '.join(f'{a} degrees' for a in ANGLES)} |"
    )
    print("|---" * (3 + len(ANGLES)) + "|")
    for particles in given.particles:
        for solid in given.solids:
            for mode, friction in MODES:
                try:
                    flat, up, dx = drop(solid, mode, friction, 0.0, particles)
                    away = [drop(solid, mode, friction, a, particles)[0] - flat for a in ANGLES]
                except MosaError as error:
                    print(f"| {particles} | {solid}, {mode} | {error} |")
                    continue
                cells = [f"{float(d.norm(dim=1).square().mean().sqrt()) / dx:.3f}" for d in away]
                print(
                    f"| {particles} | {solid}, {mode} | {up:.2f} | {' | '.join(cells)} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()

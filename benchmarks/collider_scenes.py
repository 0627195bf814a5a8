"""Picture of bodies among colliders beside closed forms: docs/images/colliders.png.

    python benchmarks/collider_scenes.py [output.png]

A sphere rolls (friction) and slides (none) down an incline and bounces from the ground; a block is squeezed between moving plates
and the force on them is compared with the uniaxial neo-Hookean stress. About half a minute on one core.
"""

import argparse
import math
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import torch

from mosa.physics.constitutive.elasticity import lame
from mosa.physics.contact.colliders import Box, Collider, HalfSpace
from mosa.physics.contact.motion import Motion, exponential
from mosa.physics.engine.simulator import Simulator
from mosa.physics.time.time_step import required_substeps
from mosa.types import ParticleState, Rollout

DENSITY, G = 1000.0, 9.8


def simulate(
    x, colliders, *, dx, E, frame_dt, frames, gravity=(0.0, 0.0, 0.0), v=(0.0, 0.0, 0.0), C=None
) -> Rollout:
    mu, lam = lame(torch.tensor(E), torch.tensor(0.3))
    substeps = required_substeps(float(lam + 2 * mu), DENSITY, frame_dt, dx, 3.0)
    simulator = Simulator(
        "neo_hookean",
        dx=dx,
        substeps=substeps,
        frame_dt=frame_dt,
        gravity=gravity,
        colliders=colliders,
    )
    eye = torch.eye(3).expand(len(x), 3, 3).contiguous()
    C = torch.zeros_like(eye) if C is None else C.expand_as(eye).contiguous()
    velocity = torch.as_tensor(v, dtype=torch.float32).expand_as(x).contiguous()
    volume = torch.full((len(x),), (dx / 2) ** 3)
    return simulator.rollout(
        ParticleState(x.contiguous(), velocity, C, eye, eye),
        {"mu": mu, "lam": lam},
        volume,
        DENSITY,
        frames,
    )


def lattice(size: tuple, spacing: float) -> torch.Tensor:
    axes = [(torch.arange(round(s / spacing)) + 0.5) * spacing - s / 2 for s in size]
    return torch.cartesian_prod(*axes)


def ball(radius: float, spacing: float) -> torch.Tensor:
    x = lattice((2 * radius + 2 * spacing,) * 3, spacing)
    return x[x.norm(dim=1) < radius]


def incline(friction: float, radius=0.1, degrees=20.0):
    """(rollout, rest positions, rotation of the incline): down along the turned x axis."""
    dx = radius / 6
    R = exponential(torch.tensor([0.0, math.radians(degrees), 0.0]))
    rest = ball(radius, dx / 2)
    x = (rest + torch.tensor([0.0, 0.0, radius + 0.2 * dx])) @ R.mT
    ground = [Collider(HalfSpace(), "separate", friction, Motion(rotation=R))]
    return simulate(x, ground, dx=dx, E=5e5, frame_dt=0.02, frames=31, gravity=(0, 0, -G)), rest, R


def bounce(radius=0.1, height=0.3):
    dx = radius / 6
    rest = ball(radius, dx / 2)
    x = rest + torch.tensor([0.0, 0.0, radius + height])
    return simulate(x, [Collider(HalfSpace(), "separate", 0.3)], dx=dx, E=2e5, frame_dt=0.01, frames=71, gravity=(0, 0, -G),
                    v=(1.5, 0.0, 0.0)), rest  # fmt: skip


def squeeze(edge=0.2, cells=12, stroke=0.3, duration=1.2, frames=60):
    """(rollout, rest, plate positions (T,)): both plates move by half the stroke."""
    dx, rate = edge / cells, stroke / duration
    rest = lattice((edge,) * 3, dx / 2)
    gradient = torch.diag(torch.tensor([0.3, 0.3, -1.0])) * rate
    motions = [
        Motion((0.0, 0.0, s * edge), velocity=(0.0, 0.0, -s * rate * edge / 2)) for s in (-1, 1)
    ]
    plates = [
        Collider(Box((4 * edge, 4 * edge, edge)), "slip", motion=motion) for motion in motions
    ]
    result = simulate(
        rest,
        plates,
        dx=dx,
        E=1e5,
        frame_dt=duration / frames,
        frames=frames + 1,
        v=rest @ gradient,
        C=gradient,
    )
    return result, rest, edge / 2 * (1 - rate * result.times)


def uniaxial_force(stretch: torch.Tensor, area: float, E=1e5) -> torch.Tensor:
    """Force [N] of a neo-Hookean bar with free sides at this stretch, compression positive."""
    mu, lam = (float(v) for v in lame(torch.tensor(E), torch.tensor(0.3)))
    side = torch.ones_like(stretch)
    for _ in range(30):
        side = side - (mu * (side**2 - 1) + lam * torch.log(side**2 * stretch)) / (
            2 * mu * side + 2 * lam / side
        )
    return -(mu * (stretch**2 - 1) + lam * torch.log(side**2 * stretch)) / stretch * area


def snapshots(axis, rollout: Rollout, rest: torch.Tensor, frames: list[int]) -> None:
    """The middle slice of the body at some frames, coloured by quadrant of the material so that a turn shows."""
    middle = rest[:, 1].abs() < 0.03
    colour = ((rest[:, 0] * rest[:, 2]) > 0)[middle].numpy()
    for frame in frames:
        p = rollout.x[frame][middle]
        axis.scatter(
            p[:, 0],
            p[:, 2],
            c=[("#c44e52", "#4c72b0")[int(c)] for c in colour],
            s=1.5,
            linewidths=0,
        )
    axis.set_aspect("equal")
    axis.set_xlabel("x [m]")
    axis.set_ylabel("z [m]")


def along(rollout: Rollout, R: torch.Tensor) -> torch.Tensor:
    """Distance [m] that the centre has gone down the incline."""
    centre = rollout.x.mean(1) @ R
    return centre[:, 0] - centre[0, 0]


def draw(path: Path) -> None:
    figure, axes = plt.subplots(2, 3, figsize=(14, 8))
    inclines = [("rolls (friction 0.6)", incline(0.6)), ("slides (no friction)", incline(0.0))]
    for axis, (title, (rollout, rest, R)) in zip(axes[0], inclines):
        snapshots(axis, rollout, rest, [0, 18, 30])
        down = R @ torch.tensor([1.0, 0.0, 0.0])
        axis.plot([-0.2 * down[0], 0.8 * down[0]], [-0.2 * down[2], 0.8 * down[2]], "k", lw=1)
        axis.set_title(f"sphere {title}, 20 degrees")
    rollout, rest = bounce()
    snapshots(axes[0, 2], rollout, rest, [0, 26, 48, 70])
    axes[0, 2].axhline(0.0, color="k", lw=1)
    axes[0, 2].plot(rollout.x.mean(1)[:, 0], rollout.x.mean(1)[:, 2], "k:", lw=1)
    axes[0, 2].set_title("sphere bounces")
    sine, axis = math.sin(math.radians(20.0)), axes[1, 0]
    for (title, (rollout, _, R)), factor, style in zip(inclines, (5 / 7, 1.0), ("C0", "C1")):
        t, s = rollout.times, along(rollout, R)
        # from frame 5 on, when it has settled: position and velocity there are taken from the simulation
        v = rollout.v[5].mean(0) @ R[:, 0]
        closed = s[5] + v * (t - t[5]) + 0.5 * factor * G * sine * (t - t[5]) ** 2
        axis.plot(t, s, style + ".", label=title)
        axis.plot(t[5:], closed[5:], style, label=f"{'5/7 ' if factor < 1 else ''}g sin(20 deg)")
        gone, expected = (
            float(s[-1] - s[5] - v * (t[-1] - t[5])),
            float(closed[-1] - s[5] - v * (t[-1] - t[5])),
        )
        print(f"sphere {title}: acceleration {gone / expected:.3f} of the closed form")
    axis.set(xlabel="t [s]", ylabel="distance down [m]", title="down the incline")
    axis.legend()
    rollout, rest, plate = squeeze()
    snapshots(axes[1, 1], rollout, rest, [60])
    outline = axes[1, 1]
    outline.plot([-0.1, 0.1, 0.1, -0.1, -0.1], [-0.1, -0.1, 0.1, 0.1, -0.1], "k:", lw=1)
    for s in (-1, 1):
        outline.fill_between([-0.18, 0.18], s * float(plate[-1]), s * 0.13, color="0.7")
    outline.set_title("block between slipping plates (dotted: at rest)")
    stretch = rollout.F[:, rest[:, 2].abs() < 0.05, 2, 2].mean(1)
    stretch = 0.5 * (stretch[1:] + stretch[:-1])
    measured, expected = rollout.reactions[..., 1, 2].mean(1), uniaxial_force(stretch, 0.04)
    axis = axes[1, 2]
    axis.plot(1 - stretch, expected, "k", label="uniaxial neo-Hooke at the measured stretch")
    axis.plot(1 - stretch, measured, "C0.", label="reaction of the upper plate")
    axis.set(xlabel="1 - stretch of the middle half", ylabel="force [N]", title="squeezed block")
    axis.legend(loc="lower right", fontsize=8)
    late = slice(15, None)
    worst = float(((measured - expected) / expected)[late].abs().max())
    print(f"squeezed block: force within {100 * worst:.2f} % of the closed form")
    figure.tight_layout()
    figure.savefig(path, dpi=80)
    print(f"wrote {path}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    picture = Path(__file__).parents[1] / "docs" / "images" / "colliders.png"
    parser.add_argument("output", type=Path, nargs="?", default=picture, help="PNG")
    draw(parser.parse_args().output)

"""What to film next: drops and presses ranked by how much they would tell about the learned law.

Where the laws that are still possible predict different motions, seeing the motion tells them apart. For laws drawn from the
posterior the expected information of a film is that of the linear Gaussian model, 1/2 log det(I + K), K the draws' covariance
in units of the noise (Chaloner and Verdinelli, Bayesian experimental design: a review, Statistical Science 10, 1995).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from mosa.errors import ConfigError, MosaError
from mosa.modules.fitting.parameters import each_law
from mosa.system.progress import tqdm
from mosa.twin.start import rotation_matrix
from mosa.twin.twin import Twin

INDEPENDENT = 30.0  # data in a frame, as `identification.count`
LEAST_DRAWS = 4
SQUEEZED, AWAY = 0.2, 1.5
"""Share of the body's height that a press takes; particle spacings of the plate from the body at first."""


@dataclass(frozen=True)
class Candidate:
    """A start as `Twin.simulate` takes it, and the information [nats] that its motion is expected to give. plate: speed [m/s] of
    a plate that comes down on the body, which then stands on the ground; 0: a drop."""

    rotation: tuple[float, float, float, float]
    height: float
    velocity: tuple[float, float, float]
    gain: float
    plate: float = 0.0


def information(drawn: Tensor, noise: float) -> float:
    """1/2 log det(I + K) [nats] of positions (D, T, N, 3) [m] under D drawn laws; noise [m]: of a particle's position."""
    draws, _, particles = drawn.shape[:3]
    away = (drawn - drawn.mean(0)).reshape(draws, -1).double()
    # neighbouring particles are one datum: each counts as INDEPENDENT/N of one, and noise is over three components
    share = min(1.0, INDEPENDENT / particles) * 3 / noise**2 / (draws - 1)
    values = torch.linalg.eigvalsh(away @ away.T).clamp(min=0) * share
    return 0.5 * float(torch.log1p(values).sum())


def drawn_starts(count: int, seed: int) -> list[tuple[float, float, float, float]]:
    """(axis, degrees) of `count` rotations, evenly drawn; the first is the rest pose, which the training drop shows already."""
    quaternions = np.random.default_rng(seed).normal(size=(count - 1, 4))
    found = [(0.0, 1.0, 0.0, 0.0)]
    for vector in (Rotation.from_quat(q).as_rotvec() for q in quaternions):
        angle = float((vector @ vector) ** 0.5)
        found.append((*(float(v) / angle for v in vector), math.degrees(angle)))
    return found


def press(
    twin: Twin, rotation: tuple[float, float, float, float], frames: int
) -> tuple[float, dict[str, Any]]:
    """(speed [m/s] of the plate, further arguments of `Twin.simulate`) of a press by a plate that does not rub."""
    body, world = twin.body, twin.world
    assert world.ground is not None
    up = world.up.double().cpu()
    heights = body.rest.double().cpu() @ rotation_matrix(rotation).double().T @ up
    tall = float(heights.max() - heights.min())
    gap = AWAY * body.spacing
    speed = (SQUEEZED * tall + gap) / ((frames - 1) * twin.frame_dt)
    top, motion = up * (world.ground.height + tall + gap), {"velocity": (-speed * up).tolist()}
    plate = {"type": "plane", "normal": (-up).tolist(), "position": top.tolist(), "motion": motion}
    plate |= {"mode": "touch", "name": "plate"}
    return speed, {"angular_velocity": (0.0, 0.0, 0.0), "colliders": [plate]}


@torch.no_grad()
def plan(
    twin: Twin, *, count: int = 8, draws: int = 16, frames: int = 15, seed: int = 0, presses: bool = False
) -> list[Candidate]:  # fmt: skip
    """`count` starts, the most telling first: turned at random, thrown down as the training drop was, from where it fell.
    presses: the body also stands on the ground in each of these poses, and a plate comes down on it. What the force on the plate
    would tell is left out.

    Errors: ConfigError where the run kept no posterior, or no start can be simulated."""
    if twin.posterior is None:
        way = "a fit that ends by Gauss-Newton does (adapter=operator, linear or none)"
        raise ConfigError(f"plan: this run kept no posterior; {way}")
    speed = tuple(float(v) for v in twin.training_start.velocity)
    up, ground = twin.world.up, twin.world.ground
    lowest = float((twin.body.rest.cpu() @ up).min())
    height = max(0.02, lowest - (ground.height if ground is not None else 0.0))
    numbers = twin.posterior.draws(draws, torch.Generator().manual_seed(seed))
    ranked, why = [], ""
    for rotation in tqdm(drawn_starts(count, seed), "candidates"):
        ways: list[tuple[Any, ...]] = [(height, speed, 0.0, {})]
        if presses and ground is not None:
            ways.append((0.0, (0.0, 0.0, 0.0), *press(twin, rotation, frames)))
        for lifted, velocity, plate, more in ways:
            start = {"rotation": rotation, "height": lifted, "velocity": velocity}
            motions = []
            for _ in each_law(twin.body, numbers):
                try:
                    motions.append(twin.simulate(**start, frames=frames, **more).x.cpu())
                except MosaError as error:  # a turned body may also begin inside of a solid
                    why = str(error)
            if len(motions) >= LEAST_DRAWS:
                gain = information(torch.stack(motions), max(twin.posterior.model_error, 1e-3))
                ranked.append(Candidate(**start, gain=gain, plate=plate))
    if not ranked:
        raise ConfigError(f"plan: none of the candidate starts can be simulated: {why}")
    return sorted(ranked, key=lambda each: -each.gain)


def plan_text(ranked: list[Candidate]) -> str:
    """What a person does next, in lines."""
    from_ = "axis and degrees from the pose of the training drop's first frame"
    lines = [f"Film this next (rotation: {from_}):", ""]
    for i, each in enumerate(ranked, 1):
        x, y, z, degrees = each.rotation
        speed = ", ".join(f"{v:.2f}" for v in each.velocity)
        way = f"lowest point {each.height:.3f} m above the ground, thrown at ({speed}) m/s"
        if each.plate:
            way = f"stands, pressed by {SQUEEZED:.0%} of its height by a plate that comes down at {each.plate:.3f} m/s"
        turned = f"turned by {degrees:3.0f} degrees about ({x:.2f}, {y:.2f}, {z:.2f})"
        lines.append(f"{i}. {each.gain:6.2f} nats: {turned}, {way}")
    return "\n".join(lines)

"""A cylinder squeezed between two plates: what they feel, against the uniaxial force of the stroke they made."""

from __future__ import annotations

import math

import torch
from bodies import DENSITY, LAM, MU, resting

from mosa.physics.contact.colliders import Collider, HalfSpace
from mosa.physics.contact.motion import Motion, exponential
from mosa.physics.engine.simulator import Simulator

HEIGHT, RADIUS, STROKE, RAMP, HOLD, FRAME = 0.2, 0.1, 0.3, 0.3, 0.1, 0.01


def uniaxial(stretch: float) -> float:
    """Force per reference area [Pa] of the corotated law whose sides are free."""
    low, high = 0.5, 2.0
    for _ in range(100):
        side = 0.5 * (low + high)
        J = stretch * side**2
        low, high = (
            (low, side) if 2 * MU * (side - 1) * side + LAM * (J - 1) * J > 0 else (side, high)
        )
    return (2 * MU * (stretch - 1) * stretch + LAM * (J - 1) * J) / stretch


def squeezed(cells: int, *, angle: float = 0.0, mode: str = "separate") -> float:
    """Mean force on the plates, without friction, over that of 30 % of stroke. cells: of the cylinder's height; angle [degrees]:
    of its axis out of the grid; mode: of the plates' contact."""
    dx = HEIGHT / cells
    h, n, t = dx / 2, 2 * cells, math.radians(angle)
    R = torch.eye(3, dtype=torch.float64)
    R[:2, :2] = torch.tensor([[math.cos(t), math.sin(t)], [-math.sin(t), math.cos(t)]])
    along = (torch.arange(n).double() + 0.5) * h
    rest = torch.stack(
        torch.meshgrid(along - RADIUS, along, along - RADIUS, indexing="ij"), -1
    ).reshape(-1, 3)
    rest = rest[rest[:, 0] ** 2 + rest[:, 2] ** 2 < RADIUS**2]
    offset = R @ torch.tensor([0.0, 0.3 * dx if angle else 0.0, 0.0], dtype=torch.float64)
    axis, z = R[:, 1], torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    plates = []
    for side, height in ((1, 0.0), (-1, HEIGHT)):
        turn = torch.linalg.cross(z, side * axis)
        attitude = exponential(turn / turn.norm() * math.pi / 2)
        first, last = (
            offset + height * axis,
            offset + (height + side * 0.5 * STROKE * HEIGHT) * axis,
        )
        places = [p.tolist() for p in (first, last, last)]
        motion = Motion.waypoints([0, RAMP, RAMP + HOLD + 1], places, torch.stack([attitude] * 3))
        plates.append(Collider(HalfSpace(), mode, 0.0, motion))
    substeps = math.ceil(FRAME * math.sqrt((LAM + 2 * MU) / DENSITY) / (0.4 * dx))
    simulator = Simulator("corotated", dx=dx, substeps=substeps, frame_dt=FRAME, gravity=(0, 0, 0), up=(0, 1, 0), colliders=plates,
                          dtype=torch.float64)  # fmt: skip
    with torch.no_grad():
        out = simulator.rollout(resting(rest @ R.T + offset), {"mu": MU, "lam": LAM}, torch.full((len(rest),), h**3).double(),
                                DENSITY, round((RAMP + HOLD) / FRAME) + 1)  # fmt: skip
    force = (out.reactions[round(RAMP / FRAME) :, :, :, :3] @ axis).mean((0, 1))
    area = len(rest) * h**3 / HEIGHT
    return float((force[1] - force[0]) / 2 / (-uniaxial(1 - STROKE) * area))

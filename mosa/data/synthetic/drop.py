"""The truth: a body with its hidden material, simulated from one drop on a finer grid, in smaller steps than the learner's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from mosa.data.synthetic.bodies.objects import BuiltinObject, Drop
from mosa.data.synthetic.materials.hidden import Hidden
from mosa.physics.engine.simulator import Simulator
from mosa.physics.time.time_step import required_substeps
from mosa.types import Ground, ParticleState

GRAVITY = (0.0, -9.8, 0.0)
# share of the sound-speed bound on the time step that is used: squashed, the material is stiffer than at rest
COURANT = 0.3


@dataclass(frozen=True)
class Fall:
    """rest: (N, 3) rest positions [m] (those of the training sequence's frame 0); positions: (T, N, 3) [m]; rotation: (3, 3);
    velocity: (3,) [m/s] at frame 0; substeps per frame."""

    rest: np.ndarray
    positions: np.ndarray
    rotation: np.ndarray
    velocity: np.ndarray
    substeps: int


def place(
    points: np.ndarray, center: np.ndarray, drop: Drop, lowest: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Points of the shape's frame at frame 0 of a drop, and where `center` goes. lowest: surface points (M, 3) that decide the
    height: free fall brings the lowest of them to the ground at time drop.contact."""
    Q = drop.rotation
    gap = drop.speed * drop.contact + 0.5 * 9.8 * drop.contact**2
    arms = (lowest - center) @ Q.T
    target = np.array([drop.offset[0], gap - arms[:, 1].min(), drop.offset[1]])
    return (points - center) @ Q.T + target, target


def simulate(
    body: BuiltinObject, material: Hidden, particles: np.ndarray, surface: np.ndarray, drop: Drop,
    training: Drop, *, progress: Callable[[int], None] | None = None, device: str = "cpu",
) -> Fall:  # fmt: skip
    """Particles (N, 3) of the shape's frame through a drop; surface: (M, 3) points of the shape's frame."""
    center = particles.mean(0)
    center[[0, 2]] = 0.0  # turned about an axis through the shape's own origin: offsets stay
    rest, _ = place(particles, center, training, surface)
    start, _ = place(particles, center, drop, surface)
    frame_dt, dx = 1 / body.footage.fps, body.dx
    reach = drop.speed + 9.8 * frame_dt * body.footage.frames
    substeps = required_substeps(
        material.wave_modulus(), material.density, frame_dt, dx, v_max=reach, courant=COURANT, limit=5000,
        viscosity=material.viscosity(),
    )  # fmt: skip
    simulator = Simulator(
        material.law, dx=dx, substeps=substeps, frame_dt=frame_dt, gravity=GRAVITY, up=(0.0, 1.0, 0.0),
        ground=Ground(0.0, body.meeting.mode, body.meeting.friction), options=material.options,
        device=device,
    )  # fmt: skip
    velocity = np.array([0.0, -drop.speed, 0.0])
    n = len(particles)
    lift = np.array([0.0, body.meeting.lift * dx, 0.0])
    tensor = lambda a: torch.tensor(a, dtype=torch.float32, device=device)  # noqa: E731
    F = tensor(drop.rotation).expand(n, 3, 3).contiguous()
    # velocities half a substep early: symplectic Euler then follows the parabola exactly
    early = tensor(velocity) - 0.5 * frame_dt / substeps * tensor(GRAVITY)
    x, v = tensor(start + lift), early.expand(n, 3).contiguous()
    state = ParticleState(x, v, torch.zeros_like(F), F, F)
    volume = torch.full_like(x[:, 0], body.spacing**3)
    given = material.parameters(tensor(rest)), volume, material.density, body.footage.frames
    with torch.no_grad():
        rollout = simulator.rollout(state, *given, progress=progress)
    return Fall(rest, rollout.x.double().cpu().numpy() - lift, drop.rotation, velocity, substeps)

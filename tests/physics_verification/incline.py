"""Block on an incline with Coulomb friction (check 16): it slips from the friction angle on, slides as a point mass does, and stays
below that angle also where gravity begins at once."""

from __future__ import annotations

import math

import torch
from bodies import DENSITY, LAM, MU, lattice, resting, uniform_volume

from mosa.physics.contact.planes import Plane
from mosa.physics.engine.simulator import Simulator

GRAVITY = 9.8


def slide(angle: float, friction: float, dtype: torch.dtype = torch.float64, law: str = "corotated",
          seconds: float = 0.4) -> tuple[float, float]:  # fmt: skip
    """(acceleration down the incline over the second half of the time [m/s^2], speed at its end [m/s]); angle [degrees].

    The incline is the plane y = 0 and gravity is turned. The block still swings a little on its lower face, so its normal force
    is not quite m g cos: friction (v_y1 - v_y0)/t is added, which makes m a t = m g sin t - friction (normal impulse) that of a
    block whose normal force is m g cos.
    """
    dx, n, frames, frame_dt = 0.04, 6, round(seconds / 0.005), 0.005
    x = lattice((n, n, n), dx / 2)
    state = resting(x, dtype=dtype)
    t = math.radians(angle)
    sim = Simulator(law, dx=dx, substeps=20, frame_dt=frame_dt, gravity=(GRAVITY * math.sin(t), -GRAVITY * math.cos(t), 0.0),
                    up=(0.0, 1.0, 0.0), planes=[Plane((0, 0, 0), (0, 1, 0), "separate", friction)], dtype=dtype)  # fmt: skip
    with torch.no_grad():
        out = sim.rollout(
            state, {"mu": MU, "lam": LAM}, uniform_volume(state, dx / 2), DENSITY, frames + 1
        )
    v = out.v.double().mean(1)
    half = frames // 2
    gain = (v[-1] - v[half]) / (frame_dt * (frames - half))
    return float(gain[0] + friction * gain[1]), float(v[-1, 0])


def bounced(thickness: float | None) -> float:
    """Largest speed upwards [m/s] of a soft block of 6 x 5 x 4 cells of 20 mm after its fall at 1.5 m/s, turned, onto friction 0.3.
    thickness [m]: of the contact."""
    dx, E, frame_dt = 0.02, 3e4, 1 / 60
    mu, lam, t = E / 2.7, E * 0.35 / (1.35 * 0.3), 0.6
    R = torch.eye(3, dtype=torch.float64)
    R[:2, :2] = torch.tensor([[math.cos(t), -math.sin(t)], [math.sin(t), math.cos(t)]])
    x = lattice((12, 10, 8), dx / 2) @ R.T
    state = resting(
        x - torch.tensor([0.0, float(x[:, 1].min()) - 0.02, 0.0]).double(), (0.3, -1.5, 0.0)
    )
    plane = Plane((0, 0, 0), (0, 1, 0), "separate", 0.3, thickness)
    substeps = math.ceil(frame_dt * (math.sqrt((lam + 2 * mu) / DENSITY) + 3) / (0.4 * dx))
    sim = Simulator("corotated", dx=dx, substeps=substeps, frame_dt=frame_dt, gravity=(0, -GRAVITY, 0), up=(0, 1, 0),
                    planes=[plane], dtype=torch.float64)  # fmt: skip
    with torch.no_grad():
        out = sim.rollout(state, {"mu": mu, "lam": lam}, uniform_volume(state, dx / 2), DENSITY, 20)
    return float(out.v.mean(1)[:, 1].max())


def point_mass(angle: float, friction: float) -> float:
    """g (sin - friction cos) [m/s^2]."""
    t = math.radians(angle)
    return GRAVITY * (math.sin(t) - friction * math.cos(t))


def slip_angle(friction: float, dtype: torch.dtype = torch.float64) -> float:
    """Angle [degrees] at which the acceleration of a sliding block, extrapolated linearly from two steeper ones, vanishes."""
    steep = math.degrees(math.atan(friction))
    (a, _), (b, _) = slide(steep + 3, friction, dtype), slide(steep + 6, friction, dtype)
    return steep + 3 - 3 * a / (b - a)


def released(
    angle: float,
    friction: float,
    *,
    E: float = 1e6,
    turned: bool = False,
    gap: float = 0.0,
    thickness: float | None = None,
) -> tuple[float, float]:
    """(way [m], speed at the end [m/s]) down an incline, in 0.4 s, of a flat block of 10 x 3 x 5 cells that nothing strains when
    gravity begins. angle [degrees]; turned: the grid is horizontal and the incline crosses it; gap [cells] between block and
    incline; thickness [m]: of the contact."""
    dx, frames, frame_dt = 0.04, 80, 0.005
    t, mu, lam = math.radians(angle), E / 2.6, E * 0.3 / (1.3 * 0.4)
    R = torch.eye(3, dtype=torch.float64)
    if turned:
        R[:2, :2] = torch.tensor([[math.cos(t), math.sin(t)], [-math.sin(t), math.cos(t)]])
    x = lattice((20, 6, 10), dx / 2, (0.0, gap * dx, 0.0))
    state = resting(x @ R.T)
    substeps = math.ceil(frame_dt * math.sqrt((lam + 2 * mu) / DENSITY) / (0.3 * dx))
    down = R @ torch.tensor([math.sin(t), -math.cos(t), 0.0], dtype=torch.float64)
    plane = Plane((0, 0, 0), tuple(R[:, 1].tolist()), "separate", friction, thickness)
    sim = Simulator("corotated", dx=dx, substeps=substeps, frame_dt=frame_dt, gravity=GRAVITY * down, up=(0.0, 1.0, 0.0),
                    planes=[plane], dtype=torch.float64)  # fmt: skip
    with torch.no_grad():
        out = sim.rollout(
            state, {"mu": mu, "lam": lam}, uniform_volume(state, dx / 2), DENSITY, frames + 1
        )
    along = (out.x.mean(1) @ R)[:, 0]
    return float(along[-1] - along[0]), float(along[-1] - along[-21]) / (20 * frame_dt)

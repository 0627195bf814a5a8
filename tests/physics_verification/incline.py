"""Block on an incline with Coulomb friction (check 16): it slips from the friction angle on, and slides as a point mass does."""

from __future__ import annotations

import math

import torch
from bodies import DENSITY, LAM, MU, lattice, resting, uniform_volume

from mosa.physics.boundary import Plane
from mosa.physics.rollout import Simulator

GRAVITY = 9.8


def slide(angle: float, friction: float, dtype: torch.dtype = torch.float64, law: str = "corotated") -> tuple[float, float]:
    """(acceleration down the incline [m/s^2], mean speed [m/s]) over the second half of 0.4 s; angle [degrees].

    The incline is the plane y = 0 and gravity is turned. The block still swings a little on its lower face, so its normal force
    is not quite m g cos: friction (v_y1 - v_y0)/t is added, which makes m a t = m g sin t - friction (normal impulse) that of a
    block whose normal force is m g cos.
    """
    dx, n, frames, frame_dt = 0.04, 6, 80, 0.005
    x = lattice((n, n, n), dx / 2)
    state = resting(x, dtype=dtype)
    t = math.radians(angle)
    sim = Simulator(law, dx=dx, substeps=20, frame_dt=frame_dt, gravity=(GRAVITY * math.sin(t), -GRAVITY * math.cos(t), 0.0),
                    up=(0.0, 1.0, 0.0), planes=[Plane((0, 0, 0), (0, 1, 0), "separate", friction)], dtype=dtype)  # fmt: skip
    with torch.no_grad():
        out = sim.rollout(state, {"mu": MU, "lam": LAM}, uniform_volume(state, dx / 2), DENSITY, frames + 1)
    v = out.v.double().mean(1)
    half = frames // 2
    gain = (v[-1] - v[half]) / (frame_dt * (frames - half))
    return float(gain[0] + friction * gain[1]), float(v[half:, 0].mean())


def point_mass(angle: float, friction: float) -> float:
    """g (sin - friction cos) [m/s^2]."""
    t = math.radians(angle)
    return GRAVITY * (math.sin(t) - friction * math.cos(t))


def slip_angle(friction: float, dtype: torch.dtype = torch.float64) -> float:
    """Angle [degrees] at which the acceleration of a sliding block, extrapolated linearly from two steeper ones, vanishes."""
    steep = math.degrees(math.atan(friction))
    (a, _), (b, _) = slide(steep + 3, friction, dtype), slide(steep + 6, friction, dtype)
    return steep + 3 - 3 * a / (b - a)

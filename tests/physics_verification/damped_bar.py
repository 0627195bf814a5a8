"""Decay of a free vibrating rod with a viscous branch, against the closed form (check 32).

python tests/physics_verification/damped_bar.py    prints the table of docs/results/contact.md
"""

from __future__ import annotations

import math

import torch
from bodies import DENSITY, lattice, resting, uniform_volume
from scipy.optimize import least_squares

from mosa.physics.constitutive.damping import viscosity
from mosa.physics.engine.simulator import Simulator
from mosa.physics.time.time_step import required_substeps
from mosa.types import ParticleState

MODULUS, LENGTH = 1e6, 0.32
SPEED = math.sqrt(MODULUS / DENSITY)
K = math.pi / LENGTH
GRIDS, RATIOS = (12, 16, 32), (0.002, 0.02, 0.2)


def decay(cells: int, ratio: float, law: str = "neo_hookean", periods: float = 3.0) -> float:
    """Rate [1/s] at which the first standing wave of a free rod, `cells` long, decays: exp(-rate
    t).

    ratio: rate/frequency of the closed form, eta K/(density c): the rate is (4 eta/3 + zeta) K^2/(2
    density), and with nu = 0 and zeta = 2 eta/3 one dimension is exact. ratio 0: what the scheme
    damps by itself.
    """
    dx = LENGTH / cells
    x = lattice((2 * cells, 2, 2), dx / 2)
    state = resting(x)
    eta = ratio * DENSITY * SPEED / K
    v, C = torch.zeros(len(x), 3).double(), torch.zeros(len(x), 3, 3).double()
    amplitude = 1e-4 * SPEED
    v[:, 0] = amplitude * torch.cos(K * x[:, 0])
    C[:, 0, 0] = -amplitude * K * torch.sin(K * x[:, 0])
    state = ParticleState(state.x, v, C, state.F, state.F)
    frame_dt = 2 * math.pi / (K * SPEED) / 24
    values = {"damping": torch.tensor(eta), "bulk_damping": torch.tensor(2 * eta / 3)}
    substeps = required_substeps(
        MODULUS, DENSITY, frame_dt, dx, 0.0, courant=0.4, viscosity=float(viscosity(**values))
    )
    simulator = Simulator(
        law + "~damped",
        dx=dx,
        substeps=substeps,
        frame_dt=frame_dt,
        gravity=(0, 0, 0),
        dtype=torch.float64,
    )
    parameters = {"mu": 0.5 * MODULUS, "lam": 0.0} | values
    with torch.no_grad():
        out = simulator.rollout(
            state, parameters, uniform_volume(state, dx / 2), DENSITY, int(24 * periods) + 1
        )
    mode = ((out.v[..., 0] * torch.cos(K * x[:, 0])).mean(1) / (amplitude / 2)).numpy()

    def missed(p):
        rate, omega, a, b = p
        swing = a * torch.cos(omega * out.times) + b * torch.sin(omega * out.times)
        return (torch.exp(-rate * out.times) * swing).numpy() - mode

    rate = ratio * K * SPEED
    return float(
        least_squares(missed, [rate, K * SPEED, 1.0, 0.0], x_scale=[K * SPEED, K * SPEED, 1, 1]).x[
            0
        ]
    )


if __name__ == "__main__":
    print(
        "cells  ratio  (rate - scheme's own)/closed form  rate/closed form  scheme's own rate/frequency"
    )
    for cells in GRIDS:
        own = decay(cells, 0.0)
        for ratio in RATIOS:
            rate, expected = decay(cells, ratio), ratio * K * SPEED
            shares = f"{(rate - own) / expected:.4f} {rate / expected:.4f} {own / (K * SPEED):.2e}"
            print(cells, ratio, shares, flush=True)
    for ratio in RATIOS:
        print(
            "law",
            ratio,
            *(
                f"{decay(16, ratio, law=law) / (ratio * K * SPEED):.4f}"
                for law in ("corotated", "stvk")
            ),
        )

"""Bodies with a closed solution: affine motion (12), hydrostatic column (14), standing wave (15), cantilever (16)."""

from __future__ import annotations

import math

import numpy as np
import torch
from bodies import DENSITY, NU, eyes, lattice, parameters_of, resting, uniform_volume
from torch import Tensor

from mosa.physics.contact.planes import Plane
from mosa.physics.engine.material_operations import kirchhoff_stress
from mosa.physics.engine.simulator import Simulator
from mosa.types import ParticleState

GRAVITY = 9.8
HELD = 0.178
"""Cells by which a held face is put behind the lowest held plane of nodes: `bar.stiffness_error` vanishes there."""


def thin(law: str, modulus: float) -> dict[str, float]:
    """Parameters of a rod that does not contract sideways: nu = 0, so E = M = 2 mu and one dimension is exact; no yielding."""
    changes = {
        "mu": modulus / 2,
        "lam": 0.0,
        "kappa": modulus / 3,
        "yield_stress": 1e12,
        "cohesion": 1.0,
    }
    return {name: changes.get(name, value) for name, value in parameters_of(law).items()}


def affine_motion(law: str, dtype: torch.dtype) -> dict[str, float]:
    """One substep of an unstrained cloud with v = a + B x, C_affine = B, relative errors of v, C_affine, F and x."""
    dx, dt = 0.04, 2e-4
    g = torch.Generator().manual_seed(2)
    x = 0.3 * torch.rand(300, 3, generator=g, dtype=torch.float64)
    B = 3 * torch.randn(3, 3, generator=g, dtype=torch.float64)
    a = torch.randn(3, generator=g, dtype=torch.float64)
    v, F = a + x @ B.T, eyes(300)
    state = ParticleState(*(t.to(dtype) for t in (x, v, B.expand(300, 3, 3).contiguous(), F, F)))
    sim = Simulator(law, dx=dx, substeps=1, frame_dt=dt, gravity=(0, 0, 0), dtype=dtype)
    # stress-free whatever the law makes of C_affine: the stiffness is nearly zero
    parameters = {
        k: 1e-30 if k in ("mu", "lam", "kappa") else v for k, v in parameters_of(law).items()
    }
    out = sim.rollout(
        state, parameters, torch.full((300,), 8e-6, dtype=dtype), DENSITY, 2, started=True
    ).final
    expected = {"v": v, "C_affine": B, "F_tot": torch.eye(3).double() + dt * B, "x": x + dt * v}
    errors = {
        k: (getattr(out, k).double() - e).abs().max() / e.abs().max() for k, e in expected.items()
    }
    return {k: float(e) for k, e in errors.items()}


def interior_force(law: str, dtype: torch.dtype) -> tuple[float, float]:
    """(largest |dv| in the interior, at the surface) after a substep of a regular lattice with one F, in units of a traction's
    impulse on a cell, dt |tau|/(density dx)."""
    dx, dt, n = 0.04, 2e-4, 16
    F = torch.tensor(
        [[0.97, 0.02, 0.0], [-0.01, 0.95, 0.03], [0.01, 0.0, 0.96]], dtype=torch.float64
    )
    x = lattice((n, n, n), dx / 2)
    state = resting(x, dtype=dtype)
    many = F.expand(len(x), 3, 3).contiguous().to(dtype)
    state = ParticleState(state.x, state.v, state.C_affine, many, many)
    sim = Simulator(law, dx=dx, substeps=1, frame_dt=dt, gravity=(0, 0, 0), dtype=dtype)
    parameters = parameters_of(law)
    tau = float(_stress(sim, many[:1], state.C_affine[:1], parameters).abs().max())
    v = (
        sim.rollout(state, parameters, uniform_volume(state, dx / 2), DENSITY, 2, started=True)
        .final.v.double()
        .abs()
        .amax(1)
    )
    unit = dt * tau / (DENSITY * dx)
    depth = torch.minimum(x, n * dx / 2 - x).amin(1) / dx
    return float(v[depth > 3].max()) / unit, float(v[depth < 1].max()) / unit


def free_fall(law: str, dtype: torch.dtype) -> tuple[ParticleState, float]:
    """(state after 100 substeps of 2e-4 s, largest error of v and x [m/s, m]) of an unstrained block thrown without spin.

    v = v0 + g t exactly; symplectic Euler puts x off the parabola by g t dt/2, which is dt/t of g t^2/2.
    """
    x, t, substeps = lattice((4, 4, 4), 0.02), 0.02, 100
    v0, g = torch.tensor([0.1, 0.2, -0.3]).double(), torch.tensor([0.3, -9.8, 0.0]).double()
    state = resting(x, tuple(v0.tolist()), dtype)
    sim = Simulator(law, dx=0.04, substeps=substeps, frame_dt=t, gravity=g, dtype=dtype)
    final = sim.rollout(state, parameters_of(law), uniform_volume(state, 0.02), DENSITY, 2).final
    expected = x + v0 * t + 0.5 * g * t**2 * (1 + sim.dt / t)
    return final, float(
        torch.maximum((final.v - (v0 + g * t)).abs().max(), (final.x - expected).abs().max())
    )


def column(
    law: str, dtype: torch.dtype = torch.float64, cells: int = 16, modulus: float = 1e6
) -> tuple[Tensor, Tensor, float]:
    """(heights [m], vertical Kirchhoff stress [Pa], slope / (density g)) of a column on a slipping ground.

    Released without strain it oscillates about rest; every mode of a free-fixed rod has a whole number of periods in the first
    one's, 4 H/c, over which the mean of the stress is -density g (H - y). The slope leaves out two cells at either end.
    """
    dx = 0.02
    x = lattice((4, 2 * cells, 4), dx / 2)
    state = resting(x, dtype=dtype)
    height, speed = cells * dx, math.sqrt(modulus / DENSITY)
    frames = 64
    frame_dt = 4 * height / speed / frames
    substeps = math.ceil(frame_dt * speed / (0.4 * dx))
    sim = Simulator(law, dx=dx, substeps=substeps, frame_dt=frame_dt, gravity=(0, -GRAVITY, 0), dtype=dtype,
                    planes=[Plane((0, 0, 0), (0, 1, 0), "slip")])  # fmt: skip
    parameters = thin(law, modulus)
    with torch.no_grad():
        rollout = sim.rollout(
            state, parameters, uniform_volume(state, dx / 2), DENSITY, 2 * frames + 1
        )
        C = torch.zeros_like(rollout.F[0])
        tau = (
            torch.stack([_stress(sim, F, C, parameters)[:, 1, 1] for F in rollout.F[1:]])
            .mean(0)
            .double()
        )
    y = x[:, 1]
    inside = (y > 2 * dx) & (y < height - 2 * dx)
    slope = np.polyfit(y[inside].numpy(), tau[inside].numpy(), 1)[0]
    return y, tau, float(slope / (DENSITY * GRAVITY))


def _stress(sim: Simulator, F: Tensor, C: Tensor, parameters: dict) -> Tensor:
    """Kirchhoff stress (N, 3, 3) [Pa], by the kernel that simulates."""
    n = len(F)
    return kirchhoff_stress(sim.law, F, C, sim.pack(parameters, n, eyes(n, F.dtype)))


def wave(law: str, cells: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor, float]:
    """(times [s], amplitude of the mode, c / sqrt(M/density)) of the first standing wave of a free rod `cells` long.

    v = A cos(pi x/L) has the period 2 L/c; c is measured between the first and the last zero of four periods. dt goes with dx.
    """
    modulus, length = 1e6, 0.32
    dx = length / cells
    speed = math.sqrt(modulus / DENSITY)
    x = lattice((2 * cells, 2, 2), dx / 2)
    state = resting(x, dtype=dtype)
    k = math.pi / length
    v, C = torch.zeros(len(x), 3).double(), torch.zeros(len(x), 3, 3).double()
    amplitude = 1e-4 * speed
    v[:, 0], C[:, 0, 0] = (
        amplitude * torch.cos(k * x[:, 0]),
        -amplitude * k * torch.sin(k * x[:, 0]),
    )
    state = ParticleState(state.x, v.to(dtype), C.to(dtype), state.F, state.F)
    frames, period = 80, 2 * length / speed
    sim = Simulator(law, dx=dx, substeps=math.ceil(period / 20 * speed / (0.4 * dx)), frame_dt=period / 20, gravity=(0, 0, 0),
                    dtype=dtype)  # fmt: skip
    with torch.no_grad():
        out = sim.rollout(
            state, thin(law, modulus), uniform_volume(state, dx / 2), DENSITY, frames + 1
        )
    mode = (out.v[..., 0].double() * torch.cos(k * x[:, 0])).mean(1) / (amplitude / 2)
    zeros = _zeros(out.times.double().numpy(), mode.numpy())
    return out.times.double(), mode, period / 2 * (len(zeros) - 1) / (zeros[-1] - zeros[0])


def _zeros(t: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Times where a smooth y changes sign, by cubic interpolation through four samples."""
    found = []
    for i in range(1, len(y) - 2):
        if y[i] * y[i + 1] < 0:
            s = np.array([-1.0, 0.0, 1.0, 2.0])
            roots = np.roots(np.polyfit(s, y[i - 1 : i + 3], 3))
            real = roots[(abs(roots.imag) < 1e-9) & (roots.real >= 0) & (roots.real <= 1)].real
            found.append(t[i] + real[0] * (t[i + 1] - t[i]))
    return np.array(found)


def timoshenko(E: float, nu: float, length: float, depth: float) -> float:
    """Deflection [m] of a cantilever's end under its weight: w L^4/(8 E I) + w L^2/(2 k G A), per breadth; w = density g depth.

    Shear coefficient of a rectangle k = 10 (1 + nu)/(12 + 11 nu) (Cowper 1966); breadth about the depth: E, not E/(1 - nu^2).
    """
    weight, shear, k = DENSITY * GRAVITY * depth, E / (2 * (1 + nu)), 10 * (1 + nu) / (12 + 11 * nu)
    return weight * length**4 / (8 * E * depth**3 / 12) + weight * length**2 / (
        2 * k * shear * depth
    )


def cantilever(law: str = "corotated", dtype: torch.dtype = torch.float64, depth: int = 6, length: int = 30, breadth: int = 2,
               E: float = 2e7) -> tuple[Tensor, float]:  # fmt: skip
    """(deflection of the end over a period of the first mode [m], its mean over `timoshenko`); lengths in cells.

    Released from its straight form the beam swings about its static one, which is the mean over a period.
    """
    dx = 0.02
    x = lattice((2 * length, 2 * depth, 2 * breadth), dx / 2, (-HELD * dx, 0.0, 0.0))
    state = resting(x, dtype=dtype)
    mu, lam = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
    L, h = length * dx, depth * dx
    period = 2 * math.pi / 3.516 * math.sqrt(12 * DENSITY / (E * h**2)) * L**2
    frames = 60
    frame_dt = period / frames
    substeps = math.ceil(frame_dt * math.sqrt((lam + 2 * mu) / DENSITY) / (0.5 * dx))
    sim = Simulator(law, dx=dx, substeps=substeps, frame_dt=frame_dt, gravity=(0, -GRAVITY, 0), dtype=dtype,
                    planes=[Plane((0, 0, 0), (1, 0, 0), "sticky")])  # fmt: skip
    with torch.no_grad():
        out = sim.rollout(
            state, {"mu": mu, "lam": lam}, uniform_volume(state, dx / 2), DENSITY, frames + 1
        )
    end = x[:, 0] > x[:, 0].max() - 1e-9
    deflection = -(out.x[:, end, 1] - out.x[0, end, 1]).double().mean(1)
    return deflection, float(deflection[1:].mean()) / timoshenko(E, NU, L, h)

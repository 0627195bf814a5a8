"""A cantilever whose end is held as driven particles, against Timoshenko's beam (check 31).

python tests/physics_verification/driven_beam.py 10 20 40 80    prints the table of docs/results/contact.md
"""

from __future__ import annotations

import math
import sys
from typing import NamedTuple

import numpy as np
import torch
from scipy.linalg import eigh
from scipy.optimize import least_squares

from mosa.physics.contact.colliders import Collider, Particles
from mosa.physics.contact.motion import Motion
from mosa.physics.engine.simulator import Simulator
from mosa.types import ParticleState

LENGTH, DEPTH, BREADTH = 1.0, 0.2, 0.1
E, DENSITY, GRAVITY = 1e6, 1000.0, 0.02
SECOND = 6.267
"""Frequency of a slender beam's second mode over the first's."""


def shear_area(nu: float) -> tuple[float, float]:
    """(k G A per breadth [N/m], E I per breadth [N m]); k of a rectangle (Cowper 1966)."""
    k = 10 * (1 + nu) / (12 + 11 * nu)
    return k * E / (2 * (1 + nu)) * DEPTH, E * DEPTH**3 / 12


def sag(nu: float) -> float:
    """Of the end under the beam's weight [m]."""
    kGA, EI = shear_area(nu)
    w = DENSITY * GRAVITY * DEPTH
    return w * LENGTH**4 / (8 * EI) + w * LENGTH**2 / (2 * kGA)


def frequency(nu: float, terms: int = 8) -> float:
    """First of Timoshenko's beam [Hz], by Ritz with polynomials x^i of deflection and rotation."""
    kGA, EI = shear_area(nu)
    x, weight = np.polynomial.legendre.leggauss(4 * terms)
    x, weight = (x + 1) / 2, weight * LENGTH / 2
    value = np.array([x ** (i + 1) for i in range(terms)])
    slope = np.array([(i + 1) * x**i / LENGTH for i in range(terms)])
    inner = lambda a, b: (a * weight) @ b.T  # noqa: E731
    K = np.block([
        [kGA * inner(slope, slope), -kGA * inner(slope, value)],
        [-kGA * inner(value, slope), EI * inner(slope, slope) + kGA * inner(value, value)],
    ])  # fmt: skip
    mass = inner(value, value)
    M = np.zeros_like(K)
    M[:terms, :terms], M[terms:, terms:] = DENSITY * DEPTH * mass, DENSITY * DEPTH**3 / 12 * mass
    return math.sqrt(eigh(K, M, eigvals_only=True)[0]) / (2 * math.pi)


class Beam(NamedTuple):
    """Over theory: sag and frequency; reaction and torque at the clamp, over weight and its moment;
    drift of the held particles [cells]."""

    sag: float
    frequency: float
    reaction: float
    torque: float
    drift: float


def beam(cells: int, nu: float = 0.0, offset: float = 0.3, courant: float = 0.5, dtype: torch.dtype = torch.float64,
         periods: float = 1.1, frames: int = 61, law: str = "neo_hookean") -> Beam:  # fmt: skip
    """cells: along the beam; offset [cells]: of the clamp's face from a node. It is released
    straight, swings about its static form by its weight (0.3 % of its length), and is held by three
    cells of its own."""
    dx = LENGTH / cells
    spacing = dx / 2
    axes = [(torch.arange(-6, 2 * cells).double() + 0.5) * spacing]
    axes += [
        (torch.arange(round(size / spacing)).double() + 0.5) * spacing - size / 2
        for size in (DEPTH, BREADTH)
    ]
    X = torch.cartesian_prod(*axes)
    origin = torch.tensor([10 + offset, 10.2, 10.1]).double() * dx
    held = (X[:, 0] < 0).nonzero()[:, 0]
    frame_dt = periods / frequency(nu) / (frames - 1)
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    substeps = math.ceil(frame_dt * math.sqrt((lam + 2 * mu) / DENSITY) / (courant * dx))
    clamp = Collider(Particles(held), motion=Motion(origin))
    simulator = Simulator(law, dx=dx, substeps=substeps, frame_dt=frame_dt, gravity=(0.0, -GRAVITY, 0.0),
                          colliders=[clamp], dtype=dtype)  # fmt: skip
    state = ParticleState.at_rest((X + origin).to(dtype))
    volume = torch.full((len(X),), spacing**3, dtype=dtype)
    parameters = {"mu": torch.tensor(mu, dtype=dtype), "lam": torch.tensor(lam, dtype=dtype)}
    with torch.no_grad():
        out = simulator.rollout(state, parameters, volume, DENSITY, frames)
    times, moved = out.times.double().numpy(), (out.x - out.x[0]).double()
    end = X[:, 0] > LENGTH - spacing
    tip = -moved[:, end, 1].mean(1).numpy()

    def basis(f: float, t: np.ndarray) -> np.ndarray:
        turns = [2 * math.pi * f * factor * t for factor in (1.0, SECOND)]
        return np.stack(
            [np.ones_like(t), *(g(turn) for turn in turns for g in (np.cos, np.sin))], 1
        )

    def fitted(values: np.ndarray, t: np.ndarray, f: float) -> tuple[np.ndarray, np.ndarray]:
        A = basis(f, t)
        c = np.linalg.lstsq(A, values, rcond=None)[0]
        return c, values - A @ c

    found = float(least_squares(lambda f: fitted(tip, times, f[0])[1], [frequency(nu)]).x[0])
    middle = 0.5 * (times[1:] + times[:-1])
    forces = out.reactions.double().mean(1)[:, 0].numpy()
    force, torque = (fitted(forces[:, i], middle, found)[0][0] for i in (1, 5))
    mass = DENSITY * spacing**3 * len(X)
    moment = mass * GRAVITY * float(X[:, 0].mean())
    # the particles of the last layer are half a spacing before the end
    at_end = 1 - 4 / 3 * 0.5 * spacing / LENGTH
    return Beam(fitted(tip, times, found)[0][0] / (at_end * sag(nu)), found / frequency(nu), -force / (mass * GRAVITY),
                -torque / moment, float(moved[-1, held].norm(dim=1).max()) / dx)  # fmt: skip


if __name__ == "__main__":
    print("cells  nu  sag  frequency  reaction  torque  drift [cells]")
    for cells in map(int, sys.argv[1:]):
        for nu in (0.0, 0.3):
            *shares, drift = beam(cells, nu)
            print(cells, nu, *(f"{share:.4f}" for share in shares), f"{drift:.1e}", flush=True)

"""The hanging bar of karamelo_vertical_bar: a cube held at its top face, loaded at once by a hundred times gravity.

1 x 1 x 1 m, neo-Hookean, E = 1e6 Pa, nu = 0.3, density 1050 kg/m^3, g = 1000 m/s^2 along -y; the top face y = 0 is held in y only.
Measured: the displacement of the bottom corner over 0.25 s against a finite-element solution, as root mean square over time.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from bodies import lattice, resting

from mosa.physics.contact.planes import Plane
from mosa.physics.engine.simulator import Simulator

E, NU, BAR_DENSITY, GRAVITY, END = 1e6, 0.3, 1050.0, 1000.0, 0.25
MU, LAM = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
EMBEDDED = 0.178
"""Cells by which the top face is put above the lowest held node plane, see `stiffness_error`."""


def stiffness_error(embedded: float) -> float:
    """Relative error of the static stiffness times the number of cells along the bar, from the splines alone.

    A node field that is linear below a held plane of nodes and zero on and above it is, after quadratic splines, s below half a
    cell and (s + 1/2)^2/2 above, s the distance [cells] below the plane: the strain falls to s + 1/2. With the face `embedded`
    above the plane, N cells of material and node strain k the extension is k (N - e) and the energy k^2/2 (N - e - 1/2 +
    (1 - (1/2 - e)^3)/3), so that N times the relative error of the stiffness is e - 1/2 + (1 - (1/2 - e)^3)/3 for large N.
    It vanishes at e = 0.178; with the face on a plane of nodes (e = 0) the bar is too soft by 0.21 cells.
    """
    return embedded - 0.5 + (1 - (0.5 - embedded) ** 3) / 3


def bar(cells: int, *, across: int = 2, along: int = 8, embedded: float = EMBEDDED, dtype: torch.dtype = torch.float32,
        frames: int = 51) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """(times (T,) [s], displacement of the bottom corner (T,) [m]). cells: per metre; across, along: particles per cell.

    The top of the bar stretches to about five times its length: below seven particles per cell along it there are cells without
    a particle, through which no stress is carried, and the bar tears.
    """
    dx, frame_dt = 1.0 / cells, END / (frames - 1)
    size = torch.tensor([dx / across, dx / along, dx / across], dtype=torch.float64)
    counts = (cells * across, cells * along, cells * across)
    lowest = embedded * dx - 1.0
    x = lattice(counts, 1.0) * size + torch.tensor([-0.5, lowest, -0.5], dtype=torch.float64)
    state = resting(x, dtype=dtype)
    # where the bar is stretched four times a wave runs at sqrt((mu (4^2 + 1) + lam)/density)
    speed = ((MU * 17 + LAM) / BAR_DENSITY) ** 0.5
    substeps = int(np.ceil(frame_dt * speed / (0.4 * dx)))
    sim = Simulator(
        "neo_hookean", dx=dx, substeps=substeps, frame_dt=frame_dt, gravity=(0.0, -GRAVITY, 0.0), dtype=dtype,
        planes=[Plane((0.0, 0.0, 0.0), (0.0, -1.0, 0.0), "slip")],
    )  # fmt: skip
    volume = torch.full((len(x),), float(size.prod()), dtype=dtype)
    corner = len(x) - counts[1] * counts[2]  # last in x, first in y and z
    to_corner = 0.5 * size * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    tip = [0.0]
    with torch.no_grad():
        for frame in range(1, frames):  # one frame at a time: a rollout keeps all frames
            state = sim.rollout(
                state, {"mu": MU, "lam": LAM}, volume, BAR_DENSITY, 2, started=frame > 1
            ).final
            tip.append(
                float(state.x[corner, 1].double() + state.F[corner, 1].double() @ to_corner)
                - lowest
            )
    return frame_dt * np.arange(frames), np.array(tip)


def finite_elements(reference_data: Path) -> tuple[np.ndarray, np.ndarray]:
    """(times [s], displacement [m]) of the reference solution."""
    table = np.loadtxt(
        reference_data / "references" / "karamelo_vertical_bar" / "FEM.data", skiprows=1
    )
    return 1000 * table[:, 0], table[:, 1]


def distance(times: np.ndarray, tip: np.ndarray, reference: tuple[np.ndarray, np.ndarray]) -> float:
    """Root mean square over time [m]."""
    return float(np.sqrt(np.mean((tip - np.interp(times, *reference)) ** 2)))


def held_face_bound(cells: int, reference: tuple[np.ndarray, np.ndarray]) -> float:
    """Root mean square [m] of what a relative change of stiffness s = 0.21/cells does to the reference u(t).

    A bar softer by s moves as u(t sqrt(1 - s))/(1 - s) = u + s (u - t u'/2): the first-order error of a face held at a plane of
    nodes (`stiffness_error(0)`), the largest one of the discretisation.
    """
    s = -stiffness_error(0.0) / cells
    times = np.linspace(0.0, END, 501)
    u = np.interp(times, *reference)
    return float(np.sqrt(np.mean((s * (u - 0.5 * times * np.gradient(u, times))) ** 2)))

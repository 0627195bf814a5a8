"""The static sag of a nearly incompressible cantilever under its weight, with the simulator's own forces (check 33).

PYTHONPATH=.:tests/helpers python tests/physics_verification/locking.py 3 4 6    prints the table of
docs/results/locking.md
"""

from __future__ import annotations

import sys

import numpy as np
import torch
from elastic_bodies import HELD, timoshenko
from scipy.linalg import solveh_banded
from scipy.sparse import coo_matrix, csr_matrix
from torch import Tensor

from mosa.physics.engine.law_options import LawOptions
from mosa.physics.engine.simulator import Simulator
from mosa.physics.engine.workspace import Workspace

E, DENSITY, DX, STRAIN = 2e7, 1000.0, 0.02, 1e-6
REACH = 13
"""Layers of nodes, of which only the first moves others' forces: two spline widths, and the average between them."""


class StaticBeam:
    """depth, length, breadth in cells, 8 particles in each; held at nodes at x <= 0, `HELD` cells before its face ends."""

    def __init__(
        self, nu: float, depth: int, length: int, breadth: int, mean_volume: bool, law: str = "neo_hookean"
    ) -> None:  # fmt: skip
        axes = [(torch.arange(2 * n) + 0.5) * DX / 2 for n in (length, depth, breadth)]
        x = torch.cartesian_prod(*axes).double() + torch.tensor([-HELD, 0.2, 0.1]).double() * DX
        mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
        options = LawOptions(mean_volume=mean_volume)
        sim = Simulator(
            law,
            dx=DX,
            substeps=1,
            frame_dt=1.0,
            gravity=(0, 0, 0),
            dtype=torch.float64,
            options=options,
        )
        packed = sim.pack(
            {"mu": torch.tensor(mu).double(), "lam": torch.tensor(lam).double()}, len(x)
        )
        self.work = work = Workspace(
            sim.numerics, len(x), 1, adapted=False, plastic_adapted=False, with_adjoint=False
        )
        low, size = np.array([-3, -3, -3]), np.array([length, depth, breadth]) + 7
        work.set_window(low, size)
        blank = torch.zeros(len(x), 3, 3).double()
        self.eye, volume = torch.eye(3).double(), torch.full((len(x),), (DX / 2) ** 3).double()
        work.load((x, torch.zeros_like(x), blank, blank + self.eye, blank + self.eye), {"parameters": packed}, volume,
                  DENSITY * volume, 0.0)  # fmt: skip
        nodes = torch.cartesian_prod(*(torch.arange(a, a + n) for a, n in zip(low, size)))
        weight = self.gathered()[:, 3]  # mass of the nodes: with 1 m/s^2, their weight
        self.free = (weight > 0) & (nodes[:, 0] > 0)
        self.length = int(size[0])
        self.weight, self.end = weight[self.free], x[:, 0] > x[:, 0].max() - 1e-9

    def gathered(self) -> Tensor:
        """(nodes, 4): impulse of the forces of the state in 1 s [N s], and mass."""
        work = self.work
        work.over_nodes(work.kernels.clear, [work.grid_wp[0]])
        work.run(work.stress, work.particles, work._stress_arguments(0, 0))
        work.run(work.kernels.p2g, work.particles, [
            work.states_wp[0], work.states_wp[0].v, work.tau_wp[0], work.mass_wp, work.volume_wp, work.grids, 1.0, 0, 0,
            work.flags_wp, work.grid_wp[0],
        ])  # fmt: skip
        return work.grid_slots()[0, 0].clone()

    def carried(self, u: Tensor) -> Tensor:
        """(N, 3) displacements of particles by those u of the free nodes; F becomes I + grad u."""
        work, field = self.work, self.work.grid_slots()[1, 0]
        field.zero_()
        field[self.free, :3] = u
        far = work.kernels.vec3(*[1e9] * 3)
        work.run(work.kernels.g2p, work.particles, [
            work.states_wp[0], work.velocity_wp[0], work.grids, 0.0, -far, far, 0, work.flags_wp, work.states_wp[1],
        ])  # fmt: skip
        work.F[0].copy_(self.eye + work.C_affine[1])
        return work.v[1].clone()

    def stiffness(self) -> csr_matrix:
        """(M, M) [N/m] over the numbers of the free nodes, from the forces of displacements of many nodes at once that are too far
        from each other to meet."""
        free = self.free.nonzero()[:, 0]
        section, count = len(self.free) // self.length, 3 * len(free)
        layer, place = free // section, torch.full((len(self.free),), -1)
        place[free] = torch.arange(len(free))
        rows, columns, values = [], [], []
        for first in range(REACH):
            together = layer % REACH == first
            for each in range(section):
                moved = together & (free % section == each)
                if not bool(moved.any()):
                    continue
                for k in range(3):
                    u = torch.zeros(len(free), 3).double()
                    u[moved, k] = STRAIN
                    ends = []
                    for sign in (1, -1):  # of second order in the strain
                        self.carried(sign * u)
                        ends.append(self.gathered()[self.free, :3])
                    forces = (ends[1] - ends[0]) / (2 * STRAIN)
                    # of which of the moved nodes: the nearest one along the beam
                    own = layer[:, None] - layer[moved][None]
                    which = moved.nonzero()[:, 0][own.abs().argmin(1)]
                    rows.append(torch.arange(count))
                    columns.append((3 * which + k).repeat_interleave(3))
                    values.append(forces.flatten())
        row, column, value = (torch.cat(part).numpy() for part in (rows, columns, values))
        found = coo_matrix((value, (row, column)), shape=(count, count)).tocsr()
        return 0.5 * (found + found.T)

    def sag(self, acceleration: float = 9.8) -> float:
        """Of the end [m]."""
        load = np.zeros((len(self.weight), 3))
        load[:, 1] = -acceleration * self.weight.numpy()
        K = self.stiffness().tocoo()
        band = np.zeros((int((K.row - K.col).max()) + 1, load.size))
        low = K.row >= K.col
        band[K.row[low] - K.col[low], K.col[low]] = K.data[low]
        band[0] += 1e-14 * band[0].max()  # nodes at the rim that hardly any particle reaches
        u = solveh_banded(band, load.ravel(), lower=True, overwrite_ab=True)
        return float(-self.carried(torch.from_numpy(u).view(-1, 3))[self.end, 1].mean())


def over_theory(nu: float, depth: int, length: int, breadth: int, mean_volume: bool) -> float:
    """Sag over Timoshenko's, in the same weight."""
    found = StaticBeam(nu, depth, length, breadth, mean_volume).sag()
    # particles of the last layer are a quarter of a cell before the end
    at_end = 1 - 4 / 3 * 0.25 / length
    return found / (at_end * timoshenko(E, nu, length * DX, depth * DX))


if __name__ == "__main__":
    print("cells deep  nu  each particle's own volume  mean")
    for depth in map(int, sys.argv[1:]):
        for nu in (0.0, 0.3, 0.4, 0.49, 0.499):
            shares = [over_theory(nu, depth, 10 * depth, 2, mean) for mean in (False, True)]
            print(depth, nu, *(f"{share:.4f}" for share in shares), flush=True)

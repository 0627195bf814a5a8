"""The stress of a homogeneous specimen, from the law's Warp function as the simulator's kernels call it.

Free faces carry no stress: an incompressible specimen gets the pressure that frees one, and a free stretch is solved for by
Newton's method. The deformation is diagonal in the specimen's axes, or a simple shear: the clamps hold it so where the material
would shear by itself, as a strip at an angle to its fibres does."""

from __future__ import annotations

import numpy as np
import torch

from mosa.errors import SimulationDiverged
from mosa.evaluation.analysis.law_stress import kirchhoff
from mosa.material_tests.measurements import Measurements
from mosa.modules.adapters.hyperelastic import HyperelasticAdapter
from mosa.modules.body.material import Material

ITERATIONS, STEP, LONGEST, PRECISE = 60, 1e-6, 0.3, 1e-11
"""Of Newton's method: logarithms of stretches move by at most `LONGEST`; it ends at stresses of `PRECISE` moduli."""


class Specimens:
    """Predicted stresses of `data` under any law. incompressible: a pressure keeps volumes; else free faces are solved for. true:
    Cauchy's stresses, of the area now, in place of the first Piola-Kirchhoff ones."""

    def __init__(self, data: Measurements, incompressible: bool, true: bool = False) -> None:
        self.data, self.incompressible, self.true = data, incompressible, true
        n = len(data.test)
        self.sheared: np.ndarray = np.equal(data.kind, "shear")
        self.logs = np.zeros((n, 3))
        self.moves = np.zeros((n, 3, 2))
        """Directions in which the logarithms of the stretches are free."""
        self.isochoric = np.zeros((n, 2))
        """Along them, where the volume is that at rest."""
        self.free = np.full(n, -1)
        """A face whose stress the pressure cancels, -1 where it does no work."""
        for i in np.flatnonzero(~self.sheared):
            axes = [a for a in data.axes[i] if a >= 0]
            loose = [a for a in range(3) if a not in axes]
            self.logs[i, axes] = np.log(data.given[i, : len(axes)])
            self.free[i] = loose[-1]
            if incompressible:
                self.logs[i, loose] = -self.logs[i].sum() / len(loose)
                loose = loose[:-1]
            for k, a in enumerate(loose):
                self.moves[i, a, k] = 1.0
                self.isochoric[i, k] = -self.logs[i].sum() / len(loose)
                if incompressible:
                    self.moves[i, self.free[i], k] = -1.0
        self.solved = np.flatnonzero(self.moves.any((1, 2)))
        cosine, sine = np.cos(data.angle), np.sin(data.angle)
        self.turn = np.zeros((n, 3, 3))
        """From the material's axes to the specimen's."""
        self.turn[:, 0, 0] = self.turn[:, 1, 1] = cosine
        self.turn[:, 0, 1], self.turn[:, 1, 0], self.turn[:, 2, 2] = sine, -sine, 1.0
        self.last: np.ndarray | None = None

    def gradients(self, rows: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """F (k, 3, 3) of states, in the specimen's axes; moved: (k, 2) along `moves`."""
        F = np.zeros((len(rows), 3, 3))
        stretch = np.exp(self.logs[rows] + (self.moves[rows] @ moved[:, :, None])[:, :, 0])
        F[:, range(3), range(3)] = stretch
        for k in np.flatnonzero(self.sheared[rows]):
            face, along = self.data.axes[rows[k]]
            F[k, along, face] = self.data.given[rows[k], 0]
        return F

    def predict(self, material: Material, adapter: HyperelasticAdapter | None) -> np.ndarray:
        """(m,) stresses [Pa]. Errors: SimulationDiverged where no equilibrium is found."""

        def stress(rows: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            F = self.gradients(rows, moved)
            return F, kirchhoff(material, adapter, torch.from_numpy(F @ self.turn[rows])).numpy()

        with np.errstate(all="ignore"):
            moved = np.zeros((len(self.data.test), 2))
            if len(self.solved):
                moved[self.solved] = self.equilibrium(material, stress)
            every = np.arange(len(self.data.test))
            F, tau = stress(every, moved)
            held = self.incompressible & (self.free >= 0)
            pressure = np.where(held, tau[every, self.free, self.free], 0.0)
            tau = tau - pressure[:, None, None] * np.eye(3)
            if self.true:
                P = tau / np.linalg.det(F)[:, None, None]
            else:
                P = tau @ np.linalg.inv(F).swapaxes(1, 2)
        i, axes = self.data.row, self.data.axes[self.data.row]
        along = np.where(self.data.component == 0, axes[:, 0], axes[:, 1])
        face = np.where(self.sheared[i], axes[:, 0], along)
        along = np.where(self.sheared[i], axes[:, 1], along)
        found = P[i, along, face]
        if not np.isfinite(found).all():
            raise SimulationDiverged("the law's stress is not finite in one of the tests")
        return found

    def equilibrium(self, material: Material, stress) -> np.ndarray:
        """(k, 2) of the states that are solved for: where the energy is stationary along `moves`."""
        # from the last one, else from that of small strains: where nothing moves across, a law compressed far may have no slope
        share = 2 * float(material.poisson())
        starts = [share * self.isochoric[self.solved]]
        for start in starts if self.last is None else [self.last, *starts]:
            self.last = self.newton(start, float(material.max_modulus()), stress)
            if self.last is not None:
                return self.last
        raise SimulationDiverged("no free stretch was found at which the faces carry no stress")

    def newton(self, x: np.ndarray, scale: float, stress) -> np.ndarray | None:
        """As `equilibrium`, from x (k, 2); scale [Pa] of stresses. None where it finds none."""
        rows = self.solved
        k, B = len(rows), self.moves[rows]
        idle = np.eye(2) * (np.abs(B).sum(1) == 0)[:, None, :]

        def force(x: np.ndarray, rows: np.ndarray, B: np.ndarray) -> np.ndarray:
            tau = stress(rows, x)[1]
            return (B.swapaxes(1, 2) @ tau[:, range(3), range(3)][:, :, None])[:, :, 0]

        three, shift = np.tile(rows, 3), np.zeros((3 * k, 2))
        shift[k : 2 * k, 0] = shift[2 * k :, 1] = STEP
        for _ in range(ITERATIONS):
            g = force(np.tile(x, (3, 1)) + shift, three, np.tile(B, (3, 1, 1))).reshape(3, k, 2)
            if not np.isfinite(g).all():
                break
            scale = max(scale, np.abs(g).max() * 1e-6)
            if np.abs(g[0]).max() <= PRECISE * scale:
                return x
            slope = np.stack([g[1] - g[0], g[2] - g[0]], -1) / STEP + idle * scale
            try:
                change = np.linalg.solve(slope, -g[0][:, :, None])[:, :, 0]
            except np.linalg.LinAlgError:
                break
            x = x + np.clip(change, -LONGEST, LONGEST)
        return None

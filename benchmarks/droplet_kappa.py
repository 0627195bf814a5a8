"""How well the true bulk modulus explains the droplet's true motion on coarser grids, with and without the mean volume.

python benchmarks/droplet_kappa.py    prints the table of docs/results/locking.md (ten CPU-minutes)
"""

import numpy as np
import torch
from scipy.spatial import cKDTree

from mosa.data.synthetic.bodies.objects import OBJECTS
from mosa.data.synthetic.bodies.shapes import SHAPES
from mosa.data.synthetic.drop import GRAVITY, place
from mosa.data.synthetic.surface import fill
from mosa.physics.engine.law_options import LawOptions
from mosa.physics.engine.simulator import Simulator
from mosa.physics.time.time_step import required_substeps
from mosa.types import Ground, ParticleState

BODY = OBJECTS["droplet"]
VALUES, DROP, FRAME = dict(BODY.material.values), BODY.drops["train"], 1 / BODY.footage.fps
LIFT = 0.4
"""Contact offset [cells]."""
LANDED = 6
"""Frame from which the droplet has landed."""
TRUTH = 0.0075, 8
"""Spacing of particles [m], particles in a cell."""
GRIDS = (0.0215, 4), (0.0176, 4), (0.0155, 4)
MULTIPLES = 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0


def lattice(spacing: float) -> np.ndarray:
    return fill(SHAPES[BODY.shape], spacing, np.random.default_rng([0, 2]))


def motion(
    spacing: float, in_cell: int, mean_volume: bool, kappa: float, courant: float
) -> tuple[np.ndarray, np.ndarray]:
    """(start (N, 3), displacements (T, N, 3)) [m]."""
    center = lattice(BODY.spacing).mean(0) * (0, 1, 0)
    start, _ = place(lattice(spacing), center, DROP, lattice(0.005))
    n, dx, mu = len(start), spacing * in_cell ** (1 / 3), VALUES["mu"]
    fastest = DROP.speed + 9.8 * FRAME * BODY.footage.frames
    substeps = required_substeps(7 * kappa, BODY.material.density, FRAME, dx, v_max=fastest, courant=courant, limit=5000,
                                 viscosity=mu)  # fmt: skip
    simulator = Simulator("newtonian", dx=dx, substeps=substeps, frame_dt=FRAME, gravity=GRAVITY, ground=Ground(0.0),
                          up=(0.0, 1.0, 0.0), options=LawOptions(mean_volume=mean_volume))  # fmt: skip
    x = torch.tensor(start + np.array([0.0, LIFT * dx, 0.0]), dtype=torch.float32)
    early = torch.tensor([0.0, -DROP.speed, 0.0]) - 0.5 * FRAME / substeps * torch.tensor(GRAVITY)
    F = torch.tensor(DROP.rotation, dtype=torch.float32).expand(n, 3, 3).contiguous()
    state = ParticleState(x, early.expand(n, 3).contiguous(), torch.zeros(n, 3, 3), F, F)
    volume = torch.full((n,), spacing**3)
    with torch.no_grad():
        moved = simulator.rollout(
            state, {"mu": mu, "kappa": kappa}, volume, BODY.material.density, BODY.footage.frames
        ).x
    return start, (moved - moved[0]).double().numpy()


def distance(ours: tuple[np.ndarray, np.ndarray], truth: tuple[np.ndarray, np.ndarray]) -> float:
    """Root mean square after contact [mm]; the truth between its 8 nearest particles by inverse squares of distances."""
    away, near = cKDTree(truth[0]).query(ours[0], 8)
    weights = 1 / np.maximum(away, 1e-5) ** 2
    weights /= weights.sum(1, keepdims=True)
    there = np.einsum("nk,tnki->tni", weights, truth[1][LANDED:, near])
    return 1e3 * float(np.sqrt(((ours[1][LANDED:] - there) ** 2).sum(-1).mean()))


if __name__ == "__main__":
    kappa = VALUES["kappa"]
    truths = [motion(*TRUTH, mean, kappa, 0.3) for mean in (False, True)]
    print("grid [mm], mean volume; multiples of kappa", *MULTIPLES)
    for spacing, in_cell in GRIDS:
        for mean in (False, True):
            runs = [motion(spacing, in_cell, mean, m * kappa, 0.5) for m in MULTIPLES]
            for name, truth in zip(("own", "mean"), truths):
                far = " ".join(f"{distance(run, truth):.1f}" for run in runs)
                print(
                    f"{1e3 * spacing * in_cell ** (1 / 3):.1f} {mean}; truth {name}: {far}",
                    flush=True,
                )

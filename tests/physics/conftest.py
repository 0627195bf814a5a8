"""Particles, drawn deformation gradients and oracle files shared by the physics tests."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from mosa.physics.engine.solver import SegmentSolver
from mosa.types import ParticleState

torch.set_num_threads(1)


def rotation_matrices(count: int, generator: torch.Generator) -> torch.Tensor:
    """(count, 3, 3) float64 random rotations."""
    Q, R = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))
    Q = Q * torch.sign(R.diagonal(dim1=-2, dim2=-1))[:, None, :]
    return Q * torch.linalg.det(Q)[:, None, None]


@pytest.fixture
def rotations():
    """200 rotations."""
    return rotation_matrices(200, torch.Generator().manual_seed(11))


DRAWN = {
    "rest": [1.0, 1.0, 1.0],
    "dilated": [1.3, 1.3, 1.3],
    "nearly equal": [1.1, 1.1 + 1e-9, 0.9],
    "two equal": [1.2, 0.8, 0.8],
    "series edge": [1.0, 1.0 + 1e-2, 1.0 - 2e-2],
    "generic": [1.5, 1.1, 0.6],
    "large": [4.0, 2.0, 1.1],
    "flat": [1.3, 0.9, 0.06],
    "nearly singular": [1.2, 0.7, 0.004],
    "inverted": [1.4, 0.9, -0.5],
    "inverted, equal": [1.2, 1.2, -0.7],
    "inverted, sum 2e-3": [1.1, 0.502, -0.5],
}


@pytest.fixture
def drawn():
    """(names, F (M, 3, 3) float64): six rotated copies of each kind of singular values, and exactly I."""
    generator = torch.Generator().manual_seed(5)
    names, gradients = ["identity"], [torch.eye(3, dtype=torch.float64)]
    for name, values in DRAWN.items():
        U, V = rotation_matrices(6, generator), rotation_matrices(6, generator)
        S = torch.diag(torch.tensor(values, dtype=torch.float64))
        gradients += list(U @ S @ V.mT)
        names += [name] * 6
    return names, torch.stack(gradients)


def block(n: int = 4, spacing: float = 0.02, height: float = 0.03, jitter: float = 0.4, seed: int = 0,
          dtype: torch.dtype = torch.float64, velocity=(0.2, -1.5, 0.1)) -> ParticleState:  # fmt: skip
    """A jittered cube of n^3 particles above the ground, slightly deformed so that nothing is special."""
    generator = torch.Generator().manual_seed(seed)
    index = (
        torch.stack(torch.meshgrid(*(torch.arange(n),) * 3, indexing="ij"), -1)
        .reshape(-1, 3)
        .double()
    )
    x = (index + 0.5) * spacing + torch.tensor([0.11, height, 0.07], dtype=torch.float64)
    x = x + jitter * spacing * (torch.rand(x.shape, generator=generator, dtype=torch.float64) - 0.5)
    count = len(x)
    F = torch.eye(3, dtype=torch.float64) + 0.03 * torch.randn(
        count, 3, 3, generator=generator, dtype=torch.float64
    )
    v = torch.tensor(velocity, dtype=torch.float64) + 0.1 * torch.randn(
        count, 3, generator=generator, dtype=torch.float64
    )
    C = 2.0 * torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)
    return ParticleState(*(t.to(dtype).contiguous() for t in (x, v, C, F, F)))


@pytest.fixture
def make_block():
    """The function `block`."""
    return block


@pytest.fixture
def looks(monkeypatch):
    """Frames of each stretch of frames that is launched before the host looks at it, in turn."""
    found, together = [], SegmentSolver.together

    def counted(*arguments):
        found.append(together(*arguments))
        return found[-1]

    monkeypatch.setattr(SegmentSolver, "together", counted)
    return found


@pytest.fixture
def oracle():
    """Loader of a file of the reference data's `oracle` folder: name -> (arrays as float64 tensors, meta)."""
    folder = (
        Path(os.environ.get("MOSA_DATA", Path(__file__).parents[2] / ".." / "shared" / "data"))
        / "oracle"
    )

    def load(name: str):
        path = folder / f"{name}.npz"
        if not path.is_file():
            pytest.skip(
                f"reference data absent: set MOSA_DATA to the folder that holds oracle/{name}.npz"
            )
        with np.load(path, allow_pickle=False) as file:
            arrays = {
                key: torch.from_numpy(np.asarray(file[key]))
                for key in file.files
                if file[key].dtype.kind in "fi"
            }
            meta = json.loads(str(file["meta"])) if "meta" in file.files else {}
        return arrays, meta

    return load

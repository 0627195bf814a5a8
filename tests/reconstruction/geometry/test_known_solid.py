"""The solid of a mesh, a cloud of its surface, a cloud that fills it, and Gaussians on it is one."""

import numpy as np
import pytest
import torch

from mosa.data.io.gaussian_ply import save_ply
from mosa.errors import DataError
from mosa.reconstruction.geometry.known import known_solid
from mosa.types import KnownBody, Splats

UNIT, AT = 40.0, np.array([300.0, -50.0, 20.0])
HALF = np.array([0.5, 0.3, 0.2]) * UNIT


def body(path) -> KnownBody:
    return KnownBody(str(path), None, path.name)


def box_surface(count: int) -> np.ndarray:
    """(6 count^2, 3) points of a box's faces."""
    u = (np.arange(count) + 0.5) / count * 2 - 1
    a, b = (x.ravel() for x in np.meshgrid(u, u))
    faces = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            points = np.insert(np.stack([a, b], 1), axis, side, axis=1)
            faces.append(points * HALF)
    return np.concatenate(faces) + AT


def write_cloud(path, points: np.ndarray) -> None:
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    path.write_text(header + "\n".join(" ".join(f"{v:.6g}" for v in p) for p in points))


def filled(step: float) -> np.ndarray:
    axes = [np.arange(-h + step / 2, h, step) for h in HALF]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3) + AT


@pytest.mark.parametrize("kind", ["surface", "filled", "gaussians"])
def test_clouds_and_gaussians_enclose_the_box(tmp_path, kind):
    path = tmp_path / f"{kind}.ply"
    points = filled(UNIT / 20) if kind == "filled" else box_surface(30)
    if kind == "gaussians":
        n, means = len(points), torch.from_numpy(points).float()
        turns = torch.tensor([1.0, 0, 0, 0]).expand(n, 4)
        thin = torch.full((n, 3), 0.002 * UNIT)
        save_ply(path, Splats(means, thin, turns, torch.full((n,), 0.95), torch.full((n, 3), 0.5)))
    else:
        write_cloud(path, points)
    solid = known_solid(body(path))
    volume = float((solid.distance.values < 0).sum()) * (solid.distance.pitch * solid.unit) ** 3
    spacing = UNIT / 20 if kind == "filled" else UNIT / 30
    area = 8 * (HALF * np.roll(HALF, 1)).sum()
    assert abs(volume - 8 * HALF.prod()) < area * spacing / 4
    assert np.abs(solid.centre.numpy() - AT).max() < 0.02 * UNIT
    faces = torch.diag(torch.from_numpy(HALF).float()) / solid.unit
    assert float(solid.at(faces).abs().max()) < 0.5 * spacing / solid.unit


def test_files_that_hold_no_solid_are_refused(tmp_path):
    few = tmp_path / "few.ply"
    write_cloud(few, box_surface(3))
    with pytest.raises(DataError, match=r"few.ply: expected at least 100 .* found 54"):
        known_solid(body(few))
    open_mesh = tmp_path / "open.obj"
    open_mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3")
    with pytest.raises(DataError, match="expected a closed surface"):
        known_solid(body(open_mesh))
    with pytest.raises(DataError, match=r"expected a file \.ply, \.obj or \.stl, found none"):
        known_solid(body(tmp_path / "missing.ply"))

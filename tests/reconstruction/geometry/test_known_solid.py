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
    path.write_text(header + "\n".join(" ".join(f"{v:.10g}" for v in p) for p in points))


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
    open_mesh.write_text(
        "v 9e5 0 0\nv 900001 0 0\nv 9e5 1 0\nv 9e5 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4"
    )
    with pytest.raises(DataError, match="expected a mesh with an extent near 0, found 1"):
        known_solid(body(open_mesh))
    with pytest.raises(DataError, match=r"expected a \.ply, \.obj or \.stl, found none"):
        known_solid(body(tmp_path / "missing.ply"))


def test_strays_and_doubled_points_are_no_part_of_a_cloud(tmp_path, monkeypatch):
    monkeypatch.setattr("mosa.reconstruction.geometry.known.VOXELS", 40)
    strays = AT + 50 * UNIT * np.eye(3)
    write_cloud(tmp_path / "a.ply", np.concatenate([np.repeat(box_surface(10), 2, 0), strays]))
    found = known_solid(body(tmp_path / "a.ply"))
    volume = len(found.inside) * (found.distance.pitch * found.unit) ** 3
    assert volume == pytest.approx(8 * HALF.prod(), rel=0.1)


@pytest.mark.parametrize("name, said", [
    ("empty.obj", "expected triangles, found none"), ("cut.stl", "expected triangles, found none"),
    ("needle.obj", "expected a solid, found nothing"), ("far.ply", "an extent near 0"),
])  # fmt: skip
def test_a_file_that_holds_no_solid_is_named(tmp_path, name, said):
    path = tmp_path / name
    if name == "far.ply":
        write_cloud(path, box_surface(8) + 1e6)
    elif name == "needle.obj":
        corners = [(x, y, z) for x in (0, 1) for y in (0, 0.003) for z in (0, 0.003)]
        sides = ((1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4))
        path.write_text("".join("v {} {} {}\n".format(*c) for c in corners)
                        + "".join("f {} {} {} {}\n".format(*f) for f in sides))  # fmt: skip
    else:
        path.write_bytes(b"" if name == "empty.obj" else b"\0" * 80 + b"\x0c\0\0\0" + b"\0" * 50)
    with pytest.raises(DataError, match=said):
        known_solid(body(path))

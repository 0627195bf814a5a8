"""3DGS PLY files: what is written is read back, in the layout that other programs expect, and mistakes are named."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from mosa.data.io.gaussian_ply import load_ply, save_ply
from mosa.errors import ConfigError, DataError
from mosa.types import Splats

COUNT = 7


def drawn(seed=0):
    g = torch.Generator().manual_seed(seed)
    rotations = torch.randn(COUNT, 4, generator=g)
    return Splats(
        torch.randn(COUNT, 3, generator=g),
        0.001 + 0.1 * torch.rand(COUNT, 3, generator=g),
        rotations / rotations.norm(dim=1, keepdim=True),
        0.05 + 0.9 * torch.rand(COUNT, generator=g),
        torch.rand(COUNT, 3, generator=g),
    )


def assert_same(found, wanted):
    for f in fields(Splats):
        torch.testing.assert_close(
            getattr(found, f.name), getattr(wanted, f.name), rtol=2e-6, atol=2e-6, msg=f.name
        )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_round_trip(tmp_path, degree):
    splats = drawn()
    coefficients = torch.randn(
        COUNT, (degree + 1) ** 2, 3, generator=torch.Generator().manual_seed(1)
    )
    coefficients[:, 0] = (splats.colors - 0.5) * math.sqrt(4 * math.pi)
    found, harmonics = load_ply(save_ply(tmp_path / "new" / "splats.ply", splats, coefficients))
    assert_same(found, splats)
    torch.testing.assert_close(harmonics, coefficients)


def test_colours_alone_are_harmonics_of_degree_0(tmp_path):
    splats = drawn()
    found, harmonics = load_ply(save_ply(tmp_path / "splats.ply", splats))
    assert_same(found, splats)
    torch.testing.assert_close(0.5 + 0.28209479177387814 * harmonics[:, 0], splats.colors)


def test_layout_is_the_published_one(tmp_path):
    """Field names, order and encodings as 3D Gaussian Splatting's own writer: logit, log, wxyz, and f_rest with all
    coefficients of red first."""
    splats, coefficients = drawn(), torch.arange(COUNT * 48).view(COUNT, 16, 3).float()
    vertex = PlyData.read(save_ply(tmp_path / "splats.ply", splats, coefficients))["vertex"]
    names = [p.name for p in vertex.properties]
    assert names == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(45)),
                     "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]  # fmt: skip
    assert all(vertex[name].dtype == np.dtype("<f4") for name in names)
    assert (
        vertex["f_rest_0"][2] == coefficients[2, 1, 0]
        and vertex["f_rest_14"][2] == coefficients[2, 15, 0]
    )
    assert (
        vertex["f_rest_15"][2] == coefficients[2, 1, 1]
        and vertex["f_dc_2"][2] == coefficients[2, 0, 2]
    )
    opacity = float(splats.opacities[3])
    assert vertex["opacity"][3] == pytest.approx(math.log(opacity / (1 - opacity)), rel=1e-5)
    assert vertex["scale_1"][3] == pytest.approx(math.log(float(splats.scales[3, 1])), rel=1e-5)
    assert [vertex[f"rot_{i}"][3] for i in range(4)] == pytest.approx(
        splats.rotations[3].tolist(), rel=1e-6
    )


def test_extremes_that_have_no_logarithm_stay_finite(tmp_path):
    splats = drawn()
    splats = replace(
        splats, opacities=torch.tensor([0.0, 1.0] + [0.5] * 5), scales=splats.scales * 0
    )
    found, _ = load_ply(save_ply(tmp_path / "splats.ply", splats))
    torch.testing.assert_close(found.opacities, splats.opacities, atol=2e-6, rtol=0)
    assert float(found.scales.max()) < 1e-8


def rewrite(change):
    def apply(path):
        data = PlyData.read(path)["vertex"].data
        data = change({name: np.array(data[name]) for name in data.dtype.names})
        array = np.empty(
            len(data["x"]) if "x" in data else COUNT, dtype=[(name, "f4") for name in data]
        )
        for name, values in data.items():
            array[name] = values
        PlyData([PlyElement.describe(array, "vertex")]).write(path)

    return apply


def without(*names):
    return rewrite(lambda d: {k: v for k, v in d.items() if k not in names})


def put(name, value):
    def change(d):
        d[name][4] = value
        return d

    return rewrite(change)


BROKEN = {
    "gone": (lambda p: p.unlink(), "splats.ply: file not found"),
    "no PLY": (lambda p: p.write_text("solid teapot"), "splats.ply: expected a PLY file"),
    "cut": (lambda p: p.write_bytes(p.read_bytes()[:-30]), "splats.ply: expected a PLY file"),
    "no position": (without("y"), "splats.ply: no field y"),
    "point cloud": (without("opacity", "scale_0", "scale_1", "scale_2"), "no field scale_0.*point cloud or mesh"),
    "flat Gaussians": (without("scale_2"), "no field scale_2"),
    "no rotation": (without("rot_3"), "no field rot_3"),
    "no opacity": (without("opacity"), "no field opacity"),
    "no colour": (without("f_dc_1"), "no field f_dc_1"),
    "harmonics cut": (without("f_rest_44"), r"expected 0, 9, 24 or 45 fields f_rest_\*.*found 44"),
    "gap in harmonics": (
        rewrite(lambda d: {("f_rest_99" if k == "f_rest_5" else k): v for k, v in d.items()}), "no field f_rest_5",
    ),
    "NaN": (put("rot_1", float("nan")), "field rot_1: expected finite numbers, found NaN or infinity in 1 of 7, first at vertex 4"),
    "infinite": (put("f_rest_3", float("inf")), "field f_rest_3: expected finite"),
    "scale no logarithm": (put("scale_0", 1e3), r"field scale_\*: expected logarithms"),
    "zero quaternion": (
        rewrite(lambda d: d | {f"rot_{i}": 0 * d["x"] for i in range(4)}),
        r"field rot_\*: expected quaternions, found zero at vertex 0",
    ),
    "empty": (rewrite(lambda d: {k: v[:0] for k, v in d.items()}), "expected Gaussians, found none"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_mistakes_name_file_and_field(tmp_path, name):
    path = save_ply(tmp_path / "splats.ply", drawn(), torch.zeros(COUNT, 16, 3))
    load_ply(path)
    corrupt, message = BROKEN[name]
    corrupt(path)
    with pytest.raises(DataError, match=message):
        load_ply(path)


def test_nothing_broken_is_written(tmp_path):
    splats = drawn()
    splats.means[2, 1] = float("nan")
    with pytest.raises(
        DataError, match=r"splats.ply: field y: expected finite numbers, to write NaN .* vertex 2"
    ):
        save_ply(tmp_path / "splats.ply", splats)
    assert not (tmp_path / "splats.ply").exists()
    with pytest.raises(ConfigError, match="K = 1, 4, 9 or 16"):
        save_ply(tmp_path / "splats.ply", drawn(), torch.zeros(COUNT, 5, 3))

"""Moving splats as files: every frame, read back by readers that are not this program's, looks as the program sees it."""

import numpy as np
import pytest
import torch
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from mosa.data.io import splat_formats
from mosa.data.io.splat_formats import save_frames, splats_at, upright
from mosa.errors import ConfigError
from mosa.rendering.appearance.carried_splats import Seen
from mosa.rendering.appearance.spherical_harmonics import basis, colors_in

M, T = 30, 3


def drawn(degree: int = 2) -> Seen:
    g = torch.Generator().manual_seed(degree)
    A = 0.01 * torch.randn(T, M, 3, 3, generator=g)
    turns = (
        torch.as_tensor(Rotation.random(T * M, random_state=1).as_matrix()).float().view(T, M, 3, 3)
    )
    return Seen(
        torch.randn(T, M, 3, generator=g),
        A @ A.mT + 1e-6 * torch.eye(3),
        0.05 + 0.9 * torch.rand(M, generator=g),
        0.2 * torch.randn(M, (degree + 1) ** 2, 3, generator=g),
        turns,
        0.5 + torch.rand(T, M, generator=g),
    )


def covariance(vertex) -> np.ndarray:
    axes = Rotation.from_quat(np.stack([vertex[f"rot_{i}"] for i in (1, 2, 3, 0)], -1)).as_matrix()
    scales = np.exp(np.stack([vertex[f"scale_{i}"] for i in range(3)], -1))
    return axes * scales[:, None] ** 2 @ axes.transpose(0, 2, 1)


def test_plyfile_reads_what_is_seen(tmp_path):
    """Positions, covariances, opacities, and the colours of each frame in directions of the world."""
    shown = drawn()
    save_frames(shown, tmp_path, ("ply",))
    directions = torch.randn(12, 3, generator=torch.Generator().manual_seed(9))
    for t in range(T):
        vertex = PlyData.read(tmp_path / "ply" / f"{t:03d}.ply")["vertex"]
        assert np.allclose(np.stack([vertex[a] for a in "xyz"], -1), shown.means[t].numpy())
        assert np.allclose(covariance(vertex), shown.covariances[t].numpy(), rtol=1e-3, atol=1e-8)
        assert np.allclose(1 / (1 + np.exp(-vertex["opacity"])), shown.opacities.numpy(), atol=1e-5)
        channels = [
            [vertex[f"f_dc_{k}"], *(vertex[f"f_rest_{8 * k + i}"] for i in range(8))]
            for k in range(3)
        ]
        c = np.stack([np.stack(channel, -1) for channel in channels], -1)
        found = 0.5 + np.einsum("dk,mkc->dmc", basis(directions, 2).numpy(), c)
        back = (directions[:, None, None, :] @ shown.rotations[t])[:, :, 0]  # (d, M, 3)
        wanted = (
            0.5 + torch.einsum("dmk,mkc->dmc", basis(back, 2), shown.harmonics)
        ) * shown.shades[t][:, None]
        assert np.allclose(found, wanted.numpy(), atol=1e-5)
        assert np.allclose(
            np.maximum(found, 0),
            colors_in(torch.as_tensor(c), directions[:, None].expand(-1, M, -1)),
            atol=1e-5,
        )


def test_another_format_is_refused(tmp_path):
    with pytest.raises(
        ConfigError,
        match=r"some of ply, gltf, sog, usd, rrd .to other simulators: Twin\.export_material., found",
    ):
        save_frames(drawn(0), tmp_path, ("ply", "obj"))
    assert not (tmp_path / "ply").exists()


def test_a_usd_stage_has_the_gaussians_of_every_frame(tmp_path):
    pxr = pytest.importorskip("pxr.UsdVol")
    from pxr import Usd, UsdGeom

    shown = drawn(1)
    save_frames(shown, tmp_path, ("usd",), rate=24, up=torch.tensor([0.0, 0, 1]))
    stage = Usd.Stage.Open(str(tmp_path / "splats.usdc"))
    field = pxr.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    assert (
        stage.GetTimeCodesPerSecond(),
        stage.GetEndTimeCode(),
        UsdGeom.GetStageUpAxis(stage),
    ) == (24, T - 1, "Z")
    for t in range(T):
        frame = splats_at(shown, t)
        assert np.allclose(np.array(field.GetPositionsAttr().Get(t)), frame.splats.means.numpy())
        assert np.allclose(np.array(field.GetScalesAttr().Get(t)), frame.splats.scales.numpy())
        found = np.array(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(t)).reshape(
            M, 4, 3
        )
        assert np.allclose(found, frame.harmonics.numpy(), atol=1e-6)


def of_glb(path, name: str) -> np.ndarray:
    """The values of an attribute, through pygltflib."""
    gltf = pytest.importorskip("pygltflib")
    file = gltf.GLTF2().load(path)
    accessor = file.accessors[vars(file.meshes[0].primitives[0].attributes)[name]]
    view = file.bufferViews[accessor.bufferView]
    assert accessor.componentType == gltf.FLOAT
    values = np.frombuffer(file.binary_blob(), "<f4", view.byteLength // 4, view.byteOffset)
    return values.reshape(accessor.count, -1)


@pytest.mark.parametrize("up", [[0.0, 1, 0], [0.0, 0, 1], [0.0, -1, 0]])
def test_a_glb_has_the_gaussians_upright(tmp_path, up):
    """Read by pygltflib: places, covariances, colours in directions, all turned so that up is y."""
    gltf = pytest.importorskip("pygltflib")
    shown, up = drawn(2), torch.tensor(up)
    turn = upright(up)
    assert torch.allclose(turn @ up, torch.tensor([0.0, 1, 0]), atol=1e-6)
    assert torch.allclose(turn @ turn.T, torch.eye(3), atol=1e-6) and torch.linalg.det(turn) > 0
    save_frames(shown, tmp_path, ("gltf",), up=up)
    path, prefix, t = tmp_path / "gltf" / "001.glb", "KHR_gaussian_splatting:", 1
    file = gltf.GLTF2().load(path)
    primitive = file.meshes[0].primitives[0]
    assert file.extensionsUsed == [prefix[:-1]] and primitive.mode == gltf.POINTS
    assert primitive.extensions[prefix[:-1]] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
    }
    places = of_glb(path, "POSITION")
    assert np.allclose(places, shown.means[t] @ turn.T, atol=1e-6)
    assert np.allclose(file.accessors[0].min, places.min(0))
    axes = Rotation.from_quat(of_glb(path, prefix + "ROTATION")).as_matrix()
    found = axes * of_glb(path, prefix + "SCALE")[:, None] ** 2 @ axes.transpose(0, 2, 1)
    assert np.allclose(found, turn @ shown.covariances[t] @ turn.T, rtol=1e-3, atol=1e-8)
    assert np.allclose(of_glb(path, prefix + "OPACITY")[:, 0], shown.opacities, atol=1e-6)
    names = [f"{prefix}SH_DEGREE_{l}_COEF_{n}" for l in range(3) for n in range(2 * l + 1)]
    c = np.stack([of_glb(path, name) for name in names], 1)
    directions = torch.randn(12, 3, generator=torch.Generator().manual_seed(9))
    found = 0.5 + np.einsum("dk,mkc->dmc", basis(directions @ turn.T, 2).numpy(), c)
    back = (directions[:, None, None, :] @ shown.rotations[t])[:, :, 0]
    wanted = (0.5 + torch.einsum("dmk,mkc->dmc", basis(back, 2), shown.harmonics)) * shown.shades[
        t
    ][:, None]
    assert np.allclose(found, wanted.numpy(), atol=1e-5)


def test_sog_that_takes_long_says_how_far_it_is(tmp_path, monkeypatch, capsys):
    program = tmp_path / "bin" / splat_formats.CONVERTER
    program.parent.mkdir()
    program.write_text('#!/bin/sh\ncp "$6" "$7"\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent), prepend=":")
    save_frames(drawn(0), tmp_path, ("ply",))
    assert capsys.readouterr().err == ""
    save_frames(drawn(0), tmp_path, ("sog",))
    assert "splats: 100%" in capsys.readouterr().err and (tmp_path / "sog" / "000.sog").is_file()


def test_sog_is_what_the_converter_reads_back(tmp_path):
    """Codes of 16 bits for places, palettes of 256 for scales and colours: as near as these are."""
    import shutil
    import subprocess

    if shutil.which("splat-transform") is None:
        pytest.skip("no splat-transform")
    shown = drawn(0)
    save_frames(shown, tmp_path, ("sog",))
    words = ["splat-transform", "-q", str(tmp_path / "sog" / "000.sog"), str(tmp_path / "a.ply")]
    subprocess.run(words, check=True)
    vertex = PlyData.read(tmp_path / "a.ply")["vertex"]
    found, places = np.stack([vertex[a] for a in "xyz"], -1), shown.means[0].numpy()
    nearest = np.linalg.norm(found[:, None] - places, axis=-1)
    order = nearest.argmin(0)
    assert len(np.unique(order)) == M and nearest.min(0).max() < 1e-3 * np.ptp(places)
    wanted = shown.covariances[0].numpy()
    size = np.linalg.norm(wanted, axis=(1, 2))
    assert (np.linalg.norm(covariance(vertex)[order] - wanted, axis=(1, 2)) < 0.05 * size).all()


def test_a_recording_of_rerun_can_be_verified(tmp_path):
    import subprocess
    import sys

    pytest.importorskip("rerun")
    shown = drawn(1)
    save_frames(shown, tmp_path, ("rrd",), rate=24)
    path = str(tmp_path / "splats.rrd")
    words = [sys.executable, "-m", "rerun", "rrd", "print", "-vvv", path]
    said = subprocess.run(words, check=True, capture_output=True, text=True).stdout
    assert "GaussianSplats3D:centers" in said and "time" in said


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    import sys

    for module, format, package in (
        ("pxr.UsdVol", "usd", "usd-core"),
        ("rerun", "rrd", "rerun-sdk"),
    ):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(ConfigError, match=f"{format} needs the package {package}"):
            save_frames(drawn(0), tmp_path, (format,))
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ConfigError, match="sog needs the program splat-transform on the PATH: npm"):
        save_frames(drawn(0), tmp_path, ("sog",))
    assert not list(tmp_path.iterdir())

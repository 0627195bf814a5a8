"""Moving splats as files: every frame, read back by readers that are not this program's, looks as the program sees it."""

import numpy as np
import pytest
import torch
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from mosa.data.io.splat_formats import save_frames, splats_at
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
    with pytest.raises(ConfigError, match="formats: expected a list of some of ply, usd, found"):
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


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(ConfigError, match="usd needs the package usd-core"):
        save_frames(drawn(0), tmp_path, ("usd",))

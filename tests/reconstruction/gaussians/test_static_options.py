"""What comes after the static stage takes what its options give: filling, moving carriers, cues, cache, export."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from mosa.data.io.gaussian_ply import load_ply, save_ply
from mosa.reconstruction.motion.cues import neighbourhood
from mosa.reconstruction.motion.modes import deformation_modes
from mosa.reconstruction.motion.motion import ModalMotion
from mosa.reconstruction.pipeline import posed, reconstruct, spacing_for
from mosa.reconstruction.settings import build_settings
from mosa.rendering.covariance import covariance_from
from mosa.types import Splats

TINY = {"resolution": 32, "ridge_passes": 4, "points": 150}
MOTION = {"modes": 8, "track_iterations": 2, "iterations": 2}
TURN = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.7, 0.2], [0.7, 0.0, -0.4], [-0.2, 0.4, 0.0]]))


def elongated(count=60):
    generator = torch.Generator().manual_seed(0)
    means = 0.1 * torch.rand(count, 3, generator=generator)
    scales = 0.002 + 0.01 * torch.rand(count, 3, generator=generator)
    rotations = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1)
    return Splats(
        means,
        scales,
        rotations,
        torch.full((count,), 0.7),
        torch.rand(count, 3, generator=generator),
    )


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """Of all options: most have the same geometry."""
    return tmp_path_factory.mktemp("options")


@pytest.mark.parametrize("static, appearance, more", [
    ({}, {}, {"geometry": {"source": "hull"}}),
    ({"shape": "anisotropic"}, {"shape": "anisotropic"}, {"cue": "gaussian"}),
])  # fmt: skip
def test_a_scene_is_reconstructed_with_every_option(squashed, cache, static, appearance, more):
    settings = build_settings(**TINY, static={"iterations": 8} | static, appearance={"iterations": 3} | appearance, **more,
                              carried={"iterations": 3},
                              dynamic=MOTION | {"free_shape": more.get("cue") == "gaussian"})  # fmt: skip
    scene = replace(squashed, holdout_frames=(3, 4))
    spacing = spacing_for(scene, 200, settings, cache_dir=cache)
    found = reconstruct(scene, settings=settings, spacing=spacing, cache_dir=cache, progress=False)
    count = len(found.static.means)
    assert count == 150
    free = found.static.scales.amax(1) / found.static.scales.amin(1)
    assert (float(free.max()) > 1.01) == (static.get("shape") == "anisotropic")
    assert torch.isfinite(found.cues.positions).all() and torch.isfinite(found.cues.stretch).all()
    torch.testing.assert_close(
        found.cues.covariances[0], covariance_from(found.splats.scales, found.splats.rotations)
    )
    torch.testing.assert_close(
        found.cues.stretch[0], torch.ones_like(found.cues.stretch[0]), atol=1e-4, rtol=0
    )
    again = reconstruct(scene, settings=settings, spacing=spacing, cache_dir=cache, progress=False)
    assert torch.equal(again.static.scales, found.static.scales)
    if more.get("cue") == "gaussian":
        assert float((found.splats.scales.amax(1) / found.splats.scales.amin(1)).max()) > 1.001
        turn = torch.linalg.det(found.cues.rotation)
        torch.testing.assert_close(turn, torch.ones_like(turn), atol=1e-4, rtol=0)


def test_moving_carriers_are_turned_and_stretched():
    """A_t = F A_0 F^T for an affine motion of elongated carriers that are not the particles."""
    particles = elongated(200).means
    around = neighbourhood(particles)
    modes = deformation_modes(particles, around, count=8)
    carriers = elongated()
    motion = ModalMotion(torch.zeros(2, 3), modes.energy, reach=0.1)
    F = TURN @ torch.diag(torch.tensor([1.3, 0.8, 1.1]))
    wanted = particles @ F.T - particles
    c = torch.linalg.lstsq(modes.values[:, :4], wanted).solution
    motion.amplitude.data[1, :4] = c / motion.unit[:4, None]
    sample = motion(torch.tensor([1]), carriers, modes.at(carriers.means, particles))
    expected = F @ covariance_from(carriers.scales, carriers.rotations) @ F.T
    torch.testing.assert_close(sample.covariances[0], expected, atol=1e-8, rtol=2e-3)
    torch.testing.assert_close(sample.positions[0], carriers.means @ F.T, atol=1e-5, rtol=1e-4)


def test_elongated_gaussians_are_turned_and_written(tmp_path):
    splats = elongated()
    expected = covariance_from(splats.scales, splats.rotations)
    turned = posed(splats, TURN, torch.zeros(3), torch.zeros(3))
    torch.testing.assert_close(
        covariance_from(turned.scales, turned.rotations), TURN @ expected @ TURN.T
    )
    read, _ = load_ply(save_ply(tmp_path / "static.ply", splats))
    torch.testing.assert_close(
        covariance_from(read.scales, read.rotations), expected, rtol=1e-5, atol=1e-10
    )

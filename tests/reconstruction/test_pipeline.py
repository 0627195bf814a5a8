"""The whole reconstruction on a scene with a known motion: accuracy, cache, resumption, and what it must not read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import squashed_body
import torch
import yaml

from mosa.errors import ConfigError
from mosa.reconstruction import pipeline
from mosa.reconstruction.motion import moved
from mosa.reconstruction.pipeline import follow, reconstruct, spacing_for
from mosa.reconstruction.settings import InformedSettings, build_settings
from mosa.rendering.appearance.lighting import shading, surface_normals

CONF = Path(__file__).parents[2] / "conf" / "reconstruction"
SETTINGS = build_settings(
    resolution=56, points=1200, static={"iterations": 120}, appearance={"iterations": 100},
    dynamic={"modes": 40, "track_iterations": 30, "track_views": 3, "iterations": 40}, carried={"iterations": 20},
)  # fmt: skip


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def unknown(squashed):
    """The truth is taken away: reading it would be an error."""
    return replace(squashed, truth=None)


@pytest.fixture(scope="module")
def spacing(unknown, cache):
    return spacing_for(unknown, 700, SETTINGS, cache_dir=cache)


@pytest.fixture(scope="module")
def found(unknown, spacing, cache):
    return reconstruct(unknown, settings=SETTINGS, spacing=spacing, cache_dir=cache, progress=False)


def true_positions(squashed, particles):
    last = float(squashed.times[-1])
    rest = squashed_body.backward(particles.double().numpy(), 0.0, last)
    return torch.as_tensor(
        np.stack([squashed_body.forward(rest, float(t), last) for t in squashed.times]),
        dtype=torch.float32,
    )


def test_particles_fill_the_body(squashed, found, spacing):
    true = 4 / 3 * np.pi * np.prod(squashed_body.RADII)
    assert float(found.volume.sum()) == pytest.approx(true, rel=0.05)
    assert len(found.volume) == pytest.approx(700, rel=0.05)
    mass = found.volume[:, None]
    centre = (found.splats.means * mass).sum(0) / mass.sum()
    assert (centre - torch.tensor([0.02, 0.30, 0.01])).norm() < 0.002
    assert found.spacing == spacing


def test_particle_motion_against_truth(squashed, found):
    """A tenth of a pixel is 0.5 mm here (5 mm per pixel); the body is 0.22 m tall."""
    true = true_positions(squashed, found.splats.means)
    error = (found.cues.positions - true).norm(dim=-1)[1:]
    assert float(error.pow(2).mean().sqrt()) < 2e-3
    assert float((found.cues.positions.mean(1) - true.mean(1)).norm(dim=-1).max()) < 1.5e-3


def test_cues_against_truth(squashed, found):
    from mosa.reconstruction.motion.cues import neighbourhood, neighbourhood_cues

    true = true_positions(squashed, found.splats.means)
    expected = neighbourhood_cues(true, found.cues.covariances, neighbourhood(found.splats.means))
    turn = expected.rotation.transpose(-1, -2) @ found.cues.rotation
    angle = torch.rad2deg(
        torch.acos(((turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1))
    )
    assert float(angle[1:].median()) < 3.0
    signal = (expected.stretch[-1] - 1).pow(2).mean().sqrt()
    assert float(signal) > 0.08
    assert float(
        (expected.stretch[-1] - found.cues.stretch[-1]).pow(2).mean().sqrt()
    ) < 0.5 * float(signal)
    assert torch.equal(
        found.cues.rotation[0], torch.eye(3).expand_as(found.cues.rotation[0])
    ) or torch.allclose(
        found.cues.rotation[0], torch.eye(3).expand_as(found.cues.rotation[0]), atol=1e-5
    )


def test_free_fall_gives_the_velocity(squashed, found):
    """Frames 0 to 1 are free flight: the mean velocity between them, without gravity's share, is the initial one."""
    mass = found.volume[:, None]
    centre = (found.cues.positions * mass).sum(1) / mass.sum()
    dt = float(squashed.times[1])
    velocity = (centre[1] - centre[0]) / dt + torch.tensor([0, 0.5 * 9.8 * dt, 0])
    # the rotation about the origin of the rest frame adds to the centre's displacement as well: none, its centre is the origin
    assert (velocity - torch.tensor([0.3, -1.6, 0.0])).norm() < 0.06


def test_results_come_from_the_cache(squashed, found, spacing, cache, monkeypatch):
    monkeypatch.setattr(pipeline, "fit_splats", None)
    monkeypatch.setattr(moved, "fit_motion", None)
    monkeypatch.setattr(pipeline, "fit_carried", None)
    again = reconstruct(
        squashed, settings=SETTINGS, spacing=spacing, cache_dir=cache, progress=False
    )
    assert torch.equal(again.cues.positions, found.cues.positions) and torch.equal(
        again.splats.colors, found.splats.colors
    )
    assert torch.equal(again.appearance.harmonics, found.appearance.harmonics)
    assert pipeline.stored(squashed, lambda: spacing, SETTINGS, cache_dir=cache)
    folders = [
        {p.name for p in folder.iterdir()}
        for folder in sorted((cache / "reconstruction").iterdir())
    ]
    # the geometry does not depend on the particles' spacing, and nothing on the carried splats
    carried, geometry, rest = sorted(
        folders, key=lambda names: (len(names), "geometry.pt" in names)
    )
    assert carried == {"key.json", "carried.pt"} and geometry == {"key.json", "geometry.pt"}
    assert {"static.png", "particles.png", "motion.png", "key.json", "motion.pt"} <= rest
    assert not any(n.endswith(".tmp") for n in rest)
    assert not pipeline.stored(squashed, lambda: 2 * spacing, SETTINGS, cache_dir=cache)


def test_the_second_look_takes_what_the_first_motion_was_fitted_with(squashed, found, monkeypatch):
    """Modes and hulls take as long as both fits where there are many particles."""
    monkeypatch.setattr(moved, "deformation_modes", None)
    monkeypatch.setattr(moved, "hull_centroid", None)
    settings = SETTINGS.but(informed=InformedSettings(iterations=1))
    again = moved.SecondLook(squashed, found, settings, progress=False).about(found.cues.positions)
    assert again.positions.shape == found.cues.positions.shape and bool(
        torch.isfinite(again.positions).all()
    )


def test_the_second_look_compares_what_was_fitted_to_all_frames(squashed, found):
    """In the light of every frame; `first` and a reconstruction without such Gaussians compare those of the first motion."""
    fitted, first = (moved.SecondLook(squashed, found, SETTINGS.but(informed=InformedSettings(carriers=name)), progress=False)
                     for name in ("fitted", "first"))  # fmt: skip
    carried = fitted._carried
    assert torch.equal(carried.splats.means, found.appearance.splats.means)
    assert torch.equal(carried.light, found.appearance.light)
    still = torch.eye(3).expand(1, len(carried.splats.means), 3, 3)
    torch.testing.assert_close(carried.colors(still)[0], carried.splats.colors)
    assert first._carried is found.moving.carried
    assert (
        moved.SecondLook(
            squashed, replace(found, appearance=None), fitted.settings, progress=False
        )._carried.light
        is None
    )


def test_a_body_that_flows_is_not_compared_as_the_first_motion_carried_it(squashed, found):
    law = []  # the fit chooses it, after the look was made
    one, other = (
        moved.SecondLook(squashed, found, SETTINGS, progress=False, plastic=lambda: "liquid" in law)
        for _ in range(2)
    )
    assert one.settings.informed.carriers == "auto"
    assert one._carried.light is not None
    law.append("liquid")
    assert other._carried is found.moving.carried


def test_a_damaged_stage_is_computed_again_and_the_rest_kept(
    squashed, found, spacing, cache, monkeypatch
):
    damaged = next((cache / "reconstruction").glob("*/geometry.pt"))
    damaged.write_bytes(b"half a file")
    monkeypatch.setattr(moved, "fit_motion", None)
    again = reconstruct(
        squashed, settings=SETTINGS, spacing=spacing, cache_dir=cache, progress=False
    )
    assert torch.equal(again.cues.positions, found.cues.positions)
    assert damaged.stat().st_size > 1000


def quickly(scene, settings, cache):
    """Of 200 particles, with one search of the geometry."""
    spacing = spacing_for(scene, 200, settings, cache_dir=cache)
    return reconstruct(scene, settings=settings, spacing=spacing, cache_dir=cache, progress=False)


def test_held_out_cameras_and_frames_have_no_influence(squashed, tmp_path):
    """Garbage in held-out images and mattes leaves the result bit-equal. Each with a cache of its own, as their keys are equal."""
    quick = build_settings(resolution=32, ridge_passes=4, points=200, static={"iterations": 3}, appearance={"iterations": 3},
                           dynamic={"modes": 8, "track_iterations": 2, "iterations": 2}, carried={"iterations": 3})  # fmt: skip
    held = replace(squashed, holdout_cameras=(2,), holdout_frames=(4,))
    images, mattes = squashed.images.clone(), squashed.mattes.clone()
    images[2], mattes[2], images[:, 4], mattes[:, 4] = 0.1, 0.0, 0.9, 0.0
    spoiled = replace(held, images=images, mattes=mattes)
    results = [quickly(s, quick, tmp_path / str(k)) for k, s in enumerate((held, spoiled))]
    assert results[0].cues.positions.shape[0] == 4
    assert torch.equal(results[0].cues.positions, results[1].cues.positions)
    assert torch.equal(results[0].splats.colors, results[1].splats.colors)
    assert torch.equal(results[0].appearance.harmonics, results[1].appearance.harmonics)


def test_gaussian_cues_come_from_free_shapes(squashed, tmp_path):
    quick = {"resolution": 32, "ridge_passes": 4, "points": 200, "static": {"iterations": 3}, "appearance": {"iterations": 3},
             "carried": {"iterations": 3}}  # fmt: skip
    dynamic = {"modes": 8, "track_iterations": 2, "iterations": 2}
    with pytest.raises(ConfigError, match="free_shape=true"):
        build_settings(**quick, cue="gaussian", dynamic=dynamic)
    settings = build_settings(**quick, cue="gaussian", dynamic=dynamic | {"free_shape": True})
    scene = replace(squashed, holdout_frames=(3, 4))
    cues = quickly(scene, settings, tmp_path).cues
    assert torch.allclose(cues.stretch[0], torch.ones_like(cues.stretch[0]), atol=1e-5)
    assert float((cues.stretch[1] - 1).abs().max()) > 1e-6 and cues.weight.min() == 1
    assert torch.allclose(torch.linalg.det(cues.rotation), torch.ones_like(cues.weight), atol=1e-4)


@pytest.mark.parametrize("name", ["fast", "paper"])
def test_presets_build(name):
    settings = build_settings(**(yaml.safe_load((CONF / f"{name}.yaml").read_text()) or {}))
    assert settings.cue == ("neighbourhood" if name == "fast" else "gaussian")


def test_wrong_keys_are_named():
    with pytest.raises(ConfigError, match=r"reconstruction\.pointz: unknown key"):
        build_settings(pointz=3)
    with pytest.raises(ConfigError, match=r"reconstruction\.dynamic\.mode: unknown key"):
        build_settings(dynamic={"mode": 3})
    with pytest.raises(ConfigError, match="cue: expected neighbourhood or gaussian"):
        build_settings(cue="flow")


def test_wrong_spacing_is_an_error(squashed):
    with pytest.raises(ConfigError, match="spacing must be positive"):
        reconstruct(squashed, settings=SETTINGS, spacing=0.0, cache_dir=None)
    with pytest.raises(ConfigError, match="at least 8, found 2"):
        spacing_for(squashed, 2)


def turned_scene(scene, Q, shift):
    """The same footage in a world turned by Q and shifted: another sequence of the body, in another pose."""
    back = torch.eye(4)
    back[:3, :3], back[:3, 3] = Q.T, -Q.T @ shift
    corners = torch.cartesian_prod(*scene.box.T.unbind()) @ Q.T + shift
    return replace(
        scene, sequence="turned", truth=None, cameras=replace(scene.cameras, w2c=scene.cameras.w2c @ back),
        box=torch.stack([corners.amin(0), corners.amax(0)]), fingerprint=scene.fingerprint + "-turned",
    )  # fmt: skip


def test_a_known_body_is_followed_through_another_sequence(squashed, found, tmp_path):
    """Its cues are those of the first sequence in the turned world: rotations relative to the pose at frame 0."""
    Q = torch.linalg.matrix_exp(
        torch.tensor([[0.0, -0.9, 0.3], [0.9, 0.0, -0.5], [-0.3, 0.5, 0.0]])
    )
    shift, middle = torch.tensor([0.03, 0.05, -0.02]), found.splats.means.mean(0)
    other = turned_scene(squashed, Q, shift)
    pose = {"rotation": Q, "center": Q @ middle + shift, "rest_center": middle}
    result = follow(
        other, squashed, found, **pose, settings=SETTINGS, cache_dir=tmp_path, progress=False
    )
    true = true_positions(squashed, found.splats.means) @ Q.T + shift
    error = (result.cues.positions - true).norm(dim=-1)[1:]
    assert error.square().mean().sqrt() < 0.002
    assert torch.equal(result.volume, found.volume) and torch.equal(
        result.splats.colors, found.splats.colors
    )
    known = (result.cues.weight > 0) & (found.cues.weight > 0)
    change = (result.cues.rotation - Q @ found.cues.rotation @ Q.T)[known].flatten(1).norm(dim=1)
    assert torch.rad2deg(change / 2**0.5).median() < 2.0 and known.float().mean() > 0.9
    # colours known in another light than that of this film: its first frame says what they are here
    normals = surface_normals(found.static.means, found.splats.means)
    light = torch.tensor([0.3, -0.2, 0.4, 0, 0, 0, 0, 0])
    relit = replace(
        found,
        static=replace(
            found.static, colors=found.static.colors / shading(light, normals, Q)[:, None]
        ),
    )
    started = follow(
        other, squashed, relit, **pose, settings=SETTINGS, cache_dir=None, progress=False
    ).static
    off, before = (
        (known.colors - found.static.colors).abs().mean() for known in (started, relit.static)
    )
    assert off < 0.5 * before
    stored = follow(
        other, squashed, found, **pose, settings=SETTINGS, cache_dir=tmp_path, progress=False
    )
    assert (
        torch.equal(stored.cues.positions, result.cues.positions)
        and len(list(tmp_path.rglob("motion.pt"))) == 1
    )

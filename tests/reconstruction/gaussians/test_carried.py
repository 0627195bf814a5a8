"""The fit of carried splats: further frames show what the first hides, and a light that stays is told from a colour."""

from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation

from mosa.reconstruction.gaussians.carried import fit_carried
from mosa.reconstruction.motion.observed import Windows
from mosa.reconstruction.pipeline import reconstruct
from mosa.reconstruction.settings import CarriedSettings, build_settings
from mosa.rendering.appearance.carried_splats import CarriedSplats, Seen
from mosa.rendering.appearance.lighting import shading
from mosa.rendering.appearance.spherical_harmonics import constant_coefficients
from mosa.rendering.cameras import look_at
from mosa.rendering.covariance import covariance_from
from mosa.types import Appearance, Cameras, Splats

FRAMES, SIZE = 5, 40
LIGHT = torch.tensor([0.3, 0.5, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0])


def ball() -> tuple[torch.Tensor, Splats]:
    """Particles of a ball, and splats on its surface in colours of their own."""
    axis = torch.linspace(-0.1, 0.1, 9)
    grid = torch.cartesian_prod(axis, axis, axis)
    particles = grid[grid.norm(dim=1) < 0.1]
    g = torch.Generator().manual_seed(0)
    means = 0.1 * torch.nn.functional.normalize(torch.randn(250, 3, generator=g), dim=1)
    rotations = torch.tensor([1.0, 0, 0, 0]).repeat(250, 1)
    colors = 0.3 + 0.4 * torch.rand(250, 3, generator=g)
    return particles, Splats(
        means, torch.full((250, 3), 0.012), rotations, torch.full((250,), 0.9), colors
    )


@pytest.fixture(scope="module")
def filmed() -> tuple:
    """A ball that turns under a light: particles, true splats, positions, windows."""
    particles, true = ball()
    turns = torch.as_tensor(
        Rotation.from_rotvec([[0.35 * t, 0.1 * t, 0] for t in range(FRAMES)]).as_matrix()
    ).float()
    positions = particles @ turns.mT
    eyes = torch.tensor([[0.5, 0.1, 0.0], [-0.3, 0.2, 0.4], [-0.2, -0.3, -0.4], [0.1, 0.45, -0.2]])
    w2c = torch.stack([look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])) for eye in eyes])
    K = torch.tensor([[80.0, 0, SIZE / 2], [0, 80, SIZE / 2], [0, 0, 1]]).expand(4, 3, 3)
    cameras = Cameras(K, w2c, SIZE, SIZE, ("a", "b", "c", "d"))
    images = (
        shown(true, particles, positions, LIGHT, true.means / 0.1)
        .images(cameras, torch.ones(3))
        .clamp(0, 1)
    )
    mattes = (
        Seen(
            positions,
            4e-4 * torch.eye(3).expand(FRAMES, len(particles), 3, 3),
            torch.ones(len(particles)),
            constant_coefficients(torch.zeros(len(particles), 3)),
        ).images(cameras, torch.ones(3))[..., 0]
        < 0.5
    )
    view, frame = torch.arange(4).repeat_interleave(FRAMES), torch.arange(FRAMES).repeat(4)
    windows = Windows(
        images.flatten(0, 1),
        mattes.float().flatten(0, 1),
        cameras.select(view.tolist()),
        view,
        frame,
    )
    return particles, true, positions, windows


def shown(splats: Splats, particles, positions, light, normals) -> Seen:
    carried = CarriedSplats(
        Appearance(splats, constant_coefficients(splats.colors)), particles
    ).carry(positions)
    shapes = carried.covariances(covariance_from(splats.scales, splats.rotations))
    return Seen(
        carried.means,
        shapes,
        splats.opacities,
        constant_coefficients(splats.colors),
        None,
        shading(light, normals, carried.rotations),
    )


def test_colours_and_light_are_found_from_all_frames(filmed):
    particles, true, positions, windows = filmed
    dull = replace(true, colors=torch.full_like(true.colors, 0.5))
    settings = CarriedSettings(
        iterations=120, ssim=0.0, matte=0.0, degree=0, keep=0.0, lr_positions=0.0, lr_scales=0.0
    )
    found = fit_carried(dull, particles, positions, windows, torch.ones(3), settings, seed=0)
    dark = fit_carried(
        dull, particles, positions, windows, torch.ones(3), settings.but(light=False), seed=0
    )
    assert torch.equal(dark.light, torch.zeros(8))

    def error(result) -> float:
        splats = CarriedSplats(result, particles)
        carried = splats.carry(positions)
        views = windows.cameras.select([0, FRAMES, 2 * FRAMES, 3 * FRAMES])
        images = Seen(
            carried.means,
            carried.covariances(covariance_from(splats.scales, splats.rotations)),
            splats.opacities,
            result.harmonics,
            None,
            shading(result.light, splats.normals, carried.rotations),
        ).images(views, torch.ones(3))
        return float((images.clamp(0, 1).flatten(0, 1) - windows.images).square().mean().sqrt())

    assert error(found) < 0.5 * error(dark)
    assert abs(float(found.light[1]) - 0.5) < 0.15 and abs(float(found.light[0]) - 0.3) < 0.15


def test_the_same_seed_gives_the_same_bits(filmed):
    particles, true, positions, windows = filmed
    fits = [
        fit_carried(
            true,
            particles,
            positions,
            windows,
            torch.ones(3),
            CarriedSettings(iterations=4, degree=2),
            seed=1,
        )
        for _ in range(2)
    ]
    assert torch.equal(fits[0].harmonics, fits[1].harmonics) and torch.equal(
        fits[0].splats.means, fits[1].splats.means
    )
    assert fits[0].harmonics.shape == (250, 9, 3)


def test_a_reconstruction_has_them_and_its_motion_does_not_depend_on_them(squashed, tmp_path):
    quick = {"resolution": 32, "ridge_passes": 4, "points": 200, "static": {"iterations": 3}, "appearance": {"iterations": 3},
             "dynamic": {"modes": 8, "track_iterations": 2, "iterations": 2}}  # fmt: skip

    def run(**carried):
        return reconstruct(
            squashed,
            settings=build_settings(**quick, carried=carried),
            spacing=0.03,
            cache_dir=tmp_path,
            progress=False,
        )

    first, again, plain = run(iterations=3), run(iterations=3), run(iterations=0)
    assert (
        torch.equal(first.appearance.harmonics, again.appearance.harmonics)
        and first.appearance.harmonics.shape[1] == 4
    )
    assert plain.appearance.light is None and torch.equal(
        plain.appearance.splats.means, plain.static.means
    )
    assert torch.equal(first.cues.positions, plain.cues.positions)
    assert len(list((tmp_path / "reconstruction").glob("*/motion.pt"))) == 1
    assert len(list((tmp_path / "reconstruction").glob("*/carried.pt"))) == 1

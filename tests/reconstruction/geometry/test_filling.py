"""Visual hull and filling: volume, centre of mass and silhouettes of bodies whose shape is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import squashed_body
import torch
from scipy import ndimage

from mosa.data.hull import (
    Volume,
    hull_bounds,
    hull_centroid,
    matte_values,
    shave_ridges,
    visual_hull,
)
from mosa.errors import DataError
from mosa.reconstruction.gaussians.initial import initial_splats
from mosa.reconstruction.geometry.behind import fill_behind
from mosa.reconstruction.geometry.filling import body_volume, fill

TRUE_VOLUME = 4 / 3 * np.pi * np.prod(squashed_body.RADII)
CENTRE = torch.tensor(squashed_body.forward(np.zeros((1, 3)), 0.0, 1.0)[0], dtype=torch.float32)


@pytest.fixture(scope="module")
def hull(squashed):
    return visual_hull(squashed.mattes[:, 0], squashed.cameras, squashed.box, pitch=0.0028)


def truly_inside(volume: Volume) -> np.ndarray:
    points = volume.points().double().numpy()
    return (
        squashed_body.inside(points.reshape(-1, 3) - CENTRE.double().numpy()).reshape(
            points.shape[:3]
        )
        < 0
    )


def ball(radius: float = 0.1, pitch: float = 0.004) -> Volume:
    axis = torch.arange(-radius - 2 * pitch, radius + 2 * pitch, pitch)
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return Volume((grid.norm(dim=-1) < radius).float(), axis[0].repeat(3), pitch)


def test_hull_holds_the_body_and_no_silhouette_sticks_out(hull, squashed):
    inside, true = (hull.values > 0.5).numpy(), truly_inside(hull)
    assert (true & ~inside).sum() < 0.01 * true.sum()
    assert 1.0 < body_volume(hull) / TRUE_VOLUME < 1.12
    points = hull.points()[hull.values > 0.5]
    assert matte_values(points, squashed.mattes[:, 0], squashed.cameras).min() > 0.5


def test_shaving_takes_excess_and_leaves_the_body(hull, squashed):
    shaved = shave_ridges(hull, squashed.cameras)
    inside, true = (shaved.values > 0.5).numpy(), truly_inside(hull)
    assert 0.98 < body_volume(shaved) / TRUE_VOLUME < 1.05
    assert body_volume(shaved) < body_volume(hull) - 0.02 * TRUE_VOLUME
    assert (inside & true).sum() / (inside | true).sum() > 0.94
    assert (inside & ~(hull.values > 0.5).numpy()).sum() == 0
    # every silhouette is still covered: pixels well inside a matte see a voxel
    for v in range(len(squashed.cameras)):
        points = hull.points()[shaved.values > 0.5]
        seen = points @ squashed.cameras.w2c[v, :3, :3].T + squashed.cameras.w2c[v, :3, 3]
        pixel = (seen @ squashed.cameras.K[v].T)[:, :2] / seen[:, 2:]
        covered = torch.zeros_like(squashed.mattes[v, 0], dtype=torch.bool)
        covered[pixel[:, 1].long(), pixel[:, 0].long()] = True
        matte = squashed.mattes[v, 0]
        assert (covered & (matte > 0.99)).sum() > 0.99 * (matte > 0.99).sum()


def test_centroid_and_bounds_follow_the_object(squashed):
    centre = hull_centroid(squashed.mattes[:, 0], squashed.cameras, squashed.box)
    assert (centre - CENTRE).norm() < 0.002
    bounds = hull_bounds(squashed.mattes[:, 0], squashed.cameras, squashed.box)
    radii = torch.tensor(squashed_body.RADII, dtype=torch.float32)
    assert (bounds[0] < CENTRE - 0.97 * radii).all() and (bounds[1] > CENTRE + 0.97 * radii).all()
    assert (bounds[1] - bounds[0]).max() < 0.32


def test_a_view_that_cuts_the_object_does_not_cut_the_hull(squashed, hull):
    """A matte that runs over the image's border says nothing beyond it; the other views bound the object there."""
    left, top = 0, int((squashed.mattes[0, 0].amax(1) > 0.5).float().argmax()) + 12
    K = squashed.cameras.K.clone()
    mattes = squashed.mattes[:, 0].clone()
    mattes[0] = torch.zeros_like(mattes[0])
    mattes[0, : mattes.shape[1] - top] = squashed.mattes[0, 0, top:]
    K[0, 1, 2] -= top
    cut = visual_hull(mattes, replace(squashed.cameras, K=K), squashed.box, pitch=0.0028)
    assert left == 0 and body_volume(cut) > 0.99 * body_volume(hull)


def test_empty_hull_is_an_error(squashed):
    with pytest.raises(DataError, match="lies inside all 8 mattes"):
        visual_hull(squashed.mattes[:, 0], squashed.cameras, squashed.box + 3.0, pitch=0.01)
    with pytest.raises(DataError, match="empty"):
        fill(Volume(torch.zeros(5, 5, 5), torch.zeros(3), 0.1), spacing=0.2)


@pytest.mark.parametrize("spacing", [0.012, 0.02, 0.031])
def test_filling_keeps_volume_centre_and_inertia(spacing):
    volume = ball()
    particles = fill(volume, spacing=spacing)
    true = 4 / 3 * np.pi * 0.1**3
    assert float(particles.volume.sum()) == pytest.approx(body_volume(volume), rel=1e-5)
    assert float(particles.volume.sum()) == pytest.approx(true, rel=0.01)
    assert len(particles.volume) == pytest.approx(true / spacing**3, rel=0.03)
    mass = particles.volume[:, None]
    centre = (particles.positions * mass).sum(0) / mass.sum()
    assert (centre - volume.points()[volume.values > 0.5].mean(0)).norm() < 1e-5
    inertia = ((particles.positions - centre) ** 2 * mass).sum() / mass.sum()
    # point masses miss the own inertia of their cells: spacing^2 / 4 for full cubes, more where a cell took strays in
    assert 0.99 * 0.6 * 0.1**2 - 0.35 * spacing**2 < float(inertia) < 0.6 * 0.1**2
    assert (particles.positions.norm(dim=1) < 0.1).all()
    inner = particles.volume[particles.positions.norm(dim=1) < 0.1 - 2 * spacing]
    assert len(inner) and torch.allclose(inner, torch.full_like(inner, spacing**3), rtol=0.6)


def test_thin_features_keep_particles():
    values = torch.zeros(40, 40, 40)
    values[5:25, 5:25, 5:25] = 1
    values[25:38, 14:16, 14:16] = 1
    particles = fill(Volume(values, torch.zeros(3), 0.01), spacing=0.05)
    assert particles.positions[:, 0].max() > 0.30
    assert float(particles.volume.sum()) == pytest.approx(float(values.sum()) * 1e-6, rel=1e-5)


def test_debris_goes_and_cavities_close():
    volume = ball()
    values = volume.values.clone()
    middle = values.shape[0] // 2
    values[middle, middle, middle] = 0
    values[1, 1, 1] = 1
    assert body_volume(Volume(values, volume.origin, volume.pitch)) == pytest.approx(
        body_volume(volume)
    )


def test_what_lies_behind_gaussians_of_a_skin_is_the_body(hull, still):
    """Of an opaque skin, whose depth no Gaussian of the far side draws in: the inside is filled, and nothing is added beyond the
    hull's own voxels and their neighbours."""
    skin = initial_splats(hull, still, count=3000, seed=0)
    skin = replace(skin, opacities=torch.full_like(skin.opacities, 0.999))
    found = fill_behind(skin, still, hull)
    inside, true = found.values.numpy() > 0.5, truly_inside(hull)
    deep = ndimage.binary_erosion(true, iterations=5)
    assert deep.sum() > 0.2 * true.sum() and inside[deep].all()
    assert not inside[~ndimage.binary_dilation(hull.values.numpy() > 0.5)].any()
    assert 0.85 < body_volume(found) / TRUE_VOLUME < 1.05


def test_no_gaussians_fill_nothing(hull, still):
    skin = initial_splats(hull, still, count=100, seed=0)
    clear = replace(skin, opacities=torch.full_like(skin.opacities, 1e-4))
    with pytest.raises(DataError, match="behind the 100 static Gaussians"):
        fill_behind(clear, still, hull)

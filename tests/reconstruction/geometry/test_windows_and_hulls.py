"""Short cuts of the host's work give the bits of the plain way."""

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F

from mosa.data import hull
from mosa.data.synthetic.renderer import ring_of_cameras
from mosa.reconstruction.motion.observed import object_windows


@pytest.mark.parametrize("margin", [2, 60])
def test_windows_are_cut_from_images_on_a_background(squashed, margin):
    """A margin of 60 px reaches far beyond the images."""
    scene = replace(squashed, background=torch.tensor([0.2, 0.4, 0.9]))
    windows = object_windows(scene, [1, 3], [0, 1], margin=margin)
    pad = 200
    for b, (v, t) in enumerate([(1, 0), (1, 1), (3, 0), (3, 1)]):
        x, y = (pad + int(scene.cameras.K[v, a, 2] - windows.cameras.K[b, a, 2]) for a in (0, 1))
        frame = (pad,) * 4
        whole = [
            F.pad(scene.images[v, t, ..., c], frame, value=float(scene.background[c]))
            for c in range(3)
        ]
        cut = slice(y, y + windows.cameras.height), slice(x, x + windows.cameras.width)
        assert torch.equal(windows.images[b], torch.stack(whole, -1)[cut])
        assert torch.equal(windows.mattes[b], F.pad(scene.mattes[v, t], frame)[cut])
        assert (windows.cameras.width > scene.cameras.width) == (margin == 60)


def test_occupancy_is_the_smallest_matte_of_all_views(squashed):
    mattes, cameras = squashed.mattes[:, 0], squashed.cameras
    bounds = hull.hull_bounds(mattes, cameras, squashed.box)
    points = bounds[0] + (bounds[1] - bounds[0]) * torch.rand(
        5000, 3, generator=torch.Generator().manual_seed(0)
    )
    wanted = hull.matte_values(points, mattes, cameras).amin(0)
    assert 0.1 < float((wanted > 0.5).float().mean()) < 0.9
    assert torch.allclose(hull.occupancy(points, mattes, cameras, chunk=2000), wanted, atol=1e-5)


def test_grown_mattes_are_maxima_over_squares(squashed):
    mattes = squashed.mattes[:, 0]
    for radius in (0, 1, 7):
        wanted = F.max_pool2d(mattes[:, None], 2 * radius + 1, stride=1, padding=radius)[:, 0]
        assert torch.equal(hull._grow(mattes, radius), wanted)


def test_a_small_body_in_a_wide_box_is_found():
    """A ball of 5 cm in a box of 3.2 m fills every picture: mattes grown by half a cell reach the borders."""
    rig = ring_of_cameras(
        6, 100, target=(0, 0, 0), distance=0.3, elevations=(0.1, 0.8), field=0.035, turn=0.1
    )
    axis = torch.linspace(-0.025, 0.025, 41)
    ball = torch.cartesian_prod(axis, axis, axis)
    ball = ball[ball.norm(dim=1) <= 0.025]
    mattes = torch.zeros(6, 100, 100)
    for matte, K, w2c in zip(mattes, rig.K, rig.w2c):
        pixel = (ball @ w2c[:3, :3].T + w2c[:3, 3]) @ K.T
        column, row = (pixel[:, :2] / pixel[:, 2:]).long().unbind(1)
        matte[row, column] = 1
    mattes = F.max_pool2d(mattes[:, None], 3, 1, 1)[:, 0]
    assert mattes[:, 0].sum() == 0 and mattes.mean() > 0.2
    bounds = hull.hull_bounds(mattes, rig, torch.tensor([[-1.6, -0.1, -1.6], [1.6, 1.0, 1.6]]))
    assert (bounds[0] <= -0.025).all() and (bounds[1] >= 0.025).all()
    assert (bounds[1] - bounds[0]).max() < 0.07

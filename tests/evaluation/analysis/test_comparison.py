"""The pictures of a run: the ground lies where the ground is, behind the object; errors have the colours that the legend says."""

from dataclasses import replace
from itertools import pairwise

import cv2
import imageio.v3 as iio
import matplotlib
import numpy as np
import pytest
import torch

from mosa.evaluation.analysis.comparison import (
    Comparison,
    compare,
    distances,
    error_limit,
    ground_lines,
    legend,
    on_ground,
    paint,
    round_up,
    write_comparisons,
)
from mosa.evaluation.analysis.figures import side_by_side, write_strip
from mosa.evaluation.evaluate import Sequence
from mosa.modules.body.body import Body, SimulationSettings, Start
from mosa.modules.body.material import Material
from mosa.rendering.cameras import look_at
from mosa.types import Cameras, Ground, Rollout, Scene, Truth

T, SIZE, HEIGHT = 4, 48, 0.1
SHIFT = 0.04


def grid() -> torch.Tensor:
    axis = torch.linspace(-0.1, 0.1, 6)
    return torch.cartesian_prod(axis, axis, axis)


def fall(shift: float = 0.0) -> torch.Tensor:
    """(T, N, 3): a cube that moves down, `shift` m along x."""
    return torch.stack([grid() + torch.tensor([shift, 0.5 - 0.05 * t, 0.0]) for t in range(T)])


def rollout(shift: float) -> Rollout:
    F = torch.eye(3).expand(T, len(grid()), 3, 3)
    return Rollout(fall(shift), torch.zeros(T, len(grid()), 3), F, F, torch.arange(T) / 24, None)


@pytest.fixture(scope="module")
def body() -> Body:
    n = len(grid())
    splats = {"colors": torch.full((n, 3), 0.3), "opacities": torch.full((n,), 0.9),
              "covariances": 4e-4 * torch.eye(3).expand(n, 3, 3)}  # fmt: skip
    return Body(
        rest=grid(),
        volume=torch.full((n,), 1e-5),
        **splats,
        density=1000.0,
        heterogeneity=None,
        adapter=None,
        material=Material("neo_hookean", {"E": 1e5, "nu": 0.3}),
        settings=SimulationSettings(dx=0.1),
    )


def camera(eye=(0.9, 0.8, 1.2), target=(0.0, 0.3, 0.0)) -> Cameras:
    K = torch.tensor([[60.0, 0, SIZE / 2], [0, 60.0, SIZE / 2], [0, 0, 1]])
    pose = look_at(torch.tensor(eye), torch.tensor(target), torch.tensor([0.0, 1, 0]))
    return Cameras(K[None], pose[None], SIZE, SIZE, ("0",))


def scene(truth: bool = True) -> Scene:
    mattes = torch.zeros(1, T, SIZE, SIZE)
    mattes[:, :, 12:36, 12:36] = 1
    known = Truth(grid(), fall(), torch.eye(3), torch.zeros(3)) if truth else None
    images, up = 1 - 0.7 * mattes[..., None].expand(-1, -1, -1, -1, 3), torch.tensor([0.0, 1, 0])
    return Scene(
        "cube",
        "test",
        images,
        mattes,
        camera(),
        torch.arange(T) / 24,
        -9.8 * up,
        up,
        Ground(HEIGHT),
        torch.tensor([[-1.0] * 3, [1.0] * 3]),
        1000.0,
        torch.ones(3),
        False,
        truth=known,
    )


def shown(body, truth=True):
    start = Start(torch.eye(3), torch.zeros(3), torch.zeros(3), torch.zeros(3))
    return compare(
        body,
        Sequence("test/drop", scene(truth), start, 2),
        {"prior": rollout(SHIFT), "adapted": rollout(0.0)},
    )


def test_lines_lie_on_the_ground_half_the_bodys_size_apart():
    """Every pixel's ray meets the plane on a line of the grid: one of its coordinates is a multiple of the cell."""
    cameras = camera()
    lines = ground_lines(scene(), cameras, 0.4)
    assert len(lines) > 20
    K, w2c = cameras.K[0].double().numpy(), cameras.w2c[0].double().numpy()
    eye = -w2c[:3, :3].T @ w2c[:3, 3]
    constant = []
    for line in lines:
        rays = np.c_[line, np.ones(len(line))] @ np.linalg.inv(K).T @ w2c[:3, :3]
        points = eye + (HEIGHT - eye[1]) / rays[:, 1:2] * rays
        spread = np.ptp(points, axis=0)
        assert spread[1] < 1e-9 and min(spread[0], spread[2]) < 1e-6 < max(spread[0], spread[2])
        axis = 0 if spread[0] < spread[2] else 2
        constant.append((axis, points[0, axis]))
    for axis in (0, 2):
        places = np.sort([value for a, value in constant if a == axis])
        assert np.allclose(np.diff(places), 0.2, atol=1e-6)


def test_no_ground_no_lines():
    assert ground_lines(replace(scene(), ground=None), camera(), 0.4) == []
    assert ground_lines(scene(), camera(eye=(0.5, 0.0, 1.0)), 0.4) == []  # below it
    assert (
        ground_lines(scene(), camera(eye=(0.5, 0.5, 1.0), target=(0.0, 2.0, 0.0)), 0.4) == []
    )  # looks up


def test_lines_are_behind_what_is_seen():
    image = np.full((60, 60, 3), 255, np.uint8)
    image[20:40, 20:40] = (200, 30, 30)
    found = on_ground(
        image,
        [np.array([[0.0, 15.0], [30.0, 15.0]]), np.array([[0.0, 25.0], [30.0, 25.0]])],
        2,
        torch.ones(3),
    )
    assert (found[20:40, 20:40] == image[20:40, 20:40]).all()
    assert (
        (found[30, [5, 50]] < 250).all()
        and (found[50, [5, 30, 50]] < 250).all()
        and (found[10] == 255).all()
    )


@pytest.mark.parametrize(
    "value, limit",
    [(0.0, 1e-3), (0.0011, 2e-3), (0.02, 0.02), (0.021, 0.05), (0.07, 0.1), (3.0, 5.0)],
)
def test_a_scale_ends_at_a_round_number(value, limit):
    assert round_up(value) == pytest.approx(limit)


def test_the_distance_to_the_truth_is_painted(body):
    """The adapted cube lies on the true one, the prior's is 40 mm off everywhere: 40 of 50 mm."""
    found = shown(body)
    assert (found.label, found.high) == ("distance to the true motion", "50 mm")
    viridis = matplotlib.colormaps["viridis"]
    for title, share in (("prior", SHIFT / 0.05), ("adapted (learned law)", 0.0)):
        wanted = 255 * np.array(viridis(share)[:3])
        for image in found.errors[title]:
            inside = (
                np.abs(image - wanted).max(-1) <= 3
            )  # splats are opaque to a percent in the middle of the cube
            assert 0.03 < inside.mean() < 0.5
    assert (
        found.images["real"].shape == found.errors["prior"].shape
        and found.images["real"].shape[0] == T
    )


def test_all_recordings_of_a_run_share_the_scale_of_the_farthest(body):
    near = Sequence("test/drop", scene(), Start(torch.eye(3), *torch.zeros(3, 3)), 2)
    far = distances(body, near.scene, {"prior": rollout(SHIFT), "adapted": rollout(0.0)})
    assert list(far) == ["prior", "adapted"] and error_limit(far.values()) == pytest.approx(0.05)
    limit = error_limit([*far.values(), torch.full((T, 3), 0.15)])
    assert compare(body, near, {"adapted": rollout(0.0)}, limit=limit).high == "200 mm"
    assert distances(body, scene(truth=False), {"prior": rollout(SHIFT)}) == {}


def test_without_truth_the_difference_of_the_images_is_painted(body):
    found = shown(body, truth=False)
    assert (found.label, found.high) == ("difference of the images", "0.5")
    corner = found.errors["prior"][:, 2, 2]  # background in both
    assert np.abs(corner - 255 * np.array(matplotlib.colormaps["Reds"](0.0)[:3])).max() <= 1
    assert found.errors["prior"].min() < 130  # the cubes do not look alike


def test_values_beyond_the_scale_have_its_last_colour():
    assert torch.equal(paint(torch.tensor([2.0]), "viridis"), paint(torch.tensor([1.0]), "viridis"))


def test_legend_video_and_strip(body, tmp_path):
    found = shown(body)
    picture = legend(found)
    middle = picture[picture.shape[0] // 2 + 3]
    coloured = np.ptp(middle.astype(int), axis=1) > 20
    assert 0.75 < coloured.mean() <= 0.8 and picture.shape == found.images["real"].shape[1:]
    write_comparisons(tmp_path, {"test/first": found, "test/drop": found}, video=False)
    assert [path.name for path in tmp_path.iterdir()] == ["strip.png"]
    write_comparisons(tmp_path, {"test/first": found, "test/drop": found})
    height, width = found.images["real"].shape[1:3]
    video = iio.imread(tmp_path / "video.mp4")
    rows = 2 * (height + 26) + 26
    assert video.shape == (T, rows + rows % 2, 3 * width + (3 * width) % 2, 3)
    strip = iio.imread(tmp_path / "strip.png")
    assert strip.shape == (
        2 * (5 * (height + 26) + 22) + height + 26,
        T * width,
        3,
    )  # the scale once


def test_every_frame_has_its_own_caption(tmp_path):
    images = np.full((T, 30, 200, 3), 255, np.uint8)
    frames = side_by_side({"a": images, "b": images}, footer=[f"frame {t}" for t in range(T)])
    assert all(frame.shape == (30 + 26 + 26, 400, 3) for frame in frames)
    for first, second in pairwise(frames):
        assert (first[:56] == second[:56]).all() and (first[56:] != second[56:]).any()
    plain, noted = (
        write_strip(tmp_path / "strip.png", {"a": images, "b": images}, notes=notes)
        for notes in ({}, {"a": [f"frame {t}" for t in range(T)]})
    )
    assert noted.shape[0] == plain.shape[0] + 22
    assert (noted[26 + 22 :] == plain[26:]).all() and cv2.absdiff(
        noted[26:48, :200], noted[26:48, 200:400]
    ).any()


def test_the_legend_s_words_fit_beside_a_narrow_image():
    """Of an image of 120 px: what it would lose at its edge is written smaller."""
    images = {"real": np.full((1, 200, 120, 3), 255, np.uint8)}
    wide = {"real": np.full((1, 200, 400, 3), 255, np.uint8)}
    found = [
        legend(Comparison(each, {}, "distance to the true motion", "5 mm", "viridis", [0.0]))
        for each in (images, wide)
    ]
    columns = [
        np.flatnonzero((picture[60:95] < 200).any((0, 2))) for picture in found
    ]  # of the words above the colours
    assert 105 < columns[0].max() < 119 and columns[1].max() < 240

"""A film that no thrown object could have made is refused; every film that one could have made passes."""

import sys
import warnings
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch

from mosa.data.checks.cameras import check_agreement
from mosa.data.checks.free_fall import check_direction, check_fall, parabola, track_of
from mosa.data.checks.silhouettes import check_outlines
from mosa.data.checks.validation import validate
from mosa.data.scene import load_scene
from mosa.data.synthetic.renderer import ring_of_cameras
from mosa.errors import DataError
from mosa.rendering.cameras import rays
from mosa.types import REST, Ground, Scene

RADIUS, REBOUND, FPS, FRAMES = 0.1, 0.6, 30, 12


def height(t: float) -> float:
    """Of the centre [m]: a fall from 0.55 m, and a bounce with a share of the speed."""
    touch = (2 * (0.55 - RADIUS) / 9.8) ** 0.5
    return (
        0.55 - 4.9 * t * t
        if t < touch
        else RADIUS + REBOUND * 9.8 * touch * (t - touch) - 4.9 * (t - touch) ** 2
    )


def ball(views: int = 4, size: int = 64, shift=(0.0, 0.0), elevations=(0.2, 0.6)) -> Scene:
    """shift [m]: of the object's path, sideways."""
    rig = ring_of_cameras(
        views, size, target=(0, 0.3, 0), distance=1.5, elevations=elevations, field=0.7, turn=0.4
    )
    origins, directions = rays(rig)
    mattes = []
    for t in range(FRAMES):
        arm = (
            torch.tensor([0.02 * t + shift[0], height(t / FPS), shift[1]]) - origins[:, None, None]
        )
        along = (arm * directions).sum(-1, keepdim=True)
        distance = (arm - along * directions).norm(dim=-1)
        pixel = along[..., 0] / rig.K[:, 0, 0].view(-1, 1, 1)
        mattes.append(
            ((RADIUS - distance) / pixel + 0.5).clamp(0, 1)
        )  # coverage of a pixel by the rim
    mattes = torch.stack(mattes, 1)
    images = (1 - 0.5 * mattes[..., None]).expand(-1, -1, -1, -1, 3)
    up = torch.tensor([0.0, 1.0, 0.0])
    box = torch.tensor([[-1.0, -0.1, -1.0], [1.0, 1.0, 1.0]])
    return Scene(
        "ball",
        "train",
        images,
        mattes,
        rig,
        torch.arange(FRAMES) / FPS,
        -9.8 * up,
        up,
        Ground(0.0),
        box,
        1000.0,
        torch.ones(3),
        True,
    )


@pytest.fixture(scope="module")
def scene():
    return ball()


def reordered(scene, order):
    return replace(scene, images=scene.images[:, order], mattes=scene.mattes[:, order])


def scaled(scene, unit):
    w2c = scene.cameras.w2c.clone()
    w2c[:, :3, 3] *= unit
    return replace(scene, cameras=replace(scene.cameras, w2c=w2c), box=scene.box * unit)


def test_a_film_of_a_falling_ball_passes_and_shows_its_gravity(scene):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert validate(scene) is scene
    track = track_of(scene)
    truth = torch.tensor([[0.02 * t, height(t / FPS), 0.0] for t in range(FRAMES)])
    assert float(
        (track.points - truth).norm(dim=1).max()
    ) < track.noise and track.radius == pytest.approx(RADIUS, rel=0.05)
    a, error = parabola(track, 8)  # contact is after 9 frames
    assert float((a - torch.tensor([0, -9.8, 0])).norm()) < error < 5


@pytest.mark.parametrize("factor", [0.1, 0.25, 0.5, 2.0, 8.0, 1e7])
def test_a_frame_rate_that_contradicts_free_fall_is_refused(scene, factor):
    with pytest.raises(DataError, match=r"scene\.fps"):
        validate(replace(scene, times=scene.times / factor))


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_a_frame_rate_that_is_nearly_right_is_a_warning(scene, factor):
    with pytest.warns(
        UserWarning, match=r"falls with .* under a stated gravity of 9\.8: check scene\.fps"
    ):
        validate(replace(scene, times=scene.times / factor))


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 0.1, 10.0, 1e3, 1e6])
def test_a_world_in_other_units_is_refused(scene, unit):
    with pytest.raises(DataError, match="the unit of the poses"):
        validate(scaled(scene, unit))


def test_a_gravity_that_the_object_does_not_follow_is_refused(scene):
    aside = torch.tensor([-9.8, 0.0, 0.0])
    with pytest.raises(DataError, match=r"moves with 9.* across"):
        check_fall(
            replace(scene, gravity=aside, up=-aside / 9.8, ground=None, last_free_frame=7), "scene"
        )


def test_a_fall_along_a_ground_that_the_object_straddles_is_said():
    scene, aside = ball(size=128), torch.tensor([1.0, 0.0, 0.0])
    short = replace(reordered(scene, list(range(3))), times=scene.times[:3])
    with pytest.warns(UserWarning, match=r"falls with about .* across .* check scene\.up"):
        check_fall(replace(short, up=aside, gravity=-9.8 * aside), "scene")
    for ground in (0.0, 0.4):  # above it, and straddling
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_fall(replace(short, ground=Ground(ground)), "scene")


@pytest.mark.parametrize("tick", [1.0, 1 / FPS * 1e3])
def test_a_clock_of_frames_or_milliseconds_is_refused_where_two_frames_fall(scene, tick):
    short = reordered(scene, list(range(7, FRAMES)))
    check_fall(replace(short, times=scene.times[: FRAMES - 7]), "scene")
    with pytest.raises(DataError, match=r"expected times in seconds; check scene\.fps"):
        check_fall(replace(short, times=tick * torch.arange(FRAMES - 7).float()), "scene")


def test_where_it_turns_round_is_seen_before_a_deeper_end_of_the_film(monkeypatch):
    monkeypatch.setitem(globals(), "FRAMES", 21)  # its last frame is lower than the first contact
    bouncing = ball()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_outlines(bouncing, "scene")
    with pytest.warns(UserWarning, match="turns round in frame 9 .* below the ground"):
        check_outlines(replace(bouncing, ground=Ground(0.1)), "scene")


def test_a_gravity_is_told_by_the_flight_after_a_bounce_where_none_is_before(monkeypatch):
    monkeypatch.setitem(globals(), "FRAMES", 20)
    whole = ball()
    late = replace(reordered(whole, list(range(8, 20))), times=whole.times[8:] - whole.times[8])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_fall(late, "scene")
    with pytest.warns(
        UserWarning,
        match=r"aloft, in frames \d+ to \d+, the object falls with 9\.\d+ .* gravity of 29\.4",
    ):
        check_fall(replace(late, gravity=3 * late.gravity), "scene")
    short = replace(reordered(late, [0, 1, 2, 3]), times=late.times[:4])
    with pytest.warns(
        UserWarning,
        match=r"expected scene.gravity in m/s\^2, found 980, which this film cannot tell",
    ):
        check_fall(replace(short, gravity=100 * late.gravity), "scene")


def test_cameras_that_all_look_away_are_named_as_that(scene):
    turned = scene.cameras.w2c.clone()
    turned[:, 1:3] *= -1  # OpenCV's axes read as OpenGL's
    with pytest.raises(
        DataError, match=r"all look away from it in frame 0: are the poses in other axes"
    ):
        check_agreement(replace(scene, cameras=replace(scene.cameras, w2c=turned)), "scene")


def test_a_film_that_runs_backwards_is_refused(scene):
    with pytest.raises(DataError, match="runs backwards"):
        validate(reordered(scene, list(range(FRAMES))[::-1]))


def test_a_film_that_begins_after_contact_is_named_as_that(scene):
    """Pressed flat, it is thrown up by what it has stored."""
    heights = torch.tensor(
        [0.1, 0.11, 0.15, 0.23, 0.30, 0.36, 0.41, 0.45, 0.47, 0.49, 0.5, 0.5]
    ).double()
    track = track_of(scene)
    late = track._replace(
        points=torch.stack([0 * heights, heights, 0 * heights], 1), low=heights - RADIUS
    )
    with pytest.raises(
        DataError,
        match=r"begins after contact \(start it earlier, scene\.frames\), or .* upside down",
    ):
        check_direction(scene, late, "scene", 9.8)
    with pytest.raises(DataError, match="a film that runs backwards"):
        check_direction(
            scene, late._replace(points=late.points + 0.2, low=late.low + 0.2), "scene", 9.8
        )


def test_doubled_frames_are_named_as_that(scene):
    with pytest.raises(
        DataError, match=r"the same in frames 0 to 1 of all cameras, .* \(6 such stretches\)"
    ):
        validate(reordered(scene, [t // 2 for t in range(FRAMES)]))


def test_a_stretch_in_reverse_is_named(scene):
    order = list(range(FRAMES))
    order[2:7] = order[2:7][::-1]
    with pytest.raises(DataError, match="frames 2 to 6 seem to be in reverse order: turning them"):
        validate(reordered(scene, order))


def test_equal_frames_are_refused(scene):
    with pytest.raises(DataError, match="all 12 frames are identical"):
        validate(reordered(scene, [0] * FRAMES))


def test_swapped_frames_are_named(scene):
    """Of the pairs whose exchange moves the object by more than its radius, all; of the rest none is named wrongly."""
    moved = torch.tensor([height(t / FPS) for t in range(FRAMES)])
    for i, j in combinations(range(FRAMES), 2):
        order = list(range(FRAMES))
        order[i], order[j] = j, i
        far = abs(float(moved[i] - moved[j])) > RADIUS
        try:
            check_fall(reordered(scene, order), "scene")
            assert not far, (i, j)
        except DataError as error:
            named = f"frames {i} and {j} seem" in str(error)
            assert (
                named
                or "other's place" not in str(error)
                or min(i, j) == 0
                or max(i, j) == FRAMES - 1
            ), (i, j, str(error))


@pytest.mark.parametrize("frame", [0, 5])
def test_one_opaque_matte_is_named(scene, frame):
    mattes = scene.mattes.clone()
    mattes[2, frame] = 1
    with pytest.raises(DataError, match=rf"camera 2, frame {frame}: the matte covers 100%"):
        validate(replace(scene, mattes=mattes))


def test_an_object_that_the_border_cuts_is_named(scene):
    with pytest.raises(
        DataError, match="the image's border cuts the object in frame 0 of the cameras 0, 1, 2, 3"
    ):
        left = scene.mattes.clone()
        left[..., :12, :] = left.amax(-2, keepdim=True)[..., :12, :]  # up to the upper border
        validate(replace(scene, mattes=left))
    with pytest.raises(DataError, match=r"white, opaque.* where the object is: are these inverted"):
        images = scene.mattes[..., None] + 0.5 * (1 - scene.mattes[..., None])
        validate(replace(scene, images=images.expand_as(scene.images), mattes=1 - scene.mattes))


def test_what_is_pressed_may_move_in_any_way(scene):
    """The ball's frames, ten times as slow: refused of a fall, and nothing is asked of a film that starts at rest."""
    slow = replace(scene, times=10 * scene.times)
    with pytest.raises(DataError, match=r"say scene\.start=rest"):
        validate(slow)
    validate(replace(slow, start=REST))
    frozen = reordered(slow, [0] * FRAMES)
    with pytest.raises(DataError, match="identical"):
        validate(replace(frozen, start=REST))


def test_a_camera_that_is_a_frame_late_is_named(scene):
    order = [0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10]
    mattes = scene.mattes.clone()
    mattes[1] = scene.mattes[1, order]
    with pytest.raises(
        DataError,
        match=r"camera 1, frames 4 to 11: .* as pictures of frames 3 to 10 they fit to 0.0",
    ):
        validate(replace(scene, mattes=mattes))


@pytest.mark.parametrize("name", ["tiny"])
def test_built_in_scenes_pass(name, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for sequence in ("train", "test_60"):
            load_scene(format="builtin", name=name, sequence=sequence, scale=0.5)


def test_the_bird_passes(reference_data):
    if not (reference_data / "pacnerf" / "bird").is_dir():
        pytest.skip("no bird")
    keys = {
        "gravity": [0, -9.8, 0],
        "box": [[-1, -0.1, -1], [1, 1.6, 1]],
        "ground": {"height": 0.0},
        "scale": 0.25,
    }
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_scene(format="pacnerf", path=str(reference_data / "pacnerf" / "bird"), **keys)
    a, error = parabola(track_of(scene), 5)
    assert np.allclose(a, [0, -9.8, 0], atol=error) and error < 3
    with pytest.raises(DataError, match=r"scene\.fps"):
        validate(replace(scene, times=torch.arange(scene.frames) / 240))


def test_an_object_that_three_steep_cameras_see_touch_the_ground_is_above_it():
    """Their hull reaches 1.3 radii below the ball that made the film, which was said to turn round there. Under a ground of 1.5
    radii the outlines themselves leave it no place above."""
    steep = ball(3, 48, elevations=(1.0, 1.2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_outlines(steep, "film")
    with pytest.warns(UserWarning, match="turns round .* lowest point at least .* m below the"):
        check_outlines(replace(steep, ground=Ground(1.5 * RADIUS)), "film")


def test_a_small_object_that_meets_the_ground_between_two_frames_is_not_above_it(monkeypatch):
    """A ball that falls by five of its radii from frame to frame, and is seen nowhere nearer to the ground than 0.4 radii."""
    monkeypatch.setattr(sys.modules[__name__], "RADIUS", 0.02)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_outlines(small := ball(6), "film")
    with pytest.warns(UserWarning, match="turns round .* lowest point at least .* m above the"):
        check_outlines(replace(small, ground=Ground(-0.1)), "film")

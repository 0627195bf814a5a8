"""Films of which a frame, a matte or a number was spoiled on the way: said, and silent where nothing was."""

import json
import math
import re
import shutil
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from written_scenes import export_transforms

from mosa.data.checks.free_fall import check_still, track_of
from mosa.data.checks.tangents import check_copies, check_pictures
from mosa.data.checks.validation import check_colors, validate
from mosa.data.scene import load_scene
from mosa.errors import DataError
from mosa.rendering.cameras import centers, look_at
from mosa.types import Cameras

WORLD = {
    "gravity": [0, -9.8, 0],
    "box": [[-0.7, -0.1, -0.7], [0.7, 1.0, 0.7]],
    "ground": {"height": 0.0},
}


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    return export_transforms(
        load_scene(format="builtin", name="tiny", scale=0.5),
        tmp_path_factory.mktemp("film") / "capture",
    )


def spoiled(film, place, change=lambda pixels: None, camera=None, frame=None, **keys):
    """The film with the pictures of one camera or frame, or all, changed; keys of the scene."""
    folder = shutil.copytree(film, place / "capture")
    for entry in json.loads((folder / "transforms.json").read_text())["frames"]:
        number = int(entry["file_path"].rpartition("_")[2].partition(".")[0])
        if camera in (None, entry["camera"]) and frame in (None, number):
            with Image.open(folder / entry["file_path"]) as picture:
                pixels = np.array(picture)
            change(pixels)
            Image.fromarray(pixels).save(folder / entry["file_path"])
    return load_scene(format="transforms", path=str(folder), **WORLD | keys)


def black(pixels):
    pixels[..., :3] = 0


def faded(pixels):
    pixels[..., 3] = 3 * (pixels[..., 3] // 4)


def halved(pixels):
    pixels[..., 3] //= 2


def speck(pixels):
    pixels[1:4, 1:4, 3] = 255


def held(pixels):
    pixels[: len(pixels) // 2, 24:40, 3] = 255


def grey(pixels):
    pixels[..., :3] = pixels[..., :3].mean(-1, keepdims=True)


def exchanged(pixels):
    pixels[..., :3] = pixels[..., 2::-1].copy()


def empty(pixels):
    pixels[..., 3] = 0


def test_a_focal_length_that_is_off_is_no_other_moment():
    """Where a ball falls through the view another frame fits nearly as well: to 0.033 radii."""
    scene, size, count = load_scene(format="builtin", name="tiny", scale=0.5), 128, 20
    K = torch.tensor([[1.6 * size, 0, size / 2], [0, 1.6 * size, size / 2], [0, 0, 1.0]])
    angles = 2 * math.pi * torch.arange(6) / 6 + 0.3
    eyes = torch.stack([2 * angles.cos(), 0.45 + 0.25 * (torch.arange(6) % 3), 2 * angles.sin()], 1)
    w2c = torch.stack(
        [look_at(eye, torch.tensor([0, 0.45, 0.0]), torch.tensor([0, 1.0, 0])) for eye in eyes]
    )
    pixel = torch.arange(size) + 0.5
    rays = (
        torch.stack([*torch.meshgrid(pixel, pixel, indexing="xy"), torch.ones(size, size)], -1)
        @ torch.linalg.inv(K).T
    )
    times = torch.arange(count) / 60
    centres = torch.tensor([0, 0.85, 0.0]) - (4.9 * times**2 + 0.3 * times)[:, None] * torch.tensor(
        [0, 1.0, 0]
    )
    away = centres @ w2c[:, :3, :3].mT + w2c[:, None, :3, 3]  # (cameras, frames, 3)
    cosine = torch.einsum(
        "hwi,vti->vthw",
        rays / rays.norm(dim=-1, keepdim=True),
        away / away.norm(dim=-1, keepdim=True),
    )
    mattes = (cosine > (1 - (0.1 / away.norm(dim=-1)) ** 2).sqrt()[..., None, None]).float()
    shades = torch.linspace(0, 0.9, 6)[:, None] + 0.1 * torch.linspace(0, 1, count)
    known = Cameras(K.repeat(6, 1, 1), w2c, size, size, tuple("012345"))
    scene = replace(
        scene,
        images=shades[:, :, None, None, None].expand(6, count, size, size, 3),
        mattes=mattes,
        cameras=known,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_pictures(scene, "film")
    known.K[0, :2, :2] *= 0.98
    with pytest.warns(
        UserWarning,
        match=r"camera 0, .* focal length that is off\? At a .* [123] % larger they fit",
    ):
        check_pictures(scene, "film")
    late = replace(scene, mattes=torch.cat([mattes[:3], mattes[3:4].roll(2, 1), mattes[4:]]))
    with pytest.raises(
        DataError, match=r"camera 3, .*; as pictures of frames .* put the right pictures there"
    ):
        check_pictures(late, "film")


@pytest.mark.parametrize(("change", "where", "message"), [
    (black, {"camera": "2", "frame": 2}, "camera 2, frame 2: the object's mean colour is .* beside that of the frames before"),
    (faded, {"camera": "1"}, "camera 1: the matte is nowhere more than 0.7. in any frame"),
    (speck, {"frame": 0}, "frame 0, has 9 pixels apart from the object, .* cameras have such"),
    (held, {"camera": "4", "frame": 3}, r"camera 4, frame 3: the matte reaches the image's border and is 1\.[3-9]"),
    (grey, {"camera": "2"}, "camera 2: expected the object in the colours that the other cameras see, found .* a film in grey"),
    (exchanged, {"camera": "5"}, "camera 5: expected the object in the colours .*, found [0-9]% of them there"),
    (empty, {"camera": "1", "frame": 1}, r"camera 1, frame 1: the matte is empty, where .* later frame \(1 such mattes\)"),
])  # fmt: skip
def test_what_is_suspicious_is_said(film, tmp_path, change, where, message):
    with pytest.warns(UserWarning, match=message):
        spoiled(film, tmp_path, change, **where)


def test_a_matte_below_half_coverage_is_refused(film, tmp_path):
    """No pixel of it counts as the object's."""
    with pytest.raises(
        DataError,
        match="found 127 at most: the number of a label, or a matte that is half transparent",
    ):
        spoiled(film, tmp_path, halved, camera="0", frame=3)


def test_a_rate_that_contradicts_the_files_times_is_said(film, tmp_path):
    document = json.loads((film / "transforms.json").read_text())
    times = sorted({entry["time"] for entry in document["frames"]})
    rate = 1 / (times[1] - times[0])
    with pytest.warns(
        UserWarning, match=r"scene\.fps = .* takes the place of the file's own times, which say"
    ):
        spoiled(film, tmp_path, fps=0.97 * rate)
    shutil.rmtree(tmp_path / "capture")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        spoiled(film, tmp_path, fps=rate)


@pytest.mark.parametrize(("change", "message"), [
    (lambda text: text.replace('"fl_x":', '"fl_x": 9.0, "fl_x":', 1), "found the key 'fl_x' twice, as 9.0 and as"),
    (lambda text: text.replace("{", '{"is_fisheye": "no", ', 1), "is_fisheye: expected true or false, found 'no'"),
])  # fmt: skip
def test_listings_that_say_two_things_are_refused(film, tmp_path, change, message):
    folder = shutil.copytree(film, tmp_path / "capture")
    (folder / "transforms.json").write_text(change((folder / "transforms.json").read_text()))
    with pytest.raises(DataError, match=message):
        load_scene(format="transforms", path=str(folder), **WORLD)


@pytest.mark.parametrize(("factors", "said"), [
    ([1, 0.9, 0.75, 0.65, 0.5], "mean red over all cameras is .* in frame 4 and .* in frame 0"),
    ([1, 0.98, 0.95, 0.97, 0.93], None),  # as much as a flicker
])  # fmt: skip
def test_an_exposure_that_changes_over_a_film_is_said(film, tmp_path, factors, said):
    folder = shutil.copytree(film, tmp_path / "capture")
    for entry in json.loads((folder / "transforms.json").read_text())["frames"]:
        with Image.open(folder / entry["file_path"]) as picture:
            pixels = np.array(picture)
        pixels[..., :3] = (pixels[..., :3] * factors[round(50 * entry["time"])]).astype(np.uint8)
        Image.fromarray(pixels).save(folder / entry["file_path"])
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        load_scene(format="transforms", path=str(folder), **WORLD)
    told = [str(each.message) for each in found if "over all cameras" in str(each.message)]
    assert len(told) == (said is not None), told
    if said:
        assert re.search(said, told[0])


def test_a_frame_that_no_camera_shows_is_refused_where_a_later_one_is_seen(film, tmp_path):
    with pytest.raises(
        DataError,
        match="0 of 6 cameras have a matte of the object in frame 2, and more of them in a later one",
    ):
        spoiled(film, tmp_path, empty, frame=2)


HELD, LAST = [0, 1, 2, 3, 3], [0, 0, 1, 2, 3]
SPOILED = {
    "one camera freezes": ([3], lambda x: x[HELD], "camera 3, frame 4: .* as pictures of frame 3 they fit to 0.0"),
    "one camera is late": ([3], lambda x: x[LAST], "camera 3, frames 1, 2, 4: .* as pictures of frames 0, 1, 3 they fit to 0.0"),
    "two frames of a camera are swapped": ([1], lambda x: x[[0, 2, 1, 3, 4]], "camera 1, frames 1 to 2: .* frames 2, 1 they fit"),
    "one camera is mirrored": ([2], lambda x: x.flip(2), r"camera 2, frames 0 to 4: .* mirrored they fit to 0.0.*cameras=\[2\]"),
    "one camera is mirrored in two frames": (
        [5], lambda x: torch.cat([x[:3], x[3:].flip(2)]), "camera 5, frames 3 to 4: .*; mirrored they fit to 0.0"),
    "one camera is shifted": ([0], lambda x: x.roll(3, 2), "camera 0, frames 0 to 4: .*: another moment or camera, mirrored or"),
    "all cameras freeze": (range(6), lambda x: x[HELD], "found the same in frames 3 to 4 of all cameras"),
    "all cameras begin again": (range(6), lambda x: x[[0, 1, 2, 0, 1]], "those of frame 0 in frame 3 of all cameras, after"),
    "all frames are doubled": (range(6), lambda x: x[[0, 0, 1, 1, 2]], r"in frames 0 to 1 of all cameras, .*\(2 such stretches\)"),
}  # fmt: skip


def tumbling(scene):
    """The scene with a ball of one dark and one bright side, which turns half round a level axis."""
    cameras, middle, radius = scene.cameras, torch.tensor([0.0, 0.165, 0.0]), 0.15
    y, x = torch.meshgrid(torch.arange(64) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    rays = torch.stack([x, y, torch.ones_like(x)], -1) @ torch.linalg.inv(cameras.K).mT[:, None]
    rays = torch.nn.functional.normalize(rays @ cameras.w2c[:, None, :3, :3], dim=-1)
    away = (centers(cameras) - middle)[:, None, None]
    along = (rays * away).sum(-1)
    root = along.square() - away.square().sum(-1) + radius**2
    normals = (away + (-along - root.clamp(min=0).sqrt())[..., None] * rays) / radius
    sides = [torch.tensor([math.cos(a), math.sin(a), 0.0]) for a in torch.linspace(0, math.pi, 5)]
    light = torch.stack([0.5 + 0.2 * normals @ side for side in sides], 1)
    mattes = (root > 0).float()[:, None].expand(-1, 5, -1, -1).contiguous()
    images = light[..., None] * mattes[..., None] + scene.background * (1 - mattes[..., None])
    return replace(scene, images=images, mattes=mattes)


@pytest.mark.parametrize("kind", ["as it is", "tumbling"])
@pytest.mark.parametrize("faded", [None, 0, 3])
def test_an_exposure_of_one_camera_that_changes_is_said_and_a_body_that_tumbles_is_not(
    scene, kind, faded
):
    scene = tumbling(scene) if kind == "tumbling" else replace(scene, images=scene.images.clone())
    if faded is not None:
        scene.images[faded] *= torch.linspace(1, 0.8, 5)[:, None, None, None]
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        check_colors(scene, "film")
    told = [str(each.message) for each in found]
    if faded is None:
        assert not told
    else:
        assert len(told) == 1
        assert re.search(
            f"camera {faded}: the object's brightness, over .* factor of 1.[23]", told[0]
        )


@pytest.fixture(scope="module")
def scene():
    return replace(load_scene(format="builtin", name="tiny", scale=0.5), synthetic=False)


def with_pictures(scene, cameras, change):
    """The scene with the images (T, H, W, 3) and mattes (T, H, W) of some cameras changed."""
    images, mattes = scene.images.clone(), scene.mattes.clone()
    for v in cameras:
        images[v], mattes[v] = change(scene.images[v]), change(scene.mattes[v])
    return replace(scene, images=images, mattes=mattes)


@pytest.mark.parametrize("name", SPOILED)
def test_what_the_other_cameras_contradict_is_named(scene, name):
    cameras, change, message = SPOILED[name]
    with warnings.catch_warnings(), pytest.raises((DataError, UserWarning), match=message):
        warnings.simplefilter("error")
        validate(with_pictures(scene, cameras, change))


def test_a_stretch_of_another_camera_is_named(scene):
    images, mattes = scene.images.clone(), scene.mattes.clone()
    images[1, 2:], mattes[1, 2:] = scene.images[2, 2:], scene.mattes[2, 2:]
    with pytest.raises(
        DataError, match=r"camera 1, frames 2 to 4: .* as pictures of camera 2 they fit to 0\.0"
    ):
        validate(replace(scene, images=images, mattes=mattes))


def test_a_camera_that_is_held_out_may_be_wrong(scene):
    """The way out that the error names is one: a warning is left, and nothing else is said."""
    spoiled_one = replace(with_pictures(scene, [3], lambda x: x[LAST]), holdout_cameras=(3,))
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        assert validate(spoiled_one) is spoiled_one
    assert len(found) == 1
    assert re.search(
        "camera 3, frames 1, 2, 4: .*nothing is learned from cameras that are held out",
        str(found[0].message),
    )


def test_a_body_at_rest_may_look_the_same_to_the_bit(scene):
    """What counts is that the object moves from one frame to the next where the pictures stop or go on."""
    track = track_of(scene)
    frozen = with_pictures(scene, range(6), lambda x: x[HELD])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_still(frozen, track._replace(points=track.points[[3, 3, 3, 3, 3]]), "scene")
        released = track.points[0] + torch.tensor(
            [[0.0, 0, 0], [0, 0, 0], [0, -0.00196, 0], [0, -0.00784, 0], [0, -0.0176, 0]]
        )
        check_still(
            with_pictures(scene, range(6), lambda x: x[[0, 0, 1, 2, 3]]),
            track._replace(points=released),
            "scene",
        )
    with pytest.raises(DataError, match="found the same in frames 3 to 4"):
        check_still(frozen, track, "scene")


def test_another_camera_s_picture_of_the_same_moment_is_said():
    scene = load_scene(format="builtin", name="tiny", scale=0.5)
    scene.images[0, 2], scene.mattes[0, 2] = scene.images[3, 2], scene.mattes[3, 2]
    with pytest.warns(UserWarning, match="cameras 0 and 3 have the same picture in frame 2"):
        check_copies(scene, "film")

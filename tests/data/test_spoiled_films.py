"""Films of which a frame, a matte or a number was spoiled on the way: said, and silent where nothing was."""

import json
import re
import shutil
import warnings

import numpy as np
import pytest
from PIL import Image

from mosa.data.export import export_transforms
from mosa.data.scene import load_scene
from mosa.errors import DataError

WORLD = {"gravity": [0, -9.8, 0], "box": [[-0.7, -0.1, -0.7], [0.7, 1.0, 0.7]], "ground": {"height": 0.0}}


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    return export_transforms(load_scene(format="builtin", name="tiny", scale=0.5), tmp_path_factory.mktemp("film") / "capture")


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


def empty(pixels):
    pixels[..., 3] = 0


@pytest.mark.parametrize(("change", "where", "message"), [
    (black, {"camera": "2", "frame": 2}, "camera 2, frame 2: the object's mean colour is .* beside that of the frames before"),
    (faded, {"camera": "1"}, "camera 1: the matte is nowhere more than 0.7. in any frame"),
    (speck, {"frame": 0}, "frame 0, has 9 pixels apart from the object, .* cameras have such"),
    (empty, {"camera": "1", "frame": 1}, r"camera 1, frame 1: the matte is empty, where .* later frame \(1 such mattes\)"),
])  # fmt: skip
def test_what_is_suspicious_is_said(film, tmp_path, change, where, message):
    with pytest.warns(UserWarning, match=message):
        spoiled(film, tmp_path, change, **where)


def test_a_matte_below_half_coverage_is_refused(film, tmp_path):
    """No pixel of it counts as the object's."""
    with pytest.raises(DataError, match="found 127 at most: the number of a label, or a matte that is half transparent"):
        spoiled(film, tmp_path, halved, camera="0", frame=3)


def test_a_rate_that_contradicts_the_files_times_is_said(film, tmp_path):
    document = json.loads((film / "transforms.json").read_text())
    times = sorted({entry["time"] for entry in document["frames"]})
    rate = 1 / (times[1] - times[0])
    with pytest.warns(UserWarning, match=r"scene\.fps = .* takes the place of the file's own times, which say"):
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
    with pytest.raises(DataError, match="0 of 6 cameras have a matte of the object in frame 2, and more of them in a later one"):
        spoiled(film, tmp_path, empty, frame=2)

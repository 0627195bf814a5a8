"""The whole way on a film of a cone, 160 x 120 px: what is found, what is written, what is said of mistakes."""

import json
import shutil
from types import SimpleNamespace

import forked
import numpy as np
import pytest
from filming import BODY, CONTACT, HEIGHT, WORLD, filmed, write_films
from omegaconf import OmegaConf

from mosa.capture import report
from mosa.capture.making import capture, make, warnings_of
from mosa.capture.videos import find_videos, open_clip
from mosa.capture.world import floor_of_points, ground_height, read_world
from mosa.config.leaf_settings import CaptureSettings
from mosa.data.images.reading import read_image
from mosa.data.scene import load_scene
from mosa.errors import ConfigError, DataError
from mosa.settings import node_of

DRAWN: list[tuple] = []  # what falls were drawn from


def keys(folder, **changes) -> dict:
    values = node_of(CaptureSettings)
    return values | {"videos": str(folder / "videos"), "poses": str(folder / "sparse"), "output": str(folder / "scene"),
                     "max_offset": 0.5} | changes  # fmt: skip


@pytest.fixture(scope="module")
def filmed_folder(tmp_path_factory):
    folder, films = tmp_path_factory.mktemp("capture") / "cone", filmed(count=4)
    write_films(films, folder)
    with pytest.MonkeyPatch.context() as patch:
        draw = report.draw_fall
        patch.setattr(report, "draw_fall", lambda *given: DRAWN.append(given) or draw(*given))
        return folder, films, capture(keys(folder))


def test_the_fall_is_drawn_as_it_was_fitted(filmed_folder):
    """The centres of the outlines were drawn, up to 0.8 px off a parabola that was said to fit the body's to 0.05 px."""
    _, phones, fall, exposures, _ = DRAWN[0]
    for phone, exposure, shift in zip(phones, exposures, fall.shifts, strict=True):
        times = exposure.seen_times
        times = times[(times >= fall.window[0]) & (times <= fall.window[1])]
        off = exposure.path(times) - shift - phone.camera.project(fall.at(times))
        assert len(off) > 5 and np.abs(off).max() < 0.3


def test_scale_up_and_clocks_are_found_and_the_scene_can_be_read(filmed_folder):
    folder, films, found = filmed_folder
    true = np.array([film.begin for film in films]) - films[0].begin
    assert (
        abs(found["scale"] / WORLD[0] - 1) < 0.03
        and np.degrees(np.arccos(np.array(found["up"]) @ WORLD[1][:, 1])) < 1
    )
    assert np.abs(np.array([p["offset"] for p in found["phones"]]) - true).max() < 3e-3
    scene = load_scene(format="transforms", path=str(folder / "scene"), up=[0, 1, 0], gravity=[0, -9.81, 0], box=found["box"],
                       ground={"height": 0.0}, scale=1.0)  # fmt: skip
    assert (
        scene.frames == found["frames"] >= 15
        and found["free_frames"] >= 4
        and len(scene.cameras) == 4
    )
    # the cone is 0.2 m high and stands on the floor at contact
    contact = int(
        np.searchsorted(
            np.arange(scene.frames) / found["rate"], CONTACT - films[0].begin - found["start"]
        )
    )
    assert abs(scene.times[1] - 1 / 60) < 1e-6 and 0 < contact < scene.frames
    page = (folder / "scene" / "capture.md").read_text()
    assert (
        "phone3" in page
        and found["command"] in page
        and (folder / "scene" / "contact.png").stat().st_size > 1000
    )
    assert (folder / "scene" / "fall.png").is_file()
    assert json.loads((folder / "scene" / "capture.json").read_text()) == found


def test_the_ground_is_where_the_cone_lands(filmed_folder):
    """Its base is flat and wide, which is the worst case: two rows of pixels."""
    folder, _, found = filmed_folder
    world = read_world(folder / "scene")
    scale, R, shift = WORLD
    floor = world.points(R @ np.zeros(3) / scale + shift)[1]
    assert (
        abs(floor) < 0.015
        and found["ground"]["from"] == "lowest contact"
        and found["ground"]["sd"] < 0.03
    )
    assert BODY[-1, 1] == 0.2 and HEIGHT == 0.45


def test_a_second_drop_gets_the_first_ones_world_and_points_give_the_floor(filmed_folder, tmp_path):
    folder, _, found = filmed_folder
    again = capture(
        keys(
            folder,
            output=str(tmp_path),
            like=str(folder / "scene"),
            rate=30.0,
        )
    )
    assert (
        again["world"] == found["world"]
        and again["rate"] == pytest.approx(30)
        and again["scale_sd"] is None
    )
    rng = np.random.default_rng(0)
    points = np.concatenate(
        [rng.uniform(-1, 1, (60, 3)) * [1, 0.001, 1] + [0, 0.02, 0], rng.uniform(-1, 1, (60, 3))]
    )
    height, sd, tilt = floor_of_points(points, 0.1, 0.01, 0.05)
    assert abs(height - 0.02) < 1e-3 and sd < 1e-3 and tilt < 0.5
    assert floor_of_points(points[60:66], 0.1, 0.01, 0.05) is None
    with pytest.raises(DataError, match="ground: the object's lowest point is not seen"):
        ground_height(np.full((5, 2), np.nan), 0.001)


def test_mistakes_are_named(filmed_folder, tmp_path):
    folder, _, _ = filmed_folder
    with pytest.raises(ConfigError, match=r"phones\.phone9: no video of that name"):
        capture(keys(folder, phones={"phone9": {"fps": 60}}))
    with pytest.raises(DataError, match=r"plates: folder .* not found"):
        capture(keys(folder, plates=str(tmp_path / "none")))
    with pytest.raises(DataError, match="expected the record of a capture"):
        (tmp_path / "capture.json").write_text("{}")
        read_world(tmp_path)
    world = {"scale": 0.3, "rotation": np.eye(3).tolist(), "origin": [0, 0, 0]}
    for wrong, said in (
        ({"scale": 0}, r"world\.scale"),
        ({"rotation": np.diag([1, 1, -1]).tolist()}, r"world\.rotation"),
    ):
        (tmp_path / "capture.json").write_text(json.dumps({"world": world | wrong}))
        with pytest.raises(DataError, match=said):
            read_world(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match=r"output: .*expected a folder that can be written"):
        capture(keys(folder, output=str(tmp_path / "file")))
    with pytest.raises(
        ConfigError, match=r"output: expected a folder of its own, found that of videos"
    ):
        capture(keys(folder, output=str(folder / "videos")))


@pytest.mark.parametrize("wrong, said", [
    (dict(scale=1000.0), r"scale: expected about 0\.3"), (dict(up=(-WORLD[1][:, 1]).tolist()), "up: .* falls upwards"),
    (dict(ground=[1e3, 1e3, 1e3]), r"ground: expected a point of the floor"),
])  # fmt: skip
def test_a_world_that_contradicts_the_fall_is_refused(filmed_folder, tmp_path, wrong, said):
    """A known scale pulls the fall to gravity's, so that nothing in the result would show the mistake."""
    with pytest.raises(ConfigError, match=said):
        capture(keys(filmed_folder[0], output=str(tmp_path / "scene"), **wrong))


def test_keys_are_checked_before_anything_is_read(filmed_folder):
    folder, _, _ = filmed_folder
    with pytest.raises(ConfigError, match=r"poses: expected a folder, found none"):
        make(OmegaConf.create(keys(folder, poses="???")))
    for wrong, said in ((dict(phones={"phone1": {"scan": "sideways"}}), r"phones\.phone1\.scan: expected auto or down"),
                        (dict(phones={"phone1": {"speed": 60}}), r"phones\.phone1\.speed: unknown key"),
                        (dict(plate_seconds=[2, 1]), r"plate_seconds: expected two numbers \[from, to\]"),
                        (dict(fps=0), r"fps: expected a number of at least 1"),
                        (dict(up=[0, 0, 0]), r"up: expected a direction"), (dict(max_offset=1e9), r"max_offset: .* at most 60"),
                        (dict(output=""), r"output: expected the path of a folder"),
                        (dict(before=1e9), r"before: .* at most 60")):  # fmt: skip
        with pytest.raises(ConfigError, match=said):
            make(OmegaConf.create(keys(folder, **wrong)))


def test_the_command_ends_in_one_message(filmed_folder, tmp_path):
    folder, _, _ = filmed_folder
    shutil.copytree(folder / "videos", tmp_path / "videos")
    words = [f"videos={tmp_path}/videos", f"poses={folder / 'sparse'}", f"output={tmp_path}/scene"]
    result = forked.call("mosa/capture/__main__.py", *words)
    assert result.returncode == 2 and "Traceback" not in result.stderr, result.stderr[-2000:]
    said = f"DataError: {tmp_path}/videos/phone0.mp4: no background plate: expected phone0.png"
    assert said in result.stderr


@pytest.mark.parametrize(
    "radius, said", [(2.0, True), (0.9, True), (0.001, True), (0.05, False), (0.5, False)]
)
def test_lengths_that_nobody_lets_fall_are_said(radius, said):
    knowledge = SimpleNamespace(scale=None, up=None)
    found = {
        "scale_sd": None,
        "phones": [],
        "ground": {"tilt_degrees": None, "from": "given"},
        "radius": radius,
        "free_frames": 9,
    }
    told = warnings_of(found, {"gravity": 9.81}, knowledge, [])
    assert [("m across: lengths follow from gravity and the clock" in line) for line in told] == [
        True
    ] * said


def test_what_a_mac_leaves_beside_a_video_is_none(tmp_path):
    for name in (
        "._phone0.mp4",
        ".DS_Store",
        "phone0.mp4",
        "phone1.MOV",
        "._phone1.MOV",
        ".hidden.mp4",
    ):
        (tmp_path / name).touch()
    assert [file.name for file in find_videos(tmp_path)] == ["phone0.mp4", "phone1.MOV"]


@pytest.mark.parametrize("content, said", [
    (b"version https://git-lfs.github.com/spec/v1\n", "a pointer of Git LFS; git lfs pull"), (b"<html>", "a web page"),
    (b"PK\x03\x04", "a zip file"), (b"", "damaged or other one of 0 bytes"), (b"\0" * 99, "damaged or other one of 99 bytes"),
])  # fmt: skip
def test_a_file_that_is_no_video_or_picture_is_called_by_what_it_is(tmp_path, content, said):
    for name, read in (("a.mp4", open_clip), ("a.png", read_image)):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DataError, match=said):
            read(tmp_path / name)

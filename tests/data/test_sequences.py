"""Several folders as sequences of one body: which are read, with which keys, and what they are called."""

import json
import shutil
from dataclasses import replace
from itertools import permutations

import pytest
import torch
from blocks_film import WORLD, assert_same_footage, clouds_of
from written_scenes import export_pacnerf, export_particles, export_transforms

from mosa.data import sequences
from mosa.data.sequences import load_first, load_sequences, sequence_names, taught_names
from mosa.errors import ConfigError, DataError


@pytest.fixture
def folders(blocks, tmp_path):
    """Four recordings below one root, in both layouts."""
    for k, name in enumerate(("first", "second", "a/drop", "b/drop")):
        export_transforms(recorded(blocks, k), tmp_path / "transforms" / name)
        export_pacnerf(recorded(blocks, k), tmp_path / "pacnerf" / name)
    return tmp_path


def recorded(scene, k):
    """The scene in other colours: no picture of one recording is another's."""
    return replace(scene, images=scene.images[..., list(permutations(range(3)))[k]])


def keys(folders, layout="transforms", **more):
    return {
        "format": layout,
        "root": str(folders / layout),
        "path": "first",
        "sequence": "train",
        **WORLD,
        **more,
    }


@pytest.mark.parametrize("layout", ["transforms", "pacnerf"])
def test_folders_are_sequences_of_the_training_folders_object(blocks, folders, layout):
    named = keys(
        folders,
        layout,
        also_train=["second"],
        test=["a/drop", str(folders / layout / "b" / "drop")],
    )
    scene, others = load_sequences(named)
    assert [s.sequence for s in (scene, *others)] == ["train", "second", "a_drop", "b_drop"]
    assert taught_names(named) == ["second"]
    for k, each in enumerate(others, 1):
        assert each.name == scene.name == "first"
        assert_same_footage(each, recorded(blocks, k))


def test_without_lists_there_is_one_sequence(folders):
    assert load_sequences(keys(folders))[1] == [] and taught_names(keys(folders)) == []


def test_frames_are_a_sequences_own_where_it_has_them(blocks, folders):
    """What was left out of the training sequence at its end, and what is known of its contact, is not about another one."""
    named = keys(
        folders,
        frames=[0, 3],
        holdout_frames=[3],
        last_free_frame=1,
        holdout_cameras=["2"],
        test=["second", {"path": "a/drop", "frames": [1, 4], "name": "late"}],
    )
    scene, (second, late) = load_sequences(named)
    assert (scene.frames, scene.last_free_frame, scene.holdout_frames) == (4, 1, (3,))
    assert (
        second.frames,
        second.last_free_frame,
        second.holdout_frames,
        second.holdout_cameras,
    ) == (4, None, (), (2,))
    assert late.sequence == "late" and torch.allclose(late.times, blocks.times[1:])


def test_parts_of_one_recording_are_sequences_if_they_do_not_overlap(folders):
    parts = {"frames": [0, 2], "test": [{"path": "first", "frames": [3, 4]}]}
    assert sequence_names(keys(folders, **parts), [("test", parts["test"][0])]) == ["first"]
    with pytest.raises(
        ConfigError, match=r"scene.test: first is named in scene.path as well: .* do not overlap"
    ):
        load_sequences(keys(folders, frames=[0, 3], test=parts["test"]))


@pytest.mark.parametrize("other", ["first", "first/", "second/../first", "first/transforms.json"])
def test_what_is_learned_from_is_not_held_out(folders, other):
    with pytest.raises(ConfigError, match=r"named in scene.path as well"):
        load_sequences(keys(folders, test=[other]))
    with pytest.raises(
        ConfigError, match=r"scene.test: second is named in scene.also_train as well"
    ):
        load_sequences(keys(folders, also_train=["second"], test=["second"]))


def test_a_copy_of_what_is_learned_from_is_not_held_out(folders):
    """Nor are some of its pictures, in a folder of their own with another order of cameras."""
    shutil.copytree(folders / "transforms" / "first", folders / "transforms" / "copy")
    file = folders / "transforms" / "copy" / "transforms.json"
    file.write_text(
        json.dumps(
            json.loads(file.read_text()) | {"frames": json.loads(file.read_text())["frames"][::-1]}
        )
    )
    with pytest.raises(
        DataError,
        match=r"scene.test: 15 of the 15 pictures of first/copy are those of scene.path too",
    ):
        load_sequences(keys(folders, test=["copy"]))
    with pytest.raises(
        DataError,
        match=r"scene.test: 6 of the 9 pictures of second/copy are those of scene.also_train",
    ):
        load_sequences(
            keys(
                folders,
                path="second",
                also_train=[{"path": "first", "frames": [1, 4]}],
                test=[{"path": "copy", "frames": [0, 2]}],
            )
        )


def test_names_are_unique_and_fit_for_files(folders):
    entries = [
        ("test", path)
        for path in (
            "x/my drop!",
            "y/my drop!",
            "y/My_Drop",
            "çà",
            "one/drops.json",
            "one/more.json",
            "%",
        )
    ]
    names = sequence_names(keys(folders), entries)
    assert names[3:6] == ["çà", "drops", "more"]
    assert len({name.casefold() for name in names}) == len(names)
    assert all(
        name and not set(name) & set(" !%/\\") and not name.startswith(".") for name in names
    )
    assert names[:3] == ["x_my_drop", "transforms_y_my_drop_1", "transforms_y_My_Drop_2"]


@pytest.mark.parametrize("entry, message", [
    ({"path": "second", "ground": None}, "scene.test: ground: not a key of a single sequence; expected path, name, frames"),
    ({"frames": [0, 1]}, "scene.test: expected folders, or sections like"),
    ({"path": "second", "name": "../out"}, "scene.test: name: expected letters"),
])  # fmt: skip
def test_a_mistake_in_an_entry_is_named(folders, entry, message):
    with pytest.raises(ConfigError, match=message):
        load_sequences(keys(folders, test=[entry]))


def test_two_sequences_of_one_given_name(folders):
    with pytest.raises(ConfigError, match="name: expected a name once, found 'x' again"):
        load_sequences(
            keys(folders, test=[{"path": "second", "name": "x"}, {"path": "a/drop", "name": "x"}])
        )


def test_a_built_in_scene_has_its_own_held_out_sequences():
    with pytest.raises(ConfigError, match=r"scene.test: a built-in scene brings"):
        load_sequences({"format": "builtin", "name": "tiny", "test": ["somewhere"]})


def test_the_training_film_of_a_built_in_scene_is_there_before_the_others_are_made(monkeypatch):
    """A name that is none of theirs is refused before."""
    made = []
    monkeypatch.setattr(sequences, "load_scene", lambda **keys: made.append("train") or "training")
    monkeypatch.setattr(
        sequences, "held_out_sequences", lambda **keys: made.append("others") or ["other"]
    )
    keys = {"format": "builtin", "name": "tiny"}
    scene, others = load_first(keys)
    assert scene == "training" and made == ["train"]
    assert others() == ["other"] and made == ["train", "others"]
    with pytest.raises(ConfigError, match="expected other sequences of the scene, found 'test_9'"):
        load_first(keys | {"also_train": ["test_60", "test_9"]})
    assert made == ["train", "others", "train"]


def test_particles_beside_the_images_come_first_and_are_a_sequences_own(blocks, folders):
    """Clouds of different folders have different numbers of points."""
    counts = {
        "transforms/first/ply": 5,
        "transforms/second/ply": 6,
        "transforms/ply": 7,
        "elsewhere": 8,
    }
    for name, count in counts.items():
        export_particles(clouds_of(blocks, count), folders / name)
    test = ["a/drop", {"path": "b/drop", "particles": str(folders / "elsewhere")}]
    scene, (second, third, fourth) = load_sequences(
        keys(folders, particles="ply", also_train=["second"], test=test)
    )
    assert len(scene.particles[0]) == 5 and len(second.particles[0]) == 6
    assert third.particles is None and len(fourth.particles[0]) == 8
    shutil.rmtree(folders / "transforms" / "first" / "ply")
    assert (
        len(load_sequences(keys(folders, particles="ply"))[0].particles[0]) == 7
    )  # below root, as before
    scene, (second,) = load_sequences(
        keys(folders, particles=str(folders / "elsewhere"), test=["second"])
    )
    assert len(scene.particles[0]) == 8 and second.particles is None


def late(folder, camera, seconds):
    """The times of a camera's images, shifted in the file."""
    file = folder / "transforms.json"
    document = json.loads(file.read_text())
    for entry in document["frames"]:
        if entry["camera"] == camera:
            entry["time"] += seconds
    file.write_text(json.dumps(document))


def test_clocks_a_little_apart_are_cured_by_the_frame_rate_that_the_message_names(blocks, folders):
    late(folders / "transforms" / "first", "1", 0.002)
    with pytest.raises(
        Exception, match=r"cameras must be synchronous: .* at most 2 ms apart: scene.fps=24 takes"
    ):
        load_sequences(keys(folders))
    assert_same_footage(load_sequences(keys(folders, fps=24))[0], blocks)


def test_clocks_half_a_frame_apart_are_not(folders):
    late(folders / "transforms" / "first", "1", 0.5 / 24)
    for more in ({}, {"fps": 24}):
        with pytest.raises(
            Exception, match=r"up to 20.8 ms apart, of a frame of 41.7 ms: shift the times"
        ):
            load_sequences(keys(folders, **more))


def test_pac_nerfs_layout_says_so_too(blocks, folders):
    listing = folders / "pacnerf" / "first" / "all_data.json"
    entries = json.loads(listing.read_text())
    for entry in entries:
        entry["time"] += 0.002 * ("r_1_" in entry["file_path"])
    listing.write_text(json.dumps(entries))
    with pytest.raises(
        Exception, match=r"scene.fps=<frames per second> takes a frame as one moment"
    ):
        load_sequences(keys(folders, "pacnerf"))
    assert_same_footage(load_sequences(keys(folders, "pacnerf", fps=24))[0], blocks)

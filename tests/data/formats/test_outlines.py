"""Cameras, ground and particles that contradict the outlines are named; a film as it is passes without a word."""

import json
import warnings

import cv2
import numpy as np
import pytest
import torch
from written_scenes import export_pacnerf, export_particles, export_transforms

from mosa.data.scene import load_scene
from mosa.errors import ConfigError, DataError

WORLD = {
    "gravity": [0, -9.8, 0],
    "box": [[-0.7, -0.1, -0.7], [0.7, 1.0, 0.7]],
    "ground": {"height": 0.0},
}


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """The smallest built-in scene as a capture: its folder, and the true positions."""
    scene = load_scene(format="builtin", name="tiny", scale=0.5)
    return (
        export_transforms(scene, tmp_path_factory.mktemp("film") / "capture"),
        scene.truth.positions,
        scene,
    )


def changed(folder, change, **keys):
    """The scene of a listing of the same pictures, in which `change` has changed the entries."""
    document = json.loads((folder / "transforms.json").read_text())
    change(document["frames"])
    other = folder.parent / "transforms.json"
    for entry in document["frames"]:
        entry["file_path"] = str(folder / entry["file_path"])
    other.write_text(json.dumps(document))
    return load_scene(format="transforms", path=str(other), **WORLD | keys)


def exchanged(a, b):
    """The pictures of two cameras, each in the other's place."""

    def change(entries):
        files = {(e["camera"], e["time"]): e["file_path"] for e in entries}
        for e in entries:
            e["file_path"] = files[{a: b, b: a}.get(e["camera"], e["camera"]), e["time"]]

    return change


def moved(matrix):
    """Poses M P."""
    return lambda entries: [
        e.update(transform_matrix=(np.array(matrix) @ e["transform_matrix"]).tolist())
        for e in entries
    ]


def mirrored(entries):
    flip = np.diag([-1.0, 1, 1, 1])
    for e in entries:
        e["transform_matrix"] = (flip @ e["transform_matrix"] @ flip).tolist()


def shifted(height):
    matrix = np.eye(4)
    matrix[1, 3] = height
    return moved(matrix)


def jittered(size, labels=True):
    """Poses as they are solved for each image: another one every time."""

    def change(entries):
        rng = np.random.default_rng(1)
        for e in entries:
            matrix = np.array(e["transform_matrix"])
            matrix[:3, :3] = cv2.Rodrigues(rng.normal(size=3) * size)[0] @ matrix[:3, :3]
            matrix[:3, 3] += rng.normal(size=3) * size
            e.update(transform_matrix=matrix.tolist())
            if not labels:
                e.pop("camera")

    return change


def moving(entries):
    """One camera, which goes on by a little from image to image."""
    pose = np.array(entries[0]["transform_matrix"])
    for i, e in enumerate(entries):
        turn = np.eye(4)
        turn[:3, :3] = cv2.Rodrigues(np.array([0, 0.004 * i, 0]))[0]
        e.update(transform_matrix=(turn @ pose).tolist(), time=i / 50)
        e.pop("camera")


Z_UP = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
WRONG = {
    "exchanged": (
        exchanged("0", "2"),
        "camera 0, frames 0 to 4: .* as pictures of camera 2 they fit to 0.0",
    ),
    "mirrored": (mirrored, "the outlines of frame"),
    "another axis is up": (
        moved(Z_UP),
        "scene.ground.height: expected the object above the ground",
    ),
    "the ground is higher": (
        shifted(-0.15),
        "scene.ground.height: expected the object above the ground",
    ),
    "the ground is lower": (shifted(0.08), "the object falls with -"),
    "the ground is a little higher": (
        shifted(-0.06),
        "turns round in frame 2 with its lowest point .* below the ground",
    ),
    "stretched": (
        lambda entries: [e.update(fl_x=1.3 * e["fl_x"]) for e in entries],
        "expected focal lengths of square pixels",
    ),
    "a rational lens": (
        lambda entries: [e.update(k6=0.1) for e in entries],
        "k6: expected a lens of k1, k2, k3, p1, p2",
    ),
    "a camera's name": (
        lambda entries: [e.update(camera=f"a\n{e['camera']}") for e in entries],
        "at most 100 printable",
    ),
    "a moving camera": (moving, "see every frame; a single moving camera cannot be used"),
    "moving cameras": (
        jittered(0.05),
        r"camera 0 has another pose than in .*; cameras must not move",
    ),
    "jitter without names": (
        jittered(1e-3, labels=False),
        "poses solved for each image: name the camera of each entry",
    ),
    "jitter": (
        jittered(1e-3),
        r"camera 0 has another pose than in .*: solved for each image\? The pose nearest to the mean",
    ),
    "zoom": (
        lambda entries: entries[7].update(fl_x=1.01 * entries[7]["fl_x"]),
        "has fl_x = .*: expected one lens, focus and zoom",
    ),
    "zoom without names": (
        lambda entries: [
            (e.pop("camera"), e.update(cx=e["cx"] + 1e-3 * i)) for i, e in enumerate(entries)
        ],
        "has cx = .*one lens",
    ),
    "cx from the centre": (
        lambda entries: [e.update(cx=0.0, cy=-0.5) for e in entries],
        r"outside .*measured from their centre\?",
    ),
    "cx from the centre, a little more": (
        lambda entries: [e.update(cx=0.5, cy=0.7) for e in entries],
        r"\(0.5, 0.7\) px lies in the corner of .* their centre\?",
    ),
    "no affine pose": (
        lambda entries: entries[0]["transform_matrix"][3].__setitem__(3, 2.0),
        "0, 0, 0, 1 in the fourth row",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_contradicts_the_outlines_is_named(film, name):
    """As an error or, where it may be meant, as a warning."""
    change, message = WRONG[name]
    with warnings.catch_warnings(), pytest.raises((DataError, UserWarning), match=message):
        warnings.simplefilter("error")
        changed(film[0], change)


def test_poses_that_jitter_are_one_camera(film):
    """Six cameras of five frames, at poses within the jitter of the right ones."""
    with pytest.warns(UserWarning, match="solved for each image"):
        scene = changed(film[0], jittered(1e-3))
    assert (len(scene.cameras), scene.frames) == (6, 5)
    assert float((scene.cameras.w2c - film[2].cameras.w2c).abs().max()) < 5e-3


@pytest.mark.parametrize(
    "name", ["{camera}_{frame:03d}_v2", "v2_{camera}_{frame}", "shot{frame:05d}"]
)
def test_the_number_that_counts_frames_is_one_that_differs(film, tmp_path, name):
    def change(entries):
        for e in entries:
            place = tmp_path / e["camera"]
            place.mkdir(exist_ok=True)
            file = place / (
                name.format(camera=e["camera"], frame=round(50 * e.pop("time"))) + ".png"
            )
            file.write_bytes((film[0] / e["file_path"]).read_bytes())
            e.update(file_path=str(file))

    scene = changed(film[0], change, fps=50.0)
    assert torch.allclose(scene.times, torch.arange(5) / 50) and torch.equal(
        scene.mattes, changed(film[0], lambda e: None).mattes
    )


def test_times_of_a_clock_are_as_good_as_any(film):
    scene = changed(
        film[0], lambda entries: [e.update(time=e["time"] + 1764155129.5) for e in entries]
    )
    assert torch.allclose(scene.times, torch.arange(5) / 50, atol=1e-6)


def test_a_film_as_it_is_passes_without_a_word(film):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert changed(film[0], lambda entries: None).frames == 5


@pytest.mark.parametrize("change, message", [
    (lambda x: 1e3 * x, "check their unit and axes"),
    (lambda x: x[..., [0, 2, 1]], "check their unit and axes"),
    (lambda x: x.roll(2, 0), "which file is which frame"),
    (lambda x: x.mean(1, keepdim=True), "one of 1 particles over 0 m"),
])  # fmt: skip
def test_true_particles_are_where_the_object_is_seen(film, tmp_path, change, message):
    folder, positions, _ = film
    export_particles(change(positions), tmp_path / "ply")
    with pytest.raises(DataError, match=message):
        changed(folder, lambda entries: None, particles=str(tmp_path / "ply"))


def test_particles_of_some_frames_are_those_frames(film, tmp_path):
    folder, positions, _ = film
    export_particles(positions, tmp_path / "ply")
    scene = load_scene(
        format="transforms",
        path=str(folder),
        **WORLD,
        particles=str(tmp_path / "ply"),
        frames=[1, 4],
    )
    assert torch.equal(scene.particles[0], positions[1])


def test_intrinsics_are_a_pinholes(film, tmp_path):
    folder = export_pacnerf(film[2], tmp_path / "pacnerf")
    entries = json.loads((folder / "all_data.json").read_text())
    for entry in entries:
        entry["intrinsic"][2][0] = 0.5
    (folder / "all_data.json").write_text(json.dumps(entries))
    with pytest.raises(DataError, match=r"camera 0: intrinsics: expected \[\[fx, s, cx\]"):
        load_scene(format="pacnerf", path=str(folder), **WORLD)


@pytest.mark.parametrize("keys, error, message", [
    ({"box": [[-0.7, 0.05, -0.7], [0.7, 1, 0.7]]}, ConfigError, "scene.box: expected one that the ground at"),
    ({"truth": 5}, ConfigError, "scene.truth: not a key of this format"),
    ({"last_free_frame": True}, ConfigError, "scene.last_free_frame: no frame True"),
    ({"density": 1}, UserWarning, r"scene.density: 1 kg/m\^3 is lighter than nearly all solids"),
    ({"up": [0.2, 1, 0]}, UserWarning, "scene.gravity: pulls at 11.3 degrees from scene.up"),
    ({"path": "x" * 5000}, ConfigError, "scene.path: expected a folder that can be"),
    ({"path": "~nobody_of_this_name/x"}, ConfigError, "scene.path: expected a folder that can be"),
])  # fmt: skip
def test_keys_that_contradict_each_other_are_named(film, keys, error, message):
    with warnings.catch_warnings(), pytest.raises(error, match=message):
        warnings.simplefilter("error")
        load_scene(**{"format": "transforms", "path": str(film[0])} | WORLD | keys)

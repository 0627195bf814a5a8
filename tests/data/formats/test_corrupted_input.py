"""Verification 25: every kind of broken input ends in a typed error that names the file or key and says what was expected."""

import json
import shutil
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from blocks_film import WORLD
from written_scenes import export_particles

from mosa.data.checks.validation import validate
from mosa.data.scene import load_scene
from mosa.errors import ConfigError, DataError


def edit(file, change):
    document = json.loads(file.read_text())
    change(document)
    file.write_text(json.dumps(document))


def listing(change):
    return lambda folder: edit(folder / "all_data.json", change)


def image(name, change):
    def apply(folder):
        file = folder / "data" / name
        iio.imwrite(file, change(np.array(iio.imread(file))))

    return apply


def truncate(folder):
    file = folder / "data" / "a_1_2.png"
    file.write_bytes(file.read_bytes()[:-60])


def garble(folder):
    file = folder / "data" / "a_1_2.png"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 0xFF
    file.write_bytes(bytes(content))


def raw_only(folder):
    for file in (folder / "data").glob("a_*.png"):
        file.rename(file.with_name(file.name.replace("a_", "r_")))


def delete(*names):
    def apply(folder):
        for name in names:
            (folder / name).unlink()

    return apply


def first_with(entries, name):
    return next(e for e in entries if e["file_path"].endswith(name))


CORRUPTIONS = {
    "folder gone": (lambda f: shutil.rmtree(f), "folder not found"),
    "listing gone": (delete("all_data.json"), "all_data.json: file not found"),
    "listing no JSON": (lambda f: (f / "all_data.json").write_text('[{"time": 1,'), "expected JSON, found a mistake in line 1"),
    "listing binary": (lambda f: (f / "all_data.json").write_bytes(b"\xff\xfe\x00\x81"), "no UTF-8"),
    "listing an object": (lambda f: (f / "all_data.json").write_text("{}"), "expected a list with one object per image"),
    "key missing": (listing(lambda d: d[4].pop("intrinsic")), "entry 4: expected the keys .* found no intrinsic"),
    "file name odd": (listing(lambda d: d[2].update(file_path="./data/photo.png")), "entry 2: expected a file_path like"),
    "pose NaN": (listing(lambda d: d[3]["c2w"][1].__setitem__(2, float("nan"))), "entry 3, c2w: expected .* finite numbers"),
    "pose shape": (listing(lambda d: d[3].update(c2w=[[1, 0], [0, 1]])), "entry 3, c2w: expected a 3x4 matrix"),
    "pose text": (listing(lambda d: d[3].update(c2w="identity")), "entry 3, c2w"),
    "pose scaled": (listing(lambda d: [e.update(c2w=(2 * np.array(e["c2w"])).tolist()) for e in d]), "expected a rotation"),
    "camera moves": (listing(lambda d: d[3]["c2w"][0].__setitem__(3, 9.0)), "camera 0 has another pose"),
    "time NaN": (listing(lambda d: d[1].update(time=float("nan"))), "entry 1, time: expected a finite number"),
    "time mismatch": (listing(lambda d: first_with(d, "r_1_3.png").update(time=0.2)), "frame 3 has time 0.200000 s, but 0.125"),
    "time uneven": (
        listing(lambda d: [e.update(time=0.5) for e in d if e["file_path"].endswith("_4.png")]),
        r"all_data.json: expected one frame rate, found the times 0, 0.0416667, 0.0833333, 0.125, 0.5 s: 0.375000 s between "
        "frames 3 and 4, 0.041667 s elsewhere; .*scene.fps",
    ),
    "time backwards": (
        listing(lambda d: [e.update(time=0.01) for e in d if e["file_path"].endswith("_4.png")]),
        "all_data.json: expected increasing frame times, found 0, 0.0416667, 0.0833333, 0.125, 0.01 s",
    ),
    "view missing": (delete("data/a_1_2.png"), "a_1_2.png: image not found"),
    "frame missing": (delete("data/a_0_2.png", "data/a_1_2.png", "data/a_2_2.png"), r"frames \[2\] are missing"),
    "PNG truncated": (truncate, "a_1_2.png: expected a readable image"),
    "PNG garbled": (garble, "a_1_2.png: expected a readable image"),
    "PNG empty": (lambda f: (f / "data" / "a_1_2.png").write_bytes(b""), "a_1_2.png: expected a readable image"),
    "image size": (image("a_2_1.png", lambda p: p[:30]), "a_2_1.png: expected 32x32 px .*found 32x30"),
    "no alpha": (image("a_2_1.png", lambda p: p[..., :3]), "a_2_1.png: expected RGBA"),
    "no mattes": (raw_only, "no mattes.*no background plate r_0_-1.png .*plates of camera 0, 1, 2"),
    "plate of another size": (
        lambda f: (raw_only(f), [iio.imwrite(f / "data" / f"r_{v}_-1.png", np.zeros((30, 32, 3), np.uint8)) for v in range(3)]),
        "r_0_0.png: expected 32x30 px .as the background plate of its camera., found 32x32",
    ),
    "no images": (lambda f: shutil.rmtree(f / "data"), "found none"),
    "matte empty": (image("a_1_0.png", lambda p: p * np.array([1, 1, 1, 0], np.uint8)), "camera 1: the matte .* is empty"),
    "resolution": (
        listing(lambda d: [e["intrinsic"][0].__setitem__(2, 400.0) for e in d]), "principal point .* outside",
    ),
    "focal length": (
        listing(lambda d: [e["intrinsic"][0].__setitem__(0, -50.0) for e in d]), "expected positive focal lengths",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_corrupted_pacnerf_folder(pacnerf_folder, name):
    corrupt, message = CORRUPTIONS[name]
    assert load_scene(format="pacnerf", path=str(pacnerf_folder), **WORLD).frames == 5
    corrupt(pacnerf_folder)
    with pytest.raises(DataError, match=message):
        load_scene(format="pacnerf", path=str(pacnerf_folder), **WORLD)


def entries(change):
    return lambda folder: edit(folder / "transforms.json", change)


def moved(offset):
    """All cameras moved along x [m]."""
    return entries(
        lambda d: [
            e["transform_matrix"][0].__setitem__(3, e["transform_matrix"][0][3] + offset)
            for e in d["frames"]
        ]
    )


TRANSFORMS = {
    "ten kilometres away": (moved(1e4), r"camera .*: expected within 100 m of the origin.*found .* subtract one offset"),
    "a million kilometres away": (moved(-1e9), "camera .*: expected within 100 m of the origin"),
    "no frames": (entries(lambda d: d.pop("frames")), "expected an object with a list `frames`"),
    "no pose": (entries(lambda d: d["frames"][2].pop("transform_matrix")), r"frames\[2\]: expected the key transform_matrix"),
    "no focal length": (
        entries(lambda d: [(e.pop("fl_x"), e.pop("fl_y")) for e in d["frames"]]), "expected fl_x .* or camera_angle_x",
    ),
    "no time": (entries(lambda d: d["frames"][3].pop("time")), r"frames\[3\]: expected a time"),
    "file missing": (delete("images/1_002.png"), "1_002.*image not found"),
    "view missing": (entries(lambda d: d["frames"].pop(7)), "camera 1 has no image at"),
    "times uneven": (
        entries(lambda d: [e.update(time=e["time"] + 0.01) for e in d["frames"] if e["file_path"].endswith("_003.png")]),
        "transforms.json: expected one frame rate, found the times 0, 0.0416667, 0.0833333, 0.135, 0.166667 s",
    ),
    "time off": (entries(lambda d: d["frames"][7].update(time=0.1)), "has no image at"),
    "frame twice": (entries(lambda d: d["frames"].append(d["frames"][0])), "camera 0 has two images at 0.000000 s"),
    "camera moves": (entries(lambda d: d["frames"][3]["transform_matrix"][0].__setitem__(3, 5.0)), "camera 0 has another pose"),
    "one moving camera": (
        entries(lambda d: [(e.pop("camera"), e["transform_matrix"][1].__setitem__(3, i)) for i, e in enumerate(d["frames"])]),
        "a single moving camera cannot be used",
    ),
    "size": (entries(lambda d: d.update(w=1920)), "intrinsics are for w = 1920 px"),
    "no matte": (
        lambda f: iio.imwrite(f / "images/0_000.png", np.array(iio.imread(f / "images/0_000.png"))[..., :3]),
        "expected RGBA with the matte as alpha or a mask_path in",
    ),
    "opaque": (
        lambda f: [iio.imwrite(p, iio.imread(p) | np.array([0, 0, 0, 255], np.uint8)) for p in (f / "images").glob("0_*")],
        "the footage has no matte",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", TRANSFORMS)
def test_corrupted_transforms(transforms_folder, name):
    corrupt, message = TRANSFORMS[name]
    assert load_scene(format="transforms", path=str(transforms_folder), **WORLD).frames == 5
    corrupt(transforms_folder)
    with pytest.raises(DataError, match=message):
        load_scene(format="transforms", path=str(transforms_folder), **WORLD)


def test_masks_of_another_size(blocks, tmp_path):
    from written_scenes import export_transforms

    folder = export_transforms(blocks, tmp_path / "capture", masks=True)
    iio.imwrite(folder / "images" / "0_000_mask.png", np.zeros((8, 8), np.uint8))
    with pytest.raises(
        DataError, match=r"0_000_mask.png: expected 32x32 px \(as 0_000.png\), found 8x8"
    ):
        load_scene(format="transforms", path=str(folder), **WORLD)


def nan_particle(folder):
    positions = torch.rand(5, 9, 3)
    positions[3, 4, 1] = float("nan")
    export_particles(positions, folder)


def cut_particles(folder):
    export_particles(torch.rand(5, 9, 3), folder)
    file = folder / "002.ply"
    file.write_bytes(file.read_bytes()[:-20])


PARTICLES = {
    "NaN": (
        nan_particle,
        "003.ply: expected finite positions, found NaN or infinity in 1 of 9, first at 4",
    ),
    "truncated": (cut_particles, "002.ply: expected a PLY file"),
    "too few": (
        lambda f: export_particles(torch.rand(4, 9, 3), f),
        "expected 5 PLY files, one per frame, numbered 0 to 4 as the frames are, found 4",
    ),
    "no PLY": (
        lambda f: (f.mkdir(), [(f / f"{t}.ply").write_text("hello") for t in range(5)]),
        "0.ply: expected a PLY file",
    ),
    "gone": (lambda f: None, "folder not found"),
}


@pytest.mark.parametrize("name", PARTICLES)
def test_corrupted_particles(pacnerf_folder, tmp_path, name):
    corrupt, message = PARTICLES[name]
    corrupt(tmp_path / "ply")
    with pytest.raises(DataError, match=message):
        load_scene(
            format="pacnerf", path=str(pacnerf_folder), particles=str(tmp_path / "ply"), **WORLD
        )


KEYS = [
    (
        {"format": "nerf"},
        "scene.format: expected one of builtin, markers, pacnerf, phystwin, spring_gaus, "
        "spring_gaus_real, transforms, found 'nerf'",
    ),
    ({"path": None}, "scene.path: expected the folder"),
    ({"colour": "red"}, "scene.colour: not a key of this format"),
    ({"scale": 2.0}, r"scene.scale: expected a number above 0 and at most 1"),
    ({"scale": 0.1}, "scene.scale: .* at least 16 px"),
    ({"gravity": [0, -9.8]}, "scene.gravity: expected three"),
    ({"up": [0, 0, 0]}, "scene.up: expected a direction"),
    ({"box": [[0, 0, 0], [1, -1, 1]]}, "scene.box: expected min < max"),
    ({"box": [0, 1]}, "scene.box: expected three numbers"),
    ({"density": -5.0}, "scene.density: expected a number of at least"),
    ({"fps": 0.0}, "scene.fps: expected a number above 0"),
    (
        {"ground": {"height": 0.0, "mode": "rubber"}},
        "scene.ground.mode: expected sticky or slip or separate or touch or auto",
    ),
    ({"ground": {"hight": 0.0}}, "scene.ground.hight"),
    ({"ground": {"mode": "slip"}}, "scene.ground.height: expected this key, found none"),
    ({"ground": {"height": 0.0, "friction": -1.0}}, "scene.ground.friction"),
    ({"frames": [0, 9]}, "scene.frames: .* has no frame 9, only 0 to 4"),
    ({"frames": 3}, r"scene.frames: expected \[first, last\]"),
    ({"frames": [4, 0]}, r"scene.frames: expected \[first, last\], in this order, found \[4, 0\]"),
    ({"last_free_frame": 9}, "scene.last_free_frame: no frame 9"),
    ({"up": [0, 0, 1]}, "scene.gravity: expected a pull towards the ground, against scene.up"),
    ({"ground": 0.0}, "scene.ground: expected a section of keys"),
    ({"ground": {"height": 0.0, "friction": "some"}}, "scene.ground.friction"),
    (
        {"ground": {"height": 0.0, "mode": "slip", "friction": 0.2}},
        "scene.ground.friction: acts on modes separate and touch only",
    ),
    ({"fps": "many"}, "scene.fps: expected a number above 0 and at most .* found 'many'"),
    ({"scale": "half"}, "scene.scale: expected a number"),
    ({"holdout_cameras": 2}, "scene.holdout_cameras: expected a list of cameras like"),
    (
        {"holdout_frames": "last"},
        "scene.holdout_frames: expected a list of frame numbers or how many",
    ),
    ({"holdout_frames": -1}, "scene.holdout_frames: expected a whole number of at least 0"),
    ({"frames": [0, 1]}, "expected at least three frames to learn from, found 2, 0 of"),
    (
        {"holdout_cameras": ["seven"]},
        "scene.holdout_cameras: no camera 'seven'; the scene has 0, 1, 2",
    ),
    (
        {"holdout_cameras": [0, 1]},
        "scene.holdout_cameras: expected at least two cameras .* 3, 2 of them",
    ),
    ({"holdout_frames": [1]}, "scene.holdout_frames: expected the last frames"),
    ({"holdout_frames": [7]}, "scene.holdout_frames: no frame 7"),
    (
        {"holdout_frames": 3},
        "scene.holdout_frames: expected at least three .* 5, 3 of them held out",
    ),
    (
        {"holdout_frames": 50},
        "scene.holdout_frames: expected at least three .* 5, 5 of them held out",
    ),
]


@pytest.mark.parametrize(("keys", "message"), KEYS, ids=lambda v: str(v)[:40])
def test_mistaken_keys(pacnerf_folder, keys, message):
    with pytest.raises(ConfigError, match=message):
        load_scene(**{"format": "pacnerf", "path": str(pacnerf_folder), **WORLD, **keys})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda s: replace(
                s,
                images=s.images.masked_fill(
                    torch.arange(5)[None, :, None, None, None] == 3, float("nan")
                ),
            ),
            "images: NaN or infinite pixels in camera 0, frame 3",
        ),
        (
            lambda s: replace(s, mattes=s.mattes[:, :4]),
            r"mattes: expected shape \(3, 5, 32, 32\), found \(3, 4, 32, 32\)",
        ),
        (lambda s: replace(s, times=s.times[:2]), r"images: expected shape \(3, 2, 32, 32, 3\)"),
        (
            lambda s: replace(s, cameras=replace(s.cameras, w2c=-s.cameras.w2c)),
            "expected a rotation",
        ),
    ],
)
def test_validation_of_scenes_from_anywhere(blocks, change, message):
    with pytest.raises(DataError, match=message):
        validate(change(blocks))


def test_uneven_times_can_be_overridden(pacnerf_folder, transforms_folder):
    """The way out that the message names."""
    listing(lambda d: [e.update(time=0.5) for e in d if e["file_path"].endswith("_4.png")])(
        pacnerf_folder
    )
    scene = load_scene(format="pacnerf", path=str(pacnerf_folder), fps=24.0, **WORLD)
    assert torch.allclose(scene.times, torch.arange(5) / 24)
    entries(
        lambda d: [e.update(time=0.2) for e in d["frames"] if e["file_path"].endswith("_004.png")]
    )(transforms_folder)
    scene = load_scene(format="transforms", path=str(transforms_folder), fps=24.0, **WORLD)
    assert torch.allclose(scene.times, torch.arange(5) / 24)


@pytest.mark.parametrize("value", [-1, 2.5, True])
def test_fill_holes_is_a_number_of_pixels(pacnerf_folder, value):
    with pytest.raises(
        ConfigError, match=r"scene.fill_holes: expected a whole number of at least 0"
    ):
        load_scene(format="pacnerf", path=str(pacnerf_folder), fill_holes=value, **WORLD)

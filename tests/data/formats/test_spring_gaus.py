"""Spring-Gaus' layout: what is written is read back, and every mistake names its file and entry."""

import json
import shutil

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from blocks_film import WORLD, assert_same_footage, clouds_of
from omegaconf import OmegaConf
from written_scenes import export_particles, export_spring_gaus

from mosa import compose
from mosa.data.scene import load_scene
from mosa.errors import DataError


@pytest.fixture
def folder(blocks, tmp_path):
    return export_spring_gaus(blocks, tmp_path / "torus")


def read(folder, **keys):
    return load_scene(format="spring_gaus", path=str(folder), **WORLD, **keys)


def test_round_trip(blocks, folder):
    scene = read(folder)
    assert_same_footage(scene, blocks)
    assert (
        scene.name == "torus"
        and scene.cameras.names == ("camera_0", "camera_1", "camera_2")
        and not scene.synthetic
    )
    assert read(folder, frames=[1, 4]).frames == 4
    assert read(folder, scale=0.5).images.shape[2:4] == (16, 16)


def test_a_point_lands_where_the_opengl_pose_puts_it(folder):
    """Independent of our exporter's inverse: u = K diag(1, -1, -1) R^T (X - t) with the file's own c2w."""
    scene, entry = read(folder), json.loads((folder / "camera.json").read_text())[1]
    c2w, K = np.array(entry["c2w"]), np.array(entry["K"])
    point = np.array([0.07, 0.21, -0.05])
    seen = K @ (np.diag([1, -1, -1]) @ c2w[:3, :3].T @ (point - c2w[:3, 3]))
    w2c = scene.cameras.w2c[1].double().numpy()
    assert (
        np.allclose(
            scene.cameras.K[1].double().numpy() @ (w2c[:3, :3] @ point + w2c[:3, 3]),
            seen,
            atol=1e-4,
        )
        and seen[2] > 0
    )


def test_alpha_is_straight_and_what_is_behind_becomes_white(folder):
    file = folder / "camera_0" / "000.png"
    pixels = iio.imread(file)
    pixels[pixels[..., 3] == 0] = 0  # black where nothing is, as published
    iio.imwrite(file, pixels)
    image, matte = read(folder).images[0, 0], read(folder).mattes[0, 0]
    assert bool((image[matte == 0] == 1).all()) and bool(
        (matte == torch.tensor(pixels[..., 3]) / 255).all()
    )


def test_true_particles_are_found_beside_the_pictures(blocks, folder):
    export_particles(clouds_of(blocks), folder / "ply")
    assert len(read(folder, particles="ply").particles) == len(blocks.times)


def test_the_scene_of_the_configuration_reads_it(folder):
    composed = compose("scene=spring_gaus", f"scene.path={folder}", "scene.scale=1")
    keys = OmegaConf.to_container(composed.scene, resolve=True)
    assert keys["ground"]["height"] == 0.3 and keys["holdout_frames"] == 10
    assert (
        keys.pop("also_train") == keys.pop("test") == []
    )  # further folders are read by held_out_sequences
    world = {"ground": WORLD["ground"], "box": WORLD["box"], "holdout_frames": 2}
    assert load_scene(**keys | world).training_frames == [0, 1, 2]


def changed(name, change):
    def act(folder):
        document = json.loads((folder / name).read_text())
        change(document)
        (folder / name).write_text(json.dumps(document))

    return act


@pytest.mark.parametrize(("act", "told"), [
    (changed("camera.json", lambda d: d[1].pop("K")), "camera.json, entry 1: expected the keys camera, K, c2w, found no K"),
    (changed("camera.json", lambda d: d[1].update(camera="../torus/camera_0")), "entry 1, camera: expected the name of a folder"),
    (changed("camera.json", lambda d: d[1].update(camera="..")), "entry 1, camera: expected the name of a folder"),
    (changed("camera.json", lambda d: d[1].update(camera=["camera_0"])), "entry 1, camera: expected the name of a folder"),
    (changed("camera.json", lambda d: d[1].update(camera="camera_0")), "entry 1: camera 'camera_0' twice"),
    (changed("camera.json", lambda d: d[1].update(camera="camera_7")), "camera_7: folder not found"),
    (changed("camera.json", lambda d: d[1].update(K=[[1, 0], [0, 1]])), "entry 1, K: expected a 3x3 matrix"),
    (changed("camera.json", lambda d: d[1].update(c2w=np.diag([2.0, 2, 2, 1]).tolist())), "entry 1, c2w: expected a rotation"),
    (changed("camera.json", lambda d: d.clear()), "camera.json: expected a list with one object per camera"),
    (changed("frame.json", lambda d: d.pop()), "frame.json: expected a time for each frame up to 4, found 4"),
    (changed("frame.json", lambda d: d[2].update(more=1.0)), "frame.json, entry 2: expected one key, a time"),
    (changed("frame.json", lambda d: d[2].update({"002": "late"})), "frame.json, entry 2: expected a finite number"),
    (changed("frame.json", lambda d: d[2].update({"002": 0.07})), "frame.json: expected one frame rate"),
    (lambda folder: (folder / "frame.json").unlink(), "frame.json: file not found"),
    (lambda folder: (folder / "camera_1" / "002.png").unlink(), "camera_1/002.png: image not found"),
    (lambda folder: [shutil.rmtree(file) or file.mkdir() for file in folder.glob("camera_?")], "expected pictures camera_0/0"),
    (lambda folder: [file.unlink() for file in folder.glob("camera_?/002.png")], "frames [2] are missing"),
    (lambda folder: iio.imwrite(folder / "camera_1" / "002.png", np.zeros((32, 32, 3), np.uint8)), "002.png: expected RGBA"),
    (lambda folder: iio.imwrite(folder / "camera_1" / "002.png", np.zeros((16, 32, 4), np.uint8)), "expected 32x32 px"),
    (lambda folder: shutil.rmtree(folder), "folder not found; set scene.path to a body in Spring-Gaus' layout"),
])  # fmt: skip
def test_a_mistake_names_its_file_and_entry(folder, act, told):
    act(folder)
    with pytest.raises(DataError) as error:
        read(folder)
    assert told in str(error.value) and "\n" not in str(error.value)


def test_frames_per_second_take_the_place_of_times(folder):
    changed("frame.json", lambda d: d[2].update({"002": 0.07}))(folder)
    assert torch.allclose(read(folder, fps=24.0).times, torch.arange(5) / 24)

"""Spring-Gaus' layout of real captures: what is written is read back, the rest shape is that of the static masks."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from blocks_film import WORLD, assert_same_footage
from scipy.spatial.transform import Rotation
from written_scenes import export_spring_gaus_real

from mosa import compose
from mosa.data.formats.particles import read_ply
from mosa.data.scene import load_scene
from mosa.data.synthetic.renderer import ring_of_cameras
from mosa.errors import DataError
from mosa.types import Cameras

RADII, TURN, SHIFT, UNIT = (0.05, 0.08, 0.06), (0.4, -0.8, 0.3), (3.0, -1.0, 2.0), 12.0
"""Half axes [m] of an ellipsoid; pose and metres' share of COLMAP's unit."""


@pytest.fixture(scope="module")
def photographs() -> tuple[Cameras, torch.Tensor]:
    """Cameras around an ellipsoid in the world of COLMAP, and its masks."""
    ring = ring_of_cameras(
        14, 64, target=(0, 0, 0), distance=0.5, elevations=(0.9, -0.6, 0.1), field=0.105, turn=0.2
    )
    w2c = ring.w2c.double()
    # as the film's cameras: the focal length, of the width, is a half of 1.5 / 0.3
    K = torch.tensor([[160.0, 0, 32], [0, 160, 32], [0, 0, 1]])
    grid = torch.stack(torch.meshgrid(*[torch.arange(64) + 0.5] * 2, indexing="xy"), -1).double()
    rays = torch.cat([(grid - 32) / 160, torch.ones(64, 64, 1).double()], -1)
    masks = []
    for pose in w2c:
        a, d = (-pose[:3, :3].T @ pose[:3, 3], rays @ pose[:3, :3])
        a, d = a / torch.tensor(RADII), d / torch.tensor(RADII)
        masks.append(((d @ a) ** 2 - (d * d).sum(-1) * (a @ a - 1) > 0).float())
    R = torch.tensor(Rotation.from_rotvec(TURN).as_matrix())
    moved = w2c.clone()
    moved[:, :3, :3] = w2c[:, :3, :3] @ R.T
    moved[:, :3, 3] = UNIT * w2c[:, :3, 3] - moved[:, :3, :3] @ torch.tensor(SHIFT).double()
    names = tuple(map(str, range(14)))
    return Cameras(K.expand(14, 3, 3), moved.float(), 64, 64, names), torch.stack(masks)


@pytest.fixture
def sequence(blocks, photographs, tmp_path):
    cameras, masks = photographs
    return export_spring_gaus_real(blocks, tmp_path / "real", cameras, masks)


def read(sequence, **keys):
    keys = {"format": "spring_gaus_real", "fps": 24.0, "cache": str(sequence.parent)} | keys
    return load_scene(path=str(sequence), **WORLD, **keys)


def test_round_trip(blocks, sequence):
    scene = read(sequence)
    assert_same_footage(scene, blocks)
    assert scene.name == "bun" and scene.cameras.names == ("C0", "C1", "C2")
    own = {"shape": scene.body.shape}
    assert scene.last_free_frame == 2
    assert read(sequence, last_free_frame=1, body=own).last_free_frame == 1
    assert read(sequence, frames=[0, 3], body=own).frames == 4 and not scene.synthetic


def test_the_rest_shape_is_the_ellipsoid_in_colmaps_unit(sequence):
    """A hull of 14 views is up to a twentieth larger; one voxel is 1 % of the longest axis."""
    scene = read(sequence)
    file = Path(scene.body.shape)
    points = (read_ply(file).double().numpy() - SHIFT) / UNIT
    points = points @ Rotation.from_rotvec(TURN).as_matrix()
    assert np.allclose(points.mean(0), 0, atol=0.002)
    assert np.allclose(np.ptp(points, axis=0) / 2, RADII, rtol=0.06)
    assert read(sequence).body == scene.body and scene.body.scale is None
    own = sequence.parent / "own.ply"
    own.write_bytes(file.read_bytes())
    given = read(sequence, body={"shape": "own.ply", "scale": 0.1}).body
    assert given is not None and (given.shape, given.scale) == (str(own), 0.1)


def changed(place, change):
    def act(sequence):
        file = sequence.parents[2] / place
        document = json.loads(file.read_text())
        change(document)
        file.write_text(json.dumps(document))

    return act


def lens(sequence):
    """SIMPLE_RADIAL in place of PINHOLE."""
    file = sequence.parents[3] / "static/colmap/bun/cameras.bin"
    data = bytearray(file.read_bytes())
    data[12:16] = (2).to_bytes(4, "little")
    file.write_bytes(bytes(data))


SEQUENCE, POSES = "sequences/bun/0.json", "cameras_calib.json"


@pytest.mark.parametrize(("act", "told"), [
    (changed(SEQUENCE, lambda d: d.pop("hit_frame")), "0.json: expected an object with hit_frame"),
    (changed(SEQUENCE, lambda d: d["C1"].pop()), "0.json: expected as many pictures of each camera, found {'C0': 5, 'C1': 4"),
    (changed(SEQUENCE, lambda d: d["C1"].__setitem__(2, "../../x.png")), "C1: expected names of files, found '../../x.png'"),
    (changed(POSES, lambda d: d.pop("C2")), "cameras_calib.json, C2: expected rvecs and tvecs"),
    (changed(POSES, lambda d: d["C2"].update(rvecs=[[1.0], [2.0]])), "C2, rvecs: expected three finite numbers"),
    (lambda s: (s.parents[2] / "videos_masks/C1/00002.png").unlink(), "00002.png: image not found"),
    (lambda s: (s.parents[3] / "static/masks/bun/P003.png").unlink(), "P003.png: image not found"),
    (lens, "image P000.JPG: expected a pinhole, found lens distortion; undistort"),
    (lambda s: (s.parents[3] / "static/colmap/bun/images.bin").unlink(), "expected images.bin or images.txt of a COLMAP model"),
])  # fmt: skip
def test_a_mistake_names_its_file_and_field(sequence, act, told):
    act(sequence)
    with pytest.raises(DataError) as error:
        read(sequence)
    assert told in str(error.value) and "\n" not in str(error.value)


def test_a_path_that_is_no_sequence_says_what_one_is(sequence):
    with pytest.raises(DataError, match=r"scene.path: expected <capture>/dynamic/sequences"):
        read(sequence.parent)


def test_the_configuration_has_its_keys():
    scene = compose("scene=spring_gaus_real").scene
    assert scene.gravity[2] == 9.8 and scene.up[2] == -1 and scene.fps == 120

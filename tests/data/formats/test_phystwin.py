"""PhysTwin's layout: what is written is read back, the hands' points become a driven set, no pickle runs anything."""

import json
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from blocks_film import WORLD, assert_same_footage, clouds_of
from written_scenes import export_phystwin

from mosa import compose
from mosa.config.build import build_world, measured, world_config, world_of
from mosa.data.formats.particles import read_ply
from mosa.data.scene import load_scene
from mosa.data.sequences import load_sequences
from mosa.errors import ConfigError, DataError

FAR = 0.3
"""[m] of two points of the hand from the body."""


@pytest.fixture(scope="module")
def points(blocks) -> tuple[np.ndarray, np.ndarray]:
    """The body's (5, 40, 3) and the hand's (5, 6, 3), of which four begin 1 cm above points of the body."""
    body = clouds_of(blocks, 40).double().numpy()
    hand = np.repeat(body[:1, :6], 5, 0) + np.array([0, 0.01, 0])
    hand[:, 4:] += FAR
    return body, hand + 0.02 * np.arange(5)[:, None, None] * [1, 0.5, -1]


@pytest.fixture
def case(blocks, points, tmp_path):
    return export_phystwin(blocks, tmp_path / "single_push", *points, test=3)


def read(case, **keys):
    keys = {"format": "phystwin", "fps": 24.0, "cache": str(case), "reach": 0.02} | keys
    return load_scene(path=str(case), **WORLD, **keys)


def test_round_trip(blocks, points, case):
    scene = read(case)
    assert_same_footage(scene, blocks)
    assert scene.name == "single_push" and scene.start == "rest" and scene.holdout_frames == (3, 4)
    assert read(case, holdout_frames=1).holdout_frames == (4,)
    assert scene.body.scale == 1.0 and len(read_ply(Path(scene.body.shape))) == 42
    cloud = read_ply(Path(scene.body.shape)).numpy()
    assert np.array_equal(cloud[:40], points[0][0].astype(np.float32))


def test_another_rate_in_the_file_is_said(case):
    """The film starts at rest: no free fall tells that all of its speeds are half of the true ones."""
    file = case / "metadata.json"
    document = json.loads(file.read_text())
    file.write_text(json.dumps(document | {"fps": 48}))
    with pytest.warns(UserWarning, match="scene.fps = 24 takes the place of .* say 48 frames"):
        read(case)


def test_the_hand_drives_the_particles_that_it_is_near(blocks, points, case):
    (entry,) = read(case).driven
    assert entry["name"] == "controller"
    assert np.allclose(entry["motion"]["times"], np.arange(5) / 24, atol=1e-12)
    assert np.array_equal(entry["motion"]["points"], points[1][:, :4])
    (entry,) = read(case, frames=[1, 4], reach=1.0, holdout_frames=0).driven
    assert (
        np.array_equal(entry["motion"]["points"], points[1][1:])
        and entry["motion"]["times"][0] == 0
    )


def test_a_case_without_a_mesh_has_the_points_that_were_seen(points, case):
    stored(
        POINTS, lambda d: d.update(surface_points=np.zeros(0), interior_points=np.zeros((0, 3)))
    )(case)
    assert len(read_ply(Path(read(case).body.shape))) == len(points[0][0])
    with pytest.raises(ConfigError, match=r"scene\.reach"):
        read(case, reach=-1.0)


def test_the_run_and_its_record_have_the_set(points, case):
    scene, law = read(case), {"law": "neo_hookean", "parameters": {"E": 1e5, "nu": 0.3}}
    record = measured({"prior": law, "adapter": {"name": None}, "world": {"driven": [
        {"name": "clamp", "type": "box", "size": [0.01, 0.01, 0.01]}]}}, scene, 0.02)  # fmt: skip
    moving, clamp = world_of(type(record).read(record.plain(), "mosa")).driven
    assert (moving.name, clamp.name) == ("controller", "clamp")
    half = moving.motion.at(torch.tensor([0.5 / 24], dtype=torch.float64))[0]
    assert np.allclose(half, points[1][:2, :4].mean(0), atol=1e-9)
    assert len(build_world(world_config(scene)).driven) == 1


def test_another_motion_is_another_world(case, tmp_path):
    other = shutil.copytree(case, tmp_path / "other")
    stored = pickle.loads((other / "final_data.pkl").read_bytes())
    stored["controller_points"][1:] += 0.01
    (other / "final_data.pkl").write_bytes(pickle.dumps(stored))
    keys = {"format": "phystwin", "fps": 24.0, "cache": str(case), "reach": 0.02, **WORLD}
    with pytest.raises(ConfigError, match=r"expected recordings in one world, found .* in other"):
        load_sequences(keys | {"path": str(case), "test": [str(other)]})


def stored(name, change):
    def act(case):
        value = pickle.loads((case / name).read_bytes())
        (case / name).write_bytes(pickle.dumps(change(value) or value))

    return act


class Run:
    """What a pickle would run."""

    def __reduce__(self):
        return print, ("run",)


POINTS, POSES = "final_data.pkl", "calibrate.pkl"


@pytest.mark.parametrize(("act", "told"), [
    (stored(POINTS, lambda d: d.update(more=Run())), "final_data.pkl: expected a pickle of lists, dictionaries and arrays of"),
    (stored(POINTS, lambda d: d.update(controller_points=np.array([[[Run()] * 3]], object))), "found the name builtins.print"),
    (stored(POINTS, lambda d: d.update(controller_points=np.array([[[None] * 3]]))), "controller_points: expected numbers of sha"),
    (stored(POINTS, lambda d: d.pop("surface_points") is None), "final_data.pkl, surface_points: expected numbers"),
    (stored(POINTS, lambda d: d.update(controller_points=d["controller_points"][:3])), "expected frames up to 4, as there are"),
    (stored(POINTS, lambda d: d.update(controller_points=d["controller_points"] + 1)), "within scene.reach=0.02 m of the body in"),
    (stored(POINTS, lambda d: d.update(object_points=d["object_points"].astype(str))), "object_points: expected numbers of shape"),
    (stored(POSES, lambda d: d[:2]), "metadata.json, intrinsics: expected a 3x3 matrix for each pose"),
    (stored(POSES, lambda d: [2 * pose for pose in d]), "calibrate.pkl, pose 0: expected 0, 0, 0, 1 in the fourth row"),
    (lambda c: (c / POSES).write_bytes(b"\\x80\\x04"), "calibrate.pkl: expected a pickle"),
    (lambda c: (c / POSES).unlink(), "calibrate.pkl: file not found"),
    (lambda c: (c / "mask/mask_info_1.json").write_text('{"0": "hand"}'), "mask_info_1.json: expected one number of a mask"),
    (lambda c: (c / "mask/1/1/2.png").unlink(), "mask/1/1/2.png: image not found"),
    (lambda c: (c / "color/1/2.png").unlink(), "color/1/2.png: image not found; restore it, or restrict scene.frames"),
    (lambda c: (c / "split.json").write_text("[]"), "split.json, test: expected [first, end]"),
    (lambda c: shutil.rmtree(c / "color" / "0"), "expected pictures 0.png, 1.png and so on"),
    (lambda c: shutil.rmtree(c), "file not found; set scene.path to a folder of a case of PhysTwin"),
])  # fmt: skip
def test_a_mistake_names_its_file_and_field(case, act, told, capsys):
    act(case)
    with pytest.raises(DataError) as error:
        read(case, cache=str(case.parent))
    assert told in str(error.value) and "\n" not in str(error.value)
    assert "run" not in capsys.readouterr().out


def test_the_configuration_has_its_keys():
    scene = compose("scene=phystwin").scene
    assert scene.gravity[2] == 9.8 and scene.up[2] == -1 and scene.start == "rest"
    assert json.dumps(scene.reach) == "0.04"

"""Whatever is written somewhere ends in a typed error that is one message, or in finite figures: never in another exception."""

import functools
import json
import os
from pathlib import Path

import pytest
import torch
from blocks_film import BOX, block_scene
from drawn_mistakes import changed, examples, numbers, places, plain, values
from hypothesis import given
from hypothesis import strategies as st
from strangers import ROOT, saved
from written_scenes import export_pacnerf, export_spring_gaus, export_transforms

from mosa.config.build import rehearse
from mosa.data.scene import load_scene
from mosa.errors import ConfigError, DataError, MosaError, SimulationDiverged
from mosa.system.npz import read_npz, write_npz
from mosa.twin.twin import Twin
from tests.config.test_command_settings import composed
from tests.modules.body.test_world import twin

DEFAULT = functools.cache(lambda: composed("debug=default", "world.walls={mode: separate}"))
TWIN = functools.cache(twin)


def one_message(error: MosaError) -> None:
    assert (
        str(error)
        and "Traceback" not in str(error)
        and str(error).count("\n") == 0
        and len(str(error)) < 4000
    )


def configured(config: dict) -> None:
    """What train.py checks before it reads data."""
    try:
        rehearse(config)
    except ConfigError as error:
        one_message(error)


@examples(60)
@given(st.data())
def test_configurations(data):
    config = DEFAULT()
    for _ in range(data.draw(st.integers(1, 2))):
        path = data.draw(st.sampled_from(places(config)))
        config = changed(config, path, data.draw(values), delete=data.draw(st.integers(0, 9)) == 0)
    configured(config)


THREE = st.lists(st.one_of(st.floats(-1, 1), numbers), min_size=3, max_size=3)
SHAPES = [{"type": "sphere", "radius": 0.1}, {"type": "box", "size": [0.2, 0.1, 0.3]}, {"type": "plane", "normal": [0, 1, 0]},
          {"type": "capsule", "radius": 0.1, "length": 0.2}, {"type": "cylinder", "radius": 0.1, "length": 0.2}]  # fmt: skip
MORE = {"mode": "separate", "friction": 0.3, "position": [0.0, -0.4, 0.0], "rotation": [0, 0, 1, 30],
        "motion": {"velocity": [0, 1.0, 0], "angular_velocity": [0, 0, 1.0], "times": [0.0]}}  # fmt: skip
WAY = {
    "waypoints": [
        {"time": 0.0, "position": [0, -0.4, 0]},
        {"time": 0.1, "position": [0, -0.3, 0], "rotation": [1, 0, 0, 10]},
    ]
}


@st.composite
def colliders(draw):
    item = dict(draw(st.sampled_from(SHAPES))) | {
        k: v for k, v in MORE.items() if draw(st.booleans())
    }
    if draw(st.integers(0, 3)) == 0:
        item = {k: v for k, v in item.items() if k != "position"} | {"motion": WAY}
    for _ in range(draw(st.integers(0, 2))):
        item = changed(
            item, draw(st.sampled_from(places(item))), draw(st.one_of(plain, values, THREE))
        )
    return item


def simulated(body: Twin, **arguments) -> None:
    """Finite numbers, or one message."""
    try:
        rollout = body.simulate(**arguments)
    except (ConfigError, SimulationDiverged) as error:
        one_message(error)
        return
    for found in (
        rollout.x,
        rollout.v,
        rollout.F,
        *([rollout.reactions] if rollout.reactions is not None else []),
    ):
        assert bool(torch.isfinite(found).all())


@examples(40)
@given(st.lists(colliders(), min_size=1, max_size=2))
def test_colliders(items):
    simulated(TWIN(), frames=2, colliders=items)


@examples(40)
@given(st.data())
def test_calls_of_a_twin(data):
    arguments = {"rotation": [0, 0, 1, 30], "position": [0.1, None, 0.0], "height": 0.01, "velocity": [0, -1.0, 0],
                 "angular_velocity": [0, 0, 1.0], "variant": "prior", "frames": 2}  # fmt: skip
    for name in data.draw(
        st.lists(st.sampled_from(sorted(arguments)), min_size=1, max_size=2, unique=True)
    ):
        drawn = data.draw(st.one_of(values, THREE, st.lists(numbers, min_size=4, max_size=4),
                                    st.lists(THREE, min_size=3, max_size=3)))  # fmt: skip
        if (
            name == "frames"
            and isinstance(drawn, int)
            and not isinstance(drawn, bool)
            and 100 < drawn < 10**8
        ):
            drawn = 3  # a long rollout is no mistake
        arguments[name] = drawn
    simulated(TWIN(), **arguments)


@examples(40)
@given(st.data())
def test_actions_of_a_stepped_twin(data):
    """A step that is refused moves nothing; one that is not leaves finite numbers."""
    stepped = TWIN()
    before = stepped.reset(
        colliders=[SHAPES[0] | {"position": [0.0, -0.4, 0.0], "name": "ball"}], frames=2
    )
    drawn = st.one_of(values, THREE, st.lists(THREE, min_size=3, max_size=3))
    keys = st.sampled_from(["velocity", "angular_velocity", "position", "rotation", "speed"])
    command = data.draw(st.one_of(drawn, st.dictionaries(keys, drawn, max_size=2)))
    action = data.draw(st.sampled_from([command, {"ball": command}, {"1": command}]))
    try:
        state, reactions = stepped.step(action)
    except (ConfigError, SimulationDiverged) as error:
        one_message(error)
        assert torch.equal(stepped.state.x, before.x) and int(stepped.state.frames) == 0
        return
    for found in (state.x, state.v, state.F, state.collider_position, reactions):
        assert bool(torch.isfinite(found).all())


STORED = functools.cache(saved)


@examples(40)
@given(st.data())
def test_checkpoints(tmp_path_factory, data):
    stored = STORED()
    for _ in range(data.draw(st.integers(1, 2))):
        path = data.draw(st.sampled_from(places(stored)))
        stored = changed(stored, path, data.draw(values), delete=data.draw(st.integers(0, 3)) == 0)
    file = tmp_path_factory.getbasetemp() / "drawn.ckpt"
    torch.save(stored, file)
    try:
        loaded = Twin.load(file)
    except DataError as error:
        one_message(error)
        assert "drawn.ckpt" in str(error)
        return
    simulated(loaded, frames=2)


KEYS = {"gravity": [0, -9.8, 0], "box": BOX, "ground": {"height": 0.0, "mode": "sticky", "friction": 0.0}, "up": [0, 1, 0],
        "density": 1000.0, "fps": 24.0, "scale": 1.0, "fill_holes": 0, "frames": [0, 4], "last_free_frame": 3,
        "holdout_cameras": [0], "holdout_frames": [4], "name": "blocks", "sequence": "train"}  # fmt: skip


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """By format: folder, its listing."""
    base, scene = tmp_path_factory.mktemp("folders"), block_scene(views=4)
    return {"pacnerf": (export_pacnerf(scene, base / "p"), "all_data.json"),
            "spring_gaus": (export_spring_gaus(scene, base / "s"), "camera.json"),
            "transforms": (export_transforms(scene, base / "t"), "transforms.json")}  # fmt: skip


def loaded(**keys) -> None:
    try:
        scene = load_scene(**keys)
    except (ConfigError, DataError) as error:
        one_message(error)
        return
    assert bool(torch.isfinite(scene.images).all()) and bool(
        torch.isfinite(scene.cameras.w2c).all()
    )


@pytest.mark.filterwarnings("ignore")
@examples(30)
@given(st.data())
def test_listings(folders, data):
    name = data.draw(st.sampled_from(sorted(folders)))
    folder, file = folders[name]
    good = (folder / file).read_text()
    document = json.loads(good)
    for _ in range(data.draw(st.integers(1, 2))):
        document = changed(document, data.draw(st.sampled_from(places(document))), data.draw(values),
                           delete=data.draw(st.integers(0, 4)) == 0)  # fmt: skip
    try:
        (folder / file).write_text(json.dumps(document))
        loaded(
            format=name,
            path=str(folder),
            **{k: v for k, v in KEYS.items() if k in ("gravity", "box", "ground")},
        )
    finally:
        (folder / file).write_text(good)


@pytest.mark.filterwarnings("ignore")
@examples(30)
@given(st.data())
def test_keys_of_a_scene(folders, data):
    keys = {
        "format": "transforms",
        "path": str(folders["transforms"][0]),
        "root": None,
        "cache": None,
        "particles": None,
    } | KEYS
    for _ in range(data.draw(st.integers(1, 2))):
        keys = changed(keys, data.draw(st.sampled_from(places(keys))), data.draw(values))
    loaded(**keys)


@examples(60)
@given(st.data())
def test_bytes_of_files(folders, tmp_path_factory, data):
    """A byte of an npz, a PNG or a checkpoint is another one, or the file ends early."""
    base = tmp_path_factory.getbasetemp()
    kind = data.draw(st.sampled_from(["npz", "ckpt"]))
    file = base / f"bytes.{kind}"
    if kind == "npz":
        write_npz(file, {"train/x": torch.arange(60.0).reshape(2, 10, 3).numpy()})
    else:
        torch.save(STORED(), file)
    content = bytearray(file.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    file.write_bytes(
        content[: data.draw(st.one_of(st.just(len(content)), st.integers(0, len(content))))]
    )
    try:
        (read_npz if kind == "npz" else Twin.load)(Path(file))
    except DataError as error:
        one_message(error)
        assert file.name in str(error)


def test_nothing_was_written_beside_the_tests():
    assert not any(
        Path(place).exists() for place in ("../../x", "x" * 200, "abc", "${oc.env:HOME}")
    ) or os.getcwd() != str(ROOT)

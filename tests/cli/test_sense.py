"""What is well formed and makes no sense is named: a stranger's numbers, a truth's and a task's settings, starts, arguments."""

import contextlib
import io
import math

import numpy as np
import pytest
import torch
from strangers import checkpoint

from mosa.cli.experiment import arguments, run
from mosa.environments.arena import simulator_named
from mosa.environments.tasks import TASKS, task_named
from mosa.errors import ConfigError, DataError, MosaError
from mosa.system.limits import named_device
from mosa.system.machine_errors import memory_message
from mosa.twin.twin import Twin
from mosa.viewer.pages import open_server
from mosa.viewer.recorded import options
from tests.modules.body.test_world import twin


@pytest.mark.parametrize("section, key, value, message", [
    ("world", "gravity", [0, 9.8, 0], "world.gravity: expected a pull against up"),
    (None, "ground", {"height": 1e9}, "mosa.ground.height: expected a ground inside of the box"),
    ("world", "box", [[-1e9] * 3, [1e9] * 3], "a box within 100000 m"),
    (None, "density", 1e30, "density: expected a number of at least 0.1 and at most 100000"),
    (None, "frame_dt", 1e-9, "frame_dt: expected a number of at least 1e-06"),
])  # fmt: skip
def test_a_strangers_world_holds_together(tmp_path, section, key, value, message):
    def change(stored):
        config = stored["mosa"]
        (config if section is None else config[section])[key] = value

    with pytest.raises(DataError, match=message):
        Twin.load(checkpoint(tmp_path / "bad.ckpt", change=change))


@pytest.mark.parametrize("name, change, message", [
    ("opacities", lambda x: x + 1, "expected opacities from 0 to 1"),
    ("colors", lambda x: x + 1e6, "colours within 10"),
    ("covariances", lambda x: -x, "body.covariances: expected symmetric, positive ones"),
    ("volume", lambda x: 1e6 * x, "body.volume: expected particles 0.02 to 5 cells of dx"),
    ("contact.cells", lambda x: x.long(), "body.contact.cells: expected torch.float32, found torch.int64"),
])  # fmt: skip
def test_a_strangers_body_can_be(tmp_path, name, change, message):
    def changed(stored):
        stored["state_dict"][f"body.{name}"] = change(stored["state_dict"][f"body.{name}"])

    with pytest.raises(DataError, match=message):
        Twin.load(checkpoint(tmp_path / "bad.ckpt", change=changed))


@pytest.mark.parametrize(
    "scene, error",
    [
        (..., DataError),
        (None, DataError),
        (5, DataError),
        ({"format": "builtin"}, DataError),
        ({"format": "transforms", "name": "x"}, ConfigError),
    ],
)
def test_a_run_without_a_built_in_scene_has_no_truth(tmp_path, scene, error):
    def change(stored):
        cfg = stored["mosa"]["settings"]
        cfg.pop("scene", None)
        if scene is not ...:
            cfg["scene"] = scene

    with pytest.raises(
        error,
        match=r"settings\.scene|mosa\.settings|expected learned or isotropic for a run on a scene of format transforms",
    ):
        simulator_named("truth", checkpoint(tmp_path / "bad.ckpt", change=change))


@pytest.mark.parametrize("spacing", [0, -1, math.nan, "a", True, 1e9, 1e-9])
def test_a_truths_spacing_is_a_distance_in_the_body(spacing):
    with pytest.raises(ConfigError, match=r"truth.spacing: expected a distance of 0.0005 to"):
        simulator_named("truth", scene="tiny", spacing=spacing)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize(
    "field, value",
    [("near", -1), ("steps", 0), ("control_dt", math.nan), ("still", "a"), ("near", None)],
)
def test_a_tasks_fields_have_ranges(task, field, value):
    with pytest.raises(ConfigError, match=f"options.{field}: expected"):
        task_named(task, torch.rand(9, 3), **{field: value})


def test_a_tasks_ranges_begin_before_they_end():
    with pytest.raises(
        ConfigError, match=r"options.low: expected at most options.high=0.2, found 0.4"
    ):
        task_named("placement", torch.rand(9, 3), low=0.4, high=0.2)
    with pytest.raises(ConfigError, match=r"options.foo: unknown key; expected one of steps"):
        task_named("placement", torch.rand(9, 3), foo=1)


def test_a_body_starts_above_the_ground():
    body = twin()
    center = body.world.ground.height
    with pytest.raises(ConfigError, match="position: expected a body that starts above the ground"):
        body.simulate(frames=2, position=(None, center, None))


@pytest.mark.parametrize("call, message", [
    (lambda t: t.reset(height=0.05, substeps=10**9), "substeps: expected a whole number of at least 1 and at most"),
    (lambda t: t.reset(height=0.05, differentiable=None), "differentiable: expected true or false"),
    (lambda t: t.worlds(2, laws=5), r"laws: expected one for each of 2 worlds, a tensor"),
    (lambda t: t.worlds(2).reset(5), "starts: expected what Twin.simulate takes"),
    (lambda t: t.worlds(2).restart(5), "which: expected a list of numbers of worlds, found 5"),
    (lambda t: t.export(t.simulate(frames=2), "/proc/nowhere", video=False), "export: expected a folder that can be written"),
    (lambda t: t.export(t.simulate(frames=2), "x", formats="ply"), "formats: expected a list of some of ply, gltf, sog, usd, rrd"),
])  # fmt: skip
def test_calls_of_a_twin_that_mean_nothing(call, message):
    with pytest.raises(ConfigError, match=message):
        call(twin())


def test_only_a_state_is_a_state():
    body = twin()
    body.reset(height=0.05)
    with pytest.raises(ConfigError, match="state: expected a TwinState"):
        body.state = 5


@pytest.mark.parametrize("name", ["meta", "cpu:7", "nope", "", 5, None, "cuda:99"])
def test_a_device_is_one_of_this_machine(name):
    with pytest.raises(ConfigError, match="device: expected cpu, or cuda on a machine with a GPU"):
        named_device(name)


@pytest.mark.parametrize("words, message", [
    (["--seeds", "0,0"], "--seeds: expected different whole"), (["--seeds=-1"], "--seeds: expected different whole"),
    (["--devices", "1,1"], "--devices: expected different"), (["--set", "foo"], "--set: expected KEY=VALUE"),
    (["--set", "hydra.run.dir=/x"], "--set: expected KEY=VALUE"), (["--set", "seed=3"], "--set: expected KEY=VALUE"),
    (["--set", "+foo=1"], "foo: unknown key"), (["--set", "simulation.stride=-1"], "simulation.stride: expected a whole number"),
    (["--set", "fit=nope"], "--set: .*nope"),
])  # fmt: skip
def test_mistakes_in_the_arguments_of_experiments_are_said_before_any_job(words, message):
    with contextlib.redirect_stdout(io.StringIO()), pytest.raises(ConfigError, match=message):
        run(arguments(["table_time", *words, "--dry-run"]))


def test_the_results_folder_is_tried_before_any_job(tmp_path):
    with (
        contextlib.redirect_stdout(io.StringIO()),
        pytest.raises(ConfigError, match="--results: expected a folder that can be"),
    ):
        run(arguments(["table_time", "--runs", str(tmp_path), "--results", "/proc/nowhere"]))


def test_the_viewer_listens_where_it_was_told_to_alone():
    """An empty name would be every address of the machine."""
    pytest.importorskip("viser")
    for host in ("", "a\0b", "999.1.1.1"):
        with pytest.raises(ConfigError, match=r"host: expected 127.0.0.1"):
            open_server(host, 8080)
    with pytest.raises(ConfigError, match="port: expected a number from 1 to 65535"):
        options(["run=x", "port=²"])


def test_a_message_is_one_line():
    assert (
        str(ConfigError(f"rotation: found\n{np.eye(2)}\r\nagain"))
        == "rotation: found [[1. 0.]  [0. 1.]] again"
    )
    assert isinstance(DataError("a"), MosaError)


def test_a_gpu_without_memory_is_told_from_other_errors():
    OutOfMemoryError = type("OutOfMemoryError", (RuntimeError,), {})  # as torch calls it
    assert "no memory left (CUDA out of memory" in memory_message(
        OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB")
    )
    assert "no memory left" in memory_message(
        RuntimeError("Failed to allocate 4000 bytes on device 'cuda:0'")
    )
    assert memory_message(RuntimeError("mat1 and mat2 shapes cannot be multiplied")) is None

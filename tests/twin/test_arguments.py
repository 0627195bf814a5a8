"""Arguments of public calls are checked by their types, as keys of a configuration are."""

import functools
import math
from dataclasses import replace

import pytest
import torch

from mosa.errors import ConfigError
from mosa.modules.fitting.parameters import read_numbers
from mosa.physics.engine.simulator import Simulator
from mosa.types import Ground, ParticleState
from tests.modules.body.test_world import twin

TWIN = functools.cache(twin)
MOTION = functools.cache(lambda: TWIN().simulate(frames=2))


def begun(made):
    made.reset()
    return made


@pytest.mark.parametrize("name, wrong, call", [
    ("size", (0, -1, 2.5, "a", True, 10**6, None), lambda v: TWIN().render(MOTION(), size=v)),
    ("size", ((9, 7), [64], (64,) * 3, (64, 8.5)), lambda v: TWIN().render(MOTION(), size=v)),
    ("rollout", (5, None, "a", {}, [1]), lambda v: TWIN().render(v)),
    ("rollout", (5, None, "a", {}, [1]), lambda v: TWIN().export(v, "nowhere")),
    ("folder", (5, None, True, [], 1.5), lambda v: TWIN().export(MOTION(), v)),
    ("formats", (5, "ply", ["obj"], [1], None), lambda v: TWIN().export(MOTION(), "nowhere", formats=v)),
    ("folder", (5, None, True, [], 1.5), lambda v: TWIN().export_material(v)),
    ("formats", (5, "npz", ["fbx"], [1], None), lambda v: TWIN().export_material("nowhere", v)),
    ("export", ("/proc/nowhere", "/dev/null/a", "a\0b"), lambda v: TWIN().export(MOTION(), v)),
    ("export", ("/proc/nowhere", "/dev/null/a", "a\0b"), lambda v: TWIN().export_material(v)),
    ("action", (5, 0, "a", torch.zeros(3), [{}], {"a"}), lambda v: begun(TWIN()).step(v)),
    ("action", (5, 0, "a", torch.zeros(3), [{}], {"a"}), lambda v: begun(TWIN().worlds(2)).step(v)),
    ("video", (1, "no", None, [], 0.0), lambda v: TWIN().export(MOTION(), "nowhere", video=v)),
    ("draws", (-1, 1, 2.5, "a", True, 10**12), lambda v: TWIN().predict(draws=v)),
    ("seed", (-1, 0.5, "a", True, 2**32), lambda v: TWIN().predict(seed=v)),
    ("frames", (0, -1, 2.5, "a", True, 10**12), lambda v: TWIN().simulate(frames=v)),
    ("variant", (0, "best", None, ["prior"], True), lambda v: TWIN().simulate(variant=v)),
    ("height", ("a", math.nan, True, [0.1], -1), lambda v: TWIN().simulate(height=v)),
    ("control_dt", (0, -1, math.inf, "a", True, 1e3), lambda v: TWIN().reset(control_dt=v)),
    ("substeps", (0, -1, 2.5, "a", True, 10**9), lambda v: TWIN().reset(substeps=v)),
    ("count", (0, -1, 2.5, "a", True, 10**12), lambda v: TWIN().worlds(v)),
    ("which", (5, "ab", [True], [0.5], ["a"]), lambda v: TWIN().worlds(2).restart(v)),
    (r"starts\[0\]\.height", ("a", math.nan, True, [0.1], {}), lambda v: TWIN().worlds(2).reset({"height": v})),
])  # fmt: skip
def test_a_wrong_argument_of_a_twin_is_named(name, wrong, call):
    for value in wrong:
        with pytest.raises(ConfigError, match=rf"^{name}: expected") as told:
            call(value)
        assert "found" in str(told.value)


def test_an_unknown_part_of_a_start_is_named_with_the_nearest():
    with pytest.raises(ConfigError, match=r"^starts\[1\]\.heigth: .* nearest is starts\[1\]\.he"):
        TWIN().worlds(2).reset([{}, {"heigth": 1.0}])


def test_a_list_of_one_start_for_two_worlds_is_told_from_a_start_for_all():
    """A list of one was told to be "one, or 2", and found to be 1."""
    with pytest.raises(ConfigError, match=r"expected one mapping .*list of 2.* found a list of 1$"):
        TWIN().worlds(2).reset([{"height": 1.0}])


def test_a_state_that_is_inside_out_is_refused_where_the_law_has_no_such():
    made = twin()
    made.body.law_options = made.body.law_options.but(on_inversion="error")
    now = made.reset()
    made.state = now
    with pytest.raises(ConfigError, match=r"^state\.F: expected det F > 0"):
        made.state = replace(now, F=-now.F)


GRID = {"dx": 0.05, "substeps": 40, "frame_dt": 1 / 30}


@pytest.mark.parametrize("name, wrong", [
    ("law", (5, None, True, [], 1.0)), ("dx", (0, -1, math.nan, "a", True)), ("substeps", (0, 2.5, "a", True, 10**9)),
    ("frame_dt", (0, -1, math.inf, "a", None)), ("energetic", ("foo", 5, None, [], "")),
    ("gravity", ("abc", (0, 1), (0, math.nan, 0), 5, None, (0, 1e9, 0))),
    ("up", ("abc", (0, 1), (0, math.nan, 0), 5, [[0, 1, 0]], (0, 0, 0))), ("ground", (5, "sticky", {}, True, [0.0])),
    (r"ground\.height", (Ground("a"), Ground(math.nan), Ground(True), Ground(10**400), Ground(None))),
    (r"ground\.friction", (Ground(0.0, "separate", "a"), Ground(0.0, "touch", -1), Ground(0.0, "touch", math.nan))),
    ("planes", (5, [5], "ab", {}, [None])), ("colliders", (5, [5], "ab", [{"type": "sphere"}], [None])),
    ("box", (5, "ab", [[0, 0, 0]], [[1, 1, 1], [0, 2, 2]], torch.full((2, 3), math.nan))),
    ("options", (5, None, {}, "a", True)), ("device", ("foo", "cuda:99", 5, None, "")),
])  # fmt: skip
def test_a_wrong_argument_of_a_simulator_is_named(name, wrong):
    key = "ground" if isinstance(wrong[0], Ground) else name
    for value in wrong:
        with pytest.raises(ConfigError, match=f"^{name}: expected"):
            Simulator(**{"law": "neo_hookean", **GRID, key: value})


def rolled(count=4, volume=1e-6, density=1000.0, mu=1e4, ground=0.0, **keys):
    made = Simulator("corotated", ground=Ground(ground), **GRID)
    F, x = torch.eye(3).repeat(count, 1, 1), torch.rand(count, 3) + 0.1
    given = {"state": ParticleState(x=x, v=0 * x, C_affine=0 * F, F=F, F_tot=F)}
    given |= {
        "volume": torch.full((count,), 1e-6),
        "parameters": {"mu": mu, "lam": 1e4},
        "frames": 2,
    }
    given["volume"][:1] = volume
    return made.rollout(**given | {"density": density} | keys)


@pytest.mark.parametrize("keys, message", [
    ({"frames": 2.5}, "frames: "), ({"frames": 0}, "frames: "), ({"frames": "a"}, "frames: "), ({"frames": True}, "frames: "),
    ({"stride": 0}, "stride: "), ({"stride": 1.5}, "stride: "), ({"started": 1}, "started: "),
    ({"start_time": math.nan}, "start_time: "),
    ({"count": 0}, "x: expected one particle"), ({"volume": math.inf}, "volume: "), ({"volume": 0.0}, "volume: "),
    ({"volume": math.nan}, "volume: "), ({"volume": -1.0}, "volume: "), ({"density": math.inf}, "density: "),
    ({"density": "a"}, "density: "), ({"density": None}, "density: "), ({"density": True}, "density: "),
    ({"density": [1e3] * 4}, "density: "), ({"density": -1}, "density: "),
    ({"mu": "a"}, r"parameters\.mu: "), ({"mu": None}, r"parameters\.mu: "), ({"mu": 1j}, r"parameters\.mu: "),
    ({"mu": math.nan}, r"parameters\.mu: "), ({"mu": True}, r"parameters\.mu: "), ({"parameters": 5}, "parameters: "),
    ({"state": 5}, "state: "), ({"state": None}, "state: "), ({"state": ParticleState(*[[0.0]] * 5)}, "state: "),
    ({"timing": 5}, "timing: "), ({"motions": 5}, "motions: "), ({"held": 5}, "held: "), ({"adapter": 5}, "adapter: "),
    ({"progress": 5}, "progress: "), ({"collect": "a"}, "collect: "),
    ({"collect": print, "adapter": print}, "collect: "), ({"collect": print, "adapter": [print]}, "collect: "),
    ({"ground": 2.0}, "x: expected a body above the ground"), ({"ground": 1.11}, "x: expected a body above"),
])  # fmt: skip
def test_a_wrong_argument_of_a_rollout_is_named(keys, message):
    with pytest.raises(ConfigError, match=f"^{message}"):
        rolled(**keys)


@pytest.mark.parametrize("answer, found", [
    (lambda w: None, "found None"), (lambda w: "Gh", "found 'Gh'"), (lambda w: {"G": 0, "h": 0}, "found {'G'"),
    (lambda w: (1, 2, 3, 4, 5), "found \\(1, 2"), (lambda w: torch.zeros(2), "found Tensor"),
])  # fmt: skip
@pytest.mark.parametrize("stride", [1, None])
def test_an_adapter_that_answers_with_something_else_is_named(answer, found, stride):
    with pytest.raises(ConfigError, match=f"^adapter: expected it to answer .G, h. .*{found}"):
        rolled(adapter=lambda state: answer(state.w), stride=stride)


@pytest.mark.parametrize("part", [lambda t: 0.0, lambda t: t.to("meta"), lambda t: t.to_sparse()])
def test_a_part_of_an_adapter_s_answer_is_a_dense_tensor(part):
    with pytest.raises(ConfigError, match=r"^adapter output G: expected shape"):
        rolled(adapter=lambda s: (part(torch.zeros(len(s.w), 6, 6)), torch.zeros(len(s.w), 6)))


def test_a_simulator_s_parameters_and_dtype_are_named():
    made = Simulator("corotated", **GRID)
    for wrong, named in (([1, 2], "parameters"), ("mu", "parameters")):
        with pytest.raises(ConfigError, match=f"^{named}: expected"):
            made.pack(wrong, 4)
    for count in (-1, "a", 2.5, True):
        with pytest.raises(ConfigError, match=r"^particles: expected a whole number"):
            made.pack({"mu": 1.0, "lam": 1.0}, count)
    for dtype in ([1], "float64", torch.float16, float):
        with pytest.raises(ConfigError, match=r"^dtype: expected torch.float32 or torch.float64"):
            Simulator("corotated", **GRID, dtype=dtype)


def test_another_body_s_motion_and_what_no_video_or_law_has_are_named(tmp_path):
    other = replace(MOTION(), x=MOTION().x[:, :27])
    for call in (lambda: TWIN().render(other), lambda: TWIN().export(other, tmp_path)):
        with pytest.raises(
            ConfigError, match=r"^rollout: expected one of this body's \d+ particles, found Rollout"
        ):
            call()
    for fps in (0, -5, math.nan):
        with pytest.raises(ConfigError, match=r"^fps: expected a number above 0"):
            TWIN().export(MOTION(), tmp_path, fps=fps)
    with pytest.raises(ConfigError, match=r"^law: expected a text, or null, found 5"):
        twin().material.set(law=5)
    with pytest.raises(ConfigError, match=r"^density: expected a number of at least 0.1"):
        twin().material.density = "7800"
    numbers = len(read_numbers(TWIN().body))
    with pytest.raises(ConfigError, match=r"^laws: expected .* finite numbers within 100"):
        TWIN().worlds(2, torch.full((2, numbers), 1e5))

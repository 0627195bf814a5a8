"""The tasks as Gymnasium environments: its own checker, seeds, vectors of worlds, and a library that learns in them."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from mosa.environments.tasks import TASKS
from mosa.errors import ConfigError
from tests.environments.test_environments import SHORT, arena, simulator

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from mosa.environments import gymnasium_api  # noqa: E402
from mosa.environments.gymnasium_api import TwinEnv, TwinVectorEnv  # noqa: E402

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def a_small_body(monkeypatch):
    monkeypatch.setattr(gymnasium_api, "simulator_named", lambda *a, **k: simulator())


def options(name):
    return {"steps": SHORT[name]}


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.filterwarnings(
    "ignore:.*A Box observation space.*",
    "ignore:.*alternative render modes.*",
    "ignore:.*not within.*",
)
def test_the_checker_of_gymnasium_is_content(name):
    env = gymnasium.make(
        f"mosa/{name.capitalize()}-v0", options=options(name), disable_env_checker=True
    )
    check_env(env.unwrapped, skip_render_check=True)
    env.reset(seed=1)
    _, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert reward < 0 and set(info) == {"success", "diverged"}
    assert (terminated, truncated) == (True, False)


@pytest.mark.parametrize("name", TASKS)
def test_the_same_seed_is_the_same_episode(name):
    env = TwinEnv(name, options=options(name))
    runs = []
    for seed in (5, 5, 6):
        seen, _ = env.reset(seed=seed)
        after, reward, *_ = env.step(np.full(env.action_space.shape, 0.3, np.float32))
        runs.append(np.concatenate([seen, after, [reward]]))
    assert np.array_equal(runs[0], runs[1]) and not np.array_equal(runs[0], runs[2])
    follow = [env.reset()[0] for _ in range(2)]
    assert not np.array_equal(*follow)


def test_options_of_a_reset_are_refused_as_they_would_change_nothing():
    for env in (
        TwinEnv("placement", options=options("placement")),
        TwinVectorEnv("placement", 2, options=options("placement")),
    ):
        env.reset(options={})
        with pytest.raises(ConfigError, match=r"^options: expected none, .* found height$"):
            env.reset(options={"height": 0.3})


def test_what_is_drawn_is_what_is_seen_or_held():
    env = TwinEnv("placement", options=options("placement"), render_mode="rgb_array", size=40)
    env.reset(seed=0)
    before = env.render()
    env.step(np.zeros(4, np.float32))
    assert (
        before.shape == (40, 40, 3)
        and before.dtype == np.uint8
        and not np.array_equal(before, env.render())
    )
    env = TwinEnv("placement", options={"steps": 2}, render_mode="rgb_array_list", size=40)
    env.reset(seed=0)
    env.step(np.ones(4, np.float32))
    assert len(env.render()) == 3
    with pytest.raises(Exception, match="render_mode: expected rgb_array or rgb_array_list"):
        TwinEnv("placement", render_mode="human")


@pytest.mark.parametrize("name", TASKS)
def test_a_vector_of_worlds_is_its_trials(name):
    """Episodes end together; what an ended one saw last is in info, and new trials have begun."""
    env = gymnasium.make_vec(f"mosa/{name.capitalize()}-v0", num_envs=3, options=options(name))
    assert (
        isinstance(env.unwrapped, TwinVectorEnv)
        and env.unwrapped.single_action_space.shape == env.action_space.shape[1:]
    )
    first, _ = env.reset(seed=3)
    assert first.shape == env.observation_space.shape and env.observation_space.contains(first)
    again, _ = env.reset(seed=3)
    assert np.array_equal(first, again) and len({tuple(row) for row in first.tolist()}) > 1
    action = np.full(env.action_space.shape, 0.2, np.float32)
    seen, rewards, terminated, truncated, info = env.step(action)
    assert rewards.shape == (3,) and (rewards < 0).all()
    assert terminated.all() and not truncated.any()
    assert np.array_equal(np.stack(info["final_obs"]), first)
    assert info["final_info"]["success"].shape == (3,) and not np.array_equal(first, seen)
    assert np.allclose(seen, env.unwrapped.arena.trials.observed.numpy(), atol=1e-6)


def test_the_task_of_the_page_is_a_task():
    """The class of docs/environments.md, in one world and in several."""
    blocks = re.findall(
        r"```python\n(.*?)```", (ROOT / "docs" / "environments.md").read_text(), re.S
    )
    names = {"TwinVectorEnv": TwinVectorEnv}
    exec(next(block for block in blocks if "class Land(Task)" in block), names)
    worlds, rewards = names["worlds"], names["rewards"]
    assert (
        rewards.shape == (4,) and (rewards < 0).all() and worlds.task.extents == (0.1, 0.08, 0.06)
    )
    assert [q.name for q in worlds.task.observations] == ["height", "mark x", "mark z"]
    assert worlds.task.solids()[0]["name"] == "post"
    env = TwinEnv(names["Land"](near=10.0), options={"steps": 30})
    env.reset(seed=0)
    *_, info = env.step(np.zeros(4, np.float32))
    assert info["success"] and env.task.steps == 30
    with pytest.raises(
        ConfigError, match=r"task: expected placement or hanging.*, or a Task, found"
    ):
        TwinEnv(names["Land"])


def test_worlds_have_materials_of_their_own():
    """Soft and stiff bodies are let go alike and end elsewhere; one law for all is the twin's."""
    ends = {}
    for name, laws in (("own", [{"E": 2e4}, {"E": 2e5}]), ("alike", None)):
        worlds = TwinVectorEnv("placement", 2, options={"steps": 20}, laws=laws)
        worlds.reset(seed=0)
        trials = worlds.arena.trials
        worlds.arena.reset(
            type(trials)(*(each[:1].expand_as(each) for each in (trials.observed, trials.hidden)))
        )
        worlds.step(np.zeros((2, 4), np.float32))
        ends[name] = worlds.arena.view.center
    assert torch.equal(ends["alike"][0], ends["alike"][1])
    assert (ends["own"][0] - ends["own"][1]).norm() > 1e-4


def test_a_reward_is_minus_the_loss():
    env = TwinVectorEnv("placement", 2, options=options("placement"))
    env.reset(seed=0)
    trials = env.arena.trials
    _, rewards, *_ = env.step(np.full((2, 4), 0.1, np.float32))
    made = arena("placement", 2)
    made.reset(trials)
    made.act(torch.full((2, 4), 0.1))
    np.testing.assert_allclose(rewards, -made.loss().numpy(), rtol=1e-4)


@pytest.mark.parametrize("name, wrong", [
    ("render_mode", ("human", 5, True, [], "")), ("size", (0, 2.5, "a", True, 10**6)),
    ("worlds", (0, 2.5, "a", True, 10**12)), ("options", (5, "a", [], True, 1.0)),
])  # fmt: skip
def test_a_wrong_argument_of_an_environment_is_named(name, wrong):
    for value in wrong:
        with pytest.raises(ConfigError, match=f"^{name}: expected"):
            make = TwinVectorEnv if name == "worlds" else TwinEnv
            make("placement", **{"simulator": "truth", "scene": "tiny", name: value})


def test_calls_out_of_turn_and_wrong_actions_and_seeds_are_named():
    env = TwinEnv(
        "placement", simulator="truth", scene="tiny", spacing=0.03, render_mode="rgb_array"
    )
    for call in (lambda: env.step(np.zeros(4, np.float32)), env.render):
        with pytest.raises(ConfigError, match=r"expected reset\(\) before step and render"):
            call()
    for seed in (-1, 2.5, "a", True, 2**40):
        with pytest.raises(ConfigError, match=r"^seed: expected a whole number"):
            env.reset(seed=seed)
    env.reset(seed=0)
    nan = np.full(4, np.nan)
    with pytest.raises(ConfigError, match=r"expected \(4,\) finite numbers, found shape \(1, 4\)"):
        env.step(np.zeros((1, 4)))
    for action in (
        np.zeros(3),
        np.zeros((1, 4)),
        "a",
        None,
        5,
        [0, 0, 0, "a"],
        nan,
        np.zeros(4, bool),
        np.zeros(4, complex),
        [[1], 2],
    ):
        with pytest.raises(ConfigError, match=r"^action: expected \(4,\) finite numbers"):
            env.step(action)


def test_an_episode_ends_with_its_step_and_takes_actions_of_torch_too():
    env, rewards = TwinEnv("placement", options=options("placement")), []
    for action in (np.full(4, 0.3), torch.full((4,), 0.3), [0.3] * 4, np.full(4, 9.0), np.ones(4)):
        env.reset(seed=1)
        rewards.append(env.step(action)[1])
        with pytest.raises(ConfigError, match=r"expected reset\(\) after an episode's end"):
            env.step(action)
    assert rewards[0] == pytest.approx(rewards[1]) == pytest.approx(rewards[2])
    assert rewards[3] == rewards[4] != rewards[0]  # beyond 1 is 1


def test_a_task_takes_as_many_substeps_as_it_is_told():
    env = TwinEnv("placement", options={"steps": 2, "substeps": 48})
    env.reset(seed=0)
    env.step(np.zeros(4))
    assert env.arena.worlds.episode.substeps == 48


@pytest.mark.parametrize("change, said", [
    ({"miss": lambda *a: torch.tensor(1.0)}, r"task land: miss: .* numbers \(2,\), found shape \(\)"),
    ({"miss": lambda self, t, view: view.center}, r"miss: .* \(2,\), found shape \(2, 3\)"),
    ({"miss": lambda *a: torch.tensor([0.0, -2.0])}, "miss: expected 0 or more, found -2"),
    ({"miss": lambda *a: torch.full((2,), torch.nan)}, "miss: expected finite numbers"),
    ({"succeeded": lambda *a: True}, r"succeeded: expected \(2,\) flags, found torch.bool \(\)"),
    ({"succeeded": lambda *a: torch.ones(2)}, r"succeeded: expected \(2,\) flags, found torch.fl"),
    ({"release": lambda self, t, g, time: (g[:, :3], g[:, 2:4])}, r"release: .* \(2, 2\), found shape"),
    ({"near": "5 cm"}, "options.near: expected a number, found '5 cm'"),
    ({"steps": 2.5}, "options.steps: expected a whole number"),
])  # fmt: skip
def test_a_task_s_own_mistake_is_named(change, said):
    page = (ROOT / "docs" / "environments.md").read_text()
    names = {"TwinVectorEnv": lambda *a, **k: TwinVectorEnv(*a, **k)}
    block = next(b for b in re.findall(r"```python\n(.*?)```", page, re.S) if "class Land" in b)
    exec(block.partition("\nworlds =")[0], names)
    values = {key: change[key] for key in ("near", "steps") if key in change}
    methods = {key: value for key, value in change.items() if key not in values}
    kind = type("Own", (names["Land"],), methods)
    with pytest.raises(ConfigError, match=said):
        worlds = TwinVectorEnv(kind(**{"steps": 2, **values}), 2)
        worlds.reset(seed=0)
        worlds.step(worlds.action_space.sample())
    with pytest.raises(ConfigError, match=r"options.nier: unknown key; .* nearest is options.near"):
        TwinVectorEnv(names["Land"](), 2, options={"nier": 0.1})

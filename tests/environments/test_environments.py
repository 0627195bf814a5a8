"""Tasks on a body of 120 particles: what success is, trials in many worlds, the search by gradients, the table, and the truth as a
twin."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from small_bodies import small_body, start

from mosa.config.leaf_settings import EnvironmentsSettings
from mosa.data.synthetic.bodies.objects import object_named
from mosa.data.synthetic.drop import simulate
from mosa.data.synthetic.films import built
from mosa.environments import arena as arenas
from mosa.environments import command, policies, study
from mosa.environments.arena import (
    LOST,
    Arena,
    Simulator,
    play,
    play_all,
    simulator_named,
    world_of,
)
from mosa.environments.pictures import film
from mosa.environments.policies import LinearPolicy, Search, by_gradient, by_model
from mosa.environments.study import Bench
from mosa.environments.task import CLEARANCE, View
from mosa.environments.tasks import TASKS, task_named
from mosa.environments.truth import true_twin
from mosa.errors import ConfigError, DataError, SimulationDiverged
from mosa.physics.contact.colliders import Collider, Sphere
from mosa.physics.contact.driven import Driven
from mosa.physics.world import World
from mosa.settings import node_of
from mosa.twin.twin import Twin
from mosa.types import Ground

WORLD = World(Ground(0.0, "sticky"), torch.tensor([0.0, -9.8, 0.0]), torch.tensor([0.0, 1.0, 0.0]),
              torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))  # fmt: skip
SHORT = {"placement": 8, "hanging": 8}


def simulator(name="learned", E=6e4, precision=32):
    body = small_body(precision=precision, contact=True, adapter=False, E=E)
    dtype = torch.float64 if precision == 64 else torch.float32
    return Simulator(name, Twin(body, WORLD, 1 / 60, None, start(dtype=dtype)))


def arena(task="placement", worlds=3, steps=None, precision=32, **options):
    made = simulator(precision=precision)
    return Arena(
        made, task_named(task, made.twin.body.rest, steps=steps or SHORT[task], **options), worlds
    )


def drawn(made, count, seed=0):
    return made.task.draw(count, torch.Generator().manual_seed(seed))


def test_the_truth_is_what_the_films_show(tmp_path):
    """Also of a drop that was not for training, and in two worlds."""
    film_of, sequence = object_named("tiny"), "test_60"
    surface, particles, _ = built(film_of.shape, film_of.pitch, film_of.spacing, 0)
    drops = film_of.drops
    fall = simulate(
        film_of, film_of.material, particles, surface.vertices, drops[sequence], drops["train"]
    )
    twin = true_twin("tiny", sequence)
    np.testing.assert_allclose(twin.body.rest.numpy(), fall.rest, atol=1e-6)
    worlds = twin.worlds(2)
    worlds.reset(substeps=fall.substeps)
    for _ in range(1, film_of.footage.frames):
        state, _ = worlds.step()
    assert np.abs(fall.positions[-1] - fall.positions[0])[:, 1].min() > 0.02
    for b in range(2):
        np.testing.assert_allclose(state.positions[b].numpy(), fall.positions[-1], atol=2e-6)
    again = twin.simulate(variant="prior", frames=film_of.footage.frames)
    np.testing.assert_allclose(again.x[-1].numpy(), fall.positions[-1], atol=2e-3)  # other substeps
    other = true_twin("tiny", material="isotropic", spacing=0.02)
    assert (
        len(other.body.rest) < 0.5 * len(twin.body.rest)
        and float(other.body.material.true_kf.abs().max()) == 0
    )
    with pytest.raises(ConfigError, match=r"scene\.name: expected one of the built-in"):
        true_twin("unicorn")
    for call in (
        twin.summary, lambda: print(twin.material), lambda: twin.material.E, lambda: twin.export_material(tmp_path / "none"),
        lambda: twin.worlds(2, laws=[{"E": 1e4}, {}]), lambda: twin.worlds(2, laws=torch.zeros(2, 2)),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=r"^material: .* the truth, whose law is hidden"):
            call()
    assert not (tmp_path / "none").exists()
    assert repr(twin).startswith("TrueTwin(Body(2006 particles")


@pytest.mark.parametrize("name", TASKS)
def test_the_sizes_follow_from_the_body_and_numbers_have_units(name):
    task = task_named(name, torch.tensor([[0.0, 0, 0], [0.2, 0.24, 0.16]]))
    double = task_named(name, torch.tensor([[0.0, 0, 0], [0.4, 0.48, 0.32]]))
    assert [s["name"] for s in task.solids()] == [s["name"] for s in double.solids()] != []
    for quantity in (*task.actions, *task.observations, *task.drawn[0], *task.drawn[1]):
        assert quantity.unit in ("m", "rad", "m/s", "rad/s", "1") and quantity.low < quantity.high
    low, high = (
        task.physical(-torch.ones(1, len(task.actions))),
        task.physical(torch.ones(1, len(task.actions))),
    )
    assert low[0].tolist() == pytest.approx([q.low for q in task.actions])
    assert high[0].tolist() == pytest.approx([q.high for q in task.actions])
    a, b = (task.draw(5, torch.Generator().manual_seed(s)) for s in (1, 2))
    assert not torch.equal(a.observed, b.observed)
    assert torch.equal(a.observed, task.draw(5, torch.Generator().manual_seed(1)).observed)
    with pytest.raises(ConfigError, match=r"up = \[0, 1, 0\]"):
        task.world(replace(WORLD, up=torch.tensor([0.0, 0.0, 1.0])))
    clamped = replace(WORLD, driven=(Driven([0]),), colliders=(Collider(Sphere(0.1)),))
    assert task.world(clamped).solids == ()
    with pytest.raises(ConfigError, match="task: expected placement or hanging, or a Task, found"):
        task_named("juggling", torch.zeros(2, 3))


def view(task, center=(0.0, 0.0, 0.0), lean=0.0, lowest=0.0, speed=0.0):
    up = torch.tensor([[np.sin(lean), np.cos(lean), 0.0]]).float()
    moved = torch.tensor([[speed, 0.0, 0.0]])
    return View(torch.tensor([center]), moved, up, torch.tensor([lowest]))


def test_success_is_what_the_task_says_and_the_loss_falls_towards_it():
    rest = torch.tensor([[0.0, 0, 0], [0.2, 0.24, 0.16]])
    placement, hanging = (task_named(name, rest) for name in TASKS)
    nothing = {task.name: task.draw(1, torch.Generator()) for task in (placement, hanging)}
    top, grip = placement.top, hanging.grip
    good = {placement: {"center": (0.01, top + 0.1, 0.0), "lowest": top},
            hanging: {"center": (0.01, grip - 0.02, 0.0), "lowest": grip - 0.15}}  # fmt: skip
    bad = {
        placement: ({"center": (0.08, top + 0.1, 0.0)}, {"lean": 0.6}, {"lowest": 0.0}, {"speed": 0.5}),
        hanging: ({"center": (0.04, grip, 0.0)}, {"center": (0.0, grip - 0.04, 0.0)}, {"lowest": 0.02}, {"speed": 0.5})
    }  # fmt: skip
    for task, values in good.items():
        trials, fine = nothing[task.name], view(task, **values)
        assert bool(task.succeeded(trials, fine))
        for worse in bad[task]:
            wrong = view(task, **{**values, **worse})
            assert not bool(task.succeeded(trials, wrong)), (task.name, worse)
        farther = view(
            task,
            **{
                **values,
                "center": tuple(c + d for c, d in zip(values["center"], (0.3, -0.1, 0.1))),
            },
        )
        assert float(task.loss(trials, farther)) > float(task.loss(trials, fine)) + 1


def test_a_hand_reaches_its_aim_in_free_fall():
    made = arena("hanging", worlds=4, steps=1)
    trials, action = drawn(made, 4), torch.tensor([[0.5, -0.5, 0.4, -0.8, 0.2]]).repeat(4, 1)
    action[1:3, 4] = torch.tensor([-1.0, 1.0])  # let go at rest, thrown as hard as may be
    starts = made.task.starts(trials, action, made.rest, made.gravity)
    made.reset(trials)
    made.act(action)
    told = made.task.physical(action) + trials.hidden
    upright = made.rest @ made.task.held.float().T
    for b, begun in enumerate(starts):
        down, high = float(told[b, 4].clamp_min(0)), float(trials.observed[b, 0] - CLEARANCE)
        time = float(np.roots([0.5 * made.gravity, down, -high]).max())
        assert float(begun["velocity"][1]) == pytest.approx(-down - made.gravity * time, rel=1e-5)
        flown = trials.observed[b, 1:3] + time * begun["velocity"][[0, 2]]
        torch.testing.assert_close(flown, told[b, 2:4], atol=1e-6, rtol=0)
        turned = made.rest @ begun["rotation"].T
        assert float((turned - upright).norm(dim=1).max()) > 0.01
    first = made.worlds.reset(starts, colliders=made.task.solids(), control_dt=made.task.control_dt)
    torch.testing.assert_close(
        first.positions[..., 1].amin(1),
        torch.full((4,), made.task.top + CLEARANCE),
        atol=1e-6,
        rtol=0,
    )


@pytest.mark.parametrize("answer", [torch.zeros(3, 3), torch.zeros(4), torch.zeros(4, 4), None,
                                    torch.full((3, 4), torch.nan)])  # fmt: skip
def test_a_policy_that_answers_with_another_shape_is_named(answer):
    made = arena("placement", 3, steps=1)
    with pytest.raises(ConfigError, match=r"^action: expected \(3, 4\) finite numbers, found"):
        play(made, drawn(made, 3), lambda observed: answer)


@pytest.mark.parametrize("name", TASKS)
def test_every_trial_is_its_own_world(name):
    """The same trials in three worlds and in one at a time; the recorded motion ends where the view is."""
    many, alone = arena(name, 3), arena(name, 1)
    trials, policy = drawn(many, 3), LinearPolicy(many.task)
    together, apart = (
        play(many, trials, policy, record=True),
        [play(alone, trials.select([b]), policy) for b in range(3)],
    )
    torch.testing.assert_close(
        together.loss, torch.cat([p.loss for p in apart]), rtol=1e-4, atol=1e-5
    )
    assert (
        together.success.tolist() == [bool(p.success) for p in apart]
        and not together.diverged.any()
    )
    x, F, places = together.states
    assert x.shape[:2] == (many.task.steps + 1, 3) and F.shape == (*x.shape, 3)
    assert places.shape == (*x.shape[:2], len(many.task.solids()), 3, 4)
    torch.testing.assert_close(x[-1][..., 1].amin(1), many.view.lowest)
    losses, _ = play_all(many, drawn(many, 5), policy)  # more than there are worlds
    assert losses.shape == (5,)


@pytest.mark.parametrize("name", ["placement", "hanging"])
def test_gradients_of_the_loss_reach_the_policy(name):
    """Against central differences, in float64."""
    made = arena(name, 2, steps=12, precision=64)
    trials, policy = drawn(made, 2, seed=3), LinearPolicy(made.task).double()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter += 0.1 * torch.randn(parameter.shape, generator=generator)
    played = play(made, trials, policy, differentiable=True)
    found = torch.autograd.grad(played.loss.sum(), list(policy.parameters()))
    assert all(float(g.abs().max()) > 1e-4 for g in found)
    direction = [torch.randn(g.shape, generator=generator) for g in found]
    kept, sides, step = [p.detach().clone() for p in policy.parameters()], [], 1e-5
    for side in (step, -step):
        with torch.no_grad():
            for parameter, value, d in zip(policy.parameters(), kept, direction):
                parameter.copy_(value + side * d)
        sides.append(float(play(made, trials, policy).loss.sum()))
    slope = (sides[0] - sides[1]) / (2 * step)
    assert sum(float((g * d).sum()) for g, d in zip(found, direction)) == pytest.approx(
        slope, rel=1e-3
    )


def test_descent_through_the_simulator_lowers_the_loss():
    train, check = arena("placement", 2), arena("placement", 2)
    found = by_gradient(
        train, check, Search(iterations=4, batch=2, rate=0.05, every=4, validation=2), seed=0
    )
    losses = [entry["loss"] for entry in found.history]
    assert len(losses) == 2 and losses[1] < losses[0] - 0.1 and found.trials == 4 * 2 + 2 * 2
    validation = check.task.draw(2, torch.Generator().manual_seed(10**6))
    kept, _ = play_all(check, validation, LinearPolicy.read(check.task, found.policy.written()))
    assert float(kept.mean()) == pytest.approx(min(losses))
    said = []
    still = Search(iterations=2, batch=2, rate=1e-12, every=1, validation=2)
    by_gradient(train, check, still, seed=0, say=said.append)
    assert "policy that the search began from, which is kept" in said[-1]
    with pytest.raises(DataError, match="policy: expected the numbers of a policy for placement"):
        LinearPolicy.read(check.task, {"weight": [[1.0]]})


def test_the_jaws_of_the_tower_close_about_what_is_between_them():
    """A body that is there when they close is held, and one that is not goes on."""
    made = arena(
        "hanging",
        worlds=2,
        steps=20,
        shut=0,
        closing=3,
        close=0.0,
        far=0.0,
        aside=0.0,
        grip=0.1,
        free=0.01,
        squeeze=0.4,
    )
    played = []
    for before in (0.0, 0.3):
        object.__setattr__(made.task, "before", before)
        trials = drawn(made, 2)
        played.append(
            play(
                made,
                trials,
                lambda _: torch.tensor([[0.0, 0, 0, 0, -1.0]]).repeat(2, 1),
                record=True,
            )
        )
    apart = [
        shown.states[2][:, 0, 1, 2, 3] - shown.states[2][:, 0, 0, 2, 3] - made.task.JAW[2]
        for shown in played
    ]
    wide = made.task.extents[2]
    for faces in apart:
        assert float(faces[0]) == pytest.approx(wide + 2 * made.task.OPEN, abs=1e-6)
        torch.testing.assert_close(
            faces[3:].float(), torch.full((18,), 0.6 * wide), atol=1e-6, rtol=0
        )
    moved = [(shown.states[0][-1] - shown.states[0][-2]).mean(1).norm(dim=1) for shown in played]
    assert float(moved[0].max()) < 1e-3 and float(moved[1].min()) > 1e-2, moved
    shots = [film(made, (x[-1:], F[-1:], places[[k]]), 0, 1, size=96)[0].astype(float) for x, F, places in [played[1].states]
             for k in (0, -1)]  # fmt: skip
    assert np.abs(shots[0] - shots[1]).mean() > 0.5  # pictures show them where they are


def test_a_model_of_what_was_tried_leads(monkeypatch):
    monkeypatch.setattr(policies, "FITTED", 150)
    monkeypatch.setattr(policies, "DESCENDED", 100)
    search = Search(iterations=2, batch=6, every=2, validation=4, candidates=4, spread=0.5)
    train, check = arena("hanging", 24), arena("hanging", 4)
    found = by_model(train, check, search, seed=0)
    losses = [entry["loss"] for entry in found.history]
    assert losses[-1] < losses[0] - 0.2 and found.trials == 2 * 24 + 2 * 4
    again = by_model(train, check, search, seed=0)
    assert again.history == found.history


def test_a_trial_that_diverges_is_lost_and_the_others_go_on(monkeypatch):
    made = arena("placement", 3)
    trials, policy = drawn(made, 3), LinearPolicy(made.task)
    whole = play(made, trials, policy)
    step, calls = made.worlds.step, []

    def failing(command):
        calls.append(0)
        if len(calls) == 4:
            raise SimulationDiverged("world 1: substep 3, particle 5: position is outside the box")
        return step(command)

    monkeypatch.setattr(made.worlds, "step", failing)
    lost = play(made, trials, policy)
    assert (
        lost.diverged.tolist() == [False, True, False]
        and float(lost.loss[1]) == LOST
        and not bool(lost.success[1])
    )
    torch.testing.assert_close(lost.loss[[0, 2]], whole.loss[[0, 2]], rtol=1e-5, atol=1e-6)
    assert world_of(SimulationDiverged("substep 3")) is None
    calls.clear()

    def always(command):
        raise SimulationDiverged("world 0: no")

    monkeypatch.setattr(made.worlds, "step", always)
    with pytest.raises(SimulationDiverged):
        play(made, trials, policy)


def test_a_simulator_is_named_and_what_is_missing_is_said():
    truth = simulator_named("truth", scene="tiny", spacing=0.03)
    assert truth.variant == "adapted" and len(truth.twin.body.rest) < 300
    for name, given, message in (("real", {}, "simulator: expected learned or isotropic or truth"),
                                 ("learned", {"scene": "tiny"}, "checkpoint: expected a run's checkpoint for simulator=learned"),
                                 ("truth", {}, "or truth.scene=<a built-in scene>")):  # fmt: skip
        with pytest.raises(ConfigError, match=message):
            simulator_named(name, **given)


def small_bench(tmp_path, monkeypatch, **changes):
    """A study of which no simulator comes from a file: the truth is softer than what was learned."""
    search = Search(iterations=1, batch=2, rate=0.1, every=1, validation=2)
    values = {"search": search, "trials": 3, "worlds": 2, "options": {"steps": 4}, "truth": {"scene": "tiny"}}  # fmt: skip
    made = {
        "learned": simulator(),
        "isotropic": simulator("isotropic", E=1.2e5),
        "truth": simulator("truth", E=3e4),
    }
    monkeypatch.setattr(study, "simulator_named", lambda name, *a, **k: made[name])
    return Bench(EnvironmentsSettings.read({**values, **changes}))


def test_the_table_is_made_once_and_resumed(tmp_path, monkeypatch):
    bench = small_bench(tmp_path, monkeypatch)
    page = study.table(bench, ["learned", "isotropic", "truth"], [0], tmp_path)
    text, jobs = page.read_text(), sorted(p.name for p in (tmp_path / "jobs").iterdir())
    assert jobs == [
        f"placement_{name}_0.json" for name in ("isotropic", "learned", "none", "truth")
    ]
    assert all(f"\n| {name} " in text for name in ("none", "learned", "isotropic", "truth"))
    rows = (tmp_path / "placement.csv").read_text().splitlines()
    assert rows[0] == "task,trained_in,seed,tested_in,trial,success,loss" and len(rows) == 1 + 3 * (
        1 + 2 + 2 + 1
    )
    assert (tmp_path / "placement_trial_0.png").stat().st_size > 5000
    kept = json.loads((tmp_path / "jobs" / "placement_learned_0.json").read_text())
    tested = study.test(bench, "truth", LinearPolicy.read(bench.task("truth"), kept["policy"]))
    assert tested == kept["truth"] and kept["own"] != kept["truth"]

    monkeypatch.setattr(study, "_record", lambda *a: pytest.fail("made again"))
    monkeypatch.setattr(study, "films", lambda *a: [])
    assert study.table(bench, ["learned", "isotropic", "truth"], [0], tmp_path).read_text() == text
    other = small_bench(tmp_path, monkeypatch, trials=2)
    with pytest.raises(
        DataError,
        match=r"placement_none_0.json: expected a job of the same setting, found trials=3 instead of 2",
    ):
        study.table(other, ["learned"], [0], tmp_path)


def test_the_command_takes_its_configuration(tmp_path, monkeypatch):
    values = node_of(EnvironmentsSettings)
    setting = command.setting_of(values)
    assert (
        setting.worlds == command.AT_A_TIME and setting.search == Search() and setting.trials == 100
    )
    for change, message in (({"task": "juggling"}, "task: expected placement or"), ({"trials": 0}, "trials: expected a whole"),
                            ({"policy": "magic"}, "policy: expected gradient or model"),
                            ({"options": {"nearr": 1.0}}, "options.nearr: unknown key; expected one of steps"),
                            ({"search": {**values["search"], "rat": 1}}, "search.rat: unknown key")):  # fmt: skip
        with pytest.raises(ConfigError, match=message):
            command.setting_of({**values, **change})


def test_the_command_takes_the_task_of_an_extension(tmp_path, monkeypatch):
    (tmp_path / "own_tasks.py").write_text(
        "from dataclasses import dataclass\nfrom mosa.environments.tasks import Placement\n\n\n"
        "@dataclass(frozen=True)\nclass Far(Placement):\n    name = 'far_away'\n    aim: float = 0.3\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    values = node_of(EnvironmentsSettings) | {"task": "far_away"}
    with pytest.raises(ConfigError, match=r"task: expected placement or .*, found 'far_away'"):
        command.setting_of(values)
    command.setting_of(values | {"extensions": ["own_tasks"]})
    assert TASKS.pop("far_away").aim == 0.3
    type("Nearer", (TASKS["placement"],), {})  # under the inherited name
    assert TASKS["placement"].__name__ == "Placement"


def test_a_picture_shows_the_body_on_its_box():
    made = arena("placement", 1, steps=1)
    played = play(made, drawn(made, 1), LinearPolicy(made.task), record=True)
    pictures = film(made, played.states, 0, 2, size=48)
    assert len(pictures) == 2 and pictures[0].shape == (48, 48, 3) and pictures[0].dtype == np.uint8
    x, F, tool = played.states
    gone = film(made, (x + torch.tensor([0.0, 5.0, 0.0]), F, tool), 0, 1, size=48)[0]
    assert (
        np.abs(pictures[0].astype(int) - gone).max() > 60
    )  # the white body hides what is behind it


def test_a_checkpoint_that_does_not_say_its_scene_is_named(monkeypatch):
    """One line that names file and field; with a scene that is named it is not asked."""
    with pytest.raises(DataError, match=r"^checkpoint: old\.ckpt: no such file"):
        simulator_named("learned", "old.ckpt")
    learned = SimpleNamespace(record=SimpleNamespace(settings={}))
    monkeypatch.setattr(arenas.Twin, "load", lambda *a: learned)
    with pytest.raises(
        DataError,
        match=r"old\.ckpt: settings\.scene: expected the scene that the twin was learned from, found none",
    ):
        simulator_named("truth", "old.ckpt")
    for scene, error, message in (
        ({"format": "builtin"}, DataError, r"old\.ckpt: settings\.scene\.name: expected the name"),
        ({"format": "transforms", "name": "x"}, ConfigError, "truth is known for built-in"),
    ):
        learned.record.settings["scene"] = scene
        with pytest.raises(error, match=message):
            simulator_named("truth", "old.ckpt")
    learned.record.settings.clear()
    assert (
        len(simulator_named("truth", "old.ckpt", scene="tiny", spacing=0.03).twin.body.rest) < 300
    )


def test_several_processes_share_a_table(tmp_path, monkeypatch):
    """Jobs without a page, and the page from them."""
    bench = small_bench(tmp_path, monkeypatch)
    study.make_jobs(bench, [("none", 0), ("learned", 0)], tmp_path)
    assert not (tmp_path / "placement.md").exists()
    made = []
    record = study._record
    monkeypatch.setattr(
        study, "_record", lambda bench, name, seed: made.append(name) or record(bench, name, seed)
    )
    page = study.table(bench, ["learned", "isotropic"], [0], tmp_path, filmed=0)
    assert made == ["isotropic"] and not list(tmp_path.glob("*.png"))
    assert page.read_text().count("\n| isotropic ") == 1


def test_the_truths_jobs_do_not_wait_for_a_twin(tmp_path, monkeypatch):
    """What is trained in the truth is made by the scene's name and taken by the table of a twin of that scene, and of no other."""
    before = small_bench(tmp_path, monkeypatch)
    study.make_jobs(before, [("none", 0), ("truth", 0)], tmp_path)
    checkpoint = tmp_path / "last.ckpt"
    checkpoint.write_bytes(b"a twin")
    bench = small_bench(tmp_path, monkeypatch, checkpoint=str(checkpoint), truth={})
    settings = bench.simulator("learned").twin.record.settings
    settings["scene"] = {"format": "builtin", "name": "tiny"}
    made, record = [], study._record
    monkeypatch.setattr(
        study, "_record", lambda bench, name, seed: made.append(name) or record(bench, name, seed)
    )
    study.table(bench, ["learned", "truth"], [0], tmp_path, filmed=0)
    assert made == ["learned"]
    settings["scene"]["seed"] = 3
    with pytest.raises(
        DataError,
        match=r"placement_truth_0.json: expected a job of the same setting, .*'seed': 0.*'seed': 3",
    ):
        study.make_jobs(bench, [("truth", 0)], tmp_path)


@pytest.mark.gpu
@pytest.mark.parametrize("task", TASKS)
def test_trials_on_a_gpu_are_those_of_a_cpu(task):
    """Observations, losses and the slope of a policy's numbers."""
    found = {}
    for device in ("cpu", "cuda"):
        made = simulator(precision=64)
        made.twin.body.to(device)
        check = Arena(made, task_named(task, made.twin.body.rest.cpu(), steps=4), 2)
        policy = LinearPolicy(check.task).double()
        played = play(check, drawn(check, 2), policy, differentiable=True)
        slope = torch.autograd.grad(played.loss.mean(), policy.bias)[0]
        found[device] = played.loss.detach().cpu(), slope.cpu()
    for a, b in zip(*found.values()):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-7)

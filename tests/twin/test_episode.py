"""A twin that is stepped: the bits of one long simulation, state saved and branched, driven colliders, gradients, many worlds."""

import copy
import math
from dataclasses import replace
from io import BytesIO

import pytest
import torch
from small_bodies import FRAME_DT, STICKY, WORLD, small_body, start

from mosa.errors import ConfigError, DataError, SimulationDiverged
from mosa.modules.fitting.parameters import read_numbers
from mosa.physics.contact.colliders import colliders_from_config
from mosa.physics.contact.motion import Trajectory, exponential
from mosa.twin.episode import TwinState
from mosa.twin.twin import Twin

STEPS = 8
NUMBERS = 0.2 * torch.linspace(-1, 1, 19).double()
PUSHER = {"type": "box", "name": "pusher", "size": [0.06, 0.1, 0.12], "position": [-0.12, 0.08, 0], "mode": "separate",
          "friction": 0.3, "motion": {"velocity": [0.6, 0, 0]}}  # fmt: skip
BALL = {"type": "sphere", "radius": 0.04, "position": [0.0, 0.2, 0.0],
        "motion": {"waypoints": [{"time": 0.02, "position": [0, 0.2, 0]}, {"time": 0.1, "position": [0, 0.15, 0]}]}}  # fmt: skip
BALL.pop("position")


def twin(precision=64, world=WORLD, **options):
    body = small_body(precision=precision, contact=True, numbers=NUMBERS, **options)
    return Twin(
        body,
        world,
        FRAME_DT,
        None,
        start(dtype=torch.float64 if precision == 64 else torch.float32),
    )


def test_fewer_substeps_than_the_law_needs_are_refused_by_number():
    made = twin()
    made.reset(substeps=7)
    laws = read_numbers(made.body).expand(2, -1)
    for begin in (made.reset, made.worlds(2).reset, made.worlds(2, laws).reset):
        with pytest.raises(
            ConfigError, match=r"7 substeps per frame needed .* limit is 6: .* or raise substeps"
        ):
            begin(substeps=6)


@pytest.mark.parametrize("adaptive", [False, True])
@pytest.mark.parametrize("added", [1e8, 1e9, 3e38])
def test_a_state_of_any_speed_is_refused_by_what_it_takes(added, adaptive):
    """Read from a file as docs/twin.md shows; its window has more nodes than 64 bits count."""
    made = twin(32)
    made.body.settings = made.body.settings.but(adaptive=adaptive)
    tensors = made.reset(velocity=(0.0, -1.0, 0.0)).tensors()
    made.state = TwinState.read({**tensors, "v": tensors["v"] + added})
    with pytest.raises((SimulationDiverged, ConfigError), match=r"speeds (to|reach) "):
        made.step()


def test_a_step_that_is_too_long_for_its_speed_is_refused():
    made = twin()
    with pytest.raises(
        ConfigError, match=r"10014701 substeps per frame needed .* or raise substeps"
    ):
        made.reset(velocity=(2e5, 0, 0), control_dt=1, substeps=1)
    state = made.reset(control_dt=1, substeps=600)
    made.state = replace(state, v=state.v + 2e5 * torch.eye(3)[0])
    with pytest.raises(
        SimulationDiverged,
        match=r"particles spread over 533344 x .* \(speeds to 2e\+05 m/s\): use more substeps",
    ):
        made.step()


@pytest.mark.parametrize("precision", [32, 64])
@pytest.mark.parametrize("adaptive", [False, True])
def test_steps_are_one_long_simulation_to_the_last_bit(precision, adaptive):
    """Also from a state that was saved and read, and with colliders on motions of their own."""
    made = twin(precision)
    made.body.settings = made.body.settings.but(adaptive=adaptive)
    given = {
        "colliders": [PUSHER, BALL],
        "position": (0.01, None, -0.02),
        "velocity": (0.1, -1.0, 0.0),
        "frames": STEPS + 1,
    }
    long = made.simulate(**given)
    state = made.reset(**given)
    assert (
        torch.equal(state.positions, long.x[0])
        and long.reactions.abs().max() > 1
        and float(state.time) == 0
    )
    assert torch.allclose(long.x[0].mean(0)[::2], torch.tensor([0.01, -0.02]).to(long.x))
    for k in range(STEPS):
        state, reactions = made.step()
        assert torch.equal(state.positions, long.x[k + 1]) and torch.equal(
            reactions, long.reactions[k]
        )
        if k == 3:
            file, branch = BytesIO(), state
            torch.save(state.tensors(), file)
    assert (made.episode.substeps is None) == adaptive and int(state.substeps) == sum(long.counts)
    assert float(state.time) == pytest.approx(STEPS * FRAME_DT) and float(
        state.collider_position[0, 0]
    ) == pytest.approx(-0.12 + 0.6 / 7.5)
    assert float(state.collider_position[1, 1]) == pytest.approx(0.15) and not state.driven.any()
    file.seek(0)
    for saved in (TwinState.read(torch.load(file, weights_only=True)), branch):
        made.reset(**given)
        made.state = saved
        for _ in range(STEPS - 4):
            again = made.step().state
        assert torch.equal(again.positions, long.x[-1]) and torch.equal(again.F, state.F)


def test_driven_colliders_are_the_trajectory_of_their_commands():
    """Velocities, targets and rests, step by step, against one rollout along the poses they give; the last step of each kind is
    also told by where the solid is."""
    made, generator = twin(), torch.Generator().manual_seed(3)
    made.reset(colliders=[PUSHER, BALL], frames=STEPS + 1)
    dt, count = FRAME_DT / made.episode.substeps, made.episode.substeps
    parts, states = [], [made.state]
    for k in range(STEPS):
        before, kind = states[-1], k % 4
        v, w = (0.3 * torch.randn(3, generator=generator).double() for _ in range(2))
        command = {"velocity": v, "angular_velocity": w}
        if kind == 1:
            target = {
                "position": before.collider_position[0] + FRAME_DT * v,
                "rotation": exponential(FRAME_DT * w) @ before.collider_rotation[0],
            }
            command = target
        elif kind == 2:
            command, w = tuple(v.tolist()), torch.zeros(3).double()
        action = {} if kind == 3 else {"pusher": command}
        v, w = (0 * v, 0 * w) if kind == 3 else (v, w)
        state, reactions = made.step(action)
        if kind == 1:
            assert torch.equal(state.collider_position[0], target["position"]) and torch.equal(
                state.collider_rotation[0], target["rotation"]
            )
        torch.testing.assert_close(
            state.collider_position[0],
            before.collider_position[0] + FRAME_DT * v,
            rtol=0,
            atol=1e-15,
        )
        times = dt * torch.arange(count).double()[:, None]
        turned = exponential(times * w) @ before.collider_rotation[0]
        parts.append(
            (
                before.collider_position[0] + times * v,
                turned,
                v.expand(count, 3),
                w.expand(count, 3),
            )
        )
        states.append(state)
    assert reactions.abs().max() > 1e-3 and states[-1].driven.tolist() == [True, False]
    moving = Trajectory(*(torch.cat(values) for values in zip(*parts)))
    pusher, ball = colliders_from_config([PUSHER, BALL])
    long = made.simulate(colliders=[replace(pusher, motion=moving), ball], frames=STEPS + 1)
    for k, state in enumerate(states):  # a target's twist is rounded
        torch.testing.assert_close(state.positions, long.x[k], rtol=0, atol=0 if k < 2 else 1e-13)


def test_gradients_of_a_control_sequence_are_central_differences():
    """50 steps of a body pushed along the ground by a solid that is turned and moved in every one of them. Contact is smooth here:
    a spring begins at no force, and nodes stick to the ground or do not touch it."""
    steps, generator = 50, torch.Generator().manual_seed(0)
    made = twin(world=STICKY, counts=(4, 4, 3))
    pusher = {
        **PUSHER,
        "position": [-0.115, 0.08, 0],
        "mode": "sticky",
        "friction": 0,
        "motion": None,
    }
    values = {
        "velocity": torch.tensor([0.1, -0.5, 0.1]).double(), "position": torch.tensor([0.0, 0.08, -0.01]).double(),
        "spin": torch.tensor([0.5, 1.0, -2.0]).double(),
        "controls": 0.25 * torch.randn(steps, 3, generator=generator).double() + torch.tensor([0.35, 0, 0]).double(),
        "turns": 0.5 * torch.randn(steps, 3, generator=generator).double(),
    }  # fmt: skip
    body = made.body
    law = {
        "E": body.material.raw["E"],
        "numbers": body.adapter.numbers,
        "contact": body.contact.cells,
    }
    felt = []

    def loss(given):
        made.reset(velocity=given["velocity"], position=given["position"], angular_velocity=given["spin"], colliders=[pusher],
                   control_dt=0.005, substeps=8, differentiable=True)  # fmt: skip
        total = 0.0
        for v, w in zip(given["controls"], given["turns"]):
            state, reactions = made.step({"pusher": {"velocity": v, "angular_velocity": w}})
            total = total + 1e-3 * reactions.mean(0).square().sum()
            felt.append(bool(reactions.detach().abs().max() > 1e-3))
        return (
            total
            + (state.positions - torch.tensor([0.1, 0.1, 0.0])).square().sum()
            + 0.01 * state.v.square().sum()
        )

    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    found = torch.autograd.grad(loss(leaves), [*leaves.values(), *law.values()])
    assert sum(felt) > 20 and (made.state.positions[:, 1].min() < 0.5 * 0.04)
    for (name, value), gradient in zip([*values.items(), *law.items()], found, strict=True):
        direction = torch.randn(value.shape, generator=generator, dtype=torch.float64)
        sides = []
        with torch.no_grad():
            kept = value.detach().clone()
            for side in (1e-5, -1e-5):
                moved = kept + side * direction
                if name in values:
                    sides.append(loss({**values, name: moved}))
                else:
                    value.copy_(moved)
                    sides.append(loss(values))
                    value.copy_(kept)
        slope = (sides[0] - sides[1]) / 2e-5
        torch.testing.assert_close(
            (gradient * direction).sum(),
            slope,
            rtol=1e-5,
            atol=0,
            msg=lambda m, name=name: f"{name}: {m}",
        )


PLATE = {
    "type": "box",
    "name": "plate",
    "size": [0.05, 0.4, 0.4],
    "mode": "separate",
    "friction": 0.3,
}
"""1.25 cells, and its edges far from the body."""


def pushed(made, plate, speed, steps=12):
    """How far a body is pushed by a plate of that speed (3,) which begins a cell before it."""
    low = float(made.body.rest[:, 0].min() - made.body.center[0])
    made.reset(
        position=(0.0, None, 0.0),
        height=0.01,
        velocity=(0, 0, 0),
        control_dt=0.02,
        differentiable=True,
        colliders=[{**plate, "position": [low - 0.0513 - 0.5 * plate["size"][0], 0.12, 0.0]}],
    )
    for _ in range(steps):
        state, _ = made.step({"plate": {"velocity": speed}})
    return state.positions[:, 0].mean()


def mismatch(made, plate, speed, h=1e-2):
    """Of the gradient in a plate's speed, as a share of the central difference."""
    pushing, side = (
        torch.tensor([speed, 0, 0]).double().requires_grad_(),
        torch.tensor([h, 0, 0]).double(),
    )
    (found,) = torch.autograd.grad(pushed(made, plate, pushing), pushing)
    with torch.no_grad():
        slope = (pushed(made, plate, pushing + side) - pushed(made, plate, pushing - side)) / (
            2 * h
        )
    return abs(float(found[0] / slope) - 1)


@pytest.mark.parametrize("mode, friction", [("separate", 0.3), ("sticky", 0.0), ("touch", 0.3)])
def test_gradients_of_a_plates_motion_are_differences_of_a_per_cent(mode, friction):
    """Of a plate of 1.25 cells, through the moments at which particles come to touch it: contact has no jumps."""
    made = twin(world=STICKY, counts=(4, 4, 3))
    assert (
        max(
            mismatch(made, {**PLATE, "mode": mode, "friction": friction}, speed)
            for speed in (0.45, 0.55, 0.65)
        )
        < 0.05
    )


def test_a_box_in_place_of_the_scenes():
    made = twin(
        world=replace(WORLD, box=torch.tensor([[-0.2, -0.05, -0.2], [0.2, 0.3, 0.2]]).double()),
        counts=(4, 4, 3),
    )
    away = {"velocity": (3.0, 0.0, 0.0), "frames": 10}
    with pytest.raises(
        SimulationDiverged, match=r"outside the box .*box= of a twin.* velocity that is not given"
    ):
        made.simulate(**away)
    wide = [[-1, -0.05, -1], [1, 1, 1]]
    far = made.simulate(**away, box=wide)
    made.reset(**away, box=torch.tensor(wide))
    for _ in range(9):
        state, _ = made.step()
    assert torch.equal(state.positions, far.x[-1]) and far.x[-1, :, 0].max() > 0.2
    worlds = made.worlds(2)
    worlds.reset({"velocity": (3.0, 0.0, 0.0)}, frames=10, box=wide)
    for _ in range(9):
        state, _ = worlds.step()
    assert torch.equal(state.positions[1], far.x[-1])
    worlds.restart([0], [{"position": (0.5, None, 0.0)}])  # within the box that it was reset with
    with pytest.raises(
        ConfigError,
        match=r"starts\[1\]: box: expected one that the body starts in, found 100% of it outside",
    ):
        worlds.restart([1], [{"position": (1.5, None, 0.0)}])
    for wrong in (
        [[0, 0, 0], [1, 1]],
        [[0, 0, 0], [1, 0, 1]],
        [[-1, -1, -1]],
        "large",
        [[0, 0, 0], [1, float("inf"), 1]],
    ):
        with pytest.raises(ConfigError, match=r"box: expected \[low, high\] corners"):
            made.reset(box=wrong)
    with pytest.raises(ConfigError, match=r"box: expected one that the body starts in"):
        made.simulate(box=[[-1, 0.2, -1], [1, 1, 1]])


def test_without_differentiable_no_graph_is_kept():
    made = twin()
    made.reset(colliders=[PUSHER])
    with pytest.raises(
        ConfigError, match=r"action: .*differentiable=True"
    ):  # it would get no gradient
        made.step({"pusher": torch.zeros(3, requires_grad=True)})
    state, reactions = made.step({"pusher": torch.zeros(3)})
    assert not state.x.requires_grad and not reactions.requires_grad
    made.reset(colliders=[PUSHER], differentiable=True)
    with torch.no_grad():
        assert not made.step().state.x.requires_grad
    assert made.step().state.x.requires_grad  # the law's parameters are learned


def test_worlds_are_so_many_twins():
    """Starts, commands for all or for each, gravity; then a law for each. Every world has the bits of its twin."""
    made, count = twin(), 3
    starts = [
        {"velocity": (0.1 * b, -1.0, 0.0), "position": (0.01 * b, None, 0.0)} for b in range(count)
    ]
    pushes = torch.tensor([[0.4, 0.0, 0.0], [0.5, 0.1, 0.0], [0.3, 0.0, 0.2]]).double()
    laws = read_numbers(made.body) + 0.05 * torch.randn(count, len(read_numbers(made.body)),
                                                        generator=torch.Generator().manual_seed(1)).double()  # fmt: skip
    for numbers in (None, laws):
        worlds = made.worlds(count, numbers)
        first = worlds.reset(starts, colliders=[PUSHER, BALL], substeps=12, frames=5)
        assert first.x.shape == (count, 120, 3)
        for k in range(4):
            state, reactions = worlds.step(
                {"pusher": {"velocity": pushes}, "1": (0.0, -0.1 * k, 0.0)}
            )
        assert reactions.shape == (12, count, 2, 6) and state.collider_position.shape == (
            count,
            2,
            3,
        )
        for b in range(count):
            single = twin()
            if numbers is not None:
                single = Twin(_with(made.body, numbers[b]), WORLD, FRAME_DT, None, start())
            single.reset(**starts[b], colliders=[PUSHER, BALL], substeps=12, frames=5)
            for k in range(4):
                own, forces = single.step({"pusher": pushes[b], "1": (0.0, -0.1 * k, 0.0)})
            assert torch.equal(own.positions, state.positions[b]) and torch.equal(
                forces, reactions[:, b]
            )
            assert torch.equal(own.collider_position, state.collider_position[b])
    assert (state.positions[0] - state.positions[1]).abs().max() > 1e-3
    heavy = torch.tensor([[0.0, -9.8, 0.0], [0.0, -20.0, 0.0], [1.0, -9.8, 0.0]])
    worlds = made.worlds(count)
    worlds.reset({"height": 0.5}, gravity=heavy, frames=5)
    branch = worlds.step().state
    fallen = worlds.step().state.v.mean(1) - branch.v.mean(1)
    torch.testing.assert_close(fallen, FRAME_DT * heavy.double(), rtol=1e-6, atol=1e-9)
    worlds.state = branch
    assert torch.equal(worlds.step().state.v.mean(1) - branch.v.mean(1), fallen)


def test_some_worlds_begin_again():
    """Those are at their start, or at a new one, with the bits of a twin that begins there; the others go on."""
    made, still = twin(), PUSHER | {"motion": None}
    begins = [{"velocity": (0.1 * b, -1.0, 0.0), "position": (0.0, 0.1, 0.0)} for b in range(3)]
    push, new = (
        {"pusher": (0.5, 0.1, 0.0)},
        {"velocity": (0.0, -0.5, 0.0), "position": (0.01, 0.11, 0.0)},
    )
    worlds = made.worlds(3)
    worlds.reset(begins, colliders=[still], substeps=12)
    kept = worlds.reset(begins, colliders=[still], substeps=12)
    assert torch.equal(worlds.restart([0]).x, kept.x)  # nothing has moved yet
    for _ in range(3):
        before = worlds.step(push).state
    assert torch.equal(worlds.restart([2]).positions[2], kept.positions[2])
    state = worlds.restart([0], [new])
    assert torch.equal(state.x[1], before.x[1]) and not torch.equal(state.x[0], before.x[0])
    assert torch.equal(
        state.collider_position[[0, 2]], kept.collider_position[[0, 2]]
    ) and torch.equal(state.collider_position[1], before.collider_position[1])
    for _ in range(4):
        state, reactions = worlds.step(push)
    for b, begin, steps in ((0, new, 4), (1, begins[1], 7), (2, begins[2], 4)):
        made.reset(**begin, colliders=[still], substeps=12)
        for _ in range(steps):
            own, forces = made.step(push)
        torch.testing.assert_close(state.positions[b], own.positions, rtol=0, atol=0)
        assert torch.equal(reactions[:, b], forces)
    with pytest.raises(
        ConfigError, match=r"restart: expected numbers of worlds below 3, found \[3\]"
    ):
        worlds.restart([3])
    with pytest.raises(ConfigError, match=r"starts\[1\]: velocity: expected three"):
        worlds.restart([1], [{"velocity": 1}])


def test_a_copy_has_no_motion_and_goes_on_from_its_state():
    made, given = twin(), {"colliders": [PUSHER]}
    for one in (made, made.worlds(2)):
        one.reset(**given)
        state = one.step().state
        other = copy.deepcopy(one)
        with pytest.raises(ConfigError, match="expected reset"):
            other.step()
        other.reset(**given)
        other.state = state
        assert torch.equal(other.step().state.x, one.step().state.x)


def test_all_worlds_take_the_substeps_of_the_one_that_gets_fastest():
    """Not of the one that starts fastest; a start to which they do not suffice is no new start of one."""
    made, thrown = twin(adapter=False, E=2e3), {"velocity": (0.0, -2.0, 0.0)}
    high = {"position": (0.0, 4.0, 0.0), "velocity": (0.0, 0.0, 0.0)}
    made.reset(**high, frames=90)
    alone, worlds = made.episode.substeps, made.worlds(2)
    worlds.reset([thrown, high], frames=90)
    assert worlds.episode.substeps == alone
    worlds.restart([1])
    worlds.reset(thrown, frames=90)
    assert worlds.episode.substeps < alone
    with pytest.raises(ConfigError, match=r"starts\[1\]: .* no faster than .* m/s, .* found up to"):
        worlds.restart([1], [high])


def test_gradients_of_worlds_are_those_of_their_twins():
    """Commands of each, to the last bit; the law's numbers, which they share, as a sum."""
    made, pushes = twin(), torch.tensor([[0.9, 0.0, 0.0], [0.8, 0.1, 0.1]]).double()
    numbers, given = (
        made.body.adapter.numbers,
        {"colliders": [PUSHER], "substeps": 12, "differentiable": True},
    )

    def pushed(stepped, push, begins):
        stepped.reset(begins, **given) if begins is not None else stepped.reset(
            position=(-0.01, 0.09, 0), **given
        )
        for _ in range(6):
            state, reactions = stepped.step({"pusher": push})
        return torch.autograd.grad(
            state.positions.square().sum() + reactions.square().sum(), [push, numbers]
        )

    of_each, of_all = pushed(
        made.worlds(2), pushes.clone().requires_grad_(), {"position": (-0.01, 0.09, 0)}
    )
    alone = [pushed(made, push.clone().requires_grad_(), None) for push in pushes]
    assert (
        torch.equal(of_each, torch.stack([own for own, _ in alone]))
        and (of_each.abs().amax(1) > 1e-3).all()
    )
    expected = sum(law for _, law in alone)
    # sums in another order: 1.2e-11 of the largest on a processor with AVX-512, less without
    torch.testing.assert_close(of_all, expected, rtol=0, atol=3e-11 * float(expected.abs().max()))


def _with(body, numbers):
    from mosa.modules.fitting.parameters import each_law

    for _ in each_law(body, numbers[None]):
        made = small_body(contact=True, numbers=NUMBERS)
        made.load_state_dict(body.state_dict())
    return made


@pytest.mark.parametrize("action, message", [
    ({"paddle": (0, 0, 0)}, r"action: expected names of colliders \(pusher, 1\), found 'paddle'"),
    ({"pusher": (1, 2)}, r"action\['pusher'\]\.velocity: expected finite numbers \(3,\), found shape \(2,\)"),
    ({"pusher": {"velocity": "fast"}}, r"action\['pusher'\]\.velocity: expected finite numbers \(3,\), found fast"),
    ({"pusher": {"velocity": (0, float("nan"), 0)}}, r"action\['pusher'\]\.velocity: .* found \(0, nan, 0\)"),
    ({"1": {"speed": 1.0}}, r"action\['1'\]: expected velocity and angular_velocity, or position and rotation .*, found speed"),
    ({"1": {"velocity": (0, 0, 0), "position": (0, 0, 0)}}, r"action\['1'\]: .* found velocity, position"),
    ({"1": {"rotation": 2 * torch.eye(3)}}, r"action\['1'\]\.rotation: .*a defect of 3"),
    ({"pusher": (0, 100.0, 0)}, "collider pusher: expected a speed of at most .* found 100"),
    ({"pusher": {"position": (5.0, 0, 0)}}, "collider pusher: expected a speed of at most"),
    (5, "action: expected commands by the names of colliders, found 5"),
])  # fmt: skip
def test_errors_of_actions_name_the_collider(action, message):
    made = twin()
    before = made.reset(colliders=[PUSHER, BALL])
    with pytest.raises(ConfigError, match=message):
        made.step(action)
    assert torch.equal(made.state.x, before.x) and int(made.state.frames) == 0


def test_errors_of_starts_and_states():
    made = twin()
    with pytest.raises(ConfigError, match=r"twin: expected reset\(...\) before"):
        made.step()
    with pytest.raises(ConfigError, match="position: expected three finite numbers"):
        made.reset(position=(0.0, "up", 0.0))
    with pytest.raises(ConfigError, match=r"control_dt: .*found -1"):
        made.reset(control_dt=-1)
    with pytest.raises(
        ConfigError, match=r"colliders: expected names of their own, found 0 more than once"
    ):
        made.reset(colliders=[PUSHER | {"name": ""}, BALL | {"name": "0"}])
    with pytest.raises(ConfigError, match=r"starts\[1\]: height: expected metres"):
        made.worlds(2).reset([{}, {"height": -1}])
    with pytest.raises(
        ConfigError,
        match=r"laws: expected one for each of 2 worlds, a tensor .*found shape \(3, 5\)",
    ):
        made.worlds(2, torch.zeros(3, 5))
    for laws in (
        torch.zeros(2, 5), torch.full((2, 22), math.nan), torch.zeros(2, 22).bool(), torch.zeros(2, 22).cfloat(),
    ):  # fmt: skip
        with pytest.raises(
            ConfigError,
            match=r"laws: expected one for each of 2 worlds, a tensor \(2, 22\) of finite numbers",
        ):
            made.worlds(2, laws)
    with pytest.raises(
        ConfigError, match="gravity: expected no gradients"
    ):  # found a small part of them
        made.worlds(2).reset(gravity=torch.zeros(2, 3, requires_grad=True), differentiable=True)
    with pytest.raises(ConfigError, match="gravity: expected no gradients"):  # found none
        made.reset(gravity=torch.zeros(3, requires_grad=True), differentiable=True)
    with pytest.raises(ConfigError, match="laws: expected no gradients"):
        made.worlds(2, torch.zeros(2, 22, requires_grad=True))
    worlds = made.worlds(2)
    worlds.reset()
    with pytest.raises(
        ConfigError, match=r"which: expected a list of numbers of worlds, found \[True\]"
    ):
        worlds.restart([True])
    with pytest.raises(ConfigError, match=r"worlds: expected at most .*, found 1e\+09 x 120"):
        made.worlds(10**9)
    made.reset()
    with pytest.raises(
        ConfigError,
        match=r"state\.substeps: expected a whole number of at least 0 and at most 2\^53, found 4611",
    ):
        made.state = replace(made.state, substeps=torch.tensor(2**62))
    with pytest.raises(ConfigError, match=r"state\.substeps: .* of at least 0 .*, found -1"):
        made.state = replace(made.state, substeps=torch.tensor(-1))
    with pytest.raises(
        ConfigError,
        match=r"state\.x: expected a dense tensor torch.float64 \(120, 3\), found Tensor \(torch.float64 .* \(7, 3\)",
    ):
        made.state = replace(made.state, x=torch.zeros(7, 3).double())
    for other in (made.state.F.to_sparse(), made.state.F.to("meta"), None):
        with pytest.raises(
            ConfigError, match=r"state\.F: expected a dense tensor .*, found (None|Tensor)"
        ):
            made.state = replace(made.state, F=other)
    made.reset(colliders=[PUSHER])
    for name, value, message in (
        ("collider_position", math.nan, "finite numbers, found nan"),
        ("F", math.inf, "finite"),
        ("lag", math.nan, "finite"),
        ("collider_rotation", 0.0, "rotation"),
        ("collider_rotation", 1e38, "rotation"),
    ):
        with pytest.raises(ConfigError, match=f"expected {message}"):
            made.state = replace(
                made.state, **{name: torch.full_like(getattr(made.state, name), value)}
            )
    with pytest.raises(DataError, match=r"state: expected .* found x"):
        TwinState.read({"x": torch.zeros(3)})


def test_worlds_begin_again_outside_of_where_solids_are_by_then():
    """A solid on a motion of its own, and a driven one, which is back where it began."""
    made, place = twin(32).worlds(2), {"position": (0, None, 0), "height": 0.01}
    box = {"type": "box", "size": [0.1, 0.1, 0.1], "mode": "separate"}
    own = box | {"name": "own", "position": [-0.2, 0.1, 0], "motion": {"velocity": [0.6, 0, 0]}}
    driven = box | {"name": "driven", "position": [0, 0.1, 0.3]}
    made.reset({"position": (1, None, 0)}, colliders=[own, driven])
    for _ in range(20):
        before = made.step({"driven": (0, 0, -0.9)}).state
    for starts in ([place], place):
        with pytest.raises(
            ConfigError,
            match=r"colliders\[0\] \(own\): .* of world 1 inside of it now, where its .* \[-0.0, 0",
        ):
            made.restart([1], starts)
    assert torch.equal(made.state.x, before.x) and torch.equal(
        made.state.collider_position, before.collider_position
    )
    free = made.restart(
        [1], [{"position": (-0.2, None, 0), "height": 0.01}]
    )  # where it was at t = 0
    assert free.collider_position[1, :, 2].tolist() == [0, 0.3] and free.collider_position[
        0, 1, 2
    ] == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("ground", ["sticky", "separate", "slip", "touch"])
@pytest.mark.parametrize("counts", [(1, 1, 1), (2, 2, 2), (3, 3, 3), (8, 2, 8)])
def test_what_is_set_down_at_height_0_stays(ground, counts):
    """Its lowest layer, half of a body of two, is a rounding above or below the ground."""
    world = replace(WORLD, ground=replace(WORLD.ground, mode=ground, friction=0.0))
    made = twin(32, world, counts=counts, adapter=False, E=1e5)
    first = made.reset(height=0.0, velocity=(0, 0, 0), position=(0.013, None, 0.007))
    for _ in range(10):
        state = made.step().state
    assert (state.positions.mean(0) - first.positions.mean(0)).abs().max() < 1e-3


def test_nothing_is_put_where_the_axes_of_a_motion_have_no_digits():
    """By a state or a new start of one world; a motion that is reset there has axes of its own."""
    made, box = twin(32), [[-1e4] * 3, [1e4] * 3]
    state = made.reset(box=box)
    made.state = replace(state, x=state.x + torch.tensor([300.0, 0, 0]))
    message = (
        r"x: expected particles within 369 m of the place of the reset, found .* m: reset there"
    )
    with pytest.raises(ConfigError, match=message):
        made.state = replace(state, x=state.x + torch.tensor([400.0, 0, 0]))
    worlds = made.worlds(2)
    worlds.reset(box=box)
    before = worlds.restart([1], [{"position": (300, None, 0)}])
    with pytest.raises(ConfigError, match=message):
        worlds.restart([0], [{"position": (400, None, 0)}])
    assert torch.equal(worlds.state.x, before.x) and float(before.x[1].mean(0)[0]) == pytest.approx(
        300, abs=1e-3
    )
    made.reset(box=box, position=(400, None, 0))
    made.state = made.reset(box=box, position=(700, None, 0))


@pytest.mark.parametrize("precision", [32, 64])
def test_a_twin_that_is_turned_and_far_away_moves_as_at_home(precision):
    """Ten kilometres away on a sloping ground: simulated, stepped, driven, saved and branched."""
    away = torch.tensor([9e3, 0.0, -4e3]).double()
    home = {"frames": STEPS + 1, "box": [[-9, -9, -9], [9, 9, 9]]}
    there = home | {
        "position": (away + torch.tensor([0.0, 0.09, 0.0]).double()).tolist(),
        "box": [[-1e4] * 3, [1e4] * 3],
    }
    made = twin(precision)
    near, far = made.simulate(**home), made.simulate(**there)
    assert (far.x.double() - away - near.x.double()).abs().max() < (
        1.5e-3 if precision == 32 else 1e-6
    )  # float32 resolves 1 mm
    assert (far.F - near.F).abs().max() < 0.02 and near.x[-1, :, 1].amin() > 0
    paddle = PUSHER | {"position": [-0.12, 0.08, 0]}
    moved = paddle | {"position": (away + torch.tensor([-0.12, 0.08, 0.0]).double()).tolist()}
    seen = []
    for given, solid in ((home, paddle), (there, moved)):
        state = made.reset(**given, colliders=[solid])
        for k in range(STEPS):
            state, reactions = made.step({"pusher": {"velocity": (0.6, 0, 0)}})
            if k == 3:
                saved = state
        made.state = saved
        for _ in range(STEPS - 4):
            again = made.step({"pusher": {"velocity": (0.6, 0, 0)}}).state
        assert (again.x - state.x).abs().max() < 1e-5
        seen.append((state.x.double(), reactions))
    assert seen[1][0].dtype == torch.float64 and (seen[1][0] - away - seen[0][0]).abs().max() < 1e-3
    assert float(seen[0][1].abs().max()) > 0.1


@pytest.mark.parametrize("angle", [0.9, 1.0, 1.5, 2.0, -3.0])
def test_any_turn_is_swept(angle):
    """A bar that is told to turn by half a turn and more hits the body on its way; so again from a saved state, and in worlds."""
    bar = {
        "type": "box",
        "name": "bar",
        "size": [0.5, 0.06, 0.04],
        "position": [0, 0.1, 0.2],
        "mode": "separate",
    }
    made, target = twin(), torch.tensor([0.0, angle * torch.pi, 0.0]).double()
    options = {
        "colliders": [bar],
        "control_dt": 0.4,
        "substeps": 600,
        "velocity": (0, 0, 0),
        "frames": 3,
    }
    begun = made.reset(**options)
    state, reactions = made.step({"bar": {"rotation": target.tolist()}})
    assert float(reactions.abs().max()) > 0.1
    torch.testing.assert_close(state.collider_rotation[0], exponential(target), rtol=0, atol=1e-9)
    made.state = begun
    again, same = made.step({"bar": {"rotation": target.tolist()}})
    assert torch.equal(same, reactions) and torch.equal(again.x, state.x)
    worlds = made.worlds(2)
    worlds.reset({"velocity": (0, 0, 0)}, **{k: v for k, v in options.items() if k != "velocity"})
    _, both = worlds.step({"bar": {"rotation": torch.stack([target, 0 * target])}})
    torch.testing.assert_close(both[:, 0], reactions, rtol=1e-6, atol=1e-9)


def test_turns_go_on_beyond_half_a_turn():
    """Targets in steps of 0.3 pi are reached by the same twist each, forwards and backwards, whatever lies between."""
    made = twin()
    made.reset(colliders=[PUSHER | {"position": [-2, 1, 0], "motion": {}}], frames=3, substeps=60)
    for n in (1, 2, 3, 4, 5, 6, 7, 8, 7, 6, 5):
        before = made.state.collider_rotation[0]
        state, _ = made.step({"pusher": {"rotation": (0, 0.3 * torch.pi * n, 0)}})
        torch.testing.assert_close(
            state.collider_rotation[0],
            exponential(torch.tensor([0, 0.3 * math.pi * n, 0], dtype=torch.float64)),
        )
        turned = state.collider_rotation[0] @ before.mT
        assert float(turned.diagonal().sum()) == pytest.approx(
            1 + 2 * math.cos(0.3 * math.pi), abs=1e-6
        )
    held, _ = made.step({"pusher": {"rotation": (0, 1.5 * torch.pi, 0)}})
    torch.testing.assert_close(
        held.collider_rotation, state.collider_rotation
    )  # at a speed of 0: a whole turn would be refused as too fast


FAST = {"type": "box", "name": "fast", "size": [0.1, 0.1, 0.1], "mode": "separate"}
STILL = torch.zeros(200, 3).double()
TURNS = Trajectory(
    torch.tensor([0, 0.0, 0.5]).expand(200, 3),
    0.4 * torch.arange(200)[:, None] * torch.eye(3)[:1],
    STILL,
    STILL,
)
JUMPS = Trajectory(
    torch.tensor([-1.0, 0.1, 0]) + torch.tensor([0.1, 0, 0]) * torch.arange(200)[:, None],
    STILL,
    STILL,
    STILL,
)


@pytest.mark.parametrize("solid, action", [
    ({"position": [-1, 0.1, 0], "motion": {"velocity": [1000, 0, 0]}}, None),
    ({"motion": {"waypoints": [{"time": 0, "position": [-1, 0.1, 0]}, {"time": 0.01, "position": [1, 0.1, 0]}]}}, None),
    ({"motion": {"waypoints": [{"time": FRAME_DT - 5e-7, "position": [-1, 0.1, 0]},  # within half a substep, between two steps
                               {"time": FRAME_DT - 4e-7, "position": [1, 0.1, 0]}]}}, None),
    ({"position": [-1, 0.1, 0], "motion": {"angular_velocity": [0, 0, 1000]}}, None),
    ({"position": [-1, 0.1, 0], "motion": {"velocity": [[0, 0, 0], [500, 0, 0]], "times": [0, 0.02]}}, None),
    (JUMPS, None), (TURNS, None), ({"position": [-1, 0.1, 0]}, {"velocity": (1000, 0, 0)}),
    ({"position": [-1, 0.1, 0]}, {"position": (1, 0.1, 0)}), ({"position": [-1, 0.1, 0]}, {"angular_velocity": (0, 900, 0)}),
    ({"position": [-1, 0.1, 0]}, {"rotation": (0, 40.0, 0)}),
])  # fmt: skip
def test_a_solid_that_no_body_would_feel_is_refused(solid, action):
    made = twin()
    solids = colliders_from_config(
        [FAST | (solid if isinstance(solid, dict) else {"position": [-1, 0.1, 0]})]
    )
    solids = solids if isinstance(solid, dict) else (replace(solids[0], motion=solid),)
    with pytest.raises(
        ConfigError, match=r"collider fast: expected a speed of at most .* half a cell per substep"
    ):
        made.reset(colliders=solids, substeps=8)
        for _ in range(3):
            made.step(None if action is None else {"fast": action})


def test_a_state_of_another_clock_is_refused_and_of_other_substeps_goes_on():
    """Own motions of solids go by the time that has passed, whatever the substeps of the reset were."""
    made, solid = twin(), PUSHER | {"motion": {"velocity": [0.2, 0, 0]}}
    made.reset(colliders=[solid], substeps=20)
    for _ in range(3):
        kept = made.step().state
    made.reset(colliders=[solid], substeps=40)
    made.state = kept
    after = made.step().state
    moved = (after.collider_position - kept.collider_position).norm()
    assert float(moved) == pytest.approx(0.2 * FRAME_DT) and float(after.time) == pytest.approx(
        4 * FRAME_DT
    )
    made.reset(colliders=[solid], control_dt=FRAME_DT / 2)
    with pytest.raises(
        ConfigError, match=r"^state\.time: expected 3 steps of 0\.00833333 s, found"
    ):
        made.state = kept
    for wrong in ([1], None, {"x": kept.x}):
        with pytest.raises(DataError, match=r"^state: expected C_affine, F, .*, found"):
            TwinState.read(wrong)

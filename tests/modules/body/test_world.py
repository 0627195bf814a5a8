"""A body among moving colliders: from plain configuration to reactions, through the twin's interface."""

from dataclasses import replace

import pytest
import torch

from mosa.config.build import build_world
from mosa.errors import ConfigError
from mosa.modules.body.body import Body, SimulationSettings, Start
from mosa.modules.body.material import Material
from mosa.twin.twin import Twin

WORLD = {"ground": {"height": 0.0, "mode": "separate", "friction": 0.2}, "gravity": [0, -9.8, 0], "up": [0, 1, 0],
         "box": [[-0.5, -0.5, -0.5], [0.5, 1.0, 0.5]]}  # fmt: skip
PLATE = {"type": "box", "size": [0.6, 0.1, 0.6], "position": [0, 0.36, 0], "mode": "separate", "friction": 0.1,
         "motion": {"waypoints": [{"time": 0.0, "position": [0, 0.36, 0]}, {"time": 0.1, "position": [0, 0.21, 0]}]}}  # fmt: skip
PLATE.pop("position")


def twin(world=WORLD):
    axis = (torch.arange(6) + 0.5) * 0.03 - 0.09
    rest = torch.cartesian_prod(axis, axis, axis)
    n = len(rest)
    body = Body(rest=rest, volume=torch.full((n,), 0.03**3), colors=torch.ones(n, 3), opacities=torch.ones(n),
                covariances=1e-4 * torch.eye(3).expand(n, 3, 3), density=1000.0,
                material=Material("corotated", {"E": 5e4, "nu": 0.3}), heterogeneity=None, adapter=None,
                settings=SimulationSettings(dx=0.06))  # fmt: skip
    start = Start(torch.eye(3), torch.tensor([0.0, 0.11, 0.0]), torch.zeros(3), torch.zeros(3))
    return Twin(body, build_world(world), 0.02, None, start)


def test_up_is_a_unit_vector():
    with pytest.raises(ConfigError, match=r"^up: expected a unit vector, found \[0.0, 2.0, 0.0\]"):
        build_world(WORLD | {"up": [0, 2, 0]})


def test_a_plate_presses_the_body_down():
    free = twin().simulate(frames=8)
    assert free.reactions is None
    for rollout in (
        twin().simulate(frames=8, colliders=[PLATE]),
        twin(WORLD | {"colliders": [PLATE]}).simulate(frames=8),
    ):
        top = rollout.x[-1, :, 1].max()
        assert top < 0.16 + 0.06 < free.x[-1, :, 1].max() + 0.06
        assert top < free.x[-1, :, 1].max() - 0.01
        up = rollout.reactions[..., 0, 1].mean(1)
        assert up[0] == 0 and up[-1] > 5.0


@pytest.mark.parametrize(
    "start", [{"height": 0.0}, {"height": 0.5}, {"height": 0.5, "velocity": (1, -2, 0)}]
)
def test_a_long_motion_takes_the_time_step_that_its_drop_needs(start):
    """What a body reaches is told by how far it can fall, not by how long it is simulated."""
    made = twin()
    made.body.material = Material("corotated", {"E": 2e3, "nu": 0.3})  # so soft that speeds decide
    counts = []
    for frames in (30, 300, 1500, 100_000):
        made.reset(**start, frames=frames, box=[[-99, -9, -99], [99, 9, 99]])
        counts.append(made.episode.substeps)
    assert counts[1] == counts[2] == counts[3] <= 1.3 * counts[0]
    begun = Start(
        *(
            getattr(made.episode._starts, name)
            for name in ("rotation", "center", "velocity", "angular_velocity")
        )
    )
    world, size = made.world, made.body.size
    rollout = made.simulate(**start, frames=60, box=[[-99, -9, -99], [99, 9, 99]])
    assert (
        float(rollout.v.norm(dim=-1).max())
        < world.fastest(begun, size, 60 * 0.02)
        < 1.5 * (2.3 + (2 * 9.8 * 0.8) ** 0.5)
    )
    # in a short motion it is the time that tells, and without a ground, or along one that slopes, it always is
    drop = begun.velocity.norm()
    assert world.fastest(begun, size, 0.1) == pytest.approx(float(drop) + 0.98)
    assert replace(world, ground=None).fastest(begun, size, 20.0) == pytest.approx(
        float(drop) + 196
    )
    sloping = replace(world, up=torch.tensor([0.6, 0.8, 0.0]))
    assert 0.6 * 9.8 * 20 < sloping.fastest(begun, size, 20.0) < 0.6 * 9.8 * 20 + 10


def test_worlds_take_the_time_step_of_the_one_that_needs_most():
    """Not of the strongest pull: one along the ground goes on for ever."""
    made, level, along = twin(), [0.0, -9.8, 0.0], [9.8, -0.1, 0.0]
    counts = []
    for gravity in ([level, level], [level, along]):
        worlds = made.worlds(2)
        worlds.reset(gravity=torch.tensor(gravity), frames=300)
        counts.append(worlds.episode.substeps)
    assert counts[1] > 3 * counts[0]


def test_a_fall_that_nothing_ends_is_refused_with_the_way_out():
    made = twin(WORLD | {"ground": None})
    with pytest.raises(
        ConfigError, match=r"speed 1.96e\+04 m/s.*fewer frames where no ground ends the fall"
    ):
        made.simulate(frames=100_000)


def test_walls_and_errors():
    narrow = WORLD | {"box": [[-0.12, -0.5, -0.5], [0.12, 1.0, 0.5]]}
    walled = twin(narrow | {"walls": {"mode": "separate", "friction": 0.1}})
    assert len(walled.world.planes) == 6
    assert walled.simulate(frames=8, velocity=(1.0, 0.0, 0.0)).x[..., 0].max() < 0.12
    with pytest.raises(ConfigError, match=r"world\.colliders\[0\]: a sphere needs radius"):
        build_world(WORLD | {"colliders": [{"type": "sphere"}]})
    with pytest.raises(ConfigError, match=r"colliders\[0\].type"):
        twin().simulate(colliders=[{"type": "cone"}])


@pytest.mark.parametrize("colliders, message", [
    (5, r"^world\.colliders: expected a list"),
    ([5], r"^world\.colliders\[0\]: expected type"),
    ([{"type": "sphere", "radius": 0.1, "friction": "abc"}], r"^world\.colliders\[0\]\.friction: .*abc"),
    ([{"type": "sphere", "radius": 0.1, "position": [0, 0]}], r"^world\.colliders\[0\]\.position: expected three"),
    ([{"type": "sphere", "radius": 0.1, "motion": {"waypoints": [{"time": 0}, {"time": 1}]}}], r"\[0\]\.position: expected this"),
])  # fmt: skip
def test_a_collider_of_the_wrong_form_is_named(colliders, message):
    with pytest.raises(ConfigError, match=message):
        build_world(WORLD | {"colliders": colliders})


@pytest.mark.parametrize(
    "walls",
    [
        {},
        {"friction": float("nan")},
        {"mode": "separate", "friction": float("inf")},
        {"mode": ["slip"]},
        {"mode": "separate", "friction": True},
    ],
)
def test_walls_of_the_wrong_form_are_named(walls):
    with pytest.raises(ConfigError, match=r"^world\.walls"):
        build_world(WORLD | {"walls": walls})


@pytest.mark.parametrize("collider", [
    {"type": "box", "size": [2, 2, 2]}, {"type": "sphere", "radius": 0.2, "position": [0, 0.1, 0]},
    {"type": "plane", "normal": [0, 1, 0], "position": [0, 0.5, 0]},
])  # fmt: skip
def test_a_collider_that_contains_the_body_is_named(collider):
    with pytest.raises(
        ConfigError, match=r"^colliders\[0\]: expected a solid that the body is outside of"
    ):
        twin().simulate(frames=2, colliders=[collider])


ARRIVES = {
    "waypoints": [{"time": -1.0, "position": [0, 5, 0]}, {"time": 0.0, "position": [0, 0.1, 0]}]
}
LEAVES = {
    "waypoints": [{"time": -1.0, "position": [0, 0.1, 0]}, {"time": 0.0, "position": [0, 5, 0]}]
}


@pytest.mark.parametrize("solids, named", [
    ([{"size": [0.18, 0.045, 0.18], "position": [0, 0.0425, 0]}], r"^colliders\[0\]: .* found 1\d% of the body inside of it"),
    ([{"size": [0.09, 0.18, 0.09], "position": [0.045, 0.11, 0.045]}], r"^colliders\[0\]: .* found 25% of the body"),
    ([{"size": [0.1, 0.1, 0.1], "position": [x, 0.06, 0.09]} for x in (-0.1, 0.1)], r"\[0\] and colliders\[1\]: .* of them at t"),
    ([{"type": "capsule", "radius": 0.02, "length": 1.0, "position": [0.015, 0.125, 0]}], r"^colliders\[0\]"),
    ([{"type": "cylinder", "radius": 0.03, "length": 0.05, "position": [0, 0.11, 0]}], r"^colliders\[0\]: .* found 4% of the body"),
    ([{"size": [0.4, 0.4, 0.4], "motion": ARRIVES}], r"100% of the body inside of it at t = 0, .* \[0.0, 0.1, 0.0\]"),
])  # fmt: skip
def test_a_body_that_is_partly_inside_of_solids_is_refused(solids, named):
    with pytest.raises(ConfigError, match=named):
        twin().reset(
            colliders=[{"type": "box", "name": "", **solid} for solid in solids], substeps=50
        )


@pytest.mark.parametrize("solids", [
    [{"size": [0.4, 0.4, 0.4], "motion": LEAVES}], [{"size": [0.4, 0.4, 0.4], "motion": {**LEAVES, "waypoints": [
        {"time": -3.0, "position": [0, 0.1, 0]}, {"time": -2.0, "position": [0, 5, 0]}]}}],
    [{"size": [0.1, 0.2, 0.2], "position": [s * 0.139, 0.11, 0]} for s in (-1, 1)],  # faces of the particles' cells, 1 mm inside
    [{"type": "plane", "normal": [0, 1, 0], "position": [0, 0.02, 0]}],
])  # fmt: skip
def test_a_body_beside_solids_is_not(solids):
    made = [{"type": "box", **solid} for solid in solids]
    assert twin().simulate(frames=1, colliders=made).x.shape[0] == 1
    state = twin().reset(
        colliders=[{"type": "box", "name": str(i), **solid} for i, solid in enumerate(solids)],
        substeps=400,
    )
    assert torch.isfinite(state.x).all()


@pytest.mark.parametrize("count", [3, 6, 11])
@pytest.mark.parametrize("mode", ["touch", "separate", "slip", "sticky"])
@torch.no_grad()
def test_what_is_set_down_stays(mode, count):
    """At height 0, with any number of particles: it comes to rest within a fraction of a cell, and is not thrown up."""
    h = 0.18 / count
    made = twin(
        WORLD
        | {
            "ground": {
                "height": 0.03,
                "mode": mode,
                "friction": 0.3 if mode in ("touch", "separate") else 0.0,
            }
        }
    )
    axis = (torch.arange(count) + 0.5) * h - 0.09
    rest = torch.cartesian_prod(axis, axis, axis)
    made.body = Body(
        rest=rest, volume=torch.full((len(rest),), h**3), colors=rest * 0, opacities=rest[:, 0] * 0,
        covariances=1e-4 * torch.eye(3).expand(len(rest), 3, 3), density=1000.0, heterogeneity=None, adapter=None,
        material=Material("corotated", {"E": 5e5, "nu": 0.3}), settings=SimulationSettings(dx=2 * h),
    )  # fmt: skip
    height = made.simulate(height=0.0, frames=20).x[..., 1].mean(1)
    assert float(height.max() - height[0]) < 1e-4 and float(height[0] - height.min()) < 0.4 * 2 * h
    lowest = made.simulate(height=0.0, frames=1).x[0, :, 1].min() - 0.03
    assert float(lowest) == pytest.approx(0.5 * h if mode == "touch" else 0.0, abs=1e-6)


@pytest.mark.parametrize("arguments, message", [
    ({"rotation": [[1.2, 0, 0], [0, 1, 0], [0, 0, 0.8]]}, "rotation: expected R R.T = I"),
    ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "rotation: expected R R.T = I"),
    ({"rotation": [0, 0, 0, 90]}, "rotation: expected"), ({"rotation": "abc"}, "rotation: expected"),
    ({"rotation": [1, 0, 0, float("nan")]}, "rotation: expected"), ({"rotation": [1, 0, 0]}, "rotation: expected"),
    ({"height": "a"}, "height: expected"), ({"height": float("nan")}, "height: expected"), ({"height": -1.0}, "height: expected"),
    ({"height": True}, "height: expected"), ({"velocity": "abc"}, "velocity: expected three"),
    ({"velocity": [True, False, True]}, "velocity: expected three"), ({"velocity": [1, 2]}, "velocity: expected three"),
    ({"velocity": [float("inf"), 0, 0]}, "velocity: expected three"), ({"velocity": [1e30, 0, 0]}, "velocity: expected three"),
    ({"angular_velocity": {}}, "angular_velocity: expected three"), ({"frames": 2.5}, "frames: expected a whole number"),
    ({"frames": 0}, "frames: expected a whole number"), ({"frames": True}, "frames: expected a whole number"),
    ({"frames": 10**12}, "frames: expected a whole number of at least 1"), ({"variant": "none"}, "variant: expected one of"),
    ({"variant": ["prior"]}, "variant: expected one of"), ({"colliders": "sphere"}, "colliders: expected a list"),
    ({"velocity": [1e5, 0, 0]}, "time step"),
])  # fmt: skip
def test_an_argument_of_the_wrong_form_is_named(arguments, message):
    with pytest.raises(ConfigError, match=message):
        twin().simulate(**arguments)


def test_a_start_is_put_beside_where_the_training_was():
    """The body moves as from its own place, numbers that are None are kept, and a height takes the place of the one along `up`."""
    made = twin()
    usual = made.simulate(frames=3)
    aside = made.simulate(
        frames=3, position=[0.12, None, -0.06]
    )  # whole cells, so that the grid lies the same
    moved = torch.tensor([0.12, 0.0, -0.06])
    torch.testing.assert_close(aside.x, usual.x + moved, rtol=0, atol=1e-5)
    high = made.simulate(frames=1, position=(0.12, None, 0.0), height=0.2)
    with pytest.raises(
        ConfigError, match=r"^position: expected None for y beside height=0.2, found 5"
    ):
        made.simulate(frames=1, position=(0.12, 5.0, 0.0), height=0.2)
    assert float(high.x[0, :, 1].min()) == pytest.approx(0.2, abs=1e-5)
    for wrong in ([0.1, 0.2], "here", [0.0, float("inf"), 0.0], [True, 0.0]):
        with pytest.raises(ConfigError, match="position: expected three finite numbers"):
            made.simulate(position=wrong)


@pytest.mark.parametrize(("given", "named"), [
    ({"velocity": torch.zeros(3, requires_grad=True)}, "velocity"),
    ({"position": [torch.tensor(0.1, requires_grad=True), 0.4, 0.0]}, "position"),
    ({"rotation": torch.eye(3).requires_grad_()}, "rotation"),
    ({"colliders": [{"type": "sphere", "radius": 0.1, "position": torch.ones(3).requires_grad_()}]}, "colliders"),
])  # fmt: skip
def test_a_tensor_that_waits_for_gradients_is_not_left_without(given, named):
    """The motion came without them, and whoever asked for them was told nothing."""
    falling = twin()
    for begin in (
        lambda: falling.simulate(frames=2, **given),
        lambda: falling.reset(frames=2, **given),
    ):
        with pytest.raises(
            ConfigError,
            match=rf"^{named}: expected a tensor without gradients.*reset\(differentiable=True\)",
        ):
            begin()
    started = {k: v for k, v in given.items() if k != "colliders"}
    with pytest.raises(ConfigError, match="expected a tensor without gradients"):
        falling.worlds(2).reset(started, colliders=given.get("colliders"), frames=2)


def test_gradients_that_nobody_asks_for_are_no_mistake():
    falling, velocity = twin(), torch.zeros(3, requires_grad=True)
    plain = falling.simulate(velocity=velocity.detach(), frames=2).x
    with torch.no_grad():
        assert torch.equal(falling.simulate(velocity=velocity, frames=2).x, plain)
    assert not plain.requires_grad
    paddle = {"type": "sphere", "name": "paddle", "radius": 0.02, "position": [0.5, 0.5, 0.5]}
    falling.reset(frames=2, colliders=[paddle])
    push = torch.zeros(3, requires_grad=True)
    with pytest.raises(ConfigError, match="action: expected a tensor without gradients"):
        falling.step({"paddle": {"velocity": push}})
    falling.step({"paddle": {"velocity": push.detach()}})
    falling.reset(frames=2, velocity=velocity, colliders=[paddle], differentiable=True)
    state, _ = falling.step({"paddle": {"velocity": push}})
    assert torch.autograd.grad(state.positions.sum(), velocity)[0].abs().max() > 0

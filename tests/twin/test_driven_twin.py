"""Driven sets of a twin: simulated, stepped to the same bits, driven by actions, with loads, in
many worlds."""

from dataclasses import replace

import pytest
import torch
from small_bodies import FRAME_DT, FREE, small_body, start

from mosa.errors import ConfigError
from mosa.physics.contact.driven import driven_from_config
from mosa.system.npz import read_npz
from mosa.twin.twin import Twin

CLAMP = {
    "name": "clamp",
    "type": "plane",
    "normal": [1, 0, 0],
    "position": [-0.021, 0, 0],
    "motion": {"velocity": [0, 0.1, 0]},
}
LOAD = {
    "name": "load",
    "type": "plane",
    "normal": [-1, 0, 0],
    "position": [0.035, 0, 0],
    "mass": 0.1,
    "held": False,
}
BALL = {"type": "sphere", "radius": 0.02, "position": [0.0, -0.09, 0.0]}
STEPS = 4


def twin(precision=64, **options):
    made = Twin(
        small_body(precision=precision, contact=True, **options),
        FREE,
        FRAME_DT,
        {},
        start(height=0.0, speed=0.0),
    )
    made.training_start.velocity.zero_()
    return made


def test_steps_are_the_simulation_to_the_bit_and_actions_drive_the_set():
    made = twin()
    long = made.simulate(driven=[CLAMP, LOAD], frames=STEPS + 1)
    made.reset(driven=[CLAMP, LOAD], frames=STEPS + 1)
    for k in range(STEPS):
        state, reactions = made.step()
        assert torch.equal(state.positions, long.x[k + 1]) and torch.equal(
            reactions, long.reactions[k]
        )
    made.reset(driven=[CLAMP], differentiable=True)
    velocity = torch.tensor([0.0, 0.2, 0.0], dtype=torch.float64, requires_grad=True)
    for _ in range(STEPS):
        state, reactions = made.step({"clamp": {"velocity": velocity}})
    held = made.body.rest[:, 0] < -0.03
    rise = (state.positions - long.x[0])[held, 1].mean()
    assert float(rise.detach()) == pytest.approx(0.2 * STEPS * FRAME_DT, rel=1e-3)
    (slope,) = torch.autograd.grad(rise, velocity)
    assert float(slope[1]) == pytest.approx(STEPS * FRAME_DT, rel=1e-3)


def test_a_load_is_felt_by_the_clamp():
    """0.1 kg that are moved up from rest: the impulse is that of both."""
    made = twin()
    impulse, mass = [], made.body.density * float(made.body.volume.sum())
    for sets in ([CLAMP], [CLAMP, LOAD]):
        out = made.simulate(driven=sets, frames=40)
        impulse.append(-float(out.reactions[..., 0, 1].mean(1).sum()) * FRAME_DT)
    assert impulse[0] == pytest.approx(0.1 * mass, rel=0.1)
    assert impulse[1] - impulse[0] == pytest.approx(0.1 * 0.1, rel=0.3)


def test_worlds_of_other_starts_hold_what_is_in_their_region():
    made = twin()
    shifted = [{"position": (0.0, 0.0, 0.0)}, {"position": (0.01, 0.02, 0.0)}]
    worlds = made.worlds(2)
    worlds.reset(shifted, driven=[CLAMP], frames=STEPS + 1)
    for _ in range(STEPS):
        state, reactions = worlds.step()
    for b, given in enumerate(shifted):
        alone = made.simulate(driven=[CLAMP], frames=STEPS + 1, **given)
        torch.testing.assert_close(state.positions[b], alone.x[-1], rtol=0, atol=1e-9)
        torch.testing.assert_close(reactions[:, b], alone.reactions[-1], rtol=0, atol=1e-6)


def test_loads_of_worlds_of_other_starts_are_on_what_is_in_their_region():
    made = twin()
    starts = [{"rotation": (0, 1, 0, 0)}, {"rotation": (0, 1, 0, 180)}]
    worlds = made.worlds(2)
    worlds.reset(starts, driven=[CLAMP, LOAD], frames=STEPS + 1)
    for _ in range(STEPS):
        state, _ = worlds.step()
    for b, given in enumerate(starts):
        alone = made.simulate(driven=[CLAMP, LOAD], frames=STEPS + 1, **given)
        torch.testing.assert_close(state.positions[b], alone.x[-1], rtol=0, atol=1e-9)


def test_worlds_begin_again_only_where_their_sets_chose_their_particles():
    worlds, still = twin().worlds(2), CLAMP | {"motion": None}
    worlds.reset(driven=[still])
    first = worlds.step({"clamp": {"velocity": (0.0, 0.2, 0.0)}}).state
    worlds.restart([1])
    again = worlds.step({"clamp": {"velocity": (0.0, 0.2, 0.0)}}).state
    assert torch.equal(again.positions[1], first.positions[1])
    worlds.restart([1], [{"velocity": (0.0, 0.1, 0.0)}])
    with pytest.raises(ConfigError, match=r"starts\[1\]: expected the pose of the reset"):
        worlds.restart([1], [{"position": (0.01, None, None)}])
    worlds.reset(driven=[CLAMP])
    worlds.step()
    with pytest.raises(ConfigError, match="found clamp on a motion of its own"):
        worlds.restart([1])


def test_a_set_outside_of_the_body_is_refused():
    far = {**CLAMP, "position": [-5, 0, 0]}
    with pytest.raises(
        ConfigError, match="driven set 'clamp': expected particles of the body inside of it"
    ):
        twin().simulate(driven=[far])


def test_an_export_has_the_sets_poses(tmp_path):
    made = twin()
    given = {"driven": [CLAMP, LOAD], "colliders": [BALL]}
    made.export(made.simulate(frames=3, **given), tmp_path / "said", video=False, **given)
    made.world = replace(made.world, driven=driven_from_config([CLAMP]))
    made.export(made.simulate(frames=3), tmp_path / "own", video=False)
    for name, shapes in (("said", [1, -1]), ("own", [-1])):
        found = read_npz(tmp_path / name / "rollout.npz")
        assert found["simulation/collider_shape"][:, 0].tolist() == shapes
        assert found["simulation/collider_position"].shape == (3, len(shapes), 3)
        assert found["simulation/reactions"].shape[-2:] == (len(shapes), 6)
    with pytest.raises(ConfigError, match="colliders and driven: expected the 2 that"):
        made.export(made.simulate(frames=3, **given), tmp_path, colliders=[BALL], driven=[])

"""Driven particles in rollouts: they follow their motion, the body loses what the holder feels,
exact gradients, many worlds."""

import math

import pytest
import torch
from replay import Replay

from mosa.errors import ConfigError, DataError
from mosa.physics.contact.colliders import Box, Collider, HalfSpace, Particles, Sphere
from mosa.physics.contact.driven import Driven, driven_from_config, hold, loads
from mosa.physics.contact.motion import Motion, Points, exponential
from mosa.physics.engine.simulator import Simulator
from mosa.physics.time.adaptive_steps import StepControl
from mosa.physics.time.clock import Adaptive
from mosa.types import ParticleState

DX, SPACING, DENSITY, SUBSTEPS, FRAME_DT = 0.04, 0.02, 1000.0, 20, 4e-3
X = 0.003 + torch.cartesian_prod(*[(torch.arange(n).double() + 0.5) * SPACING for n in (12, 4, 4)])
LEFT, RIGHT = (X[:, 0] < 0.05).nonzero()[:, 0], (X[:, 0] > 0.2).nonzero()[:, 0]
LED = torch.tensor([[0.22, 0.02, 0.02], [0.22, 0.06, 0.05]]).double()
TIMES = [0.0, 0.003, 0.013]
DOWN = (0.0, -9.8, 0.0)


def rollout(colliders, state=None, frames=3, gravity=DOWN, mu=4e4, device="cpu", **options):
    state = ParticleState.at_rest(X.to(device)) if state is None else state
    simulator = Simulator("neo_hookean", dx=DX, substeps=SUBSTEPS, frame_dt=FRAME_DT, gravity=gravity, colliders=colliders,
                          dtype=torch.float64, device=device)  # fmt: skip
    volume = torch.full((state.x.shape[-2],), SPACING**3, dtype=torch.float64, device=device)
    return simulator.rollout(state, {"mu": mu, "lam": 5e4}, volume, DENSITY, frames, **options)


def sets(numbers, solid=True):
    """A sphere that touches the block, a rigid set and one that points lead; numbers (18,)."""
    v, omega, position, rotation = numbers[:12].unflatten(0, (4, 3))
    path = numbers[12:].unflatten(0, (2, 3))
    points = torch.stack([LED.to(path), LED.to(path) + path, LED.to(path) + 0.5 * path])
    ball = Motion((0.12, -0.035, 0.04), velocity=(0.0, 0.1, 0.0))
    return [
        *([Collider(Sphere(0.05), "separate", 0.2, motion=ball)] if solid else []),
        Collider(Particles(LEFT), motion=Motion(position, rotation, v, omega), name="rigid"),
        Collider(Particles(RIGHT), motion=Points(TIMES, points), name="led"),
    ]


NUMBERS = torch.tensor([0.1, 0.2, -0.1, 1.0, -2.0, 0.5, 0.02, 0.03, 0.03, 0.1, 0.2, 0.0,
                        0.003, 0.001, -0.002, 0.002, -0.001, 0.003]).double()  # fmt: skip
STEPS = torch.tensor([1e-4] * 6 + [1e-6] * 12).double()


def held(colliders):
    """Of the sets as they are at `NUMBERS`: places in their axes shall not move with these."""
    motions = [collider.motion for collider in sets(NUMBERS, False)]
    return hold([LEFT, RIGHT], motions, X, len(colliders) - 2)


def outcome(numbers, mu=4e4, device="cpu"):
    colliders = sets(numbers)
    out = rollout(colliders, mu=mu, device=device, held=held(colliders))
    weights = torch.linspace(0.3, 1.1, out.reactions.numel()).double().sin().to(device)
    pattern = torch.linspace(0, 50, 3 * len(X)).double().sin().view(-1, 3).to(device)
    return (pattern * (out.x[-1] + 0.01 * out.v[-1])).sum(), (
        1e-4 * weights * out.reactions.flatten()
    ).sum()


def test_gradients_are_those_of_differences():
    """Of motion and reactions, in pose and twist of a rigid set, in the path of points, and in the
    stiffness, beside a solid."""
    numbers, mu = NUMBERS.clone().requires_grad_(), torch.tensor(4e4).double().requires_grad_()
    found = torch.autograd.grad(sum(outcome(numbers, mu)), (numbers, mu))

    def at(i, step):
        moved = NUMBERS.clone()
        if i < len(moved):
            moved[i] += step
        with torch.no_grad():
            return float(sum(outcome(moved, 4e4 + (step if i == len(moved) else 0.0))))

    for i in (1, 4, 7, 9, 12, 17, 18):
        h = float(STEPS[i]) if i < len(NUMBERS) else 1.0
        expected = (at(i, h) - at(i, -h)) / (2 * h)
        got = float(found[0][i] if i < len(NUMBERS) else found[1])
        assert got == pytest.approx(expected, rel=1e-5)


def test_driven_particles_follow_their_motion():
    """To a two hundredth of a cell, however the set turns and moves over the grid, and points lead
    theirs."""
    numbers = torch.cat([NUMBERS[:15], NUMBERS[12:15]])
    out = rollout(sets(numbers), frames=6)
    moved = exponential(5 * FRAME_DT * NUMBERS[3:6])
    place = NUMBERS[6:9] + 5 * FRAME_DT * NUMBERS[:3] + (X[LEFT] - NUMBERS[6:9]) @ moved.T
    assert float((out.x[-1, LEFT] - place).norm(dim=1).max()) < 5e-3 * DX
    path = 0.5 * numbers[12:15]
    assert float((out.x[-1, RIGHT] - X[RIGHT] - path).norm(dim=1).max()) < 5e-3 * DX


def test_the_holder_feels_what_the_body_loses():
    """The impulse of all reactions and gravity is the change of momentum, to rounding; a free body
    is not changed by a solid or a set that are not there."""
    out = rollout(sets(NUMBERS), frames=4)
    mass = DENSITY * SPACING**3
    gained = mass * out.v[-1].sum(0)
    felt = out.reactions[..., :3].sum((0, 1, 2)) * FRAME_DT / SUBSTEPS
    weight = mass * len(X) * 3 * FRAME_DT * torch.tensor(DOWN, dtype=torch.float64)
    torch.testing.assert_close(gained, weight - felt, rtol=0, atol=1e-12)
    assert float(felt.norm()) > 0.01


def test_worlds_are_rollouts_of_their_own():
    """Each with motions and places of its own, in the bits of its own rollout."""
    others = NUMBERS * torch.linspace(0.8, 1.3, 18).double()
    own = [[collider.motion for collider in sets(each)] for each in (NUMBERS, others)]
    states = [ParticleState.at_rest(X + shift) for shift in (0.0, 0.013)]
    for together in (1, 2):
        many = rollout(
            sets(NUMBERS), ParticleState.stack(states), motions=own, together=together
        ).worlds()
        for state, motions, found in zip(states, own, many):
            alone = rollout(sets(NUMBERS), state, motions=motions)
            assert torch.equal(alone.x, found.x) and torch.equal(alone.reactions, found.reactions)


def test_chosen_substeps_are_replayed_to_the_bit():
    control = StepControl(minimum=SUBSTEPS, multiple=SUBSTEPS)
    out = rollout(sets(NUMBERS), timing=Adaptive(control))
    again = rollout(sets(NUMBERS), timing=Replay(out.counts))
    assert torch.equal(out.x, again.x)
    fixed = rollout(sets(NUMBERS))
    assert float((out.x - fixed.x).abs().max()) < 1e-3 * DX


def test_regions_choose_particles_and_loads_weigh_them():
    low = Driven(Box((0.1, 1.0, 1.0)), Motion(), name="end")
    assert torch.equal(low.chosen(X), LEFT)
    turned = Motion((0.2, 0.0, 0.0), (0.0, -math.pi / 2, 0.0))  # its xy plane faces -x
    assert torch.equal(Driven(HalfSpace(), turned).chosen(X), RIGHT)
    assert Driven(LED).chosen(X).tolist() == torch.cdist(LED, X).argmin(1).sort().values.tolist()
    volume = torch.full((len(X),), SPACING**3)
    added = loads([Driven(RIGHT, mass=0.5, held=False)], X, volume)
    assert float((added * volume).sum()) == pytest.approx(0.5) and float(added[LEFT].sum()) == 0
    entries = driven_from_config([
        {"name": "end", "type": "plane", "normal": [1, 0, 0], "position": [0.05, 0, 0], "motion": {"velocity": [0, 1, 0]}},
        {"indices": RIGHT.tolist(), "mass": 0.2, "held": False}, {"points": LED.tolist()},
    ])  # fmt: skip
    assert torch.equal(entries[0].chosen(X), LEFT) and entries[0].motion.max_speed(0.0) == 1
    assert torch.equal(entries[1].chosen(X), RIGHT) and not entries[1].held
    assert len(entries[2].chosen(X)) == 2


def test_points_of_a_file_lead_what_is_nearest(tmp_path):
    from mosa.system.npz import write_npz

    points = torch.stack([LED, LED + 0.01]).numpy()
    write_npz(tmp_path / "led.npz", {"times": torch.tensor([0.0, 0.1]).numpy(), "points": points})
    (led,) = driven_from_config([{"motion": {"path": str(tmp_path / "led.npz")}}])
    assert len(led.chosen(X)) == 2 and led.motion.points.shape == (2, 2, 3)
    (same,) = driven_from_config([{"motion": {"times": [0.0, 0.1], "points": points.tolist()}}])
    assert torch.equal(same.motion.points, led.motion.points)


@pytest.mark.parametrize("entry, said", [
    ({"type": "sphere", "radius": 0.1, "mode": "slip"}, r"driven\[0\]: unknown: mode"),
    ({"motion": {"velocity": [0, 1, 0]}}, "expected one of type"),
    ({"indices": [-1]}, r"driven\[0\].indices: expected a list of numbers of particles"),
    ({"indices": [1], "mass": -2.0}, r"driven\[0\].mass"),
    ({"type": "sphere"}, "a sphere needs radius"),
    ({"motion": {"times": [0.0, 1.0], "points": [[[1, 2, 3]], [[1, 2]]]}}, r"driven\[0\].motion: expected lists times"),
    ({"motion": {"times": [0.0, float("inf")], "points": [[[1, 2, 3]]] * 2}}, r"motion: times: .* ascending finite numbers"),
    ({"motion": {"file": "a.npz"}}, r"driven\[0\].motion.file: unknown key; expected one of velocity, .*, path, points"),
    ({"motion": {"points": [[[1, 2, 3]]]}}, r"driven\[0\].motion: expected path alone, or times and points"),
    ({"indices": [1], "held": False}, r"driven\[0\]: expected a mass and no motion with held: false"),
    ({"indices": [1], "held": False, "mass": 1.0, "motion": {}}, "found .*'motion'"),
])  # fmt: skip
def test_a_wrong_entry_names_its_key(entry, said):
    with pytest.raises(ConfigError, match=said):
        driven_from_config([entry])


def test_sets_that_hold_nothing_or_the_same_are_refused():
    with pytest.raises(
        ConfigError, match="driven set 'far': expected particles of the body inside"
    ):
        Driven(Sphere(0.1), Motion((5.0, 0.0, 0.0)), name="far").chosen(X)
    with pytest.raises(ConfigError, match="points: expected places on the body, found one"):
        Driven(torch.tensor([[100.0, 0.0, 0.0]]), name="far").chosen(X)
    with pytest.raises(DataError, match="/dev/zero: expected an npz file, found none"):
        driven_from_config([{"motion": {"path": "/dev/zero"}}])
    with pytest.raises(ConfigError, match="without a common particle, found particle"):
        hold([LEFT, LEFT], [Motion(), Motion()], X)
    with pytest.raises(ConfigError, match="after all solids"):
        rollout(sets(NUMBERS)[::-1])
    colliders = sets(NUMBERS)
    good = held(colliders)
    for name, value in (
        ("sets", good.sets + 9), ("sets", 0 * good.sets - 7), ("points", good.points + 9),
        ("sets", good.sets.to_sparse()), ("local", good.local.to("meta")), ("points", good.points[:3]),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=r"held: expected (dense tensors|driven sets)"):
            rollout(colliders, held=good._replace(**{name: value}))


@pytest.mark.gpu
def test_cuda_is_the_cpu():
    """Motion, reactions and gradients."""
    found = []
    for device in ("cpu", "cuda"):
        numbers = NUMBERS.clone().requires_grad_()
        mu = torch.tensor(4e4, dtype=torch.float64, device=device, requires_grad=True)
        both = outcome(numbers, mu, device)
        found.append(
            [*(b.detach().cpu() for b in both), *torch.autograd.grad(sum(both), (numbers, mu))]
        )
    for one, other in zip(*found):
        torch.testing.assert_close(one, other.cpu(), rtol=1e-9, atol=1e-12)

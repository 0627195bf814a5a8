"""Many worlds at once are so many single rollouts: states, reactions and gradients, in one launch and in threads."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from mosa.errors import ConfigError, SimulationDiverged
from mosa.physics.adapters.interface import AdapterOperator
from mosa.physics.contact.colliders import Collider, Sphere
from mosa.physics.contact.motion import Motion, Poses, sample_poses
from mosa.physics.contact.planes import Plane
from mosa.physics.engine.simulator import Simulator
from mosa.physics.time.adaptive_steps import StepControl
from mosa.physics.time.clock import Adaptive
from mosa.types import ParticleState

WORLDS, SUBSTEPS, FRAMES, DT = 4, 14, 4, 4e-4
GRAVITY = torch.tensor([[0.0, -9.8 - b, 0.4 * b] for b in range(WORLDS)], dtype=torch.float64)


def simulator(law="corotated", gravity=(0.0, -9.8, 0.0), dtype=torch.float64, **options):
    solids = [Collider(Sphere(0.06), "separate", 0.2), Collider(Sphere(0.05))]
    floor = Plane((0, 0.02, 0), (0, 1, 0), "separate", 0.3)
    return Simulator(law, dx=0.04, substeps=SUBSTEPS, frame_dt=SUBSTEPS * DT, dtype=dtype, gravity=gravity, up=(0, 1, 0),
                     planes=[floor], colliders=options.pop("colliders", solids), **options)  # fmt: skip


def motions(world):
    return [Motion((0.15, -0.02 + 0.01 * world, 0.1), velocity=(0.0, 0.5 * world, 0.1)),
            Motion((0.15, 0.16, 0.1), velocity=(0.1 * world, -1.0, 0.0))]  # fmt: skip


def operator(world, strength=0.1):
    """An operator that differs from particle to particle, and from world to world."""
    generator = torch.Generator().manual_seed(world)
    G = strength * torch.randn(64, 6, 6, generator=generator, dtype=torch.float64)
    return G, 50 * torch.randn(64, 6, generator=generator, dtype=torch.float64)


def loss(rollout):
    return (
        (rollout.x[1:] ** 2).sum()
        + (rollout.v[1:] ** 2).sum()
        + 1e-4 * (rollout.reactions**2).sum()
    )


ROUNDINGS = 1000
"""Of a GPU where a node's sum has one: fused products of 27 nodes, functions of a law within two units in the last place."""
LAWS = {"corotated": ({"lam": 5e4}, None), "von_mises": ({"lam": 5e4, "yield_stress": 300.0}, 0.05),
        "neo_hookean": ({"lam": 5e4}, 0.1)}  # fmt: skip


def test_particles_at_rest():
    x = torch.rand(2, 5, 3, dtype=torch.float64)
    one, both = ParticleState.at_rest(x[0]), ParticleState.at_rest(x)
    assert both.x is x and both.F is both.F_tot and both.F.is_contiguous()
    assert (
        torch.equal(both.F, torch.eye(3).double().expand(2, 5, 3, 3))
        and not both.v.any()
        and not both.C_affine.any()
    )
    for part, whole in zip(one.__dict__.values(), both.worlds()[0].__dict__.values(), strict=True):
        assert torch.equal(part, whole) and part.dtype == torch.float64


@pytest.mark.parametrize(
    ("x", "found"),
    [
        (np.zeros((5, 3)), "ndarray"),
        (torch.zeros(3, 5), r"torch\.float32 \(3, 5\)"),
        (torch.zeros(3), r"torch\.float32 \(3,\)"),
        (torch.zeros(5, 3, dtype=torch.long), r"torch\.int64 \(5, 3\)"),
    ],
)
def test_other_places_than_particles_at_rest_are_refused(x, found):
    with pytest.raises(ConfigError, match=rf"^x: expected a torch tensor .*, found {found}$"):
        ParticleState.at_rest(x)


def alone(world, start, law, order=slice(None)):
    """(rollout, gradients of velocities, mu and first collider's velocity) of one world by itself. order: of the particles, which
    `start` has already."""
    others, strength = LAWS[law]
    v, mu = (
        start.v.clone().requires_grad_(),
        torch.tensor(4e4 + 4e3 * world, dtype=torch.float64).requires_grad_(),
    )
    push = torch.tensor([0.0, 0.5 * world, 0.1], dtype=torch.float64).requires_grad_()
    moving = motions(world)
    moving[0] = replace(moving[0], velocity=push)
    answer = (
        None
        if strength is None
        else AdapterOperator(*(t[order] for t in operator(world, strength)))
    )
    found = simulator(law, GRAVITY[world]).rollout(
        replace(start, v=v), {"mu": mu, **others}, torch.full((64,), 8e-6).double(), 1000.0, FRAMES, motions=moving,
        adapter=None if answer is None else lambda _: answer, stride=None,
    )  # fmt: skip
    return found, torch.autograd.grad(loss(found), [v, mu, push])


def noise_of_order(world, start, law):
    """Largest changes of (positions [m], reactions, gradients of velocities and of mu) where the same particles come in other
    orders: each node's sums are then rounded otherwise, and the motion goes on from that."""
    own, (dv, dmu, _) = alone(world, start, law)
    changes = []
    for seed in range(4):
        order = torch.randperm(64, generator=torch.Generator().manual_seed(seed))
        names = ("x", "v", "C_affine", "F", "F_tot")
        found, (of_v, of_mu, _) = alone(
            world, ParticleState(*(getattr(start, name)[order] for name in names)), law, order
        )
        pairs = (
            (found.x, own.x[:, order]),
            (found.reactions, own.reactions),
            (of_v, dv[order]),
            (of_mu, dmu),
        )
        changes.append([float((a - b).abs().max()) for a, b in pairs])
    return [max(each) for each in zip(*changes)]


def batched(starts, law, together, sim=None):
    others, strength = LAWS[law]
    states = ParticleState.stack(starts)
    v = states.v.clone().requires_grad_()
    mu = torch.tensor(
        [[4e4 + 4e3 * b] for b in range(WORLDS)], dtype=torch.float64
    ).requires_grad_()
    push = torch.tensor(
        [[0.0, 0.5 * b, 0.1] for b in range(WORLDS)], dtype=torch.float64
    ).requires_grad_()
    moving = [motions(b) for b in range(WORLDS)]
    for own, velocity in zip(moving, push):
        own[0] = replace(own[0], velocity=velocity)
    answers = (
        [AdapterOperator(*operator(b, strength)) for b in range(WORLDS)]
        if strength is not None
        else None
    )
    found = (sim or simulator(law)).rollout(
        replace(states, v=v), {"mu": mu, **others}, torch.full((64,), 8e-6).double(), 1000.0, FRAMES, motions=moving,
        gravity=GRAVITY, adapter=answers and [lambda _, a=a: a for a in answers], stride=None, together=together,
    )  # fmt: skip
    return found, torch.autograd.grad(loss(found), [v, mu, push])


@pytest.mark.parametrize("law", LAWS)
def test_each_world_is_its_own_rollout_to_the_last_bit(law, make_block):
    """One world in a launch (threads), two, and all: the path of a GPU on the CPU, forward and adjoint, captured or not."""
    starts = [make_block(seed=b, velocity=(0.2 * b, -1.0 - 0.4 * b, 0.1)) for b in range(WORLDS)]
    expected = [alone(b, starts[b], law) for b in range(WORLDS)]
    assert all((a[0].x[-1] - b[0].x[-1]).abs().max() > 1e-3 for a, b in pairwise(expected))
    assert all(
        (own.reactions.abs().amax((0, 1, 3)) > 0.1).all() for own, _ in expected
    )  # both solids are felt
    for together in (None, 2, WORLDS):
        sim = simulator(law)
        for _ in range(2 if together == WORLDS else 1):  # the second time as captured graphs
            found, gradients = batched(starts, law, together, sim)
        for b, (own, (dv, dmu, dpush)) in enumerate(expected):
            part = found.worlds()[b]
            for name in ("x", "v", "F", "F_tot", "reactions"):
                assert torch.equal(getattr(part, name), getattr(own, name)), (together, b, name)
            assert torch.equal(part.final.C_affine, own.final.C_affine)
            assert torch.equal(gradients[0][b], dv) and torch.equal(gradients[2][b], dpush), (
                together,
                b,
            )
            torch.testing.assert_close(
                gradients[1][b, 0], dmu, rtol=1e-12, atol=0
            )  # torch sums particles in another order


def test_what_is_the_same_in_all_worlds_is_given_once(make_block):
    """Single numbers, one list of motions, one adapter asked for all particles; goes on from a state."""
    starts = [make_block(seed=b) for b in range(2)]
    volume, G = torch.full((64,), 8e-6).double(), operator(0)[0]
    sim, plain = simulator(), {"mu": 4e4, "lam": torch.linspace(4e4, 6e4, 64).double()}
    asked = []

    def adapter(state):
        asked.append(len(state.w))
        return AdapterOperator(
            G.repeat(len(state.w) // 64, 1, 1), torch.zeros(len(state.w), 6).double()
        )

    options = {"adapter": adapter, "stride": 4, "motions": motions(0)}
    both = sim.rollout(ParticleState.stack(starts), plain, volume, 1000.0, 3, **options)
    again = sim.rollout(
        both.final, plain, volume, 1000.0, 2, started=True, start_time=2 * sim.frame_dt, **options
    )
    assert both.reactions.shape == (2, SUBSTEPS, 2, 2, 6) and set(asked) == {128}
    for b, start in enumerate(starts):
        own = sim.rollout(start, plain, volume, 1000.0, 4, **options)
        assert torch.equal(own.x[:3], both.x[:, b])
        torch.testing.assert_close(
            again.x[1, b], own.x[3], rtol=0, atol=1e-14
        )  # times of the solids' poses are rounded


def test_segments_that_are_run_again_give_the_same_gradients(make_block, monkeypatch):
    starts = [make_block(seed=b) for b in range(WORLDS)]
    kept = batched(starts, "corotated", None)[1]
    monkeypatch.setattr("mosa.physics.engine.budget.KEPT_ON_CPU", 0)
    assert all(
        torch.equal(a, b) for a, b in zip(kept, batched(starts, "corotated", None)[1], strict=True)
    )


@pytest.mark.parametrize("together", [1, WORLDS])
def test_the_world_that_diverges_is_named(together, make_block):
    states = ParticleState.stack([make_block(seed=b) for b in range(WORLDS)])
    states.x[2, 7, 0] += 0.4
    law, box = {"mu": 4e4, "lam": 5e4}, torch.tensor([[-1.0, -1, -1], [0.4, 1, 1]])
    for change, message in (
        (0.0, r"^world 2: substep 0, particle 7: .*outside"),
        (4e3, r"^world 2: particles spread over"),
    ):
        states.v[2, 7, 1] = change
        with pytest.raises(SimulationDiverged, match=message):
            simulator(box=box).rollout(
                states, law, torch.full((64,), 8e-6).double(), 1000.0, 3, together=together
            )


@pytest.mark.parametrize("change, message", [
    ({"parameters": {"mu": torch.ones(3).double(), "lam": 1.0}}, 
     r"'mu': expected shape \(\) or \(64,\), \(2, 1\) or \(2, 64\), found \(3,\)"),
    ({"gravity": torch.zeros(3, 3)}, r"gravity: .*\(2, 3\), found shape \(3, 3\)"),
    ({"motions": [motions(0)] * 3}, r"motions: expected 2 sequences, one a world, found 3"),
    ({"motions": [motions(0), motions(0)[:1]]}, r"motions: expected one for each of 2 colliders, found 1"),
    ({"adapter": [lambda s: s] * 3}, r"adapter: expected one, or one for each of 2 worlds, found 3"),
    ({"together": 3}, r"together: expected a divisor of the 2 worlds, found 3"),
])  # fmt: skip
def test_errors_say_what_was_expected(change, message, make_block):
    arguments = {"state": ParticleState.stack([make_block(), make_block(seed=1)]), "parameters": {"mu": 4e4, "lam": 5e4},
                 "volume": torch.full((64,), 8e-6).double(), "density": 1000.0, "frames": 2} | change  # fmt: skip
    with pytest.raises(ConfigError, match=message):
        simulator().rollout(**arguments)
    with pytest.raises(
        ConfigError, match=r"x: expected shape \(worlds, particles, 3\), found \(1, 2, 64, 3\)"
    ):
        simulator().rollout(**(arguments | {"state": ParticleState.stack([arguments["state"]])}))
    with pytest.raises(ConfigError, match="gravity and together: expected None without worlds"):
        simulator().rollout(**(arguments | {"state": make_block(), "together": 1}))


@pytest.mark.gpu
@pytest.mark.parametrize("law", LAWS)
def test_on_cuda_each_world_is_its_own_rollout(law, make_block):
    """Sums over particles have no order there. What another order changes is measured on the CPU; a GPU also fuses products with
    sums, and rounds its functions otherwise."""
    starts = [make_block(seed=b, velocity=(0.2 * b, -1.0 - 0.4 * b, 0.1)) for b in range(WORLDS)]
    expected = [alone(b, starts[b], law) for b in range(WORLDS)]
    noise = [noise_of_order(b, starts[b], law) for b in range(WORLDS)]
    others, strength = LAWS[law]
    states = ParticleState(
        *(
            getattr(ParticleState.stack(starts), name).cuda()
            for name in ("x", "v", "C_affine", "F", "F_tot")
        )
    )
    sim = simulator(law, device="cuda")
    answers = strength and [
        AdapterOperator(*(t.cuda() for t in operator(b, strength))) for b in range(WORLDS)
    ]
    for _ in range(3):  # eager, captured, replayed
        v = states.v.clone().requires_grad_()
        mu = torch.tensor(
            [[4e4 + 4e3 * b] for b in range(WORLDS)], dtype=torch.float64, device="cuda"
        ).requires_grad_()
        found = sim.rollout(
            replace(states, v=v), {"mu": mu, **others}, torch.full((64,), 8e-6).double().cuda(), 1000.0, FRAMES,
            motions=[motions(b) for b in range(WORLDS)], gravity=GRAVITY, stride=None,
            adapter=answers and [lambda _, a=a: a for a in answers],
        )  # fmt: skip
        dv, dmu = torch.autograd.grad(loss(found), [v, mu])
        for b, (own, (own_dv, own_dmu, _)) in enumerate(expected):
            found_and_own = (
                (found.x[:, b], own.x),
                (found.reactions[:, :, b], own.reactions),
                (dv[b], own_dv),
                (dmu[b, 0], own_dmu),
            )
            for (a, c), changed in zip(found_and_own, noise[b], strict=True):
                allowed = ROUNDINGS * max(changed, 2e-16 * float(c.abs().max()))
                assert (a.cpu() - c).abs().max() <= allowed, (
                    law,
                    b,
                    float((a.cpu() - c).abs().max()),
                    allowed,
                )


def test_a_stepper_goes_on_from_a_state_with_poses_from_outside(make_block):
    """Frame by frame, from a moment of one's own, with poses given as tensors or as a function: the frames of a rollout."""
    state, volume, sim = make_block(), torch.full((64,), 8e-6).double(), simulator()
    law = {"mu": 4e4, "lam": 5e4}
    long = sim.rollout(state, law, volume, 1000.0, FRAMES, motions=motions(1))
    stepper, moment = sim.stepper(state, law, volume, 1000.0, motions=motions(1))
    poses = sample_poses(motions(1), FRAMES - 1, SUBSTEPS, sim.dt, 0.0)
    frames = [
        Poses(*(part[f * SUBSTEPS : (f + 1) * SUBSTEPS] for part in poses))
        for f in range(FRAMES - 1)
    ]
    for frame, given in enumerate((None, frames[1], lambda count, dt: frames[2])):
        before, (moment, reactions, count) = moment, stepper.step(moment, given)
        assert torch.equal(moment.state.x, long.x[frame + 1]) and torch.equal(
            reactions, long.reactions[frame]
        )
        assert count == SUBSTEPS and (moment.frames, moment.substeps) == (
            frame + 1,
            (frame + 1) * SUBSTEPS,
        )
    assert torch.equal(
        stepper.step(before, frames[2]).moment.state.x, moment.state.x
    )  # a moment is left as it is
    with pytest.raises(
        ConfigError, match=r"poses: position: expected shape \(14, 2, 3\), found \(13, 2, 3\)"
    ):
        stepper.step(before, Poses(*(part[1:] for part in frames[0])))
    again, begin = sim.stepper(before.state, law, volume, 1000.0, started=True)
    assert torch.equal(again.step(begin, frames[2]).moment.state.x, moment.state.x)
    both, pair = sim.stepper(
        ParticleState.stack([before.state] * 2),
        law,
        volume,
        1000.0,
        started=True,
        gravity=GRAVITY[:2] * 0,
    )
    given = Poses(
        *(
            torch.stack([part, part + (0.01 if i == 0 else 0)], 1)
            for i, part in enumerate(frames[2])
        )
    )
    found = both.step(pair, given)
    assert found.reactions.shape == (SUBSTEPS, 2, 2, 6) and not torch.equal(*found.moment.state.x)
    with pytest.raises(ConfigError, match="timing: expected None with many worlds"):
        sim.stepper(pair.state, law, volume, 1000.0, timing=Adaptive(StepControl()))

"""Baselines of the literature: each has the property that its own paper is about, starts where it says and loads again."""

import copy
import functools
import inspect
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from drawn_adapters import randomise
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from small_bodies import DX, FRAME_DT, FREE, STICKY, WORLD, lattice, small_body, start

from mosa.baselines.interaction import InteractionNetwork
from mosa.baselines.nclaw import NeuralLaw, invariants, matrix_of, polar_rotation, pretrain, vech_of
from mosa.baselines.neuma import LowRankLaw
from mosa.baselines.pair_dynamics import Frame
from mosa.config.build import build_body
from mosa.config.record import BodyRecord
from mosa.errors import ConfigError
from mosa.modules.adapters.registry import adapter_class
from mosa.modules.body.body import Body
from mosa.modules.body.material import Material, material_states
from mosa.physics.contact.planes import Plane
from mosa.twin.twin import Twin

CONF = Path(__file__).parents[2] / "conf"
E, NU = 3e4, 0.35


def rotations(count: int, seed: int = 0) -> torch.Tensor:
    A = torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(seed)).double()
    return torch.matrix_exp(A - A.mT)


def gradients(count: int, seed: int = 1) -> torch.Tensor:
    """(count, 3, 3) deformation gradients, |log stretch| about 0.2."""
    H = 0.15 * torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(seed)).double()
    return rotations(count, seed) @ torch.matrix_exp(0.5 * (H + H.mT))


def drawn(adapter, size: float = 0.3):
    adapter = adapter.double()
    randomise(adapter, size)
    adapter.switch_on(E, NU)
    return adapter


def kirchhoff(adapter: NeuralLaw, F: torch.Tensor) -> torch.Tensor:
    R = polar_rotation(F)
    w = vech_of(R.mT @ F - torch.eye(3).double())
    return R @ matrix_of(adapter.stress(w)) @ R.mT


def states(law="neo_hookean", **parameters):
    material = Material(law, {"E": E, "nu": NU, **parameters})
    return material_states(law, material.per_particle())


# ------------------------------------------------------------------------------------------------ networks in place of the law
def test_the_rotation_is_the_polar_one_with_its_gradient():
    F = gradients(6)
    U, _, Vh = torch.linalg.svd(F)
    torch.testing.assert_close(polar_rotation(F), U @ Vh, rtol=0, atol=1e-12)
    assert torch.autograd.gradcheck(polar_rotation, gradients(2).requires_grad_(True))


def test_invariants_have_gradients_also_where_singular_values_are_equal():
    W = torch.eye(3).double().expand(2, 3, 3) * torch.tensor([1.0, 1.3]).double()[:, None, None]

    def sums(A):
        x = invariants(
            0.5 * (A + A.mT)
        )  # a sum of equal singular values is smooth, each alone is not
        return torch.cat([x[:, :3].sum(1, keepdim=True), x[:, 3:]], 1)

    assert torch.autograd.gradcheck(sums, W.clone().requires_grad_(True))


@pytest.mark.parametrize("adapter", [NeuralLaw(plastic=True), LowRankLaw(plastic=True)])
def test_stress_and_flow_are_objective_whatever_the_weights(adapter):
    adapter = drawn(adapter)
    F, Q = gradients(20), rotations(20, seed=5)
    torch.testing.assert_close(
        kirchhoff(adapter, Q @ F), Q @ kirchhoff(adapter, F) @ Q.mT, rtol=1e-9, atol=1e-12
    )
    flowed = adapter.flow(F, 1e-3)
    assert (flowed - F).abs().max() > 1e-6
    torch.testing.assert_close(adapter.flow(Q @ F, 1e-3), Q @ flowed, rtol=1e-9, atol=1e-12)


def test_it_is_stress_free_at_rest_and_may_be_anisotropic():
    adapter = drawn(NeuralLaw())
    assert torch.equal(adapter.stress(torch.zeros(3, 6).double()), torch.zeros(3, 6).double())
    F, Q = gradients(20), rotations(20, seed=5)
    turned, fixed = kirchhoff(adapter, F @ Q.mT), kirchhoff(adapter, F)
    assert (
        turned - fixed
    ).norm() > 0.05 * fixed.norm()  # an isotropic law knows no rotation of the rest shape


def test_they_have_as_many_weights_as_the_papers():
    assert sum(p.numel() for p in NeuralLaw().parameters()) == 5504
    learned = [p for p in LowRankLaw().parameters() if p.requires_grad]
    assert sum(p.numel() for p in learned) == 4448


def test_pretraining_reaches_a_law_within_three_percent():
    torch.manual_seed(0)
    assert pretrain(NeuralLaw().double().elastic, states(), E) < 0.03


@functools.cache
def prepared(kind: type[NeuralLaw]) -> NeuralLaw:
    """Not to be changed: a network is fitted to a law in three seconds."""
    torch.manual_seed(0)
    adapter = kind().double()
    adapter.switch_on(E, NU)
    adapter.prepare("neo_hookean", states())
    return adapter


def test_low_rank_starts_as_the_pretrained_network_and_learns_no_weight_of_it():
    adapter = copy.deepcopy(prepared(LowRankLaw))
    w = 0.05 * torch.randn(10, 6, generator=torch.Generator().manual_seed(0)).double()
    state = states()(torch.eye(3).double() + matrix_of(w))
    before = adapter.stress(state.w)
    assert (before - state.stress / E).norm() < 0.03 * (state.stress / E).norm()
    with torch.no_grad():
        for layer in adapter.elastic[::2]:
            layer.weight.zero_()
    assert torch.equal(
        adapter.stress(state.w), torch.zeros_like(before)
    )  # the change is nothing yet
    adapter.stress(state.w).sum().backward()
    assert all(p.grad is None for n, p in adapter.named_parameters() if n.endswith("weight"))


def adapted(adapter, law="neo_hookean", **options) -> Body:
    body = small_body(adapter=False, law=law, E=E, nu=NU, **options)
    body.adapter = adapter.double()
    adapter.settle(body.rest, body.volume)
    adapter.switch_on(E, NU)
    return body


@pytest.mark.parametrize("kind", [NeuralLaw, LowRankLaw])
def test_a_body_begins_as_its_prior_moves(kind):
    body = adapted(copy.deepcopy(prepared(kind)))
    with torch.no_grad():
        learned, prior = (body.simulate(start(speed=-0.5), WORLD, 8, FRAME_DT, model=body.model().only(adapter=on))
                          for on in (True, False))  # fmt: skip
    distance = (learned.x - prior.x).norm(dim=-1)
    assert 0 < distance.max() < 0.05 * DX


def test_a_plastic_network_takes_the_place_of_the_return_mapping():
    body = small_body(adapter=False)
    body.material = Material("von_mises", {"E": E, "nu": NU, "yield_stress": 50.0}).double()
    body.adapter = adapter = NeuralLaw(plastic=True, start="random").double()
    adapter.switch_on(E, NU)
    pretrain(adapter.elastic, states("von_mises", yield_stress=50.0), E, iterations=50)
    moved = {}
    with torch.no_grad():
        for name in ("none", "some"):
            rollout = body.simulate(start(), WORLD, 8, FRAME_DT)
            moved[name] = (rollout.F - rollout.F_tot).abs().max()
            randomise(adapter.plastic, 0.3)
        alone = body.simulate(start(), WORLD, 8, FRAME_DT, model=body.model().only(adapter=False))
    assert (
        moved["none"] < 1e-12 and moved["some"] > 1e-4
    )  # without flow it is elastic, however low the prior's yield stress is
    assert (alone.F - alone.F_tot).abs().max() > 1e-3


def test_a_plastic_network_needs_a_law_that_yields():
    adapter = NeuralLaw(plastic=True)
    adapter.switch_on(E, NU)
    with pytest.raises(ConfigError, match=r"adapter\.plastic.*von_mises.*neo_hookean"):
        adapter.prepare("neo_hookean", states())


# ------------------------------------------------------------------------------------------------ pair forces
def interacting(**options) -> tuple[InteractionNetwork, torch.Tensor]:
    adapter = InteractionNetwork(nodes=60, neighbours=16, **options)
    rest = lattice()
    adapter.double().settle(rest, torch.full((len(rest),), (DX / 2) ** 3).double())
    return drawn(adapter), rest


def test_pair_forces_keep_momentum_and_angular_momentum_and_turn_with_the_frame():
    adapter, rest = interacting()
    generator = torch.Generator().manual_seed(3)
    x = rest[adapter.nodes] + 0.1 * DX * torch.randn(60, 3, generator=generator).double()
    v = torch.randn(60, 3, generator=generator).double()
    f = adapter.forces(x, v, 1000.0)
    size = f.abs().max()
    assert size > 0 and f.sum(0).abs().max() < 1e-12 * size
    assert torch.linalg.cross(x, f).sum(0).abs().max() < 1e-12 * size
    Q = rotations(1)[0]
    torch.testing.assert_close(
        adapter.forces(x @ Q.T + 0.3, v @ Q.T, 1000.0),
        f @ Q.T,
        rtol=1e-9,
        atol=1e-9 * float(size.detach()),
    )


def test_the_bonds_have_the_bulk_modulus_of_a_quarter_before_anything_is_learned():
    adapter = InteractionNetwork(nodes=60, neighbours=16)
    rest = lattice()
    adapter.double().settle(rest, torch.full((len(rest),), (DX / 2) ** 3).double())
    adapter.switch_on(E, NU)
    strain = 1e-3
    x = rest[adapter.nodes] * (1 + strain)
    virial = -(adapter.forces(x, torch.zeros_like(x), 1000.0) * rest[adapter.nodes]).sum()
    pressure = float(virial.detach()) / (3 * float(adapter.node_volume.sum()))
    assert pressure == pytest.approx(
        3 * strain * E / (3 * (1 - 2 * 0.25)), rel=1e-3
    )  # strains are logarithms


def test_a_falling_body_is_rigid_until_it_lands_and_then_bounces():
    body = adapted(InteractionNetwork(nodes=60, neighbours=16))
    with torch.no_grad():
        free = body.simulate(start(turn=0.7, spin=(0.0, 0.0, 0.0)), FREE, 4, FRAME_DT)
        fallen = body.simulate(start(), WORLD, 12, FRAME_DT)
    moved = free.x - free.x[:1]
    torch.testing.assert_close(moved, moved[:, :1].expand_as(moved), rtol=0, atol=1e-12)
    torch.testing.assert_close(free.F, free.F[:1].expand_as(free.F), rtol=0, atol=1e-9)
    heights = fallen.x[:, :, 1]
    assert heights.min() > -0.1 * DX and fallen.v[-1, :, 1].mean() > fallen.v[0, :, 1].mean()
    assert fallen.inverted == 0


def test_a_body_leaves_sticky_ground_too():
    body = adapted(InteractionNetwork(nodes=60, neighbours=16))
    with torch.no_grad():
        rollout = body.simulate(start(speed=-2.0), STICKY, 14, FRAME_DT)
    lowest = rollout.x[..., 1].amin(1)
    assert lowest.min() < 0.5 * DX and lowest[-1] > lowest.min() + 0.1 * DX


def test_its_rollout_has_gradients():
    body = adapted(InteractionNetwork(nodes=40, neighbours=8))
    rollout = body.simulate(start(), WORLD, 6, FRAME_DT)
    rollout.x[-1].square().sum().backward()
    assert body.adapter.net[-1].weight.grad.abs().max() > 0


def rolled(body: Body, device: str, rollouts: int) -> list[torch.Tensor]:
    """Positions and gradients of the last of several rollouts, the weights stepped after each."""
    body, world = (
        body.to(device),
        replace(
            WORLD, **{name: getattr(WORLD, name).to(device) for name in ("gravity", "up", "box")}
        ),
    )
    for _ in range(rollouts):
        first = start()
        moved = {name: t for name, t in vars(first).items() if isinstance(t, torch.Tensor)}
        first = replace(first, **{n: t.to(device).requires_grad_() for n, t in moved.items()})
        weights = list(body.adapter.net.parameters())
        rollout = body.simulate(first, world, 6, FRAME_DT)
        found = torch.autograd.grad(
            rollout.x.square().sum() + rollout.F.square().sum(), [first.velocity, *weights]
        )
        with torch.no_grad():
            for weight, gradient in zip(weights, found[1:]):
                weight -= 0.01 * gradient / (gradient.norm() + 1e-12)
    return [t.detach().cpu() for t in (rollout.x, *found)]


def test_the_adjoint_of_its_frames_is_that_of_their_substeps():
    body = adapted(InteractionNetwork(nodes=40, neighbours=8))
    x, v = (
        torch.nn.Parameter(lattice()[body.adapter.nodes]),
        torch.full((40, 3), 0.1).double().requires_grad_(),
    )
    dynamics = body.adapter.simulator(1000.0, WORLD, FRAME_DT)
    dynamics.substeps = 5
    weights = tuple(body.adapter.net.parameters())
    moved = Frame.apply(dynamics.frame, x, v, *weights)
    moved = Frame.apply(dynamics.frame, *moved, *weights)
    there = dynamics.frame(*dynamics.frame(x, v, *weights), *weights)
    torch.testing.assert_close(moved, there, rtol=0, atol=0)
    found, expected = (
        torch.autograd.grad(each[0].square().sum() + each[1].sum(), [x, v, *weights])
        for each in (moved, there)
    )
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-12)


def test_weights_that_change_before_the_adjoint_are_an_error():
    body = adapted(InteractionNetwork(nodes=40, neighbours=8))
    rollout = body.simulate(start(), WORLD, 3, FRAME_DT)
    with torch.no_grad():
        body.adapter.net[-1].weight.add_(0.1)
    with pytest.raises(RuntimeError, match="inplace"):
        rollout.x[-1].square().sum().backward()


def test_a_body_with_pair_forces_is_copied_and_moves_alike():
    body = adapted(InteractionNetwork(nodes=40, neighbours=8))
    with torch.no_grad():
        here = body.simulate(start(), WORLD, 3, FRAME_DT)
        there = copy.deepcopy(body).simulate(start(), WORLD, 3, FRAME_DT)
    torch.testing.assert_close(here.x, there.x, rtol=0, atol=0)


def test_a_corrected_prediction_is_one_rollout_of_each_frame():
    body, gain = adapted(InteractionNetwork(nodes=40, neighbours=8)), 0.3
    with torch.no_grad():
        seen = body.simulate(start(speed=-1.2), WORLD, 4, FRAME_DT).x
        found = body.simulate(start(), WORLD, 4, FRAME_DT, observed=seen, gain=gain)
        ready = body.ready(start(), WORLD, 4, FRAME_DT)
        state, expected = ready.state, []
        for k in range(3):
            away = seen[k] + ready.lift - state.x
            state = replace(state, v=state.v + gain / FRAME_DT * away)
            state = ready.simulator.rollout(state, frames=2).final
            expected.append(state.x - ready.lift)
    torch.testing.assert_close(found.x[1:], torch.stack(expected), rtol=0, atol=1e-12)


@pytest.mark.gpu
def test_pair_forces_on_cuda_as_on_a_cpu():
    body = adapted(InteractionNetwork(nodes=40, neighbours=8))
    found, expected = (rolled(copy.deepcopy(body), device, 4) for device in ("cuda", "cpu"))
    for here, there in zip(found, expected):
        assert (here - there).abs().max() <= 1e-8 * max(1.0, float(there.abs().max()))


def test_walls_and_colliders_are_refused():
    body = adapted(InteractionNetwork(nodes=40, neighbours=8))
    walled = replace(WORLD, planes=(Plane((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),))
    with pytest.raises(ConfigError, match=r"adapter=interaction.*walls"):
        body.simulate(start(), walled, 3, FRAME_DT)
    with pytest.raises(ConfigError, match=r"adapter=interaction.*whole rollout"):
        body.ready(start(), WORLD, 3, FRAME_DT).simulator.stepper()
    made = Twin(body, WORLD, FRAME_DT, None, start())
    with pytest.raises(ConfigError, match="worlds: expected a law, found an adapter that moves"):
        made.worlds(2).reset()
    with pytest.raises(ConfigError, match="nu: expected E and density alone, found an adapter"):
        made.material.nu = 0.2


# ------------------------------------------------------------------------------------------------ all of them
BASELINES = {"nclaw": NeuralLaw, "neuma": LowRankLaw, "interaction": InteractionNetwork}


@pytest.mark.parametrize("kind", BASELINES.values())
def test_a_modulus_that_is_set_is_that_of_what_was_learned(kind):
    """A body of four times the modulus and the density moves as before."""
    pairs = kind is InteractionNetwork
    learned = kind(nodes=40, neighbours=8) if pairs else copy.deepcopy(prepared(kind))
    made = Twin(adapted(learned), WORLD, FRAME_DT, None, start(speed=-0.5))
    expected = made.simulate(frames=8)
    made.material.set(E=4 * made.material.E, density=4 * made.material.density)
    torch.testing.assert_close(made.simulate(frames=8).x, expected.x, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", BASELINES)
def test_the_file_lists_the_arguments_with_their_defaults(name):
    keys = OmegaConf.to_container(OmegaConf.load(CONF / "adapter" / f"{name}.yaml"))["adapter"]
    assert adapter_class(keys) is BASELINES[name] and keys.pop("name")
    assert keys == {n: p.default for n, p in inspect.signature(BASELINES[name]).parameters.items()}


@pytest.mark.parametrize("name", BASELINES)
def test_a_body_that_is_built_again_and_loaded_moves_alike(name):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("train", overrides=["debug=default", f"adapter={name}", "prior=neo_hookean"])
    world = {"gravity": [0, -9.8, 0], "up": [0, 1, 0], "box": [[-1, -1, -1], [1, 1, 1]]}
    settings = OmegaConf.to_container(cfg, resolve=True)
    record = BodyRecord(
        settings=settings, ground=None, world=world, density=1000.0, dx=DX, frame_dt=0.02
    )
    rest = lattice().float()
    n = len(rest)
    tensors = {
        "rest": rest,
        "volume": torch.full((n,), (DX / 2) ** 3),
        "colors": torch.ones(n, 3),
        "opacities": torch.ones(n),
        "covariances": 1e-4 * torch.eye(3).expand(n, 3, 3),
    }
    first = build_body(record, tensors)
    first.adapter.switch_on(E, NU)
    randomise(first.adapter, 0.1)
    again = build_body(record.but(settings=settings | {"seed": 7}), tensors)
    again.load_state_dict(first.state_dict())
    with torch.no_grad():
        here, there = (
            body.simulate(start(dtype=torch.float32), WORLD, 4, FRAME_DT) for body in (first, again)
        )
    assert torch.equal(here.x, there.x)

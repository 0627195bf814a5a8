"""A chain of segments against the same segments one by one: states, gradients and statistics; captured graphs on CUDA."""

from contextlib import ExitStack
from dataclasses import replace
from unittest.mock import patch

import pytest
import torch
from replay import Replay
from torch import nn
from torch.func import functional_call

from mosa.errors import ConfigError, SimulationDiverged
from mosa.modules.adapters.penalties import pool
from mosa.modules.adapters.stress import StressAdapter
from mosa.physics.adapters.chain_schedule import SEGMENT, Chains, chain_length, grouped
from mosa.physics.adapters.interface import AdapterOperator
from mosa.physics.contact.colliders import Collider, Sphere
from mosa.physics.contact.motion import Motion
from mosa.physics.engine import budget
from mosa.physics.engine import solver as solver_module
from mosa.physics.engine import stepping as stepping_module
from mosa.physics.engine.capture import ATTEMPTS
from mosa.physics.engine.law_options import LawOptions
from mosa.physics.engine.simulator import Simulator
from mosa.physics.time.adaptive_steps import StepControl
from mosa.physics.time.clock import Adaptive
from mosa.types import Ground, ParticleState

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]
E, NU = 2e4, 0.3


def adapter_of(device: str, dtype: torch.dtype, plastic: bool) -> StressAdapter:
    adapter = StressAdapter(hidden=16, plastic=plastic, fused=False).to(dtype)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for p in adapter.parameters():
            p.copy_(0.3 * torch.randn(p.shape, generator=generator, dtype=torch.float64))
    adapter.switch_on(E, NU)
    return adapter.to(device)


def simulator(chained: bool, law: str = "corotated", **options) -> Simulator:
    sim = Simulator(law, **{"dx": 0.04, "dtype": torch.float64, **options})
    sim.gathers = chained
    return sim


def rolled(
    chained,
    law,
    device,
    dtype,
    state,
    adapter,
    *,
    stride=2,
    substeps=11,
    frames=4,
    penalised=True,
    source="tape",
    worlds=0,
    timing=None,
    **options,
):
    """(frames x, F, F_tot, statistics of the evaluations, reactions) and gradients of a sum of them, all on the CPU in float64.

    source: of the states in the backward pass, tape | states; worlds: so many, which move at other speeds."""
    names = ("x", "v", "C_affine", "F", "F_tot")
    state = ParticleState(*(getattr(state, name).to(device=device, dtype=dtype) for name in names))
    mu = torch.full((), E / (2 * (1 + NU)), device=device, dtype=dtype, requires_grad=True)
    v0 = torch.zeros(3, device=device, dtype=dtype, requires_grad=True)
    parameters = {"mu": mu, "lam": 1e4, **({"yield_stress": 300.0} if law == "von_mises" else {})}
    sim = simulator(
        chained,
        law,
        substeps=substeps,
        frame_dt=4e-4 * substeps,
        ground=Ground(0.0),
        dtype=dtype,
        device=device,
        **options,
    )
    volume = torch.full((len(state.x),), 8e-6, device=device, dtype=dtype)
    weights = [p for p in adapter.parameters() if p.requires_grad]

    def rollout(collected):
        start, common = replace(state, v=state.v + v0), {"adapter": adapter, "stride": stride}
        if not worlds:
            return sim.rollout(
                start,
                parameters,
                volume,
                1000.0,
                frames,
                **common,
                collect=collected.append,
                timing=timing,
            )
        starts = [replace(start, v=(1 - 0.1 * world) * start.v) for world in range(worlds)]
        return sim.rollout(
            ParticleState.stack(starts),
            parameters,
            volume,
            1000.0,
            frames,
            **common,
            together=worlds,
        )

    def once():
        collected = []
        with ExitStack() as stack:
            for name in ("KEPT_ON_CPU", "KEPT_SHARE"):
                stack.enter_context(
                    patch.object(budget, name, getattr(budget, name) if source == "tape" else 0)
                )
            stack.enter_context(patch.object(Chains, "limit", lambda *_: SEGMENT))
            found = rollout(collected)
            loss, values = (
                (found.x**2).sum() + (found.F_tot**2).sum(),
                [found.x, found.F, found.F_tot],
            )
            if collected:
                over_all = pool(collected)
                loss = loss + (10 * over_all.mean_square + over_all.variance) * penalised
                values += [over_all.mean, over_all.within]
            if found.reactions is not None:
                loss, values = loss + found.reactions.square().sum(), [*values, found.reactions]
            gradients = torch.autograd.grad(loss, [mu, v0, *weights], allow_unused=True)
        values += [g for g in gradients if g is not None]
        return [t.detach().cpu().double() for t in values], len(collected)

    once.chains = sim.buffers.chains
    return once


def assert_same(found, expected, tolerance):
    for index, (a, b) in enumerate(zip(found, expected, strict=True)):
        assert (a - b).abs().max() <= tolerance * max(1e-3, float(b.abs().max())), index


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    "law, plastic", [("corotated", False), ("von_mises", True), ("von_mises", False)]
)
@pytest.mark.parametrize("penalised", [True, False])
def test_a_chain_is_its_segments(device, law, plastic, penalised, make_block):
    """11 substeps of a frame are 6 evaluations, the last for one substep. On CUDA: eager, then captured, then replayed."""
    adapter = adapter_of(device, torch.float64, plastic)
    make = (law, device, torch.float64, make_block(n=5, velocity=(0.3, -1.0, 0.2)), adapter)
    expected, evaluations = rolled(False, *make, penalised=penalised)()
    for source in ("tape", "states"):
        once = rolled(True, *make, penalised=penalised, source=source)
        for _ in range(2 if device == "cpu" else 3):
            found, count = once()
            assert count == evaluations
            assert_same(found, expected, 1e-11 if device == "cpu" else 1e-9)


BALL = Collider(
    Sphere(0.05), "separate", 0.3, Motion(position=(0.15, -0.015, 0.11), velocity=(0.0, 2.0, 0.0))
)
KINDS = {
    "colliders": {"colliders": [BALL]}, "worlds": {"worlds": 3}, "worlds, colliders": {"worlds": 2, "colliders": [BALL]},
    "replayed": {"timing": Replay([4, 11, 6])}, "replayed, colliders": {"timing": Replay([5, 9, 7], 0.0), "colliders": [BALL]},
    "adaptive": {"timing": Adaptive(StepControl(maximum=40, minimum=4, multiple=2))},
}  # fmt: skip


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("kind", KINDS)
def test_a_chain_knows_colliders_worlds_and_steps_that_vary(device, kind, make_block):
    """On CUDA: eager, then captured, then replayed, a graph for each time step."""
    adapter = adapter_of(device, torch.float64, False)
    make = ("corotated", device, torch.float64, make_block(n=4, velocity=(0.3, -1.0, 0.2)), adapter)
    expected, evaluations = rolled(False, *make, **KINDS[kind])()
    for source in ("tape", "states"):
        once = rolled(True, *make, source=source, **KINDS[kind])
        for _ in range(1 if device == "cpu" else 3):
            found, count = once()
            assert count == evaluations and once.chains
            assert_same(found, expected, 1e-11 if device == "cpu" else 1e-9)
    if "colliders" in kind:
        assert (
            float(expected[-len([*adapter.parameters()]) - 3].abs().max()) > 1e-3
        )  # the ball is hit


@pytest.mark.parametrize("device", DEVICES)
def test_steps_in_chains_are_the_frames_of_a_rollout(device, make_block):
    adapter, state = (
        adapter_of(device, torch.float64, False),
        make_block(n=4, velocity=(0.3, -1.0, 0.2)),
    )
    state = ParticleState(
        *(getattr(state, name).to(device) for name in ("x", "v", "C_affine", "F", "F_tot"))
    )
    given = (
        {"mu": 8e3, "lam": 1e4},
        torch.full((len(state.x),), 8e-6, dtype=torch.float64, device=device),
        1000.0,
    )
    sim = simulator(True, substeps=11, frame_dt=4.4e-3, device=device)
    mu = given[0]["mu"] = torch.tensor(8e3, dtype=torch.float64, device=device, requires_grad=True)
    weights = [mu, *adapter.parameters()]
    whole = sim.rollout(state, *given, 4, adapter=adapter, stride=2).x[-1]
    stepper, moment = sim.stepper(state, *given, adapter, 2)
    for _ in range(3):
        moment = stepper.step(moment).moment
    found, expected = (
        [x.detach(), *torch.autograd.grad(x.square().sum(), weights)]
        for x in (moment.state.x, whole)
    )
    assert sim.buffers.chains
    assert_same(found, expected, 0.0 if device == "cpu" else 1e-9)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("law, plastic", [("corotated", False), ("von_mises", True)])
@pytest.mark.parametrize("source", ["tape", "states"])
@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-9), (torch.float32, 2e-3)])
def test_evaluations_after_an_odd_number_of_substeps(
    device, law, plastic, source, dtype, tolerance, make_block
):
    """Of 125 particles the second slot of the adjoints begins at no multiple of 16 bytes; gradients are added to it in place."""
    adapter = adapter_of(device, dtype, plastic)
    make = (law, device, dtype, make_block(n=5, velocity=(0.3, -1.0, 0.2)), adapter)
    expected, evaluations = rolled(False, *make, stride=1, substeps=5)()
    found, count = rolled(True, *make, stride=1, substeps=5, source=source)()
    assert count == evaluations == 15 + plastic
    assert_same(found, expected, tolerance)


@pytest.mark.parametrize("device", DEVICES)
def test_graphs_follow_new_weights_states_and_windows(device, make_block):
    """What a graph holds by value or address may not outlive it: weights change in place and by copy, the body moves."""
    adapter = adapter_of(device, torch.float64, False)
    near, far = (
        make_block(n=5, velocity=(0.3, -1.0, 0.2)),
        make_block(n=5, velocity=(30.0, 20.0, -10.0)),
    )
    for state in (near, near, near, far, far, far, near):
        make = ("corotated", device, torch.float64, state, adapter)
        expected, _ = rolled(False, *make)()
        assert_same(rolled(True, *make)()[0], expected, 1e-9)
        with torch.no_grad():
            for p in adapter.parameters():
                p.mul_(0.9)
    once = rolled(True, *make)
    for _ in range(3):
        adapter.load_state_dict(adapter_of(device, torch.float64, False).state_dict())
        for module in adapter.operator.phi.children():
            if isinstance(module, nn.Linear):
                module.weight = nn.Parameter(0.8 * module.weight.detach())
        expected, _ = rolled(False, *make)()
        assert_same(rolled(True, *make)()[0], expected, 1e-9)
        once()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("collects", [True, False])
def test_rollouts_with_and_without_gradients_take_turns(device, collects, make_block):
    """They share a chain where their segments are alike. Neither replays what the other left: statistics, windows, mass cutoffs."""
    adapter, near = (
        adapter_of(device, torch.float64, False),
        make_block(n=5, velocity=(0.3, -1.0, 0.2)),
    )
    near = replace(
        near, v=near.v + torch.tensor([4.0, 3.0, -2.0], dtype=torch.float64) * near.x[:, :1]
    )
    far = replace(
        near, v=near.v + torch.tensor([60.0, 40.0, -30.0], dtype=torch.float64) * near.x[:, :1]
    )
    weights = list(adapter.parameters())
    sims = [
        simulator(chained, substeps=8, frame_dt=3.2e-3, device=device) for chained in (False, True)
    ]
    volume = torch.full((len(near.x),), 8e-6, dtype=torch.float64, device=device)

    def result(sim, state, cutoff, differentiated):
        sim.options, collected = LawOptions(mass_cutoff=cutoff), []
        state = ParticleState(
            *(getattr(state, name).to(device) for name in ("x", "v", "C_affine", "F", "F_tot"))
        )
        with torch.set_grad_enabled(differentiated):
            x = sim.rollout(
                state,
                {"mu": 8e3, "lam": 1e4},
                volume,
                1000.0,
                3,
                adapter=adapter,
                stride=2,
                collect=collected.append if collects else None,
            ).x
        gradients = torch.autograd.grad(1e4 * x.square().sum(), weights) if differentiated else []
        return [
            t.detach().cpu()
            for t in (x, *gradients, *(part for each in collected for part in each))
        ]

    for state, cutoff, differentiated in [
        (near, 0.0, True), (near, 0.0, False), (near, 0.0, True), (near, 0.0, False), (near, 0.0, True), (far, 0.0, True),
        (near, 0.0, False), (far, 1e-4, True), (near, 1e-4, False), (near, 1e-4, True), (far, 0.0, False), (far, 0.0, True),
    ]:  # fmt: skip
        expected, found = (result(sim, state, cutoff, differentiated) for sim in sims)
        assert_same(found, expected, 1e-9 if device == "cuda" else 1e-11)
        with torch.no_grad():
            for weight in weights:
                weight.mul_(0.97)


@pytest.mark.parametrize("device", DEVICES)
def test_two_rollouts_before_their_backward_passes(device, make_block):
    """Of different mass cutoffs, which a graph holds by value."""
    adapter, state = (
        adapter_of(device, torch.float64, False),
        make_block(n=5, velocity=(0.3, -1.0, 0.2)),
    )
    state = ParticleState(
        *(getattr(state, name).to(device) for name in ("x", "v", "C_affine", "F", "F_tot"))
    )
    volume = torch.full((len(state.x),), 8e-6, dtype=torch.float64, device=device)
    weights, found = list(adapter.parameters()), []
    for chained in (False, True):
        sim = simulator(chained, substeps=4, frame_dt=1.6e-3, device=device)
        for _ in range(3):
            losses = []
            for sim.options in (LawOptions(mass_cutoff=1e-3), LawOptions(mass_cutoff=1e-2)):
                x = sim.rollout(
                    state, {"mu": 8e3, "lam": 1e4}, volume, 1000.0, 3, adapter=adapter, stride=1
                ).x
                losses.append(1e4 * x.square().sum())
            found.append([g.cpu() for loss in losses for g in torch.autograd.grad(loss, weights)])
    assert float((found[0][0] - found[0][len(weights)]).abs().max()) > 1e-3 * float(
        found[0][0].abs().max()
    )
    assert float(found[0][0].abs().max()) > 1e-3
    for gradients in found[3:]:
        assert_same(gradients, found[0], 1e-9)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("law, plastic", [("corotated", False), ("von_mises", True)])
@pytest.mark.parametrize("pull, foreseen", [(9.8, True), (3000.0, False)])
def test_frames_under_one_look_are_the_frames_one_by_one(
    device, law, plastic, pull, foreseen, make_block, looks, monkeypatch
):
    """A pull that is not foreseen takes the body out of their window."""
    monkeypatch.setattr(Chains, "limit", lambda *_: 40)
    monkeypatch.setattr(stepping_module, "AHEAD", 40)
    if not foreseen:
        monkeypatch.setattr(solver_module, "fallen", lambda bounds, *_: bounds)
    adapter, state = (
        adapter_of(device, torch.float64, plastic),
        make_block(n=5, velocity=(0.3, -1.0, 0.2)),
    )
    state = ParticleState(
        *(getattr(state, name).to(device) for name in ("x", "v", "C_affine", "F", "F_tot"))
    )
    volume = torch.full((len(state.x),), 8e-6, dtype=torch.float64, device=device)
    parameters = {"mu": 8e3, "lam": 1e4, **({"yield_stress": 300.0} if law == "von_mises" else {})}
    found = {}
    for chained in (False, True):
        sim = simulator(
            chained, law, substeps=11, frame_dt=4.4e-3, gravity=(0.0, -pull, 0.0), device=device
        )
        for _ in range(3):  # on CUDA: eager, captured, replayed
            collected, frames = [], []
            with torch.no_grad():
                rollout = sim.rollout(state, parameters, volume, 1000.0, 6, adapter=adapter, stride=2, collect=collected.append,
                                      progress=frames.append)  # fmt: skip
            assert frames == [1, 2, 3, 4, 5] and len(collected) == 30 + plastic
            values = [
                rollout.x,
                rollout.v,
                rollout.F,
                rollout.F_tot,
                rollout.final.C_affine,
                rollout.final.F,
            ]
            values += [part for each in collected for part in each]
            found.setdefault(chained, []).append([t.cpu() for t in values])
    for values in found[True]:
        assert_same(values, found[False][0], 1e-9 if device == "cuda" else 1e-11)
    # 3 and 2 of 5 frames; 3 that fail, then one by one
    assert looks[: 2 if foreseen else 1] == ([3, 2] if foreseen else [3]) and len(looks) == 3 * (
        2 if foreseen else 1
    )


def test_a_body_at_rest_falls_several_frames_under_one_look(make_block, looks, monkeypatch):
    """Its window foresees what gravity does."""
    adapter, x = adapter_of("cpu", torch.float64, False), make_block(n=4, jitter=0.0).x
    still = torch.eye(3, dtype=torch.float64).expand(len(x), 3, 3).contiguous()
    state = ParticleState(x, torch.zeros_like(x), torch.zeros_like(still), still, still)
    sim = simulator(True, dx=0.02, substeps=40, frame_dt=1 / 24)
    monkeypatch.setattr(stepping_module, "AHEAD", 160)
    volume = torch.full((len(state.x),), 8e-6, dtype=torch.float64)
    with torch.no_grad():
        x = sim.rollout(
            state, {"mu": 8e2, "lam": 1e3}, volume, 1000.0, 5, adapter=adapter, stride=8
        ).x
    assert looks[0] > 1 and len(looks) < 4 and x[-1].mean(0)[1] < x[0].mean(0)[1] - 0.12


def test_an_error_after_some_frames_comes_where_it_would_one_by_one(make_block, looks, monkeypatch):
    monkeypatch.setattr(Chains, "limit", lambda *_: 60)
    monkeypatch.setattr(stepping_module, "AHEAD", 60)
    adapter, state = (
        adapter_of("cpu", torch.float64, False),
        make_block(n=4, velocity=(0.0, -2.0, 0.0)),
    )
    low, volume = state.x.min(0).values, torch.full((len(state.x),), 8e-6, dtype=torch.float64)
    box = torch.stack([low - torch.tensor([1.0, 0.03, 1.0], dtype=torch.float64), low + 2])
    seen = []
    for chained in (False, True):
        sim = simulator(chained, substeps=10, frame_dt=4e-3, box=box)
        frames, collected = [], []
        with torch.no_grad(), pytest.raises(SimulationDiverged, match="outside the box") as error:
            sim.rollout(state, {"mu": 8e3, "lam": 1e4}, volume, 1000.0, 9, adapter=adapter, stride=5, progress=frames.append,
                        collect=collected.append)  # fmt: skip
        seen.append((str(error.value), frames))
    assert seen[0] == seen[1] and frames == [1, 2, 3] and len(collected) == 6 and looks[0] > 1


class _Holder(nn.Module):
    """A module whose weights `functional_call` can replace around a rollout."""

    def __init__(self, adapter: nn.Module, rollout) -> None:
        super().__init__()
        self.adapter, self.rollout = adapter, rollout

    def forward(self):
        return self.rollout(self.adapter)


def test_gradients_are_of_the_weights_of_the_forward_pass(make_block):
    """Also where they are no parameters of the adapter, or no longer learned, when the backward pass comes."""
    state = make_block(n=4, velocity=(0.3, -1.0, 0.2))
    volume, found = torch.full((len(state.x),), 8e-6, dtype=torch.float64), []
    for chained in (False, True):
        sim = simulator(chained, substeps=6, frame_dt=2.4e-3)
        adapter, mu = (
            adapter_of("cpu", torch.float64, False),
            torch.tensor(8e3, dtype=torch.float64, requires_grad=True),
        )

        def rolled_with(adapter, sim=sim, mu=mu):
            x = sim.rollout(
                state, {"mu": mu, "lam": 1e4}, volume, 1000.0, 3, adapter=adapter, stride=2
            ).x
            return 1e4 * x.square().sum()

        replaced = {f"adapter.{name}": 0.8 * p.detach() for name, p in adapter.named_parameters()}
        leaves = [p.requires_grad_() for p in replaced.values()]
        gradients = list(
            torch.autograd.grad(
                functional_call(_Holder(adapter, rolled_with), replaced, ()), leaves
            )
        )
        for learned_before, learned_after in ((True, False), (False, True)):
            loss = rolled_with(adapter.requires_grad_(learned_before))
            adapter.requires_grad_(learned_after)
            gradients += torch.autograd.grad(loss, [mu])
        loss = rolled_with(adapter.requires_grad_(True))
        with torch.no_grad():
            next(adapter.parameters()).mul_(0.5)
        with pytest.raises(RuntimeError, match="modified by an inplace operation"):
            loss.backward()
        found.append(gradients)
    assert max(float(g.abs().max()) for g in found[0]) > 0.1
    assert_same(found[1], found[0], 1e-10)


@pytest.mark.parametrize("source", ["tape", "states"])
def test_a_frozen_adapter_passes_gradients_on(source, make_block):
    adapter = adapter_of("cpu", torch.float64, False).requires_grad_(False)
    make = ("corotated", "cpu", torch.float64, make_block(n=5, velocity=(0.3, -1.0, 0.2)), adapter)
    expected, _ = rolled(False, *make, stride=1, substeps=5)()
    assert_same(rolled(True, *make, stride=1, substeps=5, source=source)()[0], expected, 1e-9)


@pytest.mark.parametrize("missing", ["G", "h", "plastic_G", "plastic_h"])
def test_half_an_answer_is_refused(missing, make_block):
    """A kernel would read whatever lies behind a buffer of one particle."""

    class Half(nn.Module):
        def forward(self, state):
            G, h = state.w.new_zeros(len(state.w), 6, 6), torch.zeros_like(state.w)
            return AdapterOperator(G, h, G, h)._replace(**{missing: None})

    state = make_block(n=3)
    for chained in (False, True):
        sim = simulator(chained, "von_mises", substeps=4, frame_dt=1.6e-3)
        with pytest.raises(ConfigError, match=f"adapter output {missing}: .*found None"):
            sim.rollout(state, {"mu": 8e3, "lam": 1e4, "yield_stress": 300.0}, torch.full((27,), 8e-6, dtype=torch.float64),
                        1000.0, 2, adapter=Half())  # fmt: skip


def test_weights_that_are_freed_later_get_their_gradient(make_block):
    adapter, state = adapter_of("cpu", torch.float64, False), make_block(n=5)
    sim = simulator(True, substeps=8, frame_dt=3.2e-3, ground=Ground(0.0))
    volume = torch.full((len(state.x),), 8e-6, dtype=torch.float64)

    def end():
        return (
            sim.rollout(
                state, {"mu": 8e3, "lam": 1e4}, volume, 1000.0, 3, adapter=adapter, stride=2
            )
            .x[-1]
            .square()
            .sum()
        )

    adapter.requires_grad_(False)
    end()
    adapter.requires_grad_(True)
    found = torch.autograd.grad(end(), list(adapter.parameters()), allow_unused=True)
    assert all(g is not None for g in found) and any(bool(g.abs().max() > 0) for g in found)


def test_a_window_that_grows_between_the_passes_does_not_change_the_gradient(make_block):
    """A rollout of a faster body widens the grid of a chain whose backward pass is still to come."""
    adapter, near = adapter_of("cpu", torch.float64, False), make_block(n=5)
    near = replace(
        near, v=near.v + torch.tensor([4.0, 3.0, -2.0], dtype=torch.float64) * near.x[:, :1]
    )
    far = replace(
        near, v=near.v + torch.tensor([40.0, 30.0, -20.0], dtype=torch.float64) * near.x[:, :1]
    )
    volume = torch.full((len(near.x),), 8e-6, dtype=torch.float64)
    gradients = []
    for disturbed in (False, True):
        sim = simulator(True, substeps=8, frame_dt=3.2e-3)

        def end(state, sim=sim):
            x = sim.rollout(
                state, {"mu": 8e3, "lam": 1e4}, volume, 1000.0, 3, adapter=adapter, stride=2
            ).x
            return 1e4 * x[-1].square().sum()

        loss = end(near)
        if disturbed:
            (chain,) = sim.buffers.chains.values()
            before = chain.full.capacity
            end(replace(far, v=30 * far.v))
            assert chain.full.capacity > 2 * before
        gradients.append(torch.autograd.grad(loss, list(adapter.parameters())))
    assert float(gradients[0][0].abs().max()) > 1e-2
    assert_same(gradients[1], gradients[0], 1e-11)


def test_buffers_that_could_not_be_made_are_made_later(make_block, monkeypatch):
    """A GPU's memory may run out when the window grows: nothing is launched on what is too small or gone then."""
    adapter, state = adapter_of("cpu", torch.float64, False), make_block(n=4)
    sim = simulator(True, substeps=4, frame_dt=1.6e-3)

    def run(stretch):
        volume = torch.full((len(state.x),), 8e-6, dtype=torch.float64)
        start = replace(state, x=stretch * state.x)
        return sim.rollout(
            start, {"mu": 8e3, "lam": 1e4}, volume, 1000.0, 2, adapter=adapter, stride=2
        ).x

    expected, zeros = run(1), torch.zeros
    (chain,) = sim.buffers.chains.values()
    capacity, chain._graphs._replays["captured"] = chain.full.capacity, None

    def full(shape, *rest, **options):
        if isinstance(shape, tuple) and len(shape) == 4:
            raise torch.OutOfMemoryError
        return zeros(shape, *rest, **options)

    monkeypatch.setattr(torch, "zeros", full)
    with pytest.raises(torch.OutOfMemoryError):
        run(30)
    monkeypatch.setattr(torch, "zeros", zeros)
    chain.full.set_window((0, 0, 0), (60, 60, 60))
    assert chain.full.fields.shape[2] >= 60**3
    chain.full.set_window((0, 0, 0), (6, 6, 6))  # not needed any more
    assert (
        torch.equal(run(1), expected) and chain.full.capacity == capacity and not len(chain._graphs)
    )


def test_a_chain_whose_widest_window_would_be_too_large_is_cut(make_block, monkeypatch):
    """A body that bounces back faster than its window foresees, as one segment after the other."""
    monkeypatch.setattr(Chains, "limit", lambda *_: 192)
    adapter, state = (
        adapter_of("cpu", torch.float64, False),
        make_block(n=4, velocity=(0.0, -45.0, 0.0), jitter=0.0),
    )
    state = replace(state, x=0.5 * state.x)
    volume, found = torch.full((len(state.x),), 1e-6, dtype=torch.float64), []
    for chained in (False, True):
        sim = simulator(
            chained, dx=0.02, substeps=192, frame_dt=192e-4, ground=Ground(0.0, "separate")
        )
        collected = []
        with torch.no_grad():
            rollout = sim.rollout(state, {"mu": 6e6, "lam": 6e6}, volume, 1000.0, 2, adapter=adapter, stride=16,
                                  collect=collected.append)  # fmt: skip
        assert len(collected) == 12
        found.append([rollout.x, rollout.v])
    assert {sum(chain.lengths) for chain in sim.buffers.chains.values()} == {192, 32}
    assert float(rollout.v[-1, :, 1].min()) > 20
    assert_same(*found[::-1], 1e-11)


def test_divergence_names_the_substep_and_the_particle(make_block):
    adapter, state = (
        adapter_of("cpu", torch.float64, False),
        make_block(n=5, velocity=(0.0, 1.5, 0.0)),
    )
    top = float(state.x[:, 1].max()) + 0.008  # reached in the second frame
    box = torch.tensor([[-1.0, -1.0, -1.0], [1.0, top, 1.0]])
    messages = []
    for chained in (False, True):
        with pytest.raises(SimulationDiverged) as caught:
            rolled(chained, "neo_hookean", "cpu", torch.float64, state, adapter, box=box)()
        messages.append(str(caught.value))
    assert messages[0] == messages[1] and "outside the box" in messages[1]
    assert int(messages[1].split(",")[0].removeprefix("substep ")) > 11


def test_a_rollout_too_large_to_keep_takes_least_memory():
    start, each = 96, 164
    length = chain_length(1000, start, each)
    assert length == round((1000 * start / each) ** 0.5)
    needed = -(-1000 // length) * start + length * each
    for other in range(1, SEGMENT):
        assert needed <= 1.01 * (1000 / other * start + other * each)  # a whole number of chains
    assert chain_length(10**6, start, each) == SEGMENT and chain_length(4, start, 10**4) == 1


def test_segments_are_grouped_evenly_and_in_order():
    assert grouped([8] * 5, 32) == [(8, 8, 8), (8, 8)]
    assert grouped([1] * 40, 32) == [(1,) * 20, (1,) * 20]
    assert grouped([5, 5, 1], 32) == [(5, 5, 1)]
    assert grouped([8, 8, 3], 4) == [(8,), (8,), (3,)]


@pytest.mark.gpu
def test_replayed_kernels_find_the_weights_of_today(make_block):
    adapter = StressAdapter(fused=True)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for p in adapter.parameters():
            p.copy_(0.3 * torch.randn(p.shape, generator=generator))
    adapter.switch_on(E, NU)
    make = (
        "corotated",
        "cuda",
        torch.float32,
        make_block(n=5, velocity=(0.3, -1.0, 0.2)),
        adapter.cuda(),
    )
    chained, alone = (
        rolled(True, *make, stride=1, penalised=False),
        rolled(False, *make, stride=1, penalised=False),
    )
    changes = []
    for _ in range(4):
        before = alone()[0]
        with torch.no_grad():
            for p in adapter.parameters():
                p.mul_(0.8)
        expected = alone()[0]
        changes.append(float((before[0] - expected[0]).abs().max()))
        assert_same(chained()[0], expected, 2e-3)
        assert float((chained()[0][0] - expected[0]).abs().max()) < 0.1 * changes[-1]
    assert min(changes) > 1e-5


@pytest.mark.gpu
def test_an_adapter_that_looks_at_the_host_runs_uncaptured(make_block):
    class Looking(StressAdapter):
        def forward(self, state):
            float(state.w.detach().sum())
            return super().forward(state)

    adapter = Looking(hidden=16, fused=False).double()
    adapter.switch_on(E, NU)
    make = ("corotated", "cuda", torch.float64, make_block(n=5), adapter.cuda())
    expected, _ = rolled(False, *make)()
    once = rolled(True, *make)
    with pytest.warns(UserWarning, match="Looking cannot be captured"):
        for _ in range(1 + ATTEMPTS):
            assert_same(once()[0], expected, 1e-9)
    assert_same(once()[0], expected, 1e-9)

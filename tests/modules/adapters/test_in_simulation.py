"""The adapter in the simulator: the prior at the start, one gradient from the motion to every weight."""

import math

import pytest
import torch
from drawn_adapters import drawn_adapter, randomise

from mosa.errors import ConfigError
from mosa.modules.adapters.stress import StressAdapter
from mosa.physics.adapters.interface import AdapterOperator
from mosa.physics.engine.simulator import Simulator
from mosa.types import Ground, ParticleState

E, NU = 2e4, 0.3
PARAMETERS = {"mu": E / (2 * (1 + NU)), "lam": E * NU / ((1 + NU) * (1 - 2 * NU))}
DX, FRAME_DT, SUBSTEPS = 0.05, 5e-3, 25
VOLUME = 0.025**3


def body(dtype: torch.dtype) -> ParticleState:
    """A block of 64 particles, turned by 20 degrees, sheared and spinning, just above the ground."""
    axis = 0.0125 + 0.025 * torch.arange(4, dtype=torch.float64)
    X = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    c, s = math.cos(math.radians(20)), math.sin(math.radians(20))
    Q = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    F = Q @ torch.tensor([[1.03, 0.04, 0], [0, 0.97, 0.02], [0, 0, 1.0]], dtype=torch.float64)
    x = X @ F.T + torch.tensor([0.5, 0.0, 0.5])
    x = x + torch.tensor([0, 0.12, 0]) - torch.tensor([0, 1.0, 0]) * x[:, 1].min()
    spin = torch.tensor([[0, -3.0, 0], [3.0, 0, 1.0], [0, -1.0, 0]], dtype=torch.float64)
    v = (x - x.mean(0)) @ spin.T + torch.tensor([0.2, -1.0, 0.1])
    many = (F.expand(64, 3, 3), spin.expand(64, 3, 3))
    F, C = (a.contiguous().to(dtype) for a in many)
    return ParticleState(x.to(dtype), v.to(dtype), C, F, F)


def simulator(dtype: torch.dtype, law: str = "neo_hookean", ground: bool = True) -> Simulator:
    return Simulator(
        law,
        dx=DX,
        substeps=SUBSTEPS,
        frame_dt=FRAME_DT,
        dtype=dtype,
        ground=Ground(0.1) if ground else None,
    )


def roll(adapter, dtype: torch.dtype, frames: int, ground: bool = True, stride: int = 5):
    volume, start = torch.full((64,), VOLUME, dtype=dtype), body(dtype)
    return simulator(dtype, ground=ground).rollout(
        start, PARAMETERS, volume, 1000.0, frames, adapter=adapter, stride=stride
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_untrained_adapter_moves_the_body_as_the_prior_does_bit_for_bit(dtype):
    """Check 8 of docs/verification.md, where it matters: in the motion, through contact."""
    adapter = StressAdapter()
    adapter.switch_on(E, NU)
    with torch.no_grad():
        prior, adapted = roll(None, dtype, 5), roll(adapter, dtype, 5)
        randomise(adapter, 0.3)
        trained = roll(adapter, dtype, 5)
    assert torch.equal(adapted.x, prior.x) and torch.equal(adapted.F, prior.F)
    assert (trained.x - prior.x).abs().max() > 1e-5


def test_gradient_in_the_weights_over_200_substeps_is_that_of_differences():
    """Check 18 of docs/verification.md, free flight of a vibrating body: one direction through all weights."""
    adapter = StressAdapter(hidden=8).double()
    randomise(adapter, 0.3)
    adapter.switch_on(E, NU)
    parameters = [p for p in adapter.parameters() if p.requires_grad]
    generator = torch.Generator().manual_seed(2)
    direction = [torch.randn(p.shape, generator=generator, dtype=torch.float64) for p in parameters]
    probe = torch.randn(64, 3, generator=generator, dtype=torch.float64)

    def value() -> torch.Tensor:
        rollout = roll(adapter, torch.float64, 9, ground=False)
        return (probe * rollout.x[-1]).sum() + 0.1 * rollout.F[-1].square().sum()

    grads = torch.autograd.grad(value(), parameters)
    slope = float(sum((g * d).sum() for g, d in zip(grads, direction)))

    def at(t: float) -> float:
        with torch.no_grad():
            for p, d in zip(parameters, direction):
                p.add_(t * d)
            result = float(value())
            for p, d in zip(parameters, direction):
                p.sub_(t * d)
        return result

    h = 2e-4
    difference = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
    assert abs(slope) > 1e-4
    assert slope == pytest.approx(difference, rel=1e-6)


CONSTANT = {"state_dependence": "constant", "no_pre": True, "no_post": True}


@pytest.mark.parametrize("options, steady", [
    (CONSTANT, True), (CONSTANT | {"major_symmetry": True}, True), ({}, False), (CONSTANT | {"no_pre": False}, False),
    ({"no_C": True, "no_pre": True, "no_post": True}, True), ({"state_dependence": "constant"}, False),
])  # fmt: skip
def test_an_adapter_is_steady_where_its_operator_does_not_change_with_the_state(options, steady):
    adapter = drawn_adapter(**options)
    state, other = simulator(torch.float64), body(torch.float64)
    near, far = (
        state.material_state(F, other.C_affine, PARAMETERS) for F in (other.F, other.F @ other.F)
    )
    first, second = adapter(near), adapter(far)
    same = torch.equal(first.G, second.G) and torch.equal(first.h, second.h)
    assert same == steady and adapter.steady == steady


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_one_evaluation_of_a_steady_adapter_is_as_good_as_many(dtype):
    """Motion bit for bit, gradient to rounding: the order in which the segments' shares are summed differs."""
    results = []
    for stride in (1, 5, None):
        adapter = drawn_adapter(seed=3, dtype=dtype, **CONSTANT, major_symmetry=True)
        asked = []
        adapter.register_forward_hook(lambda *_, asked=asked: asked.append(1))
        rollout = roll(adapter, dtype, 3, stride=stride)
        (rollout.x[-1] * torch.linspace(-1, 1, 3, dtype=dtype)).sum().backward()
        results.append((len(asked), rollout.x.detach(), adapter.operator.free.grad))
    assert [r[0] for r in results] == [50, 10, 1]
    assert all(torch.equal(r[1], results[0][1]) for r in results)
    scale = results[0][2].abs().max()
    assert scale > 0 and all(
        (r[2] - results[0][2]).abs().max() <= 100 * torch.finfo(dtype).eps * scale for r in results
    )


def test_a_steady_adapter_that_reads_the_state_is_refused():
    """It would be asked but once, and of no state."""

    class Reads(torch.nn.Module):
        steady = True

        def forward(self, state) -> AdapterOperator:
            return AdapterOperator(state.w.new_zeros(len(state.w), 6, 6), 0.1 * state.stress)

    adapter = Reads()
    with pytest.raises(ConfigError, match=r"output h: .* Reads says that it is steady"):
        roll(adapter, torch.float64, 2, stride=None)
    adapter.steady = False
    roll(adapter, torch.float64, 2)

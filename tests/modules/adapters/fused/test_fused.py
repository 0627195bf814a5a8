"""The fused kernels against the torch modules: on CUDA where there is a device, else in Triton's interpreter."""

import pytest
import torch
from drawn_adapters import E_REF, drawn_adapter, drawn_states, material_state

from mosa.errors import ConfigError
from mosa.modules.adapters.stress import StressAdapter
from mosa.physics.engine.simulator import Simulator
from mosa.types import Ground, ParticleState

triton = pytest.importorskip("triton")
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
if DEVICE == "cpu" and tuple(map(int, triton.__version__.split(".")[:2])) < (3, 7):
    pytest.skip(
        "the interpreter of Triton before 3.7 has no loops under NumPy 2.4", allow_module_level=True
    )
ACCURATE = 1e-5
"""Relative to the norm of the result: the modules in float64 are what is compared with."""
OPTIONS = {
    "paper's form": {},
    "printed, two alphas": {
        "factors": "printed",
        "alpha_normal": 0.3,
        "l_max": None,
        "rest_free": False,
    },
    "plastic, narrow": {"plastic": True, "hidden": 16},
}


def evaluate(
    adapter: StressAdapter, count: int, penalised: bool, device: str, dtype: torch.dtype
) -> dict[str, torch.Tensor]:
    """Outputs, and gradients of a drawn functional of them to the state and to every weight."""
    adapter = adapter.to(device=device, dtype=dtype)
    w, s = (t.to(device=device, dtype=dtype).requires_grad_() for t in drawn_states(count))
    answer = adapter(material_state(w, s))
    outputs = {name: value for name, value in answer._asdict().items() if value is not None}
    generator = torch.Generator().manual_seed(3)
    total = 0.0
    for name, value in outputs.items():
        seed = torch.randn(value.shape, generator=generator, dtype=torch.float64).to(value)
        total = total + (seed * value).sum() / (E_REF if name == "h" else 1.0)
    if penalised:
        found = adapter.statistics()
        total = total + 1e3 * (found.mean_abs_C + found.mean_square + found.variance)
    inputs = {"w": w, "s": s, **dict(adapter.named_parameters())}
    gradients = torch.autograd.grad(total, list(inputs.values()))
    return outputs | {f"adjoint of {name}": g for name, g in zip(inputs, gradients)}


def largest_error(found: dict, expected: dict) -> tuple[float, str]:
    assert found.keys() == expected.keys()
    errors = {
        k: (found[k].detach().double().cpu() - v.detach()).norm() / v.detach().norm()
        for k, v in expected.items()
    }
    return max((float(error), k) for k, error in errors.items())


def compared(options: dict, count: int, penalised: bool, device: str) -> tuple[float, str]:
    expected = evaluate(
        drawn_adapter(size=0.2, fused=False, **options), count, penalised, "cpu", torch.float64
    )
    fused = drawn_adapter(size=0.2, fused=True, **options)
    return largest_error(evaluate(fused, count, penalised, device, torch.float32), expected)


@pytest.mark.parametrize("penalised", [False, True])
@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
def test_outputs_and_all_gradients_are_those_of_the_modules(options, penalised):
    """150 particles are two turns of the backward kernels' loop in the interpreter, with rows left over."""
    error, worst = compared(options, 150, penalised, DEVICE)
    assert error <= ACCURATE, worst


@pytest.mark.gpu
@pytest.mark.parametrize("penalised", [False, True])
@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
def test_on_cuda_with_more_tiles_than_multiprocessors(options, penalised):
    error, worst = compared(options, 20_000, penalised, "cuda")
    assert error <= ACCURATE, worst


@pytest.mark.gpu
def test_on_cuda_it_is_chosen_and_repeats_bit_for_bit():
    adapter = drawn_adapter(dtype=torch.float32).cuda()
    results = [evaluate(adapter, 20_000, True, "cuda", torch.float32) for _ in range(2)]
    assert adapter._last[0].shape == (20_000, 4, 12)
    for name, value in results[0].items():
        assert torch.equal(value, results[1][name]), name


def test_the_prior_at_initialisation_and_no_stress_at_rest_bit_for_bit():
    adapter = StressAdapter(fused=True).to(DEVICE)
    adapter.switch_on(E_REF)
    w, s = (t.float().to(DEVICE) for t in drawn_states(20, size=10.0))
    for value in adapter(material_state(w, s))[:2]:
        assert torch.equal(value, torch.zeros_like(value))
    adapter = drawn_adapter(dtype=torch.float32, fused=True).to(DEVICE)
    w[3], s[3] = 0, 0
    answer = adapter(material_state(w, s))
    assert torch.equal(answer.h[3], torch.zeros_like(answer.h[3])) and answer.h[4].abs().max() > 0


def test_frozen_weights_get_no_gradient_and_change_none():
    gradients = []
    for frozen in (False, True):
        adapter = drawn_adapter(dtype=torch.float32, fused=True).to(DEVICE)
        adapter.operator.requires_grad_(not frozen)
        w, s = (t.float().to(DEVICE).requires_grad_() for t in drawn_states(20))
        adapter(material_state(w, s)).G.square().sum().backward()
        gradients.append((w.grad, s.grad))
        assert all((p.grad is None) == frozen for p in adapter.operator.parameters())
    for free, held in zip(*gradients):
        assert torch.equal(free, held)


def test_a_rollout_with_the_kernels_is_that_with_the_modules():
    generator = torch.Generator().manual_seed(0)
    index = torch.stack(torch.meshgrid(*(torch.arange(3),) * 3, indexing="ij"), -1).reshape(-1, 3)
    F = torch.eye(3) + 0.05 * torch.randn(27, 3, 3, generator=generator)
    zero = torch.zeros(27, 3)
    state = ParticleState(
        *(t.to(DEVICE) for t in (0.1 + 0.02 * index, zero, torch.zeros_like(F), F, F))
    )
    sim = Simulator(
        "corotated", dx=0.04, substeps=4, frame_dt=1.6e-3, ground=Ground(0.05), device=DEVICE
    )
    results = []
    for fused in (True, False):
        adapter = drawn_adapter(dtype=torch.float32, size=0.2, fused=fused).to(DEVICE)
        mu = torch.tensor(4e4, device=DEVICE, requires_grad=True)
        volume = torch.full((27,), 8e-6, device=DEVICE)
        rollout = sim.rollout(
            state, {"mu": mu, "lam": 5e4}, volume, 1000.0, 2, adapter=adapter, stride=2
        )
        weights = list(adapter.operator.parameters())
        gradients = torch.autograd.grad(rollout.F[-1].square().sum(), [mu, *weights])
        results.append([rollout.x[-1], rollout.F[-1], *gradients])
    for found, expected in zip(*results):
        assert (found - expected).norm() <= 1e-4 * expected.norm()


def test_where_the_kernels_cannot_the_modules_are_taken_or_the_reason_said(monkeypatch):
    states = material_state(*(t.float().to(DEVICE) for t in drawn_states(5)))
    cases = {
        "major_symmetry": {"major_symmetry": True}, "ablation": {"no_pre": True}, "hidden": {"hidden": 48},
        "four networks": {"state_dependence": "constant"}, "float32": {"dtype": torch.float64},
    }  # fmt: skip
    for word, options in cases.items():
        drawn_adapter(**{"dtype": torch.float32, **options}).to(DEVICE)(states)
        with pytest.raises(ConfigError, match=f"adapter.fused=true.*{word}"):
            drawn_adapter(fused=True, **{"dtype": torch.float32, **options}).to(DEVICE)(states)
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    on_cpu = material_state(*(t.float() for t in drawn_states(5)))
    with pytest.raises(ConfigError, match="run on CUDA, found tensors on cpu"):
        drawn_adapter(fused=True, dtype=torch.float32)(on_cpu)
    with pytest.raises(ConfigError, match=r"adapter\.fused: expected"):
        StressAdapter(fused="yes")

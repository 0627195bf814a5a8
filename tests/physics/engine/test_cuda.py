"""CUDA against CPU: one substep in float64, 100 in float32, gradients and graph replays; long segments, and looks at the host."""

import warnings
from dataclasses import replace

import pytest
import torch

from mosa.physics.adapters.interface import AdapterOperator
from mosa.physics.engine.law_options import AS_USUAL, LawOptions
from mosa.physics.engine.simulator import Simulator
from mosa.types import Ground, ParticleState

pytestmark = pytest.mark.gpu


def run(state, law, device, dtype, substeps, frames, adapted):
    """adapted: None for a stiffer body whose stress takes the mean change of volume."""
    names = ("x", "v", "C_affine", "F", "F_tot")
    state = ParticleState(*(getattr(state, name).to(device=device, dtype=dtype) for name in names))
    n = len(state.x)
    mu, v0 = (torch.full((), 4e4, device=device, dtype=dtype, requires_grad=True),
              torch.zeros(3, device=device, dtype=dtype, requires_grad=True))  # fmt: skip
    lam, options = (5e4, AS_USUAL) if adapted is not None else (5e5, LawOptions(mean_volume=True))
    parameters = {"mu": mu, "lam": lam, **({"yield_stress": 800.0} if law == "von_mises" else {})}
    g = torch.Generator().manual_seed(0)
    G, h = (
        0.05
        * torch.randn(n, 6, *s, generator=g, dtype=torch.float64).to(device=device, dtype=dtype)
        for s in ((6,), ())
    )
    operator = AdapterOperator(G, 1e3 * h, G, 0.01 * h)
    sim = Simulator(
        law,
        dx=0.04,
        substeps=substeps,
        frame_dt=4e-4 * substeps,
        ground=Ground(0.0),
        dtype=dtype,
        device=device,
        options=options,
    )
    volume = torch.full((n,), 8e-6, device=device, dtype=dtype)
    rollout = sim.rollout(replace(state, v=state.v + v0), parameters, volume, 1000.0, frames,
                          adapter=(lambda _: operator) if adapted else None, stride=5)  # fmt: skip
    gradients = torch.autograd.grad((rollout.x**2).sum() + (rollout.F_tot**2).sum(), [mu, v0])
    return [t.detach().cpu().double() for t in (rollout.x, rollout.F, rollout.F_tot, *gradients)]


@pytest.mark.parametrize("adapted", [False, True, None])
@pytest.mark.parametrize("law", ["corotated", "von_mises"])
@pytest.mark.parametrize(
    "dtype, substeps, frames, tolerance",
    [(torch.float64, 1, 2, 1e-12), (torch.float64, 20, 3, 1e-9), (torch.float32, 50, 3, 1e-4)],
)
def test_cuda_against_cpu(law, dtype, substeps, frames, tolerance, adapted, make_block):
    state = make_block(n=6)
    results = [
        run(state, law, device, dtype, substeps, frames, adapted) for device in ("cuda", "cpu")
    ]
    for found, expected in zip(*results):
        assert (found - expected).abs().max() <= tolerance * max(1.0, float(expected.abs().max()))


def simulator(device, dtype, substeps, **options):
    options = {"ground": Ground(0.0), **options}
    return Simulator(
        "corotated",
        dx=0.04,
        substeps=substeps,
        frame_dt=4e-4 * substeps,
        dtype=dtype,
        device=device,
        **options,
    )


def on(device, dtype, state):
    names = ("x", "v", "C_affine", "F", "F_tot")
    state = ParticleState(*(getattr(state, name).to(device=device, dtype=dtype) for name in names))
    return state, torch.full((len(state.x),), 8e-6, device=device, dtype=dtype)


@pytest.mark.parametrize(
    "dtype, substeps, tolerance", [(torch.float64, 40, 1e-9), (torch.float32, 40, 1e-4)]
)
@pytest.mark.parametrize("kept", [True, False])
def test_gradients_with_states_kept_and_run_again(
    dtype, substeps, tolerance, kept, make_block, monkeypatch
):
    """An operator that is asked for once, as the default adapter is; three times: passes run eagerly, captured, replayed."""
    monkeypatch.setattr("mosa.physics.engine.budget.KEPT_SHARE", 0.25 if kept else 0.0)
    monkeypatch.setattr("mosa.physics.engine.budget.KEPT_ON_CPU", 0)
    results = {}
    for device in ("cuda", "cpu"):
        state, volume = on(device, dtype, make_block(n=6))
        sim, n = simulator(device, dtype, substeps), len(volume)
        leaf = torch.zeros(6, 6, device=device, dtype=dtype, requires_grad=True)
        for _ in range(3 if device == "cuda" else 1):

            def adapter(_, leaf=leaf, n=n):
                return AdapterOperator(leaf.expand(n, 6, 6), leaf[0].expand(n, 6))

            rollout = sim.rollout(
                state, {"mu": 4e4, "lam": 5e4}, volume, 1000.0, 4, adapter=adapter, stride=None
            )
            (gradient,) = torch.autograd.grad((rollout.x**2).sum(), leaf)
            results.setdefault(device, []).append(
                [t.detach().cpu().double() for t in (rollout.x, rollout.F, gradient)]
            )
    (expected,) = results["cpu"]
    for found in results["cuda"]:
        for a, b in zip(found, expected):
            assert (a - b).abs().max() <= tolerance * max(1.0, float(b.abs().max()))


@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-9), (torch.float32, 1e-4)])
def test_long_segments_without_gradients(dtype, tolerance, make_block):
    """70 substeps in one, and what they cost in looks at the host: two for the arguments, one a frame, one at the end."""
    frames, results = 8, {}
    for device in ("cuda", "cpu"):
        state, volume = on(device, dtype, make_block(n=6))
        sim = simulator(device, dtype, 70)
        for _ in range(3 if device == "cuda" else 1):
            results[device] = sim.rollout(state, {"mu": 4e4, "lam": 5e4}, volume, 1000.0, frames)
        if device == "cuda":
            assert {work.substeps for work in sim.buffers} == {70}
            torch.cuda.set_sync_debug_mode("warn")
            try:
                with warnings.catch_warnings(record=True) as caught:
                    warnings.simplefilter("always")
                    sim.rollout(state, {"mu": 4e4, "lam": 5e4}, volume, 1000.0, frames)
            finally:
                torch.cuda.set_sync_debug_mode("default")
            looks = [str(w.message) for w in caught if "synchroniz" in str(w.message)]
            assert 0 < len(looks) <= 2 + (frames - 1) + 1, (len(looks), looks[:3])
    for name in ("x", "v", "F"):
        found, expected = (
            getattr(results["cuda"], name).cpu().double(),
            getattr(results["cpu"], name).double(),
        )
        assert (found - expected).abs().max() <= tolerance * max(1.0, float(expected.abs().max()))

"""CUDA against CPU: one substep in float64, 100 in float32, gradients and graph replays."""

from dataclasses import replace

import pytest
import torch

from mosa.physics.rollout import AdapterOperator, Simulator
from mosa.types import Ground, ParticleState

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")]


def run(state, law, device, dtype, substeps, frames, adapted):
    names = ("x", "v", "C_affine", "F", "F_tot")
    state = ParticleState(*(getattr(state, name).to(device=device, dtype=dtype) for name in names))
    n = len(state.x)
    mu, v0 = (torch.full((), 4e4, device=device, dtype=dtype, requires_grad=True),
              torch.zeros(3, device=device, dtype=dtype, requires_grad=True))  # fmt: skip
    parameters = {"mu": mu, "lam": 5e4, **({"yield_stress": 800.0} if law == "von_mises" else {})}
    g = torch.Generator().manual_seed(0)
    G, h = (0.05 * torch.randn(n, 6, *s, generator=g, dtype=torch.float64).to(device=device, dtype=dtype) for s in ((6,), ()))
    operator = AdapterOperator(G, 1e3 * h, G, 0.01 * h)
    sim = Simulator(law, dx=0.04, substeps=substeps, frame_dt=4e-4 * substeps, ground=Ground(0.0), dtype=dtype, device=device)
    volume = torch.full((n,), 8e-6, device=device, dtype=dtype)
    rollout = sim.rollout(replace(state, v=state.v + v0), parameters, volume, 1000.0, frames,
                          adapter=(lambda _: operator) if adapted else None, stride=5)  # fmt: skip
    gradients = torch.autograd.grad((rollout.x**2).sum() + (rollout.F_tot**2).sum(), [mu, v0])
    return [t.detach().cpu().double() for t in (rollout.x, rollout.F, rollout.F_tot, *gradients)]


@pytest.mark.parametrize("adapted", [False, True])
@pytest.mark.parametrize("law", ["corotated", "von_mises"])
@pytest.mark.parametrize(
    "dtype, substeps, frames, tolerance",
    [(torch.float64, 1, 2, 1e-12), (torch.float64, 20, 3, 1e-9), (torch.float32, 50, 3, 1e-4)],
)
def test_cuda_against_cpu(law, dtype, substeps, frames, tolerance, adapted, make_block):
    state = make_block(n=6)
    results = [run(state, law, device, dtype, substeps, frames, adapted) for device in ("cuda", "cpu")]
    for found, expected in zip(*results):
        assert (found - expected).abs().max() <= tolerance * max(1.0, float(expected.abs().max()))

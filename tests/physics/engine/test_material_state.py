"""The state that an adapter reads: its backward pass with outputs that nobody uses, and what it does to the seeds."""

import pytest
import torch

from mosa.physics.engine.simulator import Simulator


@pytest.mark.parametrize("law", ["corotated", "von_mises"])
def test_unused_outputs_count_as_zero_and_seeds_are_left_alone(law, drawn):
    F = drawn[1][7:].clone().requires_grad_()
    parameters = {"mu": torch.tensor(4e4).double().requires_grad_(), "lam": 5e4}
    parameters |= {"yield_stress": 800.0} if law == "von_mises" else {}
    sim = Simulator(law, dx=0.1, substeps=1, frame_dt=1e-3, dtype=torch.float64)
    outputs = [t for t in sim.material_state(F, torch.zeros_like(F), parameters) if t is not None]
    assert len(outputs) == (3 if law == "von_mises" else 2)
    g = torch.Generator().manual_seed(0)
    for i, output in enumerate(outputs):
        seed = torch.randn(output.shape, generator=g, dtype=torch.float64)
        before = seed.clone()
        seeds = [seed if j == i else torch.zeros_like(seed) for j in range(len(outputs))]
        alone = torch.autograd.grad(
            output, [F, parameters["mu"]], seed, retain_graph=True, allow_unused=True
        )
        among = torch.autograd.grad(outputs, [F, parameters["mu"]], seeds, retain_graph=True)
        for a, b in zip(alone, among):
            assert torch.equal(a, b)
        assert torch.equal(seed, before)
        assert among[0].abs().sum() > 0

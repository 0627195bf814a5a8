"""An operator that is the same for all particles, answered as views of one row, against one that has a row for each."""

import pytest
import torch

from mosa.physics.adapters.interface import AdapterOperator
from mosa.physics.engine.simulator import Simulator
from mosa.physics.engine.workspace import Workspace
from mosa.types import Ground, ParticleState


def results(state, rows: bool, device, dtype, *, energetic, worlds, stride, times=1):
    """(simulator, positions, gradients of the operator and of mu) of the last of `times` rollouts; rows: a row of the operator for
    every particle."""
    names = ("x", "v", "C_affine", "F", "F_tot")
    state = ParticleState(*(getattr(state, name).to(device=device, dtype=dtype) for name in names))
    n = len(state.x)
    g = torch.Generator().manual_seed(0)
    G, h = (torch.randn(6, *s, generator=g, dtype=torch.float64) for s in ((6,), ()))
    G, h = (
        (scale * t).to(device=device, dtype=dtype).requires_grad_()
        for t, scale in ((G, 0.05), (h, 0.02 if energetic else 1e3))
    )
    mu = torch.full((), 4e4, device=device, dtype=dtype, requires_grad=True)

    def adapter(given):
        views = G.expand(len(given.w), 6, 6), h.expand(len(given.w), 6)
        return AdapterOperator(*(view.contiguous() if rows else view for view in views))

    sim = Simulator(
        "corotated",
        dx=0.04,
        substeps=10,
        frame_dt=4e-3,
        ground=Ground(0.0),
        dtype=dtype,
        device=device,
        energetic=energetic,
    )
    volume = torch.full((n,), 8e-6, device=device, dtype=dtype)
    start = ParticleState.stack([state] * worlds) if worlds else state
    for _ in range(times):
        rollout = sim.rollout(
            start, {"mu": mu, "lam": 5e4}, volume, 1000.0, 3, adapter=adapter, stride=stride
        )
        gradients = torch.autograd.grad((rollout.x**2).sum() + (rollout.F**2).sum(), [G, h, mu])
    return sim, [rollout.x.detach(), *gradients]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("worlds", [None, 2])
@pytest.mark.parametrize("energetic", [False, True])
@pytest.mark.parametrize("stride", [None, 4])
def test_one_row_gives_the_bits_of_a_row_for_each_particle(
    dtype, worlds, energetic, stride, make_block
):
    """Positions, and gradients: each particle adds to its own row of them, whatever it read."""
    options = {"energetic": energetic, "worlds": worlds, "stride": stride}
    found = [results(make_block(n=3), rows, "cpu", dtype, **options) for rows in (True, False)]
    for sim, expected in zip((found[0][0], found[1][0]), (27, 1)):
        assert {len(work.held["G"]) for work in sim.buffers} == {expected}
    for each, shared in zip(found[0][1], found[1][1]):
        assert torch.equal(each, shared) and each.abs().max() > 0


@pytest.mark.gpu
@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-9), (torch.float32, 1e-4)])
@pytest.mark.parametrize("worlds", [None, 2])
@pytest.mark.parametrize("energetic", [False, True])
def test_one_row_on_a_gpu(dtype, tolerance, worlds, energetic, make_block):
    """Within the order of the grid's sums, as `test_cuda`."""
    options = {"energetic": energetic, "worlds": worlds, "stride": None}
    each, shared = (
        results(make_block(n=6), rows, "cuda", dtype, **options)[1] for rows in (True, False)
    )
    for a, b in zip(each, shared):
        assert (a - b).abs().max() <= tolerance * max(1.0, float(a.abs().max()))


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_large_states_stay_in_their_workspaces(device, make_block, monkeypatch):
    """What copies of them give, with graphs that are captured and replayed: bit for bit on a CPU."""
    found = []
    for large in (2**40, 0):
        monkeypatch.setattr("mosa.physics.engine.workspace.LARGE", large)
        if device == "cpu":  # where they are copied
            monkeypatch.setattr(Workspace, "stays", large == 0)
        sim, values = results(
            make_block(n=3), False, device, torch.float64, energetic=True, worlds=None, stride=None, times=3,
        )  # fmt: skip
        # of two frames, whose states are kept at the same time
        workspaces = list(sim.buffers)
        assert [work.stays for work in workspaces] == [large == 0] * (2 if large == 0 else 1)
        assert all(work.tape()[0].any() for work in workspaces)
        found.append(values)
    for a, b in zip(*found):
        tolerance = 0 if device == "cpu" else 1e-9 * max(1.0, float(a.abs().max()))
        assert (a - b).abs().max() <= tolerance

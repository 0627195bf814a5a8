"""On a CPU the launches of a segment are captured too: the same bits as one by one, whatever sizes the window goes through."""

from dataclasses import replace

import pytest
import torch
import warp as wp

from mosa.physics import workspace
from mosa.physics.rollout import Simulator
from mosa.types import ParticleState


def falls(sim, state, *, mu=4e4, frames=9):
    """(positions, gradients) of a block that falls ever faster, so that its window grows."""
    leaves = [state.v.clone().requires_grad_(), torch.tensor(mu, dtype=torch.float64, requires_grad=True)]
    start = ParticleState(state.x, leaves[0], state.C_affine, state.F, state.F_tot)
    volume = torch.full((len(state.x),), 8e-6, dtype=torch.float64)
    rollout = sim.rollout(start, {"mu": leaves[1], "lam": 5e4}, volume, 1000.0, frames)
    return rollout.x.detach(), *torch.autograd.grad((rollout.x[1:] ** 2).sum(), leaves)


@pytest.mark.parametrize("kept", [True, False])
@pytest.mark.parametrize("windows", [workspace.WINDOWS, 0])
def test_captured_segments_are_those_launched_one_by_one(kept, windows, make_block, monkeypatch):
    monkeypatch.setattr(workspace, "WINDOWS", windows)
    monkeypatch.setattr("mosa.physics.memory.KEPT_ON_CPU", 2**29 if kept else 0)
    replays, dims = [], set()
    launch, place = wp.capture_launch, workspace.Workspace.set_window

    def placed(work, origin, size):
        place(work, origin, size)
        dims.add(work.dims)

    monkeypatch.setattr(wp, "capture_launch", lambda *a, **k: (replays.append(1), launch(*a, **k)))
    monkeypatch.setattr(workspace.Workspace, "set_window", placed)
    state = make_block(velocity=(1.0, -4.0, 0.5))
    state = replace(state, v=state.v + 5 * (state.x - state.x.mean(0)))
    sim = Simulator("corotated", dx=0.04, substeps=12, frame_dt=12 * 1e-3, gravity=(0.0, -90.0, 0.0), dtype=torch.float64)
    found = [falls(sim, state) for _ in range(3)]
    assert len(dims) > 1 and len(replays) >= (8 if windows else 1)
    others = falls(sim, state, mu=5e4)  # other numbers through the same graphs
    monkeypatch.setattr(workspace.Workspace, "_launch", lambda work, name, body: body())
    replays.clear()
    expected, different = (falls(Simulator("corotated", dx=0.04, substeps=12, frame_dt=12 * 1e-3, gravity=(0.0, -90.0, 0.0),
                                           dtype=torch.float64), state, mu=mu) for mu in (4e4, 5e4))  # fmt: skip
    assert not replays
    for each in found:
        assert all(torch.equal(a, b) for a, b in zip(each, expected, strict=True))
    assert all(torch.equal(a, b) for a, b in zip(others, different, strict=True)) and not torch.equal(others[0], found[0][0])

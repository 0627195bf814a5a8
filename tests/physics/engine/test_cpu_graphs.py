"""On a CPU the launches of a segment are captured too: the same bits as one by one, whatever sizes the window goes through."""

import math
from dataclasses import replace

import pytest
import torch
import warp as wp

from mosa.physics.contact.colliders import Collider, Sphere
from mosa.physics.contact.motion import Motion
from mosa.physics.engine import workspace
from mosa.physics.engine.simulator import Simulator
from mosa.types import ParticleState


def falls(sim, state, *, mu=4e4, frames=9):
    """(positions, gradients) of a block that falls ever faster, so that its window grows."""
    leaves = [
        state.v.clone().requires_grad_(),
        torch.tensor(mu, dtype=torch.float64, requires_grad=True),
    ]
    start = ParticleState(state.x, leaves[0], state.C_affine, state.F, state.F_tot)
    volume = torch.full((len(state.x),), 8e-6, dtype=torch.float64)
    rollout = sim.rollout(start, {"mu": leaves[1], "lam": 5e4}, volume, 1000.0, frames)
    return rollout.x.detach(), *torch.autograd.grad((rollout.x[1:] ** 2).sum(), leaves)


@pytest.mark.parametrize("kept", [True, False])
@pytest.mark.parametrize("tight, collides", [(False, False), (True, False), (False, True)])
def test_captured_segments_are_those_launched_one_by_one(
    kept, tight, collides, make_block, monkeypatch
):
    """tight: every window has buffers and graphs of its own size, else one size comes to serve all."""
    if tight:
        monkeypatch.setattr(workspace, "SPARE", 2**30)
        monkeypatch.setattr(workspace, "IDLE", 1)
        monkeypatch.setattr(workspace, "SMALL", 0)
    monkeypatch.setattr("mosa.physics.engine.budget.KEPT_ON_CPU", 2**29 if kept else 0)
    replays, launches, dims, sizes = [], [], set(), set()
    replay, place, send = (
        wp.capture_launch,
        workspace.Workspace.set_window,
        workspace.Workspace._launch,
    )

    def placed(work, origin, size):
        place(work, origin, size)
        dims.add(tuple(size[0].tolist()))
        sizes.add(work.capacity)

    monkeypatch.setattr(wp, "capture_launch", lambda *a, **k: (replays.append(1), replay(*a, **k)))
    monkeypatch.setattr(workspace.Workspace, "set_window", placed)
    monkeypatch.setattr(workspace.Workspace, "_launch", lambda *a: (launches.append(1), send(*a)))
    state = make_block(velocity=(1.0, -4.0, 0.5))
    state = replace(state, v=state.v + 5 * (state.x - state.x.mean(0)))
    ball = Collider(Sphere(0.1), motion=Motion(position=(*state.x.mean(0)[:1].tolist(), -0.5, 0.1)))

    def simulator():
        return Simulator("corotated", dx=0.04, substeps=12, frame_dt=12 * 1e-3, gravity=(0.0, -90.0, 0.0), dtype=torch.float64,
                         colliders=[ball] if collides else [])  # fmt: skip

    sim, found = simulator(), []
    for _ in range(3):
        replays.clear(), launches.clear()
        found.append(falls(sim, state))
    assert len(dims) > 2 and len(launches) == (16 if kept else 24)
    if tight:
        assert sizes == {math.prod(size) for size in dims}
    else:
        assert len(sizes) < len(dims) and len(replays) == len(launches)
    others = falls(sim, state, mu=5e4)  # other numbers through the same graphs
    monkeypatch.setattr(workspace.Workspace, "_launch", lambda work, name, body: body())
    replays.clear()
    expected, different = (falls(simulator(), state, mu=mu) for mu in (4e4, 5e4))
    assert not replays
    for each in found:
        assert all(torch.equal(a, b) for a, b in zip(each, expected, strict=True))
    assert all(
        torch.equal(a, b) for a, b in zip(others, different, strict=True)
    ) and not torch.equal(others[0], found[0][0])
    if collides:
        monkeypatch.setattr(workspace.Workspace, "_launch", send)
        assert not torch.equal(falls(Simulator("corotated", dx=0.04, substeps=12, frame_dt=12 * 1e-3, gravity=(0.0, -90.0, 0.0),
                                               dtype=torch.float64), state)[0], expected[0])  # fmt: skip

"""Sums that do not depend on the order of their terms, and what is computed with them: deterministic=true on a GPU."""

from dataclasses import replace

import pytest
import torch
import warp as wp

from mosa.physics import exact_sums
from mosa.physics.contact.colliders import Collider, Sphere
from mosa.physics.contact.motion import Motion
from mosa.physics.contact.planes import Plane
from mosa.physics.engine.simulator import Simulator
from mosa.types import ParticleState

FLOOR = Plane((0, 0.02, 0), (0, 1, 0), "separate", 0.3)
SOLID = Collider(Sphere(0.06), "separate", 0.2)


@pytest.fixture
def everywhere(monkeypatch):
    """As on a GPU, on a CPU too."""
    monkeypatch.setattr("mosa.physics.engine.workspace.needed", lambda device: True)


@pytest.fixture
def deterministic():
    exact_sums.use()
    yield
    exact_sums.use(False)


def summed(terms: list[float], scalar=wp.float64) -> float:
    functions = exact_sums.sum_functions(scalar)

    @wp.kernel(module="unique", enable_backward=False)
    def add(values: wp.array(dtype=scalar), sums: wp.array2d(dtype=wp.int64)):
        functions.add_exactly(sums, 0, values[wp.tid()])

    dtype = torch.float64 if scalar is wp.float64 else torch.float32
    values, sums = (
        torch.tensor(terms, dtype=dtype),
        torch.zeros(1, exact_sums.COLUMNS, dtype=torch.int64),
    )
    total = torch.zeros(1, dtype=dtype)
    wp.launch(add, len(terms), [wp.from_torch(values), wp.from_torch(sums)], device="cpu")
    wp.launch(functions.settle, 1, [wp.from_torch(sums), wp.from_torch(total)], device="cpu")
    return float(total)


def test_sums_are_exact_and_say_what_they_cannot_hold():
    assert summed([1e7, 1e-9, -1e7]) == pytest.approx(1e-9, abs=1e-18) != sum([1e7, 1e-9, -1e7])
    assert summed([-0.1] * 10) == pytest.approx(-1.0, abs=1e-17)
    for wrong in (float("nan"), float("inf"), -float("inf"), 2.0**24 * 1.01):
        assert summed([1.0, wrong]) != summed([1.0, wrong])


def drawn(order=slice(None), device="cpu", dtype=torch.float32):
    x = 0.02 * torch.cartesian_prod(*[torch.arange(5).double()] * 3) + 0.1
    x = x + 0.004 * torch.rand(
        x.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    x = x.to(device, dtype)[order]
    eye = torch.eye(3, dtype=dtype, device=device).expand(len(x), 3, 3).contiguous()
    return ParticleState(
        x,
        torch.tensor([0.3, -2.0, 0.1], dtype=dtype, device=device).expand_as(x).contiguous(),
        0 * eye,
        eye,
        eye,
    )


def motion(order=slice(None), device="cpu", dtype=torch.float32):
    """(positions, reactions, gradients of the start, of a modulus and of the solid's velocity) of a drop onto ground and ball."""
    simulator = Simulator("corotated", dx=0.04, substeps=20, frame_dt=8e-3, gravity=(0, -9.8, 0), up=(0, 1, 0), planes=[FLOOR],
                          colliders=[SOLID], dtype=dtype, device=device)  # fmt: skip
    state, push = (
        drawn(order, device, dtype),
        torch.tensor([0.0, 0.4, 0.1], dtype=torch.float64, requires_grad=True),
    )
    v, mu = (
        state.v.requires_grad_(),
        torch.tensor(4e4, dtype=dtype, device=device, requires_grad=True),
    )
    out = simulator.rollout(replace(state, v=v), {"mu": mu, "lam": 5e4}, torch.full_like(state.x[:, 0], 8e-6), 1000.0, 5,
                            motions=[Motion((0.15, -0.02, 0.12), velocity=push)])  # fmt: skip
    ((out.x[1:] ** 2).sum() + 1e-3 * (out.reactions**2).sum()).backward()
    return [t.detach().cpu() for t in (out.x, out.reactions, v.grad, mu.grad, push.grad)]


@pytest.mark.usefixtures("everywhere")
@pytest.mark.parametrize("dtype, bound", [(torch.float32, 2e-4), (torch.float64, 1e-9)])
def test_a_motion_with_exact_sums_is_the_same_to_rounding(dtype, bound, monkeypatch):
    exact = motion(dtype=dtype)
    assert exact[1].abs().max() > 0.1  # the ball is hit
    monkeypatch.setattr("mosa.physics.engine.workspace.needed", lambda device: False)
    for ours, plain in zip(exact, motion(dtype=dtype), strict=True):
        torch.testing.assert_close(ours, plain, rtol=0, atol=bound * float(plain.abs().max()))


@pytest.mark.usefixtures("everywhere")
def test_a_motion_with_exact_sums_knows_no_order_of_particles(monkeypatch):
    """The order in which a CPU goes through them stands for that of a GPU's threads, which is another in every run."""
    order = torch.randperm(125, generator=torch.Generator().manual_seed(1))

    def pair():
        x, reactions, _, _, push = motion()
        other_x, other_reactions, _, _, other_push = motion(order)
        return (x[:, order], other_x), (reactions, other_reactions), (push, other_push)

    assert all(torch.equal(a, b) for a, b in pair())
    monkeypatch.setattr("mosa.physics.engine.workspace.needed", lambda device: False)
    assert not any(torch.equal(a, b) for a, b in pair()[:2])  # the control


@pytest.mark.gpu
@pytest.mark.usefixtures("deterministic")
def test_on_a_gpu_two_motions_are_equal_bit_for_bit():
    first = motion(device="cuda")
    assert all(all(map(torch.equal, first, motion(device="cuda"))) for _ in range(3))

"""Planes that particles meet at their own height: against the torch twin, Coulomb's law as a balance, a bounce of finite
elements."""

import math

import pytest
import substep_reference as reference
import torch

from mosa.physics.contact.planes import Plane
from mosa.physics.contact.touch import GRIP
from mosa.physics.engine.simulator import Simulator
from mosa.types import Ground, ParticleState

DX, DT, DENSITY, MU, LAM = 0.04, 4e-4, 1000.0, 4e4, 6e4
GPU = pytest.param("cuda", marks=pytest.mark.gpu)


def turned(axis, degrees: float) -> torch.Tensor:
    axis = torch.tensor(axis, dtype=torch.float64)
    x, y, z = (axis / axis.norm() * math.radians(degrees)).tolist()
    return torch.linalg.matrix_exp(
        torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    )


@pytest.mark.parametrize("device", ["cpu", GPU])
@pytest.mark.parametrize("friction", [0.0, 0.4, 40.0])
def test_twin(friction, device, make_block):
    """A block that comes onto two planes, one of them oblique: sliding and, at high friction, held."""
    state = make_block(velocity=(0.5, -1.0, 0.2))
    low = float(state.x[:, 1].min())
    planes = [Plane((0, low + 0.004, 0), (0, 1, 0), "touch", friction),
              Plane((float(state.x[:, 0].min()), low, 0), (1, 0.2, 0), "touch", friction)]  # fmt: skip
    leaves = [t.clone().requires_grad_() for t in (state.x, state.v, state.C_affine, state.F)]
    started, steps = ParticleState(*leaves, leaves[3]), 6
    volume = torch.full((len(state.x),), 0.02**3, dtype=torch.float64)
    parameters = {
        k: torch.tensor(v, dtype=torch.float64, requires_grad=True)
        for k, v in (("mu", MU), ("lam", LAM))
    }
    sim = Simulator("neo_hookean", dx=DX, substeps=steps, frame_dt=steps * DT, gravity=(0.3, -9.8, 0.0), planes=planes,
                    dtype=torch.float64, device=device)  # fmt: skip
    there = ParticleState(
        *(getattr(started, n).to(device) for n in ("x", "v", "C_affine", "F", "F_tot"))
    )
    values = {k: p.to(device) for k, p in parameters.items()}
    found = sim.rollout(there, values, volume.to(device), DENSITY, 2, started=True).final
    twin = started
    for _ in range(steps):
        twin = reference.substep("neo_hookean", twin, parameters, volume, DENSITY, dx=DX, dt=DT, gravity=(0.3, -9.8, 0.0),
                                 planes=planes)  # fmt: skip
    free = Simulator(
        "neo_hookean",
        dx=DX,
        substeps=steps,
        frame_dt=steps * DT,
        gravity=(0.3, -9.8, 0.0),
        dtype=torch.float64,
    )
    missed = free.rollout(state, {"mu": MU, "lam": LAM}, volume, DENSITY, 2, started=True).final
    assert (missed.v - twin.v.detach()).abs().max() > 0.1  # the planes act
    generator, losses = torch.Generator().manual_seed(1), []
    weights = {
        name: torch.randn(getattr(twin, name).shape, generator=generator).double()
        for name in ("x", "v", "C_affine", "F")
    }
    for final in (found, twin):
        losses.append(sum((weights[name] * getattr(final, name).cpu()).sum() for name in weights))
    for name in weights:
        value, expected = getattr(found, name).detach().cpu(), getattr(twin, name).detach()
        assert (value - expected).abs().max() < 1e-12 * steps * max(
            1.0, float(expected.abs().max())
        ), name
    gradients = [torch.autograd.grad(loss, [*leaves, *parameters.values()]) for loss in losses]
    for name, ours, expected in zip(("x", "v", "C_affine", "F", *parameters), *gradients):
        assert (ours - expected).abs().max() < 1e-9 * expected.abs().max(), name
        assert float(expected.abs().max()) > 0, name


def test_what_slides_loses_friction_times_what_it_is_given_upwards(make_block):
    """Coulomb's law as a balance of momentum, which the grid keeps: -dv_t = friction (dv_n + g t), but for the cosine of what the
    block's own vibration turns a particle's sliding by."""
    friction, substeps, frames = 0.3, 10, 6
    state = make_block(velocity=(4.0, -0.3, 0.0))
    plane = Plane((0, float(state.x[:, 1].min()) - 0.012, 0), (0, 1, 0), "touch", friction)
    sim = Simulator("neo_hookean", dx=DX, substeps=substeps, frame_dt=substeps * DT, gravity=(0.0, -9.8, 0.0), planes=[plane],
                    dtype=torch.float64)  # fmt: skip
    volume = torch.full((len(state.x),), 0.02**3, dtype=torch.float64)
    v = sim.rollout(
        state, {"mu": MU, "lam": LAM}, volume, DENSITY, frames + 1, started=True
    ).v.mean(1)
    given = v[-1, 1] - v[0, 1] + 9.8 * frames * substeps * DT
    assert float(given) > 0.1
    assert float(v[0, 0] - v[-1, 0]) == pytest.approx(friction * float(given), rel=5e-4)
    assert abs(float(v[-1, 2] - v[0, 2])) < 0.02 * float(given)


def test_worlds_are_single_rollouts(make_block):
    starts = [make_block(velocity=(0.5 * k, -1.0, 0.2)) for k in range(3)]
    low = float(starts[0].x[:, 1].min())
    volume = torch.full((len(starts[0].x),), 0.02**3, dtype=torch.float64)
    sim = Simulator("neo_hookean", dx=DX, substeps=10, frame_dt=10 * DT, planes=[Plane((0, low, 0), (0, 1, 0), "touch", 0.5)],
                    dtype=torch.float64)  # fmt: skip
    moduli = [MU, 2 * MU, 3 * MU]  # each world has springs of its own
    alone = [
        sim.rollout(s, {"mu": mu, "lam": LAM}, volume, DENSITY, 4) for s, mu in zip(starts, moduli)
    ]
    names = ("x", "v", "C_affine", "F", "F_tot")
    together = sim.rollout(ParticleState(*(torch.stack([getattr(s, n) for s in starts]) for n in names)),
                           {"mu": torch.tensor(moduli, dtype=torch.float64)[:, None], "lam": LAM}, volume, DENSITY, 4)  # fmt: skip
    for k, one in enumerate(alone):
        assert torch.equal(together.x[:, k], one.x)


def bottle(count: int) -> tuple[torch.Tensor, float]:
    """(particles (N, 3) [m], volume of each [m^3]) of a solid of revolution, 0.29 m high."""
    heights = torch.tensor([-0.145, -0.13, -0.05, 0.03, 0.08, 0.145], dtype=torch.float64)
    radii = torch.tensor([0.0775, 0.085, 0.088, 0.07, 0.045, 0.0422], dtype=torch.float64)
    s = (0.00462 / count) ** (1 / 3)  # its volume
    axis = torch.arange(-0.1 + s / 2, 0.1, s, dtype=torch.float64)
    x = torch.cartesian_prod(
        axis, axis, torch.arange(-0.145 + s / 2, 0.145, s, dtype=torch.float64)
    )
    x = x + s * (
        0.4 * torch.rand(x.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        - 0.2
    )
    above = torch.searchsorted(heights, x[:, 2].contiguous().clamp(-0.1449, 0.1449))
    share = (x[:, 2] - heights[above - 1]) / (heights[above] - heights[above - 1])
    inside = x[:, :2].norm(dim=1) < torch.lerp(radii[above - 1], radii[above], share)
    return x[inside & (x[:, 2].abs() < 0.145)], s**3


def test_a_tilted_body_bounces_as_one_of_finite_elements():
    """A solid bottle, tilted by 70 degrees, comes down at 2.5 m/s and sticks while it touches. Tetrahedra of an own program
    (linear, 14,000 to 87,000 of them within 1 %): 1.18 m/s along the ground after the bounce, 1.24 m/s up at 0.075 s after the
    first contact. Nodes of a grid in place of particles: 0.93."""
    x, volume = bottle(2000)
    n, s = len(x), volume ** (1 / 3)
    x = x @ turned((0.2, 1.0, 0.3), 70).T
    x[:, 2] += 0.5 * s - x[:, 2].min()
    E, nu, dx, found = 1.2e5, 0.38, 1.587 * s, {}
    parameters = {"mu": E / 2 / (1 + nu), "lam": E * nu / (1 + nu) / (1 - 2 * nu)}
    for mode, lift in (("touch", 0.0), ("separate", 0.45 * dx)):
        sim = Simulator("neo_hookean", dx=dx, substeps=50, frame_dt=0.0125, gravity=(0, 0, -9.81), up=(0, 0, 1),
                        ground=Ground(0.0, mode, 50.0))  # fmt: skip
        eye = torch.eye(3).expand(n, 3, 3).contiguous()
        start = ParticleState(x.float() + torch.tensor([0, 0, lift]), torch.tensor([0.0, 0.0, -2.5]).expand(n, 3).contiguous(),
                              torch.zeros(n, 3, 3), eye, eye)  # fmt: skip
        with torch.no_grad():
            v = sim.rollout(start, parameters, torch.full((n,), volume), DENSITY, 7).v.mean(1)[-1]
        found[mode] = float(v[:2].norm()), float(v[2])
    assert found["touch"][0] == pytest.approx(1.18, rel=0.06)
    assert found["touch"][1] == pytest.approx(1.24, rel=0.08)
    assert found["separate"][0] < 1.0


def test_grip_holds_without_a_kick_back(make_block):
    """At any friction what is taken is at most GRIP of a particle's own sliding velocity."""
    x, v = torch.tensor([[0.0, 0.0, 0.0]]).double(), torch.tensor([[1.0, -1.0, 0.0]]).double()
    one = torch.ones(1).double()
    after = reference.meet(
        x, v, [Plane((0, 0, 0), (0, 1, 0), "touch", 1e9)], 1e-6 * one, 1e6 * one, 1e-4
    )
    torch.testing.assert_close(after[0, 0], (1 - GRIP) * v[0, 0])

"""A viscous branch: its stress, objectivity, passivity, exact gradients, and what a material and a
body make of it."""

import pytest
import torch
from energies import ENERGIES

from mosa.errors import ConfigError
from mosa.modules.body.material import Material, unit_of
from mosa.physics.constitutive.laws import law_named, law_names
from mosa.physics.engine.material_operations import kirchhoff_stress
from mosa.physics.engine.simulator import Simulator
from mosa.physics.time.adaptive_steps import StepControl
from mosa.physics.time.clock import Adaptive
from mosa.physics.time.time_step import required_substeps
from mosa.types import ParticleState

ELASTIC = ("neo_hookean", "corotated", "stvk")
MU, LAM, ETA, ZETA = 4e4, 5e4, 30.0, 20.0


def drawn(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def stress(law, F, C, *values):
    simulator = Simulator(law, dx=1.0, substeps=1, frame_dt=1.0, dtype=torch.float64)
    names = [name for name in simulator.law.parameters]
    packed = simulator.pack(dict(zip(names, map(torch.tensor, values))), len(F))
    return kirchhoff_stress(simulator.law, F, C, packed)


@pytest.mark.parametrize("law", ELASTIC)
def test_the_stress_is_objective_and_that_of_the_formula(law):
    F, C = torch.eye(3) + 0.1 * drawn(20, 3, 3), 5 * drawn(20, 3, 3, seed=1)
    found, elastic = stress(law + "~damped", F, C, MU, LAM, ETA, ZETA), stress(law, F, C, MU, LAM)
    D = 0.5 * (C + C.mT)
    trace = D.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None] * torch.eye(3)
    torch.testing.assert_close(
        found, elastic + 2 * ETA * (D - trace / 3) + ZETA * trace, rtol=0, atol=1e-9
    )
    Q = torch.linalg.qr(drawn(20, 3, 3, seed=2)).Q
    Q = Q * torch.linalg.det(Q)[:, None, None]
    turned = stress(law + "~damped", Q @ F, Q @ C @ Q.mT, MU, LAM, ETA, ZETA)
    torch.testing.assert_close(turned, Q @ found @ Q.mT, rtol=1e-10, atol=1e-8)
    spin = C - C.mT  # of a rigid motion nothing is felt
    assert torch.equal(
        stress(law + "~damped", F, spin, MU, LAM, ETA, ZETA), stress(law, F, spin, MU, LAM)
    )


@pytest.mark.parametrize("law", ELASTIC)
def test_a_closed_loop_costs_energy(law):
    """Work of stress along a loop of deformations, per rest volume: nothing where it is elastic,
    else what the viscosities say, and never less than nothing, for any loop."""
    turns = torch.linspace(0, 2 * torch.pi, 2001, dtype=torch.float64)[:-1]
    for seed in range(3):
        A, B = 0.15 * drawn(3, 3, seed=seed), 0.15 * drawn(3, 3, seed=seed + 9)
        s, c = torch.sin(turns)[:, None, None], (1 - torch.cos(turns))[:, None, None]
        F, rate = torch.eye(3) + s * A + c * B, torch.cos(turns)[:, None, None] * A + s * B
        C = rate @ torch.linalg.inv(F)
        work = [float((stress(name, F, C, *values) * C).sum()) * float(turns[1])
                for name, values in ((law, (MU, LAM)), (law + "~damped", (MU, LAM, ETA, ZETA)))]  # fmt: skip
        D = 0.5 * (C + C.mT)
        trace = D.diagonal(dim1=-2, dim2=-1).sum(-1)
        lost = 2 * ETA * (D.square().sum((1, 2)) - trace**2 / 3) + ZETA * trace**2
        assert abs(work[0]) < 1e-6 * MU and bool((lost >= 0).all())
        assert work[1] == pytest.approx(float(lost.sum()) * float(turns[1]), abs=1e-6 * MU)


SPACING, DX = 0.02, 0.04
X = 0.5 + torch.cartesian_prod(*[(torch.arange(n).double() + 0.5) * SPACING for n in (6, 4, 4)])


def rollout(
    law="neo_hookean~damped", eta=ETA, zeta=ZETA, mu=MU, frames=4, amplitude=0.5, timing=None
):
    values = {"mu": mu, "lam": LAM} | ({"damping": eta, "bulk_damping": zeta} if "~" in law else {})
    speed = (
        torch.tensor([1.0, 0.3, -0.2]).double()
        * amplitude
        * torch.sin(20 * X[:, :1] + 15 * X[:, 1:2])
    )
    eye = torch.eye(3).double().expand(len(X), 3, 3).contiguous()
    state = ParticleState(X, speed, 0 * eye, eye, eye)
    simulator = Simulator(
        law, dx=DX, substeps=20, frame_dt=4e-3, gravity=(0, 0, 0), dtype=torch.float64
    )
    return simulator.rollout(
        state, values, torch.full((len(X),), SPACING**3).double(), 1000.0, frames, timing=timing
    )


@torch.no_grad()
@pytest.mark.parametrize("law", ELASTIC)
def test_without_viscosity_it_is_the_law_and_with_it_energy_never_rises(law):
    plain, none = rollout(law), rollout(law + "~damped", 0.0, 0.0)
    assert torch.equal(plain.x, none.x) and torch.equal(plain.F, none.F)

    def energy(out):
        stored = ENERGIES[law](out.F, mu=MU, lam=LAM)
        kinetic = 0.5 * 1000.0 * out.v.square().sum(-1)
        return (stored + kinetic).mean(1)

    damped = energy(rollout(law + "~damped", frames=30, amplitude=0.2))
    assert bool((damped.diff() < 1e-3 * damped[0]).all())
    # what is left is mostly the body's spin
    assert damped[-1] < 0.6 * energy(rollout(law, frames=30, amplitude=0.2))[-1]


def test_gradients_are_those_of_differences():
    pattern = torch.linspace(0, 50, 3 * len(X)).double().sin().view(-1, 3)
    at = lambda eta, zeta, mu: (pattern * rollout("neo_hookean~damped", eta, zeta, mu).x[-1]).sum()  # noqa: E731
    values = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (ETA, ZETA, MU)]
    found = torch.autograd.grad(at(*values), values)
    for i, gradient in enumerate(found):
        h, ends = 1e-3 * (ETA, ZETA, MU)[i], []
        for sign in (1, -1):
            moved = [ETA, ZETA, MU]
            moved[i] += sign * h
            with torch.no_grad():
                ends.append(float(at(*moved)))
        assert float(gradient) == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=1e-5)


def test_the_time_step_follows_the_viscosity():
    law = law_named("stvk~damped")
    given = {
        "mu": torch.tensor(MU),
        "lam": torch.tensor(LAM),
        "damping": torch.tensor(300.0),
        "bulk_damping": torch.tensor(0.0),
    }
    assert (
        float(law.explicit_viscosity(given)) == 600
        and float(law.wave_modulus(given)) == LAM + 2 * MU
    )
    more = required_substeps(LAM + 2 * MU, 1000.0, 4e-3, DX, 0.1, viscosity=600.0)
    assert more == 6  # 4 ms (c/(0.6 dx) + 600/(0.4 density dx^2)) = 1.9 + 3.75
    with torch.no_grad():
        out = rollout("stvk~damped", 300.0, 0.0, timing=Adaptive(StepControl(multiple=1)))
    assert min(out.counts) >= 6 and bool(torch.isfinite(out.x).all())


def test_a_material_takes_it_as_two_more_parameters():
    plain = Material("neo_hookean", {"E": 1e5, "nu": 0.3})
    assert plain.law == "neo_hookean" and "neo_hookean~damped" not in law_names()
    damped = Material("neo_hookean", {"E": 1e5, "nu": 0.3, "damping": 5.0})
    assert damped.law == "neo_hookean~damped" and damped.learned == ["damping", "E", "nu"]
    values = damped.per_particle()
    assert (
        float(values["damping"].detach()) == pytest.approx(5.0)
        and float(values["bulk_damping"]) == 0
    )
    assert (
        float(damped.max_viscosity()) == pytest.approx(10.0) and float(plain.max_viscosity()) == 0
    )
    assert unit_of(damped.law, "damping") == "Pa s"
    again = Material(damped.law, {"E": 1e5, "nu": 0.3, "damping": 5.0})  # as a checkpoint names it
    assert again.law == damped.law
    either = Material(
        "auto", {"E": 1e5, "nu": 0.3, "damping": 5.0}, candidates=["stvk", "corotated"]
    )
    assert either.candidates == ("stvk~damped", "corotated~damped")
    with pytest.raises(ConfigError, match="without viscosity"):
        law_named("newtonian~damped")

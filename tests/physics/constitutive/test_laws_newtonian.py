"""The fluid: it forgets shear, keeps J and a rotation, resists rates; exact gradients through one substep of it."""

import pytest
import torch
from substep_reference import polar, unvech

from mosa.physics.engine.material_operations import first_advance
from mosa.physics.engine.simulator import Simulator

MU, KAPPA, DT = 0.4, 7.0, 1e-3
EYE = torch.eye(3).double()


def simulator():
    return Simulator("newtonian", dx=0.1, substeps=1, frame_dt=DT, dtype=torch.float64)


def advanced(F, C, mu=MU, kappa=KAPPA):
    sim = simulator()
    return first_advance(sim.numerics, F, C, sim.pack({"mu": mu, "kappa": kappa}, len(F)))


def draw(*shape, seed=3):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.fixture
def fluid(rotations):
    """F = J^(1/3) R of 200 particles, J from 0.4 to 1.6, and C_affine."""
    J = torch.linspace(0.4, 1.6, 200).double()
    return J[:, None, None] ** (1 / 3) * rotations, 20 * draw(200, 3, 3)


def test_it_keeps_volume_and_rotation_alone(fluid):
    F, C = fluid
    A = advanced(F, C)
    J = torch.linalg.det(F) * (1 + DT * C.diagonal(dim1=1, dim2=2).sum(1))
    assert (torch.linalg.det(A) - J).abs().max() < 1e-13
    assert (A.mT @ A - J[:, None, None] ** (2 / 3) * EYE).abs().max() < 1e-13
    spin = 0.5 * (C - C.mT)
    assert (
        A / J[:, None, None] ** (1 / 3) - polar((EYE + DT * spin) @ polar(F))
    ).abs().max() < 1e-13
    # the rotation of a rigid spin, to second order in the angle per step
    turn = torch.linalg.matrix_exp(DT * spin) @ polar(F)
    assert (A / J[:, None, None] ** (1 / 3) - turn).abs().max() < (
        DT * torch.linalg.matrix_norm(spin)
    ).max() ** 3


def test_volume_is_held_above_its_floor():
    A = advanced(0.3 * EYE[None], torch.zeros(1, 3, 3).double())
    assert float(torch.linalg.det(A)) == pytest.approx(0.05, rel=1e-14)
    gone = advanced(
        torch.diag(torch.tensor([1.0, 1.0, -1.0])).double()[None], torch.zeros(1, 3, 3).double()
    )
    assert float(torch.linalg.det(gone)) == pytest.approx(0.05, rel=1e-14)


def test_pressure_and_half_of_the_usual_viscous_stress():
    """p = kappa (J^-7 - 1) with sigma = -p I at rest; at J = 1 a shear rate g gives tau_xy = mu g/2."""
    F = 0.9 * EYE[None]
    J = 0.9**3
    tau = unvech(
        simulator().material_state(F, torch.zeros_like(F), {"mu": MU, "kappa": KAPPA}).stress
    )[0]
    torch.testing.assert_close(tau / J, -KAPPA * (J**-7 - 1) * EYE, rtol=1e-13, atol=1e-13)
    C = torch.zeros(1, 3, 3).double()
    C[0, 0, 1] = 5.0
    tau = unvech(
        simulator().material_state(EYE[None].clone(), C, {"mu": MU, "kappa": KAPPA}).stress
    )[0]
    expected = torch.zeros(3, 3).double()
    expected[0, 1] = expected[1, 0] = 0.5 * MU * 5.0
    torch.testing.assert_close(tau, expected, rtol=1e-14, atol=1e-14)


def test_frame_indifference_of_the_step(fluid, rotations):
    F, C = fluid
    Q = rotations.flip(0)
    assert (advanced(Q @ F, Q @ C @ Q.mT) - Q @ advanced(F, C)).abs().max() < 1e-13


@pytest.mark.parametrize("states", ["fluid", "rest", "drawn"])
def test_gradient(states, fluid, drawn):
    """Of the mapped F and of the stress it then has, in F, C_affine, mu and kappa, against differences."""
    F, C = fluid
    if states == "rest":
        F = EYE.expand(20, 3, 3).clone()
    if states == "drawn":  # a start may be any F: equal, close and sheared singular values
        names, F = drawn
        F = F[
            [
                i
                for i, n in enumerate(names)
                if n in ("identity", "rest", "dilated", "nearly equal", "two equal", "generic")
            ]
        ]
    C = C[: len(F)]
    sim, weights, other = simulator(), draw(len(F), 3, 3, seed=4), draw(len(F), 6, seed=5)

    def loss(F, C, mu, kappa):
        A = advanced(F, C, mu, kappa)
        tau = sim.material_state(A, C, {"mu": mu, "kappa": kappa}).stress
        return (weights * A).sum((1, 2)) + (other * tau).sum(1)

    n = len(F)
    leaves = [
        t.clone().requires_grad_()
        for t in (F, C, torch.full((n,), MU).double(), torch.full((n,), KAPPA).double())
    ]
    gradients = torch.autograd.grad(loss(*leaves).sum(), leaves)
    for i, (leaf, gradient) in enumerate(zip(leaves, gradients)):
        direction = draw(*leaf.shape, seed=6 + i)

        def shifted(s, i=i, direction=direction):
            return loss(
                *(
                    t.detach() + s * direction if k == i else t.detach()
                    for k, t in enumerate(leaves)
                )
            )

        h = 2e-2 if i == 1 else 1e-4
        expected = (8 * (shifted(h) - shifted(-h)) - (shifted(2 * h) - shifted(-2 * h))) / (12 * h)
        found = (gradient * direction).reshape(n, -1).sum(1)
        scale = (gradient * direction).reshape(n, -1).norm(dim=1).clamp_min(1.0)
        assert ((found - expected).abs() / scale).max() < 1e-6, i

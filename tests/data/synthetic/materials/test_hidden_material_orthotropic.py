"""The orthotropic truth: its energy, its symmetry, its isotropic limit, its engineering constants, its gradient."""

import pytest
import torch
from anisotropic_states import check_gradients, drawn_rotations, drawn_states, stress
from orthotropic import (
    MODULI,
    ORTHOTROPIC,
    OrthotropicMaterial,
    axes_matrix,
    axes_parameter,
    orthotropic_energy,
)
from substep_reference import polar

from mosa.errors import ConfigError
from mosa.physics.constitutive.laws import law_named

AXES = drawn_rotations(1, 21)[0]
WOOD = OrthotropicMaterial(E=(8.0, 3.0, 1.5), nu=(0.25, 0.3, 0.35), G=(0.9, 1.1, 1.6), axes=AXES)
TURNS = [
    torch.diag(torch.tensor(d).double()) for d in ([1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1])
]


def spread(parameters, n):
    return {k: v.expand(n, *v.shape).contiguous() for k, v in parameters.items()}


def isotropic(mu, lam):
    values = dict.fromkeys(("C11", "C22", "C33"), lam + 2 * mu) | dict.fromkeys(
        ("C23", "C13", "C12"), lam
    )
    return {
        k: torch.tensor(v).double()
        for k, v in {**values, **dict.fromkeys(("C44", "C55", "C66"), mu)}.items()
    }


def test_stress_is_the_gradient_of_the_energy():
    F = drawn_states().requires_grad_()
    parameters = spread(WOOD.parameters(), len(F))
    (P,) = torch.autograd.grad(orthotropic_energy(F, **parameters).sum(), F)
    F = F.detach()
    expected = P @ F.mT
    assert (
        stress(ORTHOTROPIC, F, parameters) - expected
    ).abs().max() < 1e-12 * expected.abs().max()


def test_rotations_only_turn_the_stress_and_rest_is_free():
    F = drawn_states()
    p = WOOD.parameters()
    Q = drawn_rotations(len(F), 5)
    plain = Q @ stress(ORTHOTROPIC, F, p) @ Q.mT
    assert (stress(ORTHOTROPIC, Q @ F, p) - plain).abs().max() < 1e-12 * plain.abs().max()
    assert stress(ORTHOTROPIC, torch.eye(3).double()[None], p).abs().max() == 0


def test_half_turns_about_its_axes_are_its_symmetry_and_quarter_turns_are_not():
    F, p = drawn_states(), WOOD.parameters()
    plain = stress(ORTHOTROPIC, F, p)
    for turn in TURNS:
        H = AXES @ turn @ AXES.T
        assert (stress(ORTHOTROPIC, F @ H, p) - plain).abs().max() < 1e-12 * plain.abs().max()
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double()
    assert (
        stress(ORTHOTROPIC, F @ AXES @ quarter @ AXES.T, p) - plain
    ).abs().max() > 1e-2 * plain.abs().max()


@pytest.mark.parametrize("lam", [0.0, 5.0])
def test_equal_coefficients_are_the_isotropic_law(lam):
    """tau = R B F^T, B = 2 mu (W - I) + lam tr(W - I) I, in any axes; without lam this is the corotated law."""
    F, eye, mu = drawn_states(), torch.eye(3).double(), 3.0
    found = stress(ORTHOTROPIC, F, {**isotropic(mu, lam), "axes": axes_parameter(AXES)})
    R = polar(F)
    e = R.mT @ F - eye
    expected = (
        R @ (2 * mu * e + lam * e.diagonal(dim1=1, dim2=2).sum(1)[:, None, None] * eye) @ F.mT
    )
    assert (found - expected).abs().max() < 1e-12 * expected.abs().max()
    if lam == 0:
        corotated = stress("corotated", F, {"mu": mu, "lam": 0.0})
        assert (found - corotated).abs().max() < 1e-12 * corotated.abs().max()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_pull_along_an_axis_meets_its_modulus(axis):
    """Strain of the compliance under a uniaxial stress, in the axes; at 1e-6 the curvature of the law moves it by about 1e-6."""
    nu23, nu13, nu12 = WOOD.nu
    E1, E2, E3 = WOOD.E
    lateral = [
        [1, -nu12, -nu13],
        [-nu12 * E2 / E1, 1, -nu23],
        [-nu13 * E3 / E1, -nu23 * E3 / E2, 1],
    ][axis]
    F = torch.eye(3).double() + 1e-6 * AXES @ torch.diag(torch.tensor(lateral).double()) @ AXES.T
    tau = AXES.T @ stress(ORTHOTROPIC, F[None], WOOD.parameters())[0] @ AXES / 1e-6
    expected = torch.zeros(3, 3).double()
    expected[axis, axis] = WOOD.E[axis]
    torch.testing.assert_close(tau, expected, rtol=0, atol=1e-4)


def test_gradient():
    F = drawn_states()
    leaves = {"F": F, **spread(WOOD.parameters(), len(F))}
    weights = torch.randn(
        len(F), 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )

    def loss(F, **parameters):
        return (weights * stress(ORTHOTROPIC, F, parameters)).sum((1, 2))

    check_gradients(loss, leaves, seed=2)


def test_axes_parameter_and_back():
    half_turn = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
    for axes in [*drawn_rotations(40, 3), half_turn, torch.eye(3).double()]:
        found = axes_matrix(axes_parameter(axes))
        # the same axes up to the sign of two of them
        assert ((found.mT @ axes).abs() - torch.eye(3).double()).abs().max() < 1e-14
        assert axes_parameter(axes).norm() < 3**0.5 + 1e-12
    with pytest.raises(ConfigError, match="axes: expected a rotation"):
        axes_parameter(2 * half_turn)


def test_mistakes_and_modulus():
    with pytest.raises(ConfigError, match="positive definite"):
        OrthotropicMaterial(E=(1.0, 1.0, 1.0), nu=(0.9, 0.9, 0.9), G=(1.0, 1.0, 1.0))
    p = WOOD.parameters()
    assert set(p) == {*MODULI, "axes"}
    C = torch.zeros(6, 6).double()
    C[:3, :3] = torch.stack([torch.stack([p["C11"], p["C12"], p["C13"]]), torch.stack([p["C12"], p["C22"], p["C23"]]),
                             torch.stack([p["C13"], p["C23"], p["C33"]])])  # fmt: skip
    C[3:, 3:] = 2 * torch.diag(torch.stack([p["C44"], p["C55"], p["C66"]]))
    largest = float(torch.linalg.eigvalsh(C)[-1])
    assert largest <= float(law_named(ORTHOTROPIC).wave_modulus(p)) < 2 * largest

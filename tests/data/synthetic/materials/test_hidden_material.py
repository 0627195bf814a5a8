"""The truth's material: its stress comes from its energy, and its fibre is as stiff as it says."""

import math

import pytest
import torch
import warp as wp
from energies import ENERGIES

from mosa.data.synthetic.bodies.objects import OBJECTS, PEANUT, RABBIT
from mosa.data.synthetic.materials.hidden_material import (
    FORMS,
    LAW,
    fibre_corotated,
    fibre_neo_hookean,
    fibre_stiffness,
)
from mosa.errors import ConfigError
from mosa.physics.constitutive.laws import LawParameters, law_named

wp.config.quiet = True


@wp.kernel(enable_backward=False)
def evaluate(
    F: wp.array(dtype=wp.mat33d),
    R: wp.array(dtype=wp.mat33d),
    p: wp.array(dtype=LawParameters),
    form: int,
    tau: wp.array(dtype=wp.mat33d),
):
    i = wp.tid()
    if form == 0:
        tau[i] = fibre_neo_hookean(F[i], R[i], R[i], p[i])
    else:
        tau[i] = fibre_corotated(F[i], R[i], R[i], p[i])


def stress(F: torch.Tensor, parameters: dict[str, torch.Tensor], form: str = LAW) -> torch.Tensor:
    """Kirchhoff stress (N, 3, 3) of the Warp law at F (N, 3, 3)."""
    U, _, Vh = torch.linalg.svd(F)
    packed = torch.zeros(len(F), 12, dtype=torch.float64)
    for i, name in enumerate(("mu", "lam", "kf")):
        packed[:, i] = parameters[name]
    packed[:, 3:6] = parameters["fibre"]
    tau = torch.zeros_like(F)
    wp.launch(
        evaluate,
        len(F),
        device="cpu",
        inputs=[
            wp.from_torch(F.contiguous(), dtype=wp.mat33d),
            wp.from_torch((U @ Vh).contiguous(), dtype=wp.mat33d),
            wp.from_torch(packed, dtype=LawParameters),
            list(FORMS).index(form),
            wp.from_torch(tau, dtype=wp.mat33d),
        ],
    )
    return tau


@pytest.fixture(scope="module")
def states():
    generator = torch.Generator().manual_seed(0)
    F = torch.eye(3, dtype=torch.float64) + 0.25 * torch.randn(
        50, 3, 3, generator=generator, dtype=torch.float64
    )
    return F[torch.linalg.det(F) > 0.3]


@pytest.mark.parametrize("form", list(FORMS))
@pytest.mark.parametrize("material", [RABBIT, PEANUT])
def test_stress_is_the_gradient_of_the_energy(states, material, form):
    """tau = (dPsi/dF) F^T (verification 6)."""
    rest = torch.rand(len(states), 3, dtype=torch.float64)
    parameters = material.parameters(rest)
    F = states.clone().requires_grad_()
    (P,) = torch.autograd.grad(ENERGIES[form](F, **parameters).sum(), F)
    expected = P @ states.mT
    found = stress(states, parameters, form)
    assert (found - expected).abs().max() < 1e-12 * expected.abs().max()
    assert law_named(form).parameters == {"mu": 1, "lam": 1, "kf": 1, "fibre": 3}


def test_both_forms_are_the_same_at_rest():
    """One small deformation, so that the difference is of second order."""
    F = torch.eye(3, dtype=torch.float64) + 1e-6 * torch.randn(9, 3, 3, dtype=torch.float64)
    parameters = RABBIT.parameters(torch.zeros(9, 3, dtype=torch.float64))
    one, other = (stress(F, parameters, form) for form in FORMS)
    assert (one - other).abs().max() < 1e-4 * one.abs().max()


def test_undeformed_is_stress_free_and_rotations_only_turn_the_stress(states):
    parameters = RABBIT.parameters(torch.zeros(len(states), 3, dtype=torch.float64))
    one = torch.eye(3, dtype=torch.float64).expand(len(states), 3, 3)
    assert stress(one, parameters).abs().max() < 1e-9
    Q = torch.linalg.qr(
        torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    ).Q
    Q = Q * torch.linalg.det(Q)
    turned, plain = stress(Q @ states, parameters), Q @ stress(states, parameters) @ Q.T
    assert (turned - plain).abs().max() < 1e-12 * plain.abs().max()


def young_modulus(material, direction: torch.Tensor, strain: float = 1e-6) -> float:
    """Uniaxial test: stretch along `direction` with free sides and shear, by Newton on F = I + sym, no closed form."""
    n = direction / direction.norm()
    parameters = {
        k: v[:1] for k, v in material.parameters(torch.zeros(1, 3, dtype=torch.float64)).items()
    }
    first = torch.linalg.qr(torch.stack([n, *torch.eye(3, dtype=torch.float64)[:2]], 1)).Q
    first[:, 0] = n

    def local(e):
        """Stress components in the frame of `direction`: 00 last."""
        E = torch.stack(
            [
                torch.stack([torch.as_tensor(strain, dtype=e.dtype), e[0], e[1]]),
                torch.stack([e[0], e[2], e[3]]),
                torch.stack([e[1], e[3], e[4]]),
            ]
        )
        F = torch.eye(3, dtype=torch.float64) + first @ E @ first.T
        t = first.T @ stress(F[None], parameters)[0] @ first
        return torch.stack([t[0, 1], t[0, 2], t[1, 1], t[1, 2], t[2, 2]]), t[0, 0]

    e = torch.zeros(5, dtype=torch.float64)
    for _ in range(6):
        residual, _ = local(e)
        h = 1e-7
        J = torch.stack(
            [
                (local(e + h * d)[0] - local(e - h * d)[0]) / (2 * h)
                for d in torch.eye(5, dtype=torch.float64)
            ],
            1,
        )
        e = e - torch.linalg.solve(J, residual)
    return float(local(e)[1]) / strain


@pytest.mark.parametrize("material", [RABBIT, PEANUT])
def test_young_modulus_along_the_fibre_over_across(material):
    """At strain 1e-6 the law's curvature moves a modulus by about 1e-5 of itself."""
    fibre = torch.tensor(material.fibre, dtype=torch.float64)
    across = torch.linalg.cross(fibre, torch.tensor([0.1, 0.2, 0.9], dtype=torch.float64))
    along_modulus, across_modulus = young_modulus(material, fibre), young_modulus(material, across)
    assert along_modulus / across_modulus == pytest.approx(material.ratio, rel=1e-4)
    summary = material.summary()
    assert along_modulus == pytest.approx(summary["E_along"], rel=1e-4)
    assert across_modulus == pytest.approx(summary["E_across"], rel=1e-4)


def test_the_rabbit_is_what_data_formats_fixes():
    assert (RABBIT.E, RABBIT.nu, RABBIT.ratio, RABBIT.fibre, RABBIT.density) == (
        2e5,
        0.3,
        1.6,
        (1.0, 0.3, 0.0),
        1000.0,
    )
    X = torch.tensor(
        [[0.0, 0.4, 0.1], [0.03125, 0.0, 0.0], [-0.03125, 0.2, 0.0], [0.125 + 0.03125, 0.0, 0.0]]
    )
    assert torch.allclose(RABBIT.factor(X), torch.tensor([1.0, 1.2, 0.8, 1.2]), atol=1e-6)
    drops = OBJECTS["rabbit"].drops
    assert [(d.speed, d.degrees) for d in drops.values()] == [(2.5, 0.0), (2.5, 60.0), (3.2, 40.0)]
    assert (drops["test_60"].axis, drops["test_40"].axis) == ((0.3, 0.2, 1.0), (1.0, 0.4, 0.2))
    assert OBJECTS["rabbit"].height == 0.25
    assert (
        OBJECTS["rabbit"].footage.cameras,
        OBJECTS["rabbit"].footage.frames,
        OBJECTS["rabbit"].footage.fps,
    ) == (
        12,
        15,
        50.0,
    )


def test_known_moduli_are_those_of_the_nearest_isotropic_law():
    """The logarithm of the stiffness, averaged over turns that are drawn, is the isotropic law's."""
    known, generator = PEANUT.known, torch.Generator().manual_seed(0)
    fibres = torch.randn(4000, 3, generator=generator, dtype=torch.float64)
    fibres /= fibres.norm(dim=1, keepdim=True)
    mu, lam = PEANUT.elastic(torch.ones((), dtype=torch.float64))
    ones = torch.tensor([1.0, 1, 1, 0, 0, 0], dtype=torch.float64)
    i, j = torch.tensor([0, 1, 2, 1, 0, 0]), torch.tensor([0, 1, 2, 2, 2, 1])
    weight = torch.tensor([1, 1, 1, 2**0.5, 2**0.5, 2**0.5], dtype=torch.float64)
    dyads = fibres[:, i] * fibres[:, j] * weight  # a x a in Mandel scaling
    kf = fibre_stiffness(PEANUT.E, PEANUT.nu, PEANUT.ratio)
    matrix = 2 * mu * torch.eye(6).double() + lam * torch.outer(ones, ones)
    moduli, modes = torch.linalg.eigh(matrix + 4 * kf * dyads[:, :, None] * dyads[:, None])
    mean = ((modes * moduli.log()[:, None]) @ modes.mT).mean(0)
    twice_shear = math.exp(float(torch.trace(mean) - ones @ mean @ ones / 3) / 5)
    three_bulk = math.exp(float(ones @ mean @ ones / 3))
    E = 3 * three_bulk * twice_shear / (2 * three_bulk + twice_shear)
    assert known["E"] == pytest.approx(E, rel=1e-3)
    assert known["nu"] == pytest.approx(E / twice_shear - 1, abs=1e-3)
    assert RABBIT.isotropic().known == {"E": 2e5, "nu": 0.3}


def test_the_twin_has_no_fibre_and_one_stiffness():
    twin = RABBIT.variant("isotropic")
    parameters = twin.parameters(torch.rand(20, 3))
    assert parameters["kf"].abs().max() == 0
    assert parameters["mu"].max() == parameters["mu"].min() == pytest.approx(2e5 / 2.6)
    assert fibre_stiffness(1.0, 0.3, 1.0) == 0
    with pytest.raises(
        ConfigError, match=r"scene\.material: expected anisotropic or isotropic, found 'wood'"
    ):
        RABBIT.variant("wood")


def test_the_second_object_hides_another_material():
    def unit(v):
        return torch.tensor(v) / torch.tensor(v).norm()

    angle = torch.rad2deg(torch.acos((unit(RABBIT.fibre) @ unit(PEANUT.fibre)).abs()))
    assert angle > 45
    assert PEANUT.E > 1.2 * RABBIT.E
    assert PEANUT.ratio > 1.1 * RABBIT.ratio
    assert PEANUT.period != RABBIT.period
    assert PEANUT.density == 1000.0

"""Laws: stress from energy, frame indifference, rest, small strain."""

import pytest
import torch
from energies import ENERGIES
from substep_reference import unvech

from mosa.errors import ConfigError
from mosa.physics.constitutive.elasticity import lame, wave_modulus
from mosa.physics.constitutive.laws import law_named, law_names
from mosa.physics.engine.simulator import Simulator

MU, LAM, KAPPA = 3.0, 5.0, 7.0
ELASTIC = {"mu": MU, "lam": LAM}
RATE = {"mu": MU, "kappa": KAPPA, "yield_stress": 0.8, "viscosity": 0.1}
PARAMETERS = {
    **dict.fromkeys(["linear", "neo_hookean", "corotated", "stvk", "stvk_paper"], ELASTIC),
    "von_mises": {**ELASTIC, "yield_stress": 0.8}, "drucker_prager": {**ELASTIC, "friction_alpha": 0.3, "cohesion": 0.02},
    "herschel_bulkley": RATE, "herschel_bulkley_hencky": RATE, "newtonian": {"mu": MU, "kappa": KAPPA},
    "mooney_rivlin": {**ELASTIC, "second_share": 0.3}, "yeoh": {**ELASTIC, "yeoh_2": 0.1, "yeoh_3": 0.02},
    "ogden": {**ELASTIC, "alpha_1": 2.5, "share_2": 0.2, "alpha_2": -4.0, "share_3": 0.3, "alpha_3": 6.0},
}  # fmt: skip
LAWS = list(PARAMETERS)
# (lam + 2 mu, lam, mu) at small strain
MODULI = {
    **dict.fromkeys(
        ["herschel_bulkley", "herschel_bulkley_hencky"],
        (KAPPA + 4 * MU / 3, KAPPA - 2 * MU / 3, MU),
    ),
    "newtonian": (7 * KAPPA, 7 * KAPPA, 0.0),
}


def stress(law, F, dtype=torch.float64, C=None):
    """tau (N, 3, 3) through the simulator's own kernel."""
    sim = Simulator(law, dx=0.1, substeps=1, frame_dt=1e-3, dtype=dtype)
    C = torch.zeros_like(F) if C is None else C
    state = sim.material_state(F.to(dtype), C.to(dtype), PARAMETERS[law])
    R = rotation(F).to(dtype)
    return R @ unvech(state.stress) @ R.mT


def rotation(F):
    U, _, Vh = torch.linalg.svd(F)
    U = torch.cat([U[..., :2], U[..., 2:] * torch.linalg.det(U @ Vh)[:, None, None]], -1)
    return U @ Vh


@pytest.mark.parametrize("law", [law for law in LAWS if law != "stvk_paper"])
def test_stress_is_the_gradient_of_the_energy(law):
    generator = torch.Generator().manual_seed(2)
    F = torch.eye(3).double() + 0.25 * torch.randn(
        50, 3, 3, generator=generator, dtype=torch.float64
    )
    F = F[torch.linalg.det(F) > 0.2]
    F.requires_grad_()
    (P,) = torch.autograd.grad(ENERGIES[law](F, **PARAMETERS[law]).sum(), F)
    tau = P @ F.mT
    if law == "linear":
        tau = 0.5 * (tau + tau.mT)
    else:
        assert (tau - tau.mT).abs().max() < 1e-12 * tau.abs().max()
    found = stress(law, F.detach())
    assert (found - tau.detach()).abs().max() < 1e-12 * tau.abs().max()
    rest = ENERGIES[law](torch.eye(3).double(), **PARAMETERS[law])
    assert float(rest.abs()) < 1e-14
    assert bool((ENERGIES[law](F.detach(), **PARAMETERS[law]) > 0).all())


def test_the_printed_stvk_is_the_gradient_of_no_energy():
    """P = tau F^-T of an energy has a symmetric derivative: <dP(A), B> = <dP(B), A>."""
    generator = torch.Generator().manual_seed(9)
    F = torch.eye(3).double() + 0.2 * torch.randn(
        20, 3, 3, generator=generator, dtype=torch.float64
    )
    A, B = torch.randn(2, 20, 3, 3, generator=generator, dtype=torch.float64)

    def asymmetry(law):
        def derivative(D, h=1e-5):
            P = lambda G: stress(law, G) @ torch.linalg.inv(G).mT  # noqa: E731
            return (P(F + h * D) - P(F - h * D)) / (2 * h)

        one, other = (derivative(A) * B).sum((1, 2)), (derivative(B) * A).sum((1, 2))
        return float((one - other).abs().max() / one.abs().max())

    assert asymmetry("stvk") < 1e-7 < 1e-2 < asymmetry("stvk_paper")


def test_the_printed_stvk_has_one_stretch_too_many(drawn):
    _, F = drawn
    F = F[torch.linalg.det(F) > 0.1]
    expected = stress("stvk", F) @ (rotation(F) @ F.mT)
    assert (stress("stvk_paper", F) - expected).abs().max() < 1e-12 * expected.abs().max()
    assert (stress("stvk", F) - expected).abs().max() > 1e-1 * expected.abs().max()


@pytest.mark.parametrize("law", LAWS)
def test_frame_indifference(law, rotations):
    generator = torch.Generator().manual_seed(3)
    F = torch.eye(3).double() + 0.3 * torch.randn(
        200, 3, 3, generator=generator, dtype=torch.float64
    )
    S = torch.linalg.svdvals(F)
    keep = (S[:, 1] - S[:, 2] > -1) & (S[:, 1] + S[:, 2] > 0.1) & (torch.linalg.det(F) > 0.05)
    F, Q = F[keep], rotations[keep]
    assert len(F) > 100
    C = torch.randn(F.shape, generator=generator, dtype=torch.float64)
    expected = Q @ stress(law, F, C=C) @ Q.mT
    error = (stress(law, Q @ F, C=Q @ C @ Q.mT) - expected).abs().amax(
        (1, 2)
    ) / expected.abs().amax((1, 2))
    if law == "linear":
        assert error.median() > 1e-2  # the control: this law is not objective
    else:
        assert error.max() < 1e-12


@pytest.mark.parametrize("law", LAWS)
def test_rest_and_small_strain(law):
    eye = torch.eye(3).double()[None]
    assert stress(law, eye).abs().max() == 0.0
    assert stress(law, eye, torch.float32).abs().max() <= 1e-5 * MU
    e = 1e-5
    stretch, shear = eye.clone(), eye.clone()
    stretch[0, 0, 0] += e
    shear[0, 1, 2] += e
    along, across, sheared = MODULI.get(law, (LAM + 2 * MU, LAM, MU))
    # the fluid's pressure is the most curved: its second derivative is 35 kappa
    assert float(stress(law, stretch)[0, 0, 0]) / e == pytest.approx(along, rel=1e-4)
    assert float(stress(law, stretch)[0, 1, 1]) / e == pytest.approx(across, rel=1e-4)
    assert float(stress(law, shear)[0, 1, 2]) / e == pytest.approx(sheared, rel=1e-4, abs=1e-9)


@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-13), (torch.float32, 1e-6)])
@pytest.mark.parametrize("law", LAWS)
def test_material_state_gradient_and_symmetry(law, dtype, tolerance, drawn):
    """w and s are six numbers each: symmetric by construction; their value agrees with the stress of a torch evaluation."""
    names, F = drawn
    F = F[[i for i, name in enumerate(names) if not name.startswith(("inverted", "nearly"))]]
    sim = Simulator(law, dx=0.1, substeps=1, frame_dt=1e-3, dtype=dtype)
    state = sim.material_state(F.to(dtype), torch.zeros_like(F, dtype=dtype), PARAMETERS[law])
    W = rotation(F).mT @ F
    expected = W - torch.eye(3).double()
    assert (unvech(state.w).double() - expected).abs().max() < 10 * tolerance * W.abs().max()


@pytest.mark.parametrize("law", LAWS)
def test_gradient_of_the_material_state(law, drawn):
    names, F = drawn
    # no value at J <= 0; the fluid's J never falls below 0.05
    least = 0.05 if law == "newtonian" else 1e-6 if law_named(law).needs_positive_J else -torch.inf
    keep = [i for i, J in enumerate(torch.linalg.det(F)) if J > least]
    names, F = [names[i] for i in keep], F[keep]
    sim = Simulator(law, dx=0.1, substeps=1, frame_dt=1e-3, dtype=torch.float64)
    generator = torch.Generator().manual_seed(4)
    a, b, C = (
        torch.randn(len(F), *shape, generator=generator, dtype=torch.float64)
        for shape in ((6,), (6,), (3, 3))
    )
    mu = MU * (1 + 0.1 * torch.rand(len(F), generator=generator, dtype=torch.float64))

    def loss(F, mu, C=C):
        state = sim.material_state(F, C, {**PARAMETERS[law], "mu": mu})
        return (a * state.w + b * state.stress).sum(1)

    leaves = F.clone().requires_grad_(), mu.clone().requires_grad_(), C.clone().requires_grad_()
    adj_F, adj_mu, adj_C = torch.autograd.grad(loss(*leaves).sum(), leaves)
    dF = torch.randn(F.shape, generator=generator, dtype=torch.float64)
    dF = dF / torch.linalg.matrix_norm(dF)[:, None, None]
    S = torch.linalg.svdvals(F)
    S[:, 2] *= torch.sign(torch.linalg.det(F))
    h = 3e-3 * torch.minimum(S[:, 1] + S[:, 2], (S - 0.05).abs().amin(1)).clamp(max=1.0)
    h = torch.minimum(h, 3e-3 * torch.linalg.det(F).abs())
    step = h[:, None, None]
    expected = (8 * (loss(F + step * dF, mu) - loss(F - step * dF, mu))
                - (loss(F + 2 * step * dF, mu) - loss(F - 2 * step * dF, mu))) / (12 * h)  # fmt: skip
    error = ((adj_F * dF).sum((1, 2)) - expected).abs() / torch.linalg.matrix_norm(adj_F).clamp_min(
        1.0
    )
    assert error.max() < 1e-6, names[int(error.argmax())]
    expected = (loss(F, mu + 1) - loss(F, mu - 1)) / 2  # linear in mu
    torch.testing.assert_close(adj_mu, expected, rtol=1e-6, atol=1e-8)
    dC = torch.randn(C.shape, generator=generator, dtype=torch.float64)
    expected = (loss(F, mu, C + dC) - loss(F, mu, C - dC)) / 2  # linear in C_affine
    torch.testing.assert_close((adj_C * dC).sum((1, 2)), expected, rtol=1e-6, atol=1e-6)
    assert bool(adj_C.abs().max() > 0) == (law == "newtonian")


def test_moduli():
    E, nu = torch.tensor([1e5, 2e5]).double(), torch.tensor([0.3, 0.45]).double()
    mu, lam = lame(E, nu)
    torch.testing.assert_close(mu * (3 * lam + 2 * mu) / (lam + mu), E)
    torch.testing.assert_close(lam / (2 * (lam + mu)), nu)
    assert float(wave_modulus("stvk", {"mu": mu, "lam": lam})) == pytest.approx(
        float((lam + 2 * mu).max())
    )
    rate = {"mu": mu, "kappa": lam, "yield_stress": mu, "viscosity": mu}
    assert float(wave_modulus("herschel_bulkley", rate)) == pytest.approx(
        float((lam + 4 * mu / 3).max())
    )
    assert float(wave_modulus("newtonian", {"mu": mu, "kappa": lam})) == pytest.approx(
        float(7 * lam.max())
    )
    with pytest.raises(ConfigError, match="mu and lam, or mu and kappa"):
        wave_modulus("stvk", {"kappa": mu})


def test_names():
    assert set(LAWS) <= set(law_names())
    with pytest.raises(ConfigError, match=r"neo_hookean.*found 'mooney'"):
        law_named("mooney")

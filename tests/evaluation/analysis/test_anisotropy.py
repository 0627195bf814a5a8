"""Directional figures of a law (mosa/evaluation/analysis/anisotropy.py) against closed forms of linear elasticity."""

import math

import pytest
import torch
from scipy.optimize import brentq

from mosa.errors import ConfigError, SimulationDiverged
from mosa.evaluation.analysis import anisotropy
from mosa.modules.adapters.base import Adapter
from mosa.modules.adapters.hyperelastic import HyperelasticAdapter
from mosa.modules.adapters.microplane import MANDEL
from mosa.modules.adapters.stress import StressAdapter
from mosa.modules.body.material import material_states
from mosa.physics.adapters.interface import AdapterOperator
from mosa.physics.constitutive.elasticity import lame

E, NU = 1e5, 0.35
MU, LAM = lame(torch.tensor(E, dtype=torch.float64), torch.tensor(NU, dtype=torch.float64))
SCALE = torch.tensor(MANDEL, dtype=torch.float64)
EYE6 = torch.eye(6, dtype=torch.float64)
ONE = torch.tensor([1.0, 1, 1, 0, 0, 0], dtype=torch.float64)
C0 = 2 * MU * EYE6 + LAM * torch.outer(ONE, ONE)  # Mandel
DIRECTIONS = anisotropy.directions_on_sphere(25)


@pytest.fixture(scope="module")
def states():
    return material_states("neo_hookean", {"mu": MU, "lam": LAM})


def rotation(seed: int = 0) -> torch.Tensor:
    A = torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return torch.matrix_exp(A - A.mT)


def on_mandel(Q: torch.Tensor) -> torch.Tensor:
    """(6, 6) of A -> Q A Q^T in Mandel scaling."""
    columns = []
    for k in range(6):
        a = EYE6[k] / SCALE
        A = torch.stack([a[[0, 5, 4]], a[[5, 1, 3]], a[[4, 3, 2]]])
        B = Q @ A @ Q.T
        columns.append(SCALE * torch.stack([B[0, 0], B[1, 1], B[2, 2], B[1, 2], B[2, 0], B[0, 1]]))
    return torch.stack(columns, 1)


def fibre_compliance(axis_of: torch.Tensor, ratio: float = 1.6) -> torch.Tensor:
    """(6, 6) Mandel compliance, Young's modulus `ratio` E along axis_of[:, 2] and E across, shear moduli of their own."""
    along, nu_across, nu_along, shear = ratio * E, 0.3, 0.35, 0.5 * E
    S = torch.zeros(6, 6, dtype=torch.float64)
    S[0, 0] = S[1, 1] = 1 / E
    S[2, 2] = 1 / along
    S[0, 1] = S[1, 0] = -nu_across / E
    S[0, 2] = S[1, 2] = S[2, 0] = S[2, 1] = -nu_along / along
    S[3, 3] = S[4, 4] = 1 / (2 * shear)
    S[5, 5] = (1 + nu_across) / E
    R = on_mandel(axis_of)
    return R @ S @ R.T


class Fixed(Adapter):
    """The same A - I (6, 6), on vech components, at every state."""

    def __init__(self, G: torch.Tensor) -> None:
        super().__init__()
        self.register_buffer("G", G)
        self.switch_on(E, NU)

    def increment(self, w, s):
        return s @ self.G.T

    def forward(self, state):
        return AdapterOperator(self.G.expand(len(state.w), 6, 6), torch.zeros_like(state.stress))


def with_compliance(S: torch.Tensor) -> Fixed:
    """Adapter that turns the prior into a law with the compliance S (6, 6), Mandel, at small strain."""
    A = torch.linalg.inv(S) @ torch.linalg.inv(C0)
    return Fixed(A / SCALE[:, None] * SCALE - EYE6)


def trained(seed: int, size: float = 0.05) -> StressAdapter:
    """An adapter with drawn changes of its weights, the zeroed last layers included."""
    torch.manual_seed(seed)
    adapter = StressAdapter()
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for p in adapter.parameters():
            p += size * torch.randn(p.shape, generator=generator)
    adapter.switch_on(E, NU)
    return adapter


# --- directional modulus ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", ["neo_hookean", "stvk"])
def test_prior_has_youngs_modulus_in_every_direction(law):
    E_n = anisotropy.directional_modulus(
        material_states(law, {"mu": MU, "lam": LAM}), None, DIRECTIONS, strain=1e-3
    )
    torch.testing.assert_close(E_n, torch.full_like(E_n, E), rtol=2e-6, atol=0)


def test_adapter_at_initialisation_is_the_prior(states):
    adapter = StressAdapter()
    adapter.switch_on(E, NU)
    E_n = anisotropy.directional_modulus(states, adapter, DIRECTIONS[:5])
    torch.testing.assert_close(
        E_n, anisotropy.directional_modulus(states, None, DIRECTIONS[:5]), rtol=1e-12, atol=0
    )


def test_modulus_of_a_fibre_law_is_that_of_its_compliance(states):
    S = fibre_compliance(rotation(1))
    N = anisotropy.dyads(DIRECTIONS)
    expected = 1 / torch.einsum("ki,ij,kj->k", N, S, N)
    assert expected.max() / expected.min() > 1.3
    E_n = anisotropy.directional_modulus(states, with_compliance(S), DIRECTIONS, strain=1e-3)
    torch.testing.assert_close(E_n, expected, rtol=1e-5, atol=0)


def modulus_ratio(states, adapter, axis, strain=5e-3) -> float:
    """E along `axis` over the mean of E across it (18 directions); 1 for an isotropic law."""
    along = axis / axis.norm()
    first = torch.linalg.cross(along, torch.eye(3).double()[int(along.abs().argmin())])
    _, across = anisotropy.directions_in_plane(
        first.tolist(), torch.linalg.cross(along, first).tolist(), 19
    )
    modulus = anisotropy.directional_modulus(
        states, adapter, torch.cat([along[None], across[:-1]]), strain
    )
    return float(modulus[0] / modulus[1:].mean())


def test_ratio_and_axis_of_a_fibre_law(states):
    Q = rotation(2)
    adapter = with_compliance(fibre_compliance(Q))
    assert modulus_ratio(states, adapter, Q[:, 2], strain=1e-3) == pytest.approx(1.6, rel=1e-4)
    assert modulus_ratio(states, None, Q[:, 2]) == pytest.approx(1, abs=1e-7)
    axis, ratio = anisotropy.stiffest_axis(states, adapter)
    assert abs(float(axis @ Q[:, 2])) > math.cos(math.radians(1.3))
    assert ratio == pytest.approx(1.6, rel=1e-3)


def test_large_stretch_against_a_scalar_equation(states):
    """neo_hookean: lateral stretch from mu (l^2 - 1) + lam log J = 0, then the axial stress."""
    mu, lam = float(MU), float(LAM)
    for strain in (0.2, -0.2):
        a = math.exp(strain)
        side = brentq(
            lambda l, a=a: mu * (l**2 - 1) + lam * math.log(a * l**2), 0.5, 2.0, xtol=1e-14
        )
        expected = mu * (a**2 - 1) + lam * math.log(a * side**2)
        found = anisotropy.uniaxial_stress(
            anisotropy.response_of(states, None), DIRECTIONS[:4], strain
        )
        torch.testing.assert_close(
            found, torch.full((4,), expected, dtype=torch.float64), rtol=1e-9, atol=0
        )


def test_drawn_weights_leave_the_lateral_faces_free(states):
    """The equilibrium found is one: rebuilt from the law alone, only the axial component is left."""
    adapter = trained(3)
    response = anisotropy.response_of(states, adapter)
    n = DIRECTIONS[7:8]
    axial = anisotropy.uniaxial_stress(response, n, 0.05)
    N = anisotropy.dyads(n)[0]
    complement = torch.linalg.svd(N[None])[2][1:]  # (5, 6), orthogonal to N

    y = torch.zeros(5, dtype=torch.float64)
    for _ in range(30):  # Newton on differences, another way than the tested one
        residual = lambda y: complement @ response((0.05 * N + y @ complement)[None])[0]  # noqa: E731
        J = torch.stack(
            [
                (residual(y + 1e-6 * e) - residual(y - 1e-6 * e)) / 2e-6
                for e in torch.eye(5).double()
            ],
            1,
        )
        y = y - torch.linalg.solve(J, residual(y))
    stress = response((0.05 * N + y @ complement)[None])[0]
    assert float((stress - (stress @ N) * N).norm()) < 1e-8 * E
    assert float(axial[0]) == pytest.approx(float(stress @ N), rel=1e-8)


def test_a_law_without_stiffness_is_reported(states):
    with pytest.raises(SimulationDiverged, match="no equilibrium at strain"):
        anisotropy.directional_modulus(states, Fixed(-EYE6), DIRECTIONS[:3])


# --- redistribution -----------------------------------------------------------------------------------------------------


def test_redistribution_by_hand():
    """Only the yz shear stress is raised by a quarter: w = 0.25 sqrt(2) |n_y n_z|."""
    A = EYE6.clone()
    A[3, 3] = 1.25
    w = anisotropy.redistribution_response(A, DIRECTIONS)
    expected = 0.25 * math.sqrt(2) * (DIRECTIONS[:, 1] * DIRECTIONS[:, 2]).abs()
    torch.testing.assert_close(w, expected, rtol=1e-12, atol=1e-15)


def test_prior_has_no_redistribution_and_an_isotropic_one_no_direction():
    assert anisotropy.redistribution_response(EYE6, DIRECTIONS).abs().max() == 0
    isotropic = 1.2 * EYE6 + 0.3 * torch.outer(
        ONE, ONE
    )  # the same on vech components as in Mandel scaling
    w = anisotropy.redistribution_response(isotropic, DIRECTIONS)
    expected = math.hypot(0.2 + 0.3, 0.3, 0.3)  # |0.2 n n^T + 0.3 I|
    torch.testing.assert_close(w, torch.full_like(w, expected), rtol=1e-12, atol=0)
    plain = (0.2 * anisotropy.dyads(DIRECTIONS) / SCALE + 0.3 * ONE).norm(dim=-1)
    assert (
        plain.max() / plain.min() > 1.005
    )  # a plain 6-vector shows an anisotropy that is not there


def test_redistribution_turns_with_the_material():
    generator = torch.Generator().manual_seed(0)
    A = EYE6 + 0.1 * torch.randn(6, 6, dtype=torch.float64, generator=generator)
    Q = rotation(4)
    R = on_mandel(Q)
    turned = (R @ anisotropy.mandel_matrix(A) @ R.T) / SCALE[:, None] * SCALE
    w = anisotropy.redistribution_response(A, DIRECTIONS)
    torch.testing.assert_close(
        anisotropy.redistribution_response(turned, DIRECTIONS @ Q.T), w, rtol=1e-12, atol=1e-14
    )


def test_jacobian_against_differences():
    adapter = trained(1, size=0.3)
    w, s = (
        0.1 * torch.randn(4, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(k))
        for k in (1, 2)
    )
    jacobian = anisotropy.stress_jacobian(adapter, w, s)
    assert not torch.allclose(jacobian, EYE6.expand(4, 6, 6), atol=1e-2)
    double = adapter.in_double()
    for k in range(6):

        def f(h: float, k: int = k) -> torch.Tensor:
            return double.increment(w, s + h * EYE6[k])

        column = (8 * (f(1e-4) - f(-1e-4)) - (f(2e-4) - f(-2e-4))) / 12e-4 + EYE6[k]
        torch.testing.assert_close(jacobian[:, :, k], column, rtol=1e-6, atol=1e-9)


def test_jacobian_of_prior_and_of_a_fixed_operator():
    w = s = torch.zeros(2, 6, dtype=torch.float64)
    fresh = StressAdapter()
    fresh.switch_on(E, NU)
    assert torch.equal(anisotropy.stress_jacobian(fresh, w, s), EYE6.expand(2, 6, 6))
    G = 0.1 * torch.randn(6, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(
        anisotropy.stress_jacobian(Fixed(G), w, s), (EYE6 + G).expand(2, 6, 6)
    )


def test_analysis_leaves_the_adapter_alone(states):
    adapter = trained(2)
    before = {k: v.clone() for k, v in adapter.state_dict().items()}
    anisotropy.directional_modulus(states, adapter, DIRECTIONS[:2])
    assert all(torch.equal(v, before[k]) for k, v in adapter.state_dict().items())
    assert all(p.requires_grad and p.grad is None for p in adapter.parameters())


# --- directions ---------------------------------------------------------------------------------------------------------


def test_directions():
    angles, n = anisotropy.directions_in_plane([0, 0, 2.0], [1.0, 0, 1.0], count=5)
    torch.testing.assert_close(n[0], torch.tensor([0, 0, 1.0]).double())
    torch.testing.assert_close(n[2], torch.tensor([1.0, 0, 0]).double())
    assert angles[2].item() == pytest.approx(math.pi / 2)
    torch.testing.assert_close(DIRECTIONS.norm(dim=1), torch.ones(25).double())
    with pytest.raises(ConfigError, match="two directions that differ"):
        anisotropy.directions_in_plane([0, 0, 1.0], [0, 0, -2.0])
    even = torch.einsum("ki,kj->ij", *[anisotropy.directions_on_sphere(400)] * 2) / 400
    torch.testing.assert_close(even, torch.eye(3).double() / 3, rtol=0, atol=5e-3)


def test_an_adapter_that_was_never_on_is_refused(states):
    with pytest.raises(ConfigError, match="switch_on"):
        anisotropy.directional_modulus(states, StressAdapter(), DIRECTIONS[:1])


def test_an_adapter_that_is_a_stiffness_is_refused():
    adapter = HyperelasticAdapter()
    adapter.switch_on(1e5, 0.3)
    with pytest.raises(ConfigError, match=r"analysis\.stiffness"):
        anisotropy.response_of(material_states("neo_hookean", {"mu": 1.0, "lam": 1.0}), adapter)

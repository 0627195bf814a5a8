"""What an adapter may stiffen the body by: the exact figure of an operator, the bound of all, and the substeps that follow."""

import pytest
import torch

from mosa.baselines.direct import DirectAdapter
from mosa.modules.adapters import microplane
from mosa.modules.adapters.stiffening import ADAPTER_MARGIN, acoustic_stiffening, worst_stiffening
from mosa.modules.adapters.stress import StressAdapter
from mosa.modules.body.body import EVEN, Body, SimulationSettings
from mosa.modules.body.material import Material
from mosa.physics.time.time_step import required_substeps

PLACES = ((0, 0), (1, 1), (2, 2), (1, 2), (2, 0), (0, 1))
OPERATOR = {"state_dependence": "constant", "major_symmetry": True, "no_pre": True, "no_post": True}


def operators(numbers: torch.Tensor) -> torch.Tensor:
    """A - I (N, 6, 6) of numbers (N, 4, 12)."""
    C = microplane.correction(numbers)
    return microplane.redistribution(C[:, :3], C[:, 3])


def corner(alpha: float, poisson: float) -> float:
    return acoustic_stiffening(
        operators(torch.full((1, 4, 12), alpha, dtype=torch.float64)), poisson
    )


def modulus(G: torch.Tensor, poisson: float, n: torch.Tensor, m: torch.Tensor) -> torch.Tensor:
    """n m : (I + G) C0 : n m over lam + 2 mu, by the stress of the strain sym(n m), without Mandel's scaling."""
    lam = 2 * poisson / (1 - 2 * poisson)  # in units of mu
    strain = 0.5 * (n[:, None] * m[None] + m[:, None] * n[None])
    stress = 2 * strain + lam * strain.trace() * torch.eye(3).double()
    vech = torch.stack([stress[i, j] for i, j in PLACES])
    vech = vech + G @ vech
    T = torch.zeros(3, 3).double()
    for value, (i, j) in zip(vech, PLACES):
        T[i, j] = T[j, i] = value
    return (n @ T @ m) / (lam + 2)


def test_the_figure_of_one_operator_is_the_largest_modulus():
    """Against 20 ascents over n and m with the stress itself; the spread directions miss the maximum by under 0.5 %."""
    rng = torch.Generator().manual_seed(0)
    G = operators(0.2 * (2 * torch.rand(1, 4, 12, generator=rng, dtype=torch.float64) - 1))[0]
    best = 0.0
    for _ in range(20):
        pair = torch.randn(2, 3, generator=rng, dtype=torch.float64).requires_grad_()
        optimiser = torch.optim.Adam([pair], lr=0.05)
        for _ in range(150):
            n, m = (v / v.norm() for v in pair)
            value = modulus(G, 0.3, n, m)
            optimiser.zero_grad()
            (-value).backward()
            optimiser.step()
        best = max(best, float(value.detach()))
    found = acoustic_stiffening(G, 0.3)
    assert 0.995 * best < found < best * (1 + 1e-6)


def test_the_prior_is_one_and_the_projection_changes_nothing():
    assert acoustic_stiffening(torch.zeros(6, 6), 0.4) == pytest.approx(1, abs=1e-12)
    assert acoustic_stiffening(0.5 * torch.eye(6), 0.4) == pytest.approx(1.5, abs=1e-12)
    G = operators(
        0.1 * torch.randn(5, 4, 12, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    )
    projected = microplane.major_symmetric(G, torch.tensor(0.35).double())
    assert acoustic_stiffening(projected, 0.35) == pytest.approx(
        acoustic_stiffening(G, 0.35), rel=1e-12
    )


@pytest.mark.parametrize("alpha", [0.1, 0.15, 0.2, 0.3])
def test_the_bound_holds_for_every_operator(alpha):
    """The corner where all numbers are alpha is above 400 others and above what ascent along the edges finds (its mirror images
    are as high, up to the spread of directions); the bound is above it."""
    rng = torch.Generator().manual_seed(2)
    signs = torch.randint(0, 2, (400, 4, 12), generator=rng).double() * 2 - 1
    for poisson in (0.0, 0.38, 0.49):
        top = corner(alpha, poisson)
        assert acoustic_stiffening(operators(alpha * signs), poisson) < top
        x = alpha * signs[:1].clone()
        most = acoustic_stiffening(operators(x), poisson)
        for _ in range(2):
            for k in range(48):
                flipped = x.clone()
                flipped.view(-1)[k] *= -1
                found = acoustic_stiffening(operators(flipped), poisson)
                if found > most:
                    x, most = flipped, found
        assert most <= top * 1.001
        assert top <= worst_stiffening(alpha) * (1.001 if poisson <= 0.38 else 1.06)
    assert worst_stiffening(alpha) < 1.25 * corner(alpha, 0.3)  # no more substeps than needed


def test_the_bound_has_the_method_s_figures():
    assert worst_stiffening(0.1) == ADAPTER_MARGIN == 1.85
    assert worst_stiffening(0.15) == pytest.approx(2.45, rel=0.01)
    assert worst_stiffening(0.05) == ADAPTER_MARGIN


def body(adapter) -> Body:
    rest = torch.rand(8, 3, generator=torch.Generator().manual_seed(0))
    return Body(rest=rest, volume=torch.full((8,), 1e-6), colors=torch.ones(8, 3), opacities=torch.ones(8),
                covariances=torch.eye(3).expand(8, 3, 3), density=1000.0, material=Material("neo_hookean", {"E": 2e5, "nu": 0.3}),
                heterogeneity=None, adapter=adapter,
                settings=SimulationSettings(dx=0.02, stride=1, max_substeps=10_000))  # fmt: skip


def test_substeps_follow_the_operator_there_is():
    """The default adapter takes one number of steps until its operator is stiffer than 1.85, and then as many as that asks for."""
    adapter = StressAdapter(alpha=0.2, **OPERATOR)
    one, count = body(adapter), 100_000.0
    before = one.substeps(count, 2.0, 1.0, True)
    assert (
        before % EVEN == 0
        and before
        == -(-required_substeps(count, 1000.0, 2.0, 0.02, 1.0, ADAPTER_MARGIN) // EVEN) * EVEN
    )
    assert (
        one.stiffening(True) == one.step_control(True).factor == ADAPTER_MARGIN
        and one.stiffening(False) == 1
    )
    with torch.no_grad():
        adapter.operator.free.fill_(0.03)  # tanh(0.3): C about 0.12
    assert one.stiffening(True) == ADAPTER_MARGIN and one.substeps(count, 2.0, 1.0, True) == before
    with torch.no_grad():
        adapter.operator.free.fill_(10.0)
    found = one.stiffening(True)
    assert found == pytest.approx(corner(0.2, 0.3), rel=1e-6) and found > 2.9
    assert one.step_control(True).factor == found
    assert one.substeps(count, 2.0, 1.0, True) == pytest.approx(
        before * (found / ADAPTER_MARGIN) ** 0.5, abs=EVEN + 1
    )


def test_networks_of_the_state_are_given_their_bound():
    for alpha in (0.1, 0.2):
        adapter = StressAdapter(alpha=alpha, hidden=4)
        assert body(adapter).stiffening(True) == adapter.stiffening(0.3) == worst_stiffening(alpha)
    assert body(StressAdapter(alpha=0.2, hidden=4, no_C=True)).stiffening(True) == ADAPTER_MARGIN
    assert body(DirectAdapter(hidden=4)).stiffening(True) == ADAPTER_MARGIN

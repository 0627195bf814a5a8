"""Start of the ablation without prior stress: what the body's stiffness is before anything is learned."""

import pytest
import torch

from mosa.errors import ConfigError
from mosa.evaluation.analysis.anisotropy import (
    directional_modulus,
    directions_on_sphere,
    response_of,
)
from mosa.modules.adapters.stress import StressAdapter
from mosa.modules.adapters.warm_start import drawn_stretches, warm_start
from mosa.modules.body.material import material_states
from mosa.physics.constitutive.elasticity import lame
from mosa.physics.engine.simulator import Simulator
from mosa.types import Ground, ParticleState

E, NU = 8e4, 0.4


@pytest.fixture(scope="module")
def states():
    mu, lam = lame(torch.tensor(E, dtype=torch.float64), torch.tensor(NU, dtype=torch.float64))
    return material_states("neo_hookean", {"mu": mu, "lam": lam})


def adapter(seed: int = 0, **options) -> StressAdapter:
    torch.manual_seed(seed)
    result = StressAdapter(**{"no_prior_stress": True, **options})
    result.switch_on(E, NU)
    return result


def strains(count: int, size: float) -> torch.Tensor:
    """(count, 6) Mandel Hencky strains of one norm, drawn apart from those of the fit."""
    H = torch.randn(count, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(99))
    return size * H / H.norm(dim=1, keepdim=True)


def test_without_it_there_is_no_stiffness(states):
    response = response_of(states, adapter())
    assert response(strains(5, 0.1)).abs().max() < 1e-12 * E


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_body_starts_with_about_the_priors_stiffness(states, seed):
    model = adapter(seed)
    left = warm_start(model, states)
    assert left < 0.01
    E_n = directional_modulus(states, model, directions_on_sphere(12))
    torch.testing.assert_close(E_n, torch.full_like(E_n, E), rtol=0.01, atol=0)


@pytest.mark.parametrize("size", [2e-3, 0.03, 0.25])
def test_stress_over_strains_that_were_not_fitted(states, size):
    model = adapter()
    warm_start(model, states)
    H = strains(200, size)
    wanted, found = response_of(states, None)(H), response_of(states, model)(H)
    error = (found - wanted).norm(dim=1) / wanted.norm(dim=1)
    assert error.square().mean().sqrt() < 0.02


def test_rest_stays_exactly_stress_free(states):
    model = adapter()
    warm_start(model, states)
    assert response_of(states, model)(torch.zeros(3, 6, dtype=torch.float64)).abs().max() == 0
    literal = adapter(rest_free=False)
    warm_start(literal, states)
    assert (
        response_of(states, literal)(torch.zeros(3, 6, dtype=torch.float64)).abs().max() < 1e-5 * E
    )


def test_body_falls_and_bounces_like_the_prior(states):
    """A block of 0.1 m dropped on the ground; asked at every substep, so that nothing but the fit differs."""
    mu, lam = lame(torch.tensor(E, dtype=torch.float64), torch.tensor(NU, dtype=torch.float64))
    spacing = 0.02
    x = (
        torch.cartesian_prod(*[0.2 + spacing * torch.arange(5, dtype=torch.float64)] * 3)
        + torch.tensor([0, 0.02, 0]).double()
    )
    eye = torch.eye(3, dtype=torch.float64).expand(len(x), 3, 3).contiguous()
    v = torch.tensor([0, -1.5, 0], dtype=torch.float64).expand(len(x), 3).contiguous()
    simulator = Simulator(
        "neo_hookean", dx=0.04, substeps=80, frame_dt=0.02, ground=Ground(0.2), dtype=torch.float64
    )

    def positions(model) -> torch.Tensor:
        volume = torch.full((len(x),), spacing**3, dtype=torch.float64)
        start = ParticleState(x, v, torch.zeros_like(eye), eye, eye)
        return simulator.rollout(start, {"mu": mu, "lam": lam}, volume, 1000.0, 4, adapter=model).x

    model = adapter()
    with torch.no_grad():
        wanted, soft = positions(None), positions(model)
        warm_start(model, states)
        found = positions(model)
    apart = lambda a: (a - wanted).square().sum(-1).mean(1).sqrt().max()  # noqa: E731
    assert apart(soft) > 0.02  # [m]: without a warm start it is a puddle
    assert apart(found) < 0.001


def test_only_the_last_layer_of_phi_moves_and_the_same_seed_gives_the_same(states):
    model = adapter()
    before = {k: v.clone() for k, v in model.state_dict().items()}
    warm_start(model, states)
    moved = {k for k, v in model.state_dict().items() if not torch.equal(v, before[k])}
    assert moved == {"operator.phi.4.weight", "operator.phi.4.bias"}
    again = adapter()
    warm_start(again, states)
    assert all(torch.equal(v, again.state_dict()[k]) for k, v in model.state_dict().items())


def test_drawn_stretches_have_all_axes_and_sizes():
    W = drawn_stretches(4000, 0.3, torch.Generator().manual_seed(0))
    torch.testing.assert_close(W, W.mT)
    values, axes = torch.linalg.eigh(W)
    size = values.log().norm(dim=1)
    assert size.min() >= 1e-3 * (1 - 1e-9) and size.max() <= 0.3 * (1 + 1e-9)
    assert (size < 1e-2).float().mean() > 0.3 and (size > 0.1).float().mean() > 0.15
    spread = torch.einsum("ni,nj->ij", axes[:, :, 2], axes[:, :, 2]) / len(W)
    torch.testing.assert_close(spread, torch.eye(3).double() / 3, rtol=0, atol=0.02)


def test_adapters_that_keep_the_prior_are_refused(states):
    with pytest.raises(ConfigError, match="no_prior_stress"):
        warm_start(adapter(no_prior_stress=False), states)
    with pytest.raises(ConfigError, match="switch_on"):
        warm_start(StressAdapter(no_prior_stress=True), states)

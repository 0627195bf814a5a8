"""`vibration_growth`: it catches operators that make energy, those of fluids too, and lets laws with an energy pass."""

import math

import pytest
import torch

from mosa.evaluation.analysis.vibration import GROWTH_LIMIT, vibration_growth
from mosa.modules.adapters.hyperelastic import (
    HyperelasticAdapter,
    anisotropic_basis,
    root_stiffness,
)
from mosa.modules.adapters.microplane import isotropic_stiffness
from mosa.modules.adapters.stress import StressAdapter
from mosa.modules.body.material import Material

SIGNS = "+++---+-----+-+-+-++--+---+-+----++-+++++-+++---"
"""Of the entries of the four matrices: the most indefinite of 102 drawn patterns at nu 0.4."""
YOUNG, DENSITY = 1e5, 1000.0


def linear(size: float, nu: float) -> StressAdapter:
    """One operator on the prior's stress with major symmetry and entries +-size."""
    adapter = StressAdapter(
        alpha=0.2, state_dependence="constant", major_symmetry=True, no_pre=True, no_post=True
    )
    signs = torch.tensor([1.0 if sign == "+" else -1.0 for sign in SIGNS]).reshape(4, 12)
    with torch.no_grad():
        adapter.operator.free.copy_(signs * math.atanh(size / 0.2) / 10)
    adapter.switch_on(YOUNG, nu)
    return adapter


def solid(nu: float) -> Material:
    return Material("corotated", {"E": YOUNG, "nu": nu})


def growth(material, adapter, **options):
    return vibration_growth(material, adapter, density=DENSITY, stride=8, **options)


@pytest.mark.filterwarnings("ignore:.*det F")  # they burst
@pytest.mark.parametrize("size, nu", [(0.16, 0.4), (0.199, 0.45)])
def test_an_operator_that_bursts_in_the_first_period_is_caught(size, nu):
    assert growth(solid(nu), linear(size, nu)) > 100 * GROWTH_LIMIT


def test_a_smaller_one_of_the_same_signs_passes():
    assert growth(solid(0.4), linear(0.1, 0.4)) <= GROWTH_LIMIT


@pytest.mark.filterwarnings("ignore:.*det F")
def test_a_fluid_with_an_operator_is_caught():
    water = Material("newtonian", {"mu": 100.0, "kappa": YOUNG})
    assert growth(water, linear(0.092, 0.49)) > 1.5


PRIORS = {
    "corotated": {"E": YOUNG, "nu": 0.4}, "neo_hookean": {"E": YOUNG, "nu": 0.45}, "stvk": {"E": YOUNG, "nu": 0.3},
    "von_mises": {"E": YOUNG, "nu": 0.3, "yield_stress": 1e3}, "newtonian": {"mu": 100.0, "kappa": YOUNG},
}  # fmt: skip


@pytest.mark.parametrize("law", PRIORS)
def test_priors_alone_pass(law):
    assert 0 < growth(Material(law, PRIORS[law]), None) <= GROWTH_LIMIT


def same_to_first_order(size: float, nu: float) -> torch.Tensor:
    """(19,) numbers whose A is the anisotropic part of C0^(-1/2) (G C0) C0^(-1/2) of the linear operator's G."""
    poisson = torch.tensor(nu, dtype=torch.float64)
    scale = torch.tensor([1, 1, 1, 2**0.5, 2**0.5, 2**0.5], dtype=torch.float64)
    with torch.no_grad():
        G = scale[:, None] * linear(size, nu).operator.constant_operator().double() / scale
    inner = torch.linalg.inv(root_stiffness(poisson))
    A = inner @ G @ isotropic_stiffness(poisson) @ inner
    A = 0.5 * (A + A.T)
    assert (
        torch.linalg.eigvalsh(torch.eye(6).double() + A)[0] < 0
    )  # to first order alone it would be indefinite
    return torch.einsum("kij,ij->k", anisotropic_basis(torch.float64, torch.device("cpu")), A)


@pytest.mark.parametrize("pattern", ["of the linear operator", 0, 1, 2])
def test_large_numbers_of_a_law_with_an_energy_pass(pattern):
    """The linear operator's own pattern, which bursts in that form; and drawn signs, six standard deviations of the prior."""
    adapter = HyperelasticAdapter()
    adapter.switch_on(YOUNG, 0.4)
    with torch.no_grad():
        if isinstance(pattern, str):
            adapter.numbers.copy_(same_to_first_order(0.16, 0.4))
        else:
            adapter.numbers.copy_(
                0.6 * torch.sign(torch.randn(19, generator=torch.Generator().manual_seed(pattern)))
            )
    assert growth(solid(0.4), adapter) <= GROWTH_LIMIT


def test_it_shakes_the_law_in_use_not_that_of_the_stage_s_start():
    """nu moved from 0.45 to 0.2 in the joint stage: S of 0.45 on the law of 0.2 is indefinite and bursts, or is too stiff."""
    generator = torch.Generator().manual_seed(0)
    moved, fresh = HyperelasticAdapter(), HyperelasticAdapter()
    moved.switch_on(YOUNG, 0.45)
    fresh.switch_on(YOUNG, 0.2)
    numbers = 0.5 * torch.randn(19, generator=generator)
    with torch.no_grad():
        moved.numbers.copy_(numbers)
        fresh.numbers.copy_(numbers)
    assert growth(solid(0.2), moved, cells=2) == growth(solid(0.2), fresh, cells=2) <= GROWTH_LIMIT

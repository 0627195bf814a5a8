"""Checks 1 to 3 and 26 of docs/verification.md: what a closed system keeps, with the full adapter on."""

import itertools
import math

import pytest
import torch
from bodies import DENSITY, LAM, LAWS, MU, PRECISIONS, random_adapter
from closed_systems import asymmetric_control, conservation, vibration

from mosa.evaluation.analysis.vibration import GROWTH_LIMIT, vibration_growth
from mosa.modules.body.material import Material


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("law", LAWS)
def test_01_02_03_mass_and_momenta_over_1000_substeps(law, dtype):
    """sum_I m_I = sum_p m_p, sum m v and sum m (x x v + affine part) constant.

    Every substep adds the rounding of sums of 64 particles: 1e-6 and 5e-6 in float32 (eps 6e-8, a random walk of 1000 steps
    gives 2e-6), 1e-12 and 1e-13 in float64.
    """
    found = conservation(law, dtype)
    double = dtype == torch.float64
    assert found["mass"] < (1e-12 if double else 1e-6)
    assert found["linear"] < (1e-13 if double else 5e-6)
    assert found["angular"] < (1e-12 if double else 5e-6)
    assert found["changed"] > 0.1  # the velocities themselves, of 0.4 m/s, are not constant


def test_03_control_an_asymmetric_stress_does_not_keep_angular_momentum():
    """tau = mu (F - I): the torque of its skew part on the body shows; linear momentum does not care."""
    found = asymmetric_control()
    assert found["angular"] > 1e-4
    assert found["linear"] < 1e-13


@pytest.mark.parametrize("law", ["corotated", "neo_hookean"])
@pytest.mark.parametrize("seed", [1, 3, 7])
def test_26_free_vibration_with_major_symmetry_never_grows(law, seed):
    """Constant operator with an energy: the kinetic maximum of 20 periods is not above that of the period before."""
    maxima = vibration(law, seed=seed, major_symmetry=True)
    assert all(later <= earlier for earlier, later in itertools.pairwise(maxima))
    assert maxima[-1] > 1e-3 * maxima[0]  # still vibrating


def test_26_control_the_literal_operator_can_pump():
    """The same random numbers without the projection are no passive law: above 1.05 per period is what a run warns of."""
    maxima = vibration("corotated", seed=7, major_symmetry=False)
    assert max(later / earlier for earlier, later in itertools.pairwise(maxima)) > 1.05


@pytest.mark.parametrize("major_symmetry", [True, False])
def test_26_a_run_reports_whether_its_law_makes_energy(major_symmetry):
    """The same operator as in the control, through what a run does with the law it has learned."""
    material = Material(
        "corotated", {"E": MU * (3 * LAM + 2 * MU) / (LAM + MU), "nu": LAM / (2 * (LAM + MU))}
    )
    adapter = random_adapter(
        7, state_dependence="constant", no_pre=True, no_post=True, major_symmetry=major_symmetry
    )
    adapter.fused = True  # as in a run on a GPU: the report is made on the CPU
    growth = vibration_growth(material, adapter, density=DENSITY, stride=8)
    assert growth < 1 if major_symmetry else growth > GROWTH_LIMIT


def test_26_a_body_that_bursts_is_no_traceback_and_a_fluid_swings_too():
    adapter = random_adapter(0, size=3.0, rest_free=False, l_max=None)
    assert (
        vibration_growth(
            Material("corotated", {"E": 8e4, "nu": 0.3}), adapter, density=DENSITY, stride=8
        )
        == math.inf
    )
    water = Material("newtonian", {"mu": 100.0, "kappa": 1e5})
    assert 0.5 < vibration_growth(water, None, density=DENSITY, stride=8) <= GROWTH_LIMIT

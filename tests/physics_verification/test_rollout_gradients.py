"""Checks 18 and 19 of docs/verification.md: the gradient of rollouts with the full adapter, random last layers, E_ref fixed.

With a linear operator, losses on all frames, and the segments' recomputation:
tests/physics/engine/test_rollout.py. Differentials of the factorisations (check 20):
tests/physics/constitutive/test_kinematics.py. Torch twin (21): tests/physics/test_reference.py and
tests/physics/engine/test_cuda.py.
"""

import pytest
import torch
from bodies import ELASTIC, LAWS
from gradients import Case, Comparison

from mosa.physics.constitutive.laws import law_named


def assert_agreement(found: dict[str, Comparison], smooth: bool) -> None:
    """1e-6 on a smooth path; else the larger of 1e-5 and ten times the disagreement of the differences at h and 10 h, 1e-3 at most.

    Where the two disagree by more than 1 % there is no difference to compare with: no such parameter is drawn here.
    """
    for name, (error, spread) in found.items():
        if smooth:
            assert error < 1e-6, (name, error)
        else:
            assert spread < 1e-2 and error < min(max(1e-5, 10 * spread), 1e-3), (
                name,
                error,
                spread,
            )


YIELDING = [law for law in LAWS if law not in ELASTIC]


def paths(laws: list[str]) -> list[tuple[str, int]]:
    """Law and substeps: one and 50 of every law, 200 of the first, as how errors add up along a path is the simulator's."""
    return [(law, substeps) for law in laws for substeps in (1, 50)] + [(laws[0], 200)]


def stride(substeps: int) -> int:
    """Substeps between evaluations of the adapter: at most five evaluations on a path."""
    return max(5, substeps // 5)


@pytest.mark.parametrize("law, substeps", paths(ELASTIC))
def test_18_smooth_laws(law, substeps):
    """dL/d(every parameter), dL/dv0 and dL/d(weights) of a vibrating block in flight. Fibres that go slack have a kink: of such a
    law the path is smooth but for the particles that cross it, so that the difference's step is small and its error measured.
    In one substep hardly one crosses it, and what a small step of the fibre's exponent changes is lost in rounding."""
    kinked = "fibre" in law_named(law).parameters
    case = Case(law, substeps, stride=stride(substeps))
    found = case.compare(
        both_steps=kinked, scale=(0.1 if substeps == 1 else 0.01) if kinked else 1.0
    )
    assert_agreement(found, smooth=not kinked)


@pytest.mark.parametrize("law, substeps", paths(YIELDING))
def test_18_laws_that_yield_in_contact_with_friction(law, substeps):
    """Also in yield stress, friction_alpha, cohesion, viscosity; steps small enough that few particles cross a switch."""
    case = Case(law, substeps, contact=True, stride=stride(substeps))
    assert_agreement(case.compare(both_steps=True, scale=0.003), smooth=False)


def test_18_contact_of_an_elastic_body():
    case = Case("corotated", 200, contact=True, stride=stride(200))
    assert_agreement(case.compare(both_steps=True, scale=0.003), smooth=False)


def test_18_training_horizon_on_a_smooth_path():
    """1500 substeps of the full adapter, the horizon of training: 1e-6."""
    assert_agreement(
        Case("corotated", 1500, stride=20).compare(both_steps=False, scale=0.05), smooth=True
    )


def test_18_training_horizon_through_contact():
    found = Case("corotated", 1500, stride=20, contact=True).compare(
        both_steps=True, scale=0.0003, names=("E", "weights")
    )
    assert_agreement(found, smooth=False)


@pytest.mark.parametrize("law", ["corotated", "neo_hookean", "von_mises"])
def test_19_single_precision_gradient_at_800_substeps(law):
    """Relative to the largest entry of each parameter's gradient, 1e-3: 800 substeps of eps 6e-8, growing with the path."""
    single, double = (
        Case(law, 800, dtype=dtype, stride=20).gradient()
        for dtype in (torch.float32, torch.float64)
    )
    for name, expected in double.items():
        assert (single[name].double() - expected).abs().max() < 1e-3 * expected.abs().max(), name


@pytest.mark.parametrize("law", ["corotated", "drucker_prager"])
def test_19_recomputed_networks_give_the_gradient_bit_for_bit(law):
    plain, recomputed = (
        Case(law, 60, recompute=recompute).gradient() for recompute in (False, True)
    )
    for name, expected in plain.items():
        assert torch.equal(recomputed[name], expected), name

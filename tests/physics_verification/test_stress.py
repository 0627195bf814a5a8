"""Checks 4 to 7 of docs/verification.md for every registered law: symmetry, frame indifference, energy, small strain.

Beside the units: the adapter's stages alone in tests/baselines/test_objectivity.py, gradients in
tests/physics/constitutive/test_elasticity.py.
"""

import pytest
import torch
from bodies import LAWS, PRECISIONS, E, eyes, is_fluid
from energies import ENERGIES
from stresses import adapted_stress, deformations, energy_error, frame_error, moduli, stress


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("law", LAWS)
def test_04_stress_is_symmetric(law, dtype):
    """tau = tau^T, of the law and with the adapter; 1e-6 in float32, 1e-13 in float64 of the largest entry."""
    F = deformations(200, 3).to(dtype)
    C = torch.randn(200, 3, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64).to(
        dtype
    )
    for tau in (stress(law, F, C), adapted_stress(law, F, C)):
        assert (tau - tau.mT).abs().max() <= (
            1e-6 if dtype == torch.float32 else 1e-13
        ) * tau.abs().max()
        assert tau.abs().max() > 1e-3 * E


@pytest.mark.parametrize("adapted", [False, True])
@pytest.mark.parametrize("law", LAWS)
def test_05_stress_turns_with_the_body(law, adapted):
    """tau(Q F) = Q tau(F) Q^T to rounding; `linear` is not objective and is the control that the test can fail."""
    error = frame_error(law, adapted)
    assert error > 1e-2 if law == "linear" else error < 1e-12


@pytest.mark.parametrize("law", [law for law in LAWS if law in ENERGIES])
def test_06_stress_is_the_gradient_of_the_energy(law):
    """tau = dPsi/dF F^T; of `linear` the symmetric part. 1e-12: rounding of automatic differentiation in float64."""
    assert energy_error(law) < 1e-12


@pytest.mark.parametrize("law", LAWS)
def test_07_small_strain_and_rest(law):
    """tau(I) = 0, exactly in float64 and to 1e-5 E in float32; C11 and C44 to 1e-4: the strain is 1e-5."""
    assert stress(law, eyes(1)).abs().max() == 0.0
    assert stress(law, eyes(1, torch.float32)).abs().max() <= 1e-5 * E
    e = 1e-5
    stretched, sheared = eyes(1), eyes(1)
    stretched[0, 0, 0] += e
    sheared[0, 1, 2] += e
    c11, c44 = moduli(law)
    assert float(stress(law, stretched)[0, 0, 0]) / e == pytest.approx(c11, rel=1e-4)
    assert float(stress(law, sheared)[0, 1, 2]) / e == pytest.approx(
        c44, rel=1e-4, abs=1e-4 * c11 if is_fluid(law) else 0
    )

"""Whether a law of one's own is symmetric, objective, derived rightly and has an energy."""

import warnings

import pytest
import torch
import warp as wp

import mosa
from mosa.errors import ConfigError
from mosa.evaluation.analysis.law_stress import check_own
from mosa.modules.body.material import Material
from mosa.physics.constitutive.laws import LawParameters, register_law

SOLID = {"E": 1e5, "nu": 0.3}


@wp.func
def right_for_left(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """mu (C - I) + lam log(J) I: C = F^T F in place of b = F F^T."""
    one = wp.identity(n=3, dtype=wp.float64)
    return p[0] * (wp.transpose(F) * F - one) + p[1] * wp.log(wp.determinant(F)) * one


@wp.func
def without_energy(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """J mu (b - I): symmetric and objective, but closed loops make work."""
    one = wp.identity(n=3, dtype=wp.float64)
    return wp.determinant(F) * p[0] * (F * wp.transpose(F) - one)


@wp.func
def skew(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """mu (F - I)."""
    return p[0] * (F - wp.identity(n=3, dtype=wp.float64))


@pytest.mark.parametrize(
    "function, wrong",
    [
        (right_for_left, {"objectivity", "loops"}),
        (without_energy, {"loops"}),
        (skew, {"symmetry", "objectivity", "loops"}),
    ],
)
def test_a_wrong_law_is_found(function, wrong):
    name = f"checked_{function.key}"
    register_law(name, function, ("mu", "lam"), needs_positive_J=True)
    with pytest.warns(UserWarning, match=f"law '{name}': loops is off by .*energy"):
        found = mosa.check_law(name, SOLID)
    assert {key for key, error in found.items() if error > 1e-2} == wrong and found["rest"] < 1e-8
    assert all(found[key] < 1e-8 for key in found.keys() - wrong)
    before = torch.random.get_rng_state()
    with pytest.warns(UserWarning, match="is off by"):
        check_own(Material(name, SOLID))  # as a run does before it reads data
    assert torch.equal(torch.random.get_rng_state(), before)


@pytest.mark.parametrize(
    "law, more", [("neo_hookean", {}), ("stvk", {}), ("mooney_rivlin", {"second_share": 0.3})]
)
def test_a_right_law_passes(law, more):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = mosa.check_law(law, SOLID | more)
        check_own(Material(law, SOLID | more))
    assert set(found) == {"symmetry", "objectivity", "gradient", "residual", "rest", "loops"}


@wp.func
def turned_sign(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """-mu (b - I) + lam log(J) I: an energy, without a minimum at rest."""
    one = wp.identity(n=3, dtype=wp.float64)
    return p[1] * wp.log(wp.determinant(F)) * one - p[0] * (F * wp.transpose(F) - one)


def test_a_law_whose_rest_is_unstable_is_found():
    register_law("checked_turned_sign", turned_sign, ("mu", "lam"), needs_positive_J=True)
    with pytest.warns(UserWarning, match="rest is off by .* resists every strain: a wrong sign"):
        found = mosa.check_law("checked_turned_sign", SOLID)
    mu, lam = 1e5 / 2.6, 3e4 / 1.3 / 0.4
    assert found["rest"] == pytest.approx(2 * mu / max(2 * mu, abs(3 * lam - 2 * mu)))
    assert all(error < 1e-8 for key, error in found.items() if key != "rest")


@wp.func
def stressed_at_rest(F: wp.mat33d, R: wp.mat33d, C_affine: wp.mat33d, p: LawParameters):
    """mu b + lam log(J) I, an energy whose body shrinks: - mu I was left out."""
    one = wp.identity(n=3, dtype=wp.float64)
    return p[0] * F * wp.transpose(F) + p[1] * wp.log(wp.determinant(F)) * one


def test_a_law_that_is_stressed_at_rest_is_found_also_where_it_is_damped():
    register_law("checked_stressed", stressed_at_rest, ("mu", "lam"), needs_positive_J=True)
    with pytest.warns(UserWarning, match=r"residual is off by .* no stress at rest, where F = I"):
        found = mosa.check_law("checked_stressed", SOLID)
    assert found["residual"] > 0.1
    assert all(error < 1e-8 for key, error in found.items() if key != "residual")
    with pytest.warns(UserWarning, match="'checked_stressed~damped': residual is off by"):
        check_own(Material("checked_stressed", SOLID | {"damping": 1.0}))


def test_parameters_are_a_section():
    with pytest.raises(ConfigError, match=r"^parameters: expected a section of keys, found None"):
        mosa.check_law("corotated", None)


def test_laws_without_an_energy_are_not_asked_for_it():
    found = mosa.check_law("von_mises", SOLID | {"yield_stress": 1e3})
    assert "loops" not in found and found["objectivity"] < 1e-8

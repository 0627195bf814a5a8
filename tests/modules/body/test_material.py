"""Global parameters: unconstrained forms, ranges, what the simulator gets, and what a mistake says."""

import math
from pathlib import Path

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from mosa.errors import ConfigError
from mosa.modules.body import material as material_module
from mosa.modules.body.material import (
    ANGLE_MAX,
    FORMS,
    LOG,
    NU_MAX,
    SOFTPLUS,
    Direction,
    Form,
    Material,
    register_form,
)
from mosa.physics.constitutive import laws
from mosa.physics.constitutive.laws import law_named

CONF = Path(__file__).parents[3] / "conf" / "prior"
ELASTIC = {"E": 1e5, "nu": 0.4}
NUMBERS = sorted(name for name, form in FORMS.items() if isinstance(form, Form))
SAND = {**ELASTIC, "friction_angle": 30.0, "cohesion": 0.0}


@pytest.mark.parametrize("file", sorted(CONF.glob("*.yaml")), ids=lambda f: f.stem)
def test_every_prior_starts_at_the_values_of_its_file(file):
    keys = OmegaConf.to_container(OmegaConf.load(file))
    keys.pop("options", None)
    material = Material(**keys)
    laws = keys["candidates"] if file.stem == "auto" else [keys["law"]]
    assert file.stem.startswith(keys["law"]) and material.law == laws[0]
    given, found = keys["parameters"], {}
    for material.law in laws:
        found |= material.physical()
    for name in given:
        if name in material.directions:
            given[name] = torch.nn.functional.normalize(
                torch.tensor(given[name]).double(), dim=0
            ).tolist()
            found[name] = material.direction(name)
        assert found[name].tolist() == pytest.approx(given[name], rel=1e-5), name
    for law in map(law_named, laws):
        material.law = law.name
        assert set(material.per_particle(torch.ones(4))) == {
            n for n in law.parameters if n != law.reference
        }


def test_each_candidate_has_its_own_parameters():
    laws, given = ("corotated", "von_mises"), {**ELASTIC, "yield_stress": 5e3}
    material = Material("auto", given, candidates=laws)
    assert material.names == ("E", "nu") and material.learned == ["E", "nu"]
    assert set(material.per_particle()) == {"mu", "lam"}
    material.choose("von_mises")
    assert material.learned == ["E", "nu", "yield_stress"]
    assert float(material.per_particle()["yield_stress"].detach()) == pytest.approx(5e3)
    assert Material("auto", {**given, "cohesion": 0.1}, candidates=laws).given == tuple(given)
    with pytest.raises(ConfigError, match=r"candidates corotated, von_mises, found cohesoin"):
        Material("auto", {**given, "cohesoin": 0.1}, candidates=laws)
    with pytest.raises(ConfigError, match="von_mises takes lam, mu, yield_stress"):
        Material("auto", ELASTIC, candidates=laws)


def test_a_liquid_among_the_candidates_has_its_viscosity_and_no_damping():
    given = {**ELASTIC, "mu": 100.0, "kappa": 2e4}
    laws = ("corotated", "newtonian")
    material = Material("auto", given, candidates=laws)
    assert material.names == ("E", "nu") and float(material.reference_modulus()) == pytest.approx(
        1e5
    )
    material.choose("newtonian")
    assert material.learned == ["mu", "kappa"] and set(material.per_particle()) == {"mu", "kappa"}
    assert float(material.reference_modulus()) == pytest.approx(2e4)
    damped = Material("auto", {**given, "damping": 5.0}, candidates=laws)
    assert damped.candidates == ("corotated~damped",)


def test_lame_parameters_and_friction_follow_from_the_physical_ones():
    values = {
        name: value.detach()
        for name, value in Material("drucker_prager", SAND).per_particle().items()
    }
    assert float(values["mu"]) == pytest.approx(1e5 / 2.8, rel=1e-5)
    assert float(values["lam"]) == pytest.approx(1e5 * 0.4 / (1.4 * 0.2), rel=1e-5)
    assert float(values["friction_alpha"]) == pytest.approx(
        (2 / 3) ** 0.5 * 2 * 0.5 / (3 - 0.5), rel=1e-5
    )
    assert float(values["cohesion"]) == 0.0


def test_heterogeneity_multiplies_the_stiffness_alone():
    factor = torch.tensor([0.8, 1.0, 1.2])
    material = Material("von_mises", {**ELASTIC, "yield_stress": 5e3})
    values = material.per_particle(factor)
    torch.testing.assert_close(values["mu"], factor * material.per_particle()["mu"])
    torch.testing.assert_close(values["lam"], factor * material.per_particle()["lam"])
    assert values["yield_stress"].shape == ()
    named = Material(
        "von_mises", {**ELASTIC, "yield_stress": 5e3}, modulated=["yield_stress"]
    ).per_particle(factor)
    torch.testing.assert_close(named["yield_stress"], factor * 5e3)
    assert named["mu"].shape == ()


def test_largest_modulus_is_that_of_the_stiffest_particle():
    material = Material("neo_hookean", ELASTIC)
    p = material.per_particle()
    expected = 1.15 * float((p["lam"] + 2 * p["mu"]).detach())
    modulus = material.max_modulus(torch.tensor([0.9, 1.15, 1.0], requires_grad=True))
    assert float(modulus) == pytest.approx(expected, rel=1e-6) and not modulus.requires_grad
    assert float(material.reference_modulus()) == pytest.approx(1e5, rel=1e-5)


def test_a_law_in_bulk_and_shear_modulus_has_both_modulated(monkeypatch):
    monkeypatch.setattr(laws, "_LAWS", dict(laws._LAWS))
    laws.register_law("bulk_and_shear", laws.law_named("stvk").stress, ("mu", "kappa"))
    material = Material("bulk_and_shear", {"mu": 3e4, "kappa": 1e5})
    factor = torch.tensor([1.0, 1.2])
    values = material.per_particle(factor)
    torch.testing.assert_close(values["mu"], 3e4 * factor)
    torch.testing.assert_close(values["kappa"], 1e5 * factor)
    assert float(material.max_modulus(factor)) == pytest.approx(1.2 * (1e5 + 4 * 3e4 / 3), rel=1e-5)
    assert float(material.reference_modulus()) == pytest.approx(1e5, rel=1e-5)


def test_gradient_reaches_every_parameter_that_is_learned():
    material = Material("drucker_prager", {**SAND, "cohesion": 0.01}, frozen=["nu"])
    sum(v.sum() for v in material.per_particle(torch.ones(3)).values()).backward()
    assert material.raw["nu"].grad is None and not material.raw["nu"].requires_grad
    assert all(material.raw[n].grad.abs() > 0 for n in ("E", "friction_angle", "cohesion"))


def test_stiffness_is_learned_as_a_logarithm():
    material = Material("corotated", ELASTIC)
    with torch.no_grad():
        material.raw["E"].add_(0.1)
    assert float(material.physical()["E"].detach()) == pytest.approx(
        1e5 * 2.718281828**0.1, rel=1e-5
    )


@pytest.mark.parametrize(
    ("law", "parameters", "name"),
    [
        ("drucker_prager", SAND, "cohesion"), ("neo_hookean", {"E": 1e5, "nu": 0.0}, "nu"),
        ("neo_hookean", {"E": 1e5, "nu": NU_MAX}, "nu"), ("drucker_prager", {**SAND, "friction_angle": 0.0}, "friction_angle"),
    ],
)  # fmt: skip
def test_a_parameter_that_starts_on_its_bound_is_held_there(law, parameters, name):
    material = Material(law, parameters)
    assert name not in material.raw
    assert float(material.physical()[name].detach()) == pytest.approx(parameters[name], abs=1e-7)
    other = Material(law, parameters)
    other.load_state_dict(material.state_dict())


@settings(max_examples=80, deadline=None)
@given(st.sampled_from(NUMBERS), st.floats(-60, 60))
@example("share_2", 60.0)
def test_no_step_of_an_optimiser_leaves_the_range(name, raw):
    value = float(FORMS[name].physical(torch.tensor(raw, dtype=torch.float64)))
    # what is written of a fit that ended there can be read again
    assert value not in (FORMS[name].low, FORMS[name].high) or value in FORMS[name].held
    low = FORMS[
        name
    ].low  # a bound that is not 0 may be reached by rounding: the law has a value there
    assert low <= value <= FORMS[name].high and (value > 0 or low < 0)


@settings(max_examples=80, deadline=None)
@given(st.sampled_from(NUMBERS), st.floats(0.001, 0.999))
def test_unconstrained_form_and_back(name, place):
    form = FORMS[name]
    value = form.low + (form.high - form.low) * place if form.high < 1e9 else 10 ** (10 * place - 3)
    back = form.physical(torch.tensor(form.inverse(value), dtype=torch.float64))
    assert float(back) == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("jelly", ELASTIC), "expected one of .*found 'jelly'"),
        (("corotated", {**ELASTIC, "stifness": 1.0}), "found stifness"),
        (
            ("corotated", {"E": -1.0, "nu": 0.4}),
            r"prior.parameters.E: expected a number between 0 and 1e\+20, found -1",
        ),
        (
            ("corotated", {"E": 1e5, "nu": 0.5}),
            "prior.parameters.nu: expected a number between 0 and 0.49, found 0.5",
        ),
        (
            ("drucker_prager", {**SAND, "friction_angle": 95.0}),
            "friction_angle: expected a number between 0 and 89",
        ),
        (
            ("corotated", {"E": "soft", "nu": 0.4}),
            "prior.parameters.E: expected a number, found 'soft'",
        ),
        (
            ("corotated", {"E": 10**400, "nu": 0.4}),
            "prior.parameters.E: expected a number, found 10{199}[.]{3}$",
        ),
        (("corotated", {"E": 1e5}), "E goes with nu"),
        (("corotated", {}), "expected E with nu, or kappa with mu"),
        (("von_mises", ELASTIC), "takes lam, mu, yield_stress .*, found none for yield_stress$"),
        (
            ("corotated", {**ELASTIC, "yield_stress": 1e3}),
            "law corotated takes lam, mu .*, found yield_stress$",
        ),
        (("corotated", ELASTIC, ["mu"]), "prior.frozen: expected names among E, nu, found mu"),
        (
            ("corotated", ELASTIC, [], ["kappa"]),
            "prior.modulated: expected names among E, nu, found kappa",
        ),
    ],
)
def test_a_mistake_is_named(arguments, message):
    with pytest.raises(ConfigError, match=message):
        Material(*arguments)


def test_a_parameter_without_a_range_says_how_it_gets_one(monkeypatch):
    monkeypatch.setattr(laws, "_LAWS", dict(laws._LAWS))
    laws.register_law("rangeless", law_named("stvk").stress, {"mu": 1, "lam": 1, "sponginess": 1})
    with pytest.raises(
        ConfigError, match=r"found sponginess \(law rangeless takes sponginess: .*register_form"
    ):
        Material("rangeless", {**ELASTIC, "sponginess": 2.0})


def test_largest_angle_is_below_a_right_angle():
    assert ANGLE_MAX < 90  # at 90 degrees the cone's slope is finite, but sin has no gradient there


@pytest.fixture
def fibred(monkeypatch):
    """A law with a direction, known to this test alone."""
    monkeypatch.setattr(laws, "_LAWS", dict(laws._LAWS))
    monkeypatch.setattr(material_module, "FORMS", dict(FORMS))
    laws.register_law("fibred", law_named("stvk").stress, {"mu": 1, "lam": 1, "k": 1, "a": 3})
    register_form("k", LOG)
    register_form("a", Direction())
    return {**ELASTIC, "k": 2e3}


@pytest.mark.parametrize("start", [[1, 0, 0], [0, -2, 0], [3, 1, -2]])
def test_a_direction_starts_at_its_value_and_stays_a_unit_vector(fibred, start):
    material = Material("fibred", {**fibred, "a": start})
    expected = torch.tensor(start).float() / torch.tensor(start).float().norm()
    torch.testing.assert_close(material.per_particle(torch.ones(4))["a"], expected)
    assert [float(material.physical()[f"a_{axis}"].detach()) for axis in "xyz"] == pytest.approx(
        expected.tolist()
    )
    assert "a" not in material.physical() and material.begins["a_1"] == material.begins["a_2"] == 0
    with torch.no_grad():
        material.raw["a_1"].fill_(0.6)
        material.raw["a_2"].fill_(-0.8)
    turned = material.direction("a")
    assert float(turned.detach().norm()) == pytest.approx(1, abs=1e-6)
    assert float(turned.detach() @ expected) == pytest.approx(math.cos(1), abs=1e-6)
    with torch.no_grad():  # 90 degrees away, where the line is as far as a line can be
        material.raw["a_1"].fill_(math.pi / 2)
        material.raw["a_2"].fill_(0)
    assert abs(float(material.direction("a").detach() @ expected)) < 1e-6


def test_the_angles_of_a_direction_have_a_slope_at_the_start_and_beyond(fibred):
    """Against differences in float64: at 0, in the series' range, at its end and far away; a radian turns by a radian."""
    frame = Direction.frame([1, 2, -1])
    for angles in ([0.0, 0.0], [3e-5, -2e-5], [9e-5, 5e-5], [0.4, -1.1]):
        angles = torch.tensor(angles, dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(
            lambda a: Direction.physical(frame, a), angles, eps=1e-6, atol=1e-8
        )
    jacobian = torch.autograd.functional.jacobian(
        lambda a: Direction.physical(frame, a), torch.zeros(2, dtype=torch.float64)
    )
    torch.testing.assert_close(jacobian, frame[1:].T)


def test_a_frozen_direction_is_not_learned_and_another_start_is_no_part_of_what_is_saved(fibred):
    material = Material("fibred", {**fibred, "a": [0, 0, 1]}, frozen=["a"])
    assert (
        not any(material.raw[name].requires_grad for name in ("a_1", "a_2"))
        and material.raw["k"].requires_grad
    )
    assert set(material.state_dict()) == {f"raw.{name}" for name in ("E", "nu", "k", "a_1", "a_2")}


@pytest.mark.parametrize("value", [1.0, [0, 0, 0], [1, 2], [1, None, 0], "x", [math.inf, 0, 0]])
def test_what_is_no_direction_is_refused(fibred, value):
    with pytest.raises(ConfigError, match=r"prior.parameters.a: expected \[x, y, z\], found"):
        Material("fibred", {**fibred, "a": value})


def test_a_range_is_given_once(fibred):
    register_form("k", LOG)
    with pytest.raises(ConfigError, match="parameter 'k' has a range already"):
        register_form("k", SOFTPLUS)


def test_a_viscosity_is_learned_in_its_logarithm():
    values = {"mu": 3e4, "kappa": 2e5, "yield_stress": 2e3, "viscosity": 10.0}
    material = Material("herschel_bulkley", values)
    assert float(material.raw["viscosity"].detach()) == pytest.approx(math.log(10.0))
    material.load_state_dict(Material("herschel_bulkley", values | {"viscosity": 3.0}).state_dict())
    assert float(material.physical()["viscosity"].detach()) == pytest.approx(3.0, rel=1e-5)

"""Laws fitted to stress-strain tests: closed forms, free faces, what is recovered, files, real heart muscle."""

import csv
import json
import math
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from forked import call
from matplotlib import pyplot

from mosa.config.known_numbers import known_numbers
from mosa.errors import ConfigError, DataError
from mosa.evaluation.analysis.law_stress import in_double, kirchhoff, tangent
from mosa.export.source import read_source
from mosa.material_tests.fitting import Fit, Fitting, Law
from mosa.material_tests.measurements import measurements, read_tests
from mosa.material_tests.report import (
    doubts,
    explained,
    figures,
    mean_explained,
    plot,
    reading,
    rms,
    table,
    uncertain,
    written,
)
from mosa.material_tests.run import build_law
from mosa.material_tests.specimen import Specimens
from mosa.modules.adapters.hyperelastic import HyperelasticAdapter
from mosa.modules.body.material import Material
from mosa.physics.constitutive.laws import law_named, register_law
from mosa.twin.twin import Twin

E, NU = 3e4, 0.4
MU = E / 2 / (1 + NU)


def rows(mode, first, second=None, **more):
    seconds = first if second is None else np.broadcast_to(second, first.shape)
    told = mode.startswith("biaxial")
    return [
        {
            "test": mode,
            "mode": mode,
            "first": a,
            "second": b if told else None,
            "stress_1": 0.0,
            **more,
        }
        for a, b in zip(first, seconds)
    ]


def predicted(law, parameters, states, incompressible=True, adapter=None):
    data = measurements(states, "Pa", "here")
    return Specimens(data, incompressible).predict(in_double(Material(law, parameters)), adapter)


LENGTHS = np.array([0.7, 1.0, 1.1, 1.6, 2.5])


def test_incompressible_closed_forms():
    """P of the Mooney-Rivlin solid (Holzapfel 2000, section 6.5), to rounding of Newton's method."""
    s = 0.3
    c1, c2 = MU * (1 - s) / 2, MU * s / 2
    values = {"E": E, "nu": NU, "second_share": s}
    l = LENGTHS
    uniaxial = 2 * (l - l**-2) * (c1 + c2 / l)
    planar = 2 * (l - l**-3) * (c1 + c2)
    equibiaxial = 2 * (l - l**-5) * (c1 + c2 * l**2)
    states = [
        *rows("uniaxial y", l),
        *rows("biaxial xz", l, 1.0),
        *rows("biaxial zy", l),
        *rows("shear zx", l, 0.0),
    ]
    found = predicted("mooney_rivlin", values, states)
    expected = np.concatenate([uniaxial, planar, equibiaxial, 2 * (c1 + c2) * l])
    assert np.abs(found - expected).max() < 1e-7 * MU


def test_free_faces_of_a_compressible_specimen_carry_nothing():
    """The stretch across solves tau = 0: of neo-Hooke's law mu (t^2 - 1) + lam log(l t^2) = 0, and P = mu (l^2 - t^2)/l."""
    lam = E * NU / (1 + NU) / (1 - 2 * NU)
    found = predicted(
        "neo_hookean", {"E": E, "nu": NU}, rows("uniaxial z", LENGTHS), incompressible=False
    )
    for l, P in zip(LENGTHS, found):
        square = l**2 - P * l / MU
        assert abs(MU * (square - 1) + lam * np.log(l * square)) < 1e-8 * MU
    small = predicted(
        "neo_hookean",
        {"E": E, "nu": NU},
        rows("uniaxial z", np.array([1 + 1e-6])),
        incompressible=False,
    )
    assert small[0] == pytest.approx(1e-6 * E, rel=1e-4)
    # compressed far: corotated's stress across, 2 mu (t^2 - t) + lam (J - 1) J, has its least at t = 1, and its 0 at 1.56
    nu, l = 0.45, 0.3
    mu, lam = E / 2 / (1 + nu), E * nu / (1 + nu) / (1 - 2 * nu)
    states = rows("uniaxial x", np.array([0.9, l]))
    P = predicted("corotated", {"E": E, "nu": nu}, states, incompressible=False)[1]
    volumetric = P * l - 2 * mu * (l**2 - l)
    J = l * (0.5 + math.sqrt(0.25 - volumetric / 2 / mu)) ** 2
    assert lam * (J - 1) * J == pytest.approx(volumetric, rel=1e-8) and J > 0.7


def test_a_test_of_a_single_state_is_fitted():
    law = Law(Material("neo_hookean", {"E": E, "nu": 0.4}), None, "full")
    states = [dict(row, stress_1=1e3) for row in rows("uniaxial x", [1.1])]
    data = measurements(states, "Pa", "here")
    fit = Fitting(law, data, False, starts=1, seed=0).fit()
    assert fit.predicted == pytest.approx([1e3], rel=1e-3) and np.isfinite(fit.covariance).all()
    page = table(law, data, fit, {}, "Pa").splitlines()
    assert page[-1].startswith("| uniaxial x | 1 | ") and page[-1].endswith(" |  |  |")
    assert "- R2: none: no test has stresses that vary" in page


def test_as_many_stresses_as_numbers_say_nothing_of_their_noise():
    """A law that meets every stress would else be certain: two moduli of a data sheet, and one stress with its deviation."""
    one, two = ([1.1], [1e3]), ([1.1, 1.5], [1e3, 4e3])
    for (l, P), sd, expected in ((one, 200.0, 0.2), (one, None, 0.05), (two, 100.0, 0.03)):
        law = Law(Material("neo_hookean", {"E": E, "nu": 0.4}, ["nu"] * (len(l) < 2)), None, "full")
        told = {} if sd is None else {"sd_1": sd}
        states = [dict(row, stress_1=v, **told) for row, v in zip(rows("uniaxial x", l), P)]
        data = measurements(states, "Pa", "here")
        fit = Fitting(law, data, len(l) < 2, starts=1, seed=0).fit()
        assert fit.covariance[0, 0] ** 0.5 > 0.99 * expected
        found = figures(data, fit, {})
        assert found.get("noise_of_sd", found.get("noise")) == fit.noise
        assert ("noise" in found) == (sd is None)


def test_a_specimen_at_an_angle_is_a_material_that_is_turned():
    fibre = {"E": E, "nu": NU, "fibre_stiffness": 1e4, "fibre_exponent": 1.0, "dispersion": 0.1}
    states = rows("biaxial xy", LENGTHS[1:4], 1.1, angle=30.0)
    with pytest.warns(UserWarning, match="angle: expected degrees, found 0.7854, which is 45"):
        predicted("hgo", {**fibre, "fibre": [1, 0, 0]}, [dict(states[0], angle=0.7854)])
    turned = [np.cos(np.pi / 6), np.sin(np.pi / 6), 0.0]
    cut = predicted("hgo", {**fibre, "fibre": turned}, states)
    along = predicted("hgo", {**fibre, "fibre": [1, 0, 0]}, rows("biaxial xy", LENGTHS[1:4], 1.1))
    assert np.abs(cut - along).max() < 1e-8 * np.abs(along).max()


def test_the_tangent_is_the_derivative_of_the_stress():
    g = torch.Generator().manual_seed(0)
    F = torch.eye(3).double() + 0.1 * torch.randn(5, 3, 3, generator=g, dtype=torch.float64)
    D, h = torch.randn(5, 3, 3, generator=g, dtype=torch.float64), 1e-5
    material, adapter = (
        Material("neo_hookean", {"E": E, "nu": NU}).double(),
        HyperelasticAdapter().double(),
    )
    torch.nn.init.constant_(adapter.numbers, 0.1)
    adapter.switch_on(E, NU)
    expected = (
        kirchhoff(material, adapter, F + h * D) - kirchhoff(material, adapter, F - h * D)
    ) / (2 * h)
    found = torch.einsum("nijkl,nkl->nij", tangent(material, adapter, F), D)
    assert (found - expected).abs().max() < 1e-8 * expected.abs().max()


def test_numbers_are_recovered_with_their_uncertainty():
    """Yeoh's law with noise of 200 Pa: within three standard deviations, and the noise within its own 20 %."""
    truth = {"E": E, "nu": 0.49, "yeoh_2": 0.08, "yeoh_3": 0.01}
    l = np.linspace(1.02, 2.2, 20)
    states = [*rows("uniaxial x", l), *rows("biaxial xy", l), *rows("shear xy", l, 0.0)]
    noise = 200 * np.random.default_rng(1).standard_normal(len(states))
    for state, P in zip(states, predicted("yeoh", truth, states) + noise):
        state["stress_1"] = P
    start = Material("yeoh", {"E": 1e5, "nu": 0.49, "yeoh_2": 0.5, "yeoh_3": 0.1}, ["nu"])
    fitting = Fitting(
        Law(start, None, "full"), measurements(states, "Pa", "here"), True, starts=2, seed=0
    )
    fit = fitting.fit()
    assert fit.noise == pytest.approx(200, rel=0.2)
    known = Material("yeoh", truth).begins
    for name, value, sd in zip(fit.names, fit.theta, np.sqrt(np.diag(fit.covariance))):
        assert abs(value - known[name]) < 3 * sd < 3
    left = fitting.left_out()
    assert set(left) == {"uniaxial x", "biaxial xy", "shear xy"}
    assert rms(left["shear xy"] - fitting.data.value[~fitting.data.without(2)]) < 2 * 200


def test_a_test_that_is_left_out_says_nothing():
    """Nor that the law has no finite stress there: exp(60 e^2) at twice the length, which tests to 1.15 do not know."""
    law = {"E": 2e4, "nu": 0.45, "fibre_stiffness": 5e3, "fibre_exponent": 60.0, "dispersion": 0.0, "fibre": [1, 0, 0]}  # fmt: skip
    states = [*rows("uniaxial x", np.linspace(1.02, 1.15, 6)), *rows("shear xy", np.array([0.2, 0.4]), 0.0)]  # fmt: skip
    for state, P in zip(states, predicted("hgo", law, states)):
        state["stress_1"] = P
    states += [dict(r, stress_1=1e5) for r in rows("biaxial xy", np.array([2.0, 2.2]))]
    start = Law(Material("hgo", law, ["nu", "fibre", "fibre_stiffness"]), None, "full")
    fitting = Fitting(start, measurements(states, "Pa", "here"), True, starts=1, seed=0)
    left = fitting.left_out()
    assert np.isnan(left["biaxial xy"]).all() and set(left) == set(fitting.data.names)
    fit = fitting.among(fitting.data.without(2)).fit(whole=False)
    assert fit.predicted == pytest.approx(fitting.data.value[:8], rel=1e-3)


def test_two_halves_of_the_tests_say_what_all_of_them_say(tmp_path):
    """Through material.json, each half with its own noise; the numbers are correlated. A film's fit
    takes the same file, by the names that it gives its numbers."""
    truth = {"E": E, "nu": 0.49, "yeoh_2": 0.08, "yeoh_3": 0.01}
    l = np.linspace(1.02, 2.2, 40)
    states = [*rows("uniaxial x", l), *rows("shear xy", l - 1, 0.0)]
    noise = 200 * np.random.default_rng(1).standard_normal(len(states))
    for state, P in zip(states, predicted("yeoh", truth, states) + noise):
        state["stress_1"], state["sd_1"] = P, 200.0

    def fitted(some, known=None):
        start = Material("yeoh", {"E": 1e5, "nu": 0.49, "yeoh_2": 0.5, "yeoh_3": 0.1}, ["nu"])
        law = Law(start, None, "full")
        fitting = Fitting(law, measurements(some, "Pa", "here"), True, starts=1, seed=0, known=known)  # fmt: skip
        return fitting.law.set((fit := fitting.fit()).theta), fit

    law, first = fitted(states[::2])
    path = tmp_path / "material.json"
    path.write_text(json.dumps(written(law, first)))
    known = known_numbers(str(path), law.material, None, "known")
    (_, second), (_, whole) = fitted(states[1::2], known), fitted(states)
    sd = np.sqrt(np.diag(whole.covariance))
    assert (np.sqrt(np.diag(first.covariance)) > 1.2 * sd).all()
    assert (np.abs(second.theta - whole.theta) < 0.15 * sd).all()
    assert np.abs(second.covariance / np.outer(sd, sd) - whole.covariance / np.outer(sd, sd)).max() < 0.15  # fmt: skip
    only = known_numbers(str(path), Material("yeoh", truth, ["yeoh_2", "yeoh_3"]), None, "known")
    assert only.names == ["E"] and float(only.covariance) == pytest.approx(first.covariance[0, 0])
    with pytest.raises(ConfigError, match="expected numbers of neo_hookean that are learned"):
        known_numbers(str(path), Material("neo_hookean", {"E": E, "nu": 0.4}), None, "known")
    whole = json.loads(path.read_text())
    for text in ("{}", "[" * 100_000, json.dumps(whole | {"posterior": [1]})):
        path.write_text(text)
        with pytest.raises(DataError, match=r"known: .*material\.json: expected a material\.json"):
            known_numbers(str(path), law.material, None, "known")


def test_what_another_experiment_said_holds_for_its_start_and_its_frozen_numbers(tmp_path):
    """The angles of a fibre count from where it began: read from another start they would be another direction."""
    fibre = {"E": E, "nu": 0.45, "fibre_stiffness": 1e4, "fibre_exponent": 1.0, "dispersion": 0.0}

    def law(start, frozen, **other):
        return Law(Material("hgo", fibre | {"fibre": start} | other, frozen), None, "full")

    first = law([1, 0.2, 0], ["nu", "dispersion"])
    theta = np.array([*first.get()[:3], 0.2, 0.0])
    fit = Fit(first.names, theta, np.diag(np.full(5, 1e-4)), 1.0, 1.0, 5.0, np.zeros(1))
    path = tmp_path / "material.json"
    path.write_text(json.dumps(written(first.set(theta), fit)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        known = known_numbers(str(path), law([1, 0.2, 0], ["nu"]).material, None, "known")
    assert known.mean.numpy() == pytest.approx(theta)
    for start in ([1, 0, 0], [-1, -0.2, 0]):
        with pytest.raises(ConfigError, match=r"count from prior.parameters.fibre = \[0.9806, 0.1961, 0\]"):  # fmt: skip
            known_numbers(str(path), law(start, ["nu"]).material, None, "known")
    for other, found in ((law([1, 0.2, 0], []), "it is learned"), (law([1, 0.2, 0], ["nu"], nu=0.3), "it is 0.3")):  # fmt: skip
        with pytest.warns(UserWarning, match=f"its numbers hold for nu = 0.45, and here {found}"):
            known_numbers(str(path), other.material, None, "known")


def pulled(lengths, stresses, law="neo_hookean", **more):
    states = [dict(r, stress_1=P) for r, P in zip(rows("uniaxial x", lengths), stresses)]
    start = Material(law, {"E": 3e4, "nu": 0.45, **more}, ["nu"])
    data = measurements(states, "MPa", "here")
    fitting = Fitting(Law(start, None, "full"), data, True, starts=1, seed=0)
    fit = fitting.fit()
    law = fitting.law.set(fit.theta)
    return uncertain(law, fit), "; ".join(doubts(law, data, fit, "MPa")), fit


def test_the_tests_tell_nominal_from_true_stress():
    """Neo-Hooke's uniaxial and equibiaxial curves with noise of 1 %: P = mu (l - l^-2), mu (l - l^-5),
    and l P is the true stress. At a stretch of 1.02 both are the same, in shear as well."""
    l = np.linspace(1.1, 2.5, 6)
    states = [*rows("uniaxial x", l), *rows("biaxial xy", l)]
    noise = 1 + 0.01 * np.random.default_rng(0).standard_normal(2 * len(l))
    P = MU * np.concatenate([l - l**-2, l - l**-5]) * noise
    law = Law(Material("neo_hookean", {"E": 1e5, "nu": NU}, ["nu"]), None, "full")
    read = {}
    for true in (False, True):
        given = measurements([dict(r, stress_1=v * a) for r, v, a in zip(states, P, np.tile(l, 2))], "Pa", "here")  # fmt: skip
        fitting = Fitting(law, given, True, starts=1, seed=0, true=true)
        fit = fitting.fit()
        read[true] = replace(fit, other=fitting.other_reading())
        said = "; ".join(doubts(law.set(fit.theta), given, read[true], "Pa"))
        assert ("stress: read as" in said) == (not true)
    assert read[False].other < 0.3 and "with stress=cauchy this law ends 0." in reading(read[False])
    assert read[True].other > 3 and "look up" not in reading(read[True])
    assert np.exp(read[True].theta) == pytest.approx(2 * (1 + NU) * MU, rel=0.02)
    assert "look up" in reading(replace(fit, other=1.1))
    for same in (rows("uniaxial x", LENGTHS[1:2] + 0.01), rows("shear xy", LENGTHS, 0.0)):
        data = measurements([dict(r, stress_1=1.0) for r in same], "Pa", "here")
        assert Fitting(law, data, True, starts=1, seed=0).other_reading() is None


def test_true_stress_of_a_compressible_specimen():
    """tau/J beside P: on a free face's specimen J = l t^2, with the stretch across t."""
    states = rows("uniaxial z", LENGTHS)
    data = measurements(states, "Pa", "here")
    material = in_double(Material("neo_hookean", {"E": E, "nu": 0.3}))
    P, sigma = (Specimens(data, False, true).predict(material, None) for true in (False, True))
    mu = E / 2.6
    across = LENGTHS**2 - P * LENGTHS / mu  # t^2, from P = mu (l^2 - t^2)/l
    assert sigma * across == pytest.approx(P, rel=1e-8, abs=1e-8 * mu)


def test_a_start_far_from_the_law_is_left():
    """Where the start has no finite stress at all: exp(3e3 (l^2 - 1)^2)."""
    l = np.linspace(1.02, 1.5, 8)
    truth = {"E": E, "nu": 0.45, "fibre_stiffness": 1e4, "fibre_exponent": 0.8, "dispersion": 0.0, "fibre": [1, 0, 0]}  # fmt: skip
    P = predicted("hgo", truth, rows("uniaxial x", l))
    start = Material("hgo", truth | {"fibre_exponent": 3e3}, ["nu", "fibre"])
    data = measurements([dict(r, stress_1=v) for r, v in zip(rows("uniaxial x", l), P)], "Pa", "here")  # fmt: skip
    fit = Fitting(Law(start, None, "full"), data, True, starts=1, seed=0).fit()
    assert fit.predicted == pytest.approx(P, rel=1e-3)


def test_without_evidence_the_stiffness_is_fitted_by_least_squares_alone():
    """Tests of an isotropic law with noise: without a prior the stiffness takes up more of the noise, and strays farther."""
    states = [row for axis in "xyz" for row in rows(f"uniaxial {axis}", np.linspace(1.05, 1.3, 5))]
    noise = 500 * np.random.default_rng(2).standard_normal(len(states))
    for state, P in zip(states, predicted("neo_hookean", {"E": E, "nu": 0.49}, states) + noise):
        state["stress_1"] = P
    data, fits = measurements(states, "Pa", "here"), {}
    for evidence in (True, False):
        adapter = HyperelasticAdapter()
        adapter.switch_on(E, 0.49)
        law = Law(Material("neo_hookean", {"E": E, "nu": 0.49}), adapter, "orthotropic")
        fits[evidence] = Fitting(law, data, True, starts=1, seed=0, evidence=evidence).fit()
    off = {key: rms(fit.predicted - data.value) for key, fit in fits.items()}
    size = {key: np.abs(fit.theta[-7:]).max() for key, fit in fits.items()}
    assert off[False] < 0.99 * off[True] and size[True] < 0.3 * size[False]


def test_slips_in_a_file_are_warned_of():
    l = np.linspace(1.1, 4.0, 12)
    P = 0.4 * (l - l**-2)
    numbers, right, _ = pulled(l, P)
    assert "R2" not in right and "strain" not in right
    assert [n for n, *_ in numbers] == ["mu", "3 mu (E at nu = 1/2)", "E (at the given nu = 0.45)"]
    assert [v for _, v, *_ in numbers] == pytest.approx([4e5, 1.2e6, 4e5 * 2 * 1.45], rel=1e-6)
    for slip in (l**4, l * (l - l**-2), l + 1 - (l + 1) ** -2):  # the last two: true stress, strain
        assert "another stress than nominal" in pulled(l, 0.4 * slip)[1]
    for scale, said in ((2e-6, "softer than most gels"), (4e5, "stiffer than plastics")):
        found = pulled(l, scale * (l - l**-2))[1]
        assert said in found and "in MPa, not in Pa or kPa" in found and "unit" not in right
    assert "in per cent" in pulled(10 * l, P)[1] and "per cent" not in right
    l = np.linspace(0.8, 4.0, 12)  # strains, the first below 1
    with pytest.warns(UserWarning, match="1 of the stresses pull at a stretch below 1"):
        pulled(l, 0.4 * (1 + l - (1 + l) ** -2))


def test_a_stress_at_rest_is_warned_of():
    """A preload, an offset of the load cell, or strains of 1 to 8 per cent, which a law follows with an R2 of 0.98 and a
    stiffness 33 times too small."""
    l = np.linspace(1.0, 1.4, 5)
    P = 1e4 * (l - l**-2)
    for mode, first, stress, found in (
        ("uniaxial x", l, P, ""), ("uniaxial x", l, P + 1e3, "up to 1000 there"), ("shear xy", l - 1, P + 1e3, "a shear of 0"),
        ("uniaxial x", np.arange(1, 9), 1e3 * np.arange(1, 9), "strains in per cent"),
        ("biaxial xy", l, P + 1e3, "a preload"),
    ):  # fmt: skip
        states = [dict(r, stress_1=P) for r, P in zip(rows(mode, first, first), stress)]
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            measurements(states, "Pa", "here")
        assert found in str(said[0].message) if found else not said


def test_an_error_that_all_residuals_share_is_no_scatter():
    """Uniaxial and equibiaxial curves with noise of 1 % from a stretch of 1.1 on, sound; with an offset of the load cell of 10 % of
    the largest stress; with slack of 5 % of the length; true stress up to 1.4. The spoiled ones have an R2 above 0.95."""
    l = np.linspace(1.1, 2.4, 12)
    noise = 1 + 0.01 * np.random.default_rng(3).standard_normal((2, len(l)))

    def fitted(l, read, spoil):
        states = [*rows("uniaxial x", read), *rows("biaxial xy", read)]
        P = MU * spoil(l, np.stack([l - l**-2, l - l**-5]) * noise).ravel()
        data = measurements([dict(r, stress_1=v) for r, v in zip(states, P)], "Pa", "here")
        law = Law(Material("neo_hookean", {"E": 1e5, "nu": NU}, ["nu"]), None, "full")
        fitting = Fitting(law, data, True, starts=1, seed=0)
        fit = replace(fitting.fit(), other=fitting.other_reading())
        said = "; ".join(doubts(law.set(fit.theta), data, fit, "Pa"))
        assert "R2" not in said
        return fit, float(np.sqrt(fit.covariance[0, 0])), said

    _, sound, said = fitted(l, l, lambda _, P: P)
    assert not said.startswith("tests:") and "stress: read as" not in said
    for read, spoil in ((l, lambda _, P: P + 0.1 * P.max()), (l + 0.05, lambda _, P: P)):
        fit, sd, said = fitted(l, read, spoil)
        assert "an offset, a preload, slack" in said and "do not contain" in said
        # the residuals of a curve are not independent: its scatter alone would give half of this, and less
        alone = fit.noise / np.sqrt((fit.predicted**2).sum())
        assert sd > 2 * alone and sd > 5 * sound
    l = np.linspace(1.03, 1.4, 12)
    assert "with stress=cauchy" in fitted(l, l, lambda l, P: l * P)[2]
    assert "with stress=cauchy" not in fitted(l, l, lambda l, P: P)[2]


def test_a_law_of_shear_and_bulk_modulus_is_looked_at_like_others():
    """It has no E: the report asked for one, behind the fit."""
    register_law("of_mu_and_kappa", law_named("stvk").stress, ("mu", "kappa"))
    law = Law(Material("of_mu_and_kappa", {"mu": 1e4, "kappa": 1e5}), None, "full")
    l = LENGTHS[2:]
    states = [dict(r, stress_1=P) for r, P in zip(rows("uniaxial x", l), 3e4 * np.log(l) / l)]
    data = measurements(states, "Pa", "here")
    fit = Fitting(law, data, True, starts=1, seed=0).fit()
    said = "; ".join(doubts(law.set(fit.theta), data, fit, "Pa"))
    assert "unit" not in said and math.exp(fit.theta[0]) == pytest.approx(1e4, rel=1e-3)


def test_the_numbers_that_are_determined_are_those_of_the_table():
    l = np.linspace(1.1, 4.0, 12)
    numbers, _, fit = pulled(l, 0.4 * (l - l**-2), "mooney_rivlin", second_share=0.1)
    assert numbers[-1][0] == "second_share" and numbers[-1][2] == "not determined (at its bound)"
    assert fit.effective == pytest.approx(1) and len(fit.names) == 2
    fibre = {"E": E, "nu": 0.45, "fibre_stiffness": 1e4, "fibre_exponent": 1.0, "dispersion": 0.0, "fibre": [1, 0, 0]}  # fmt: skip
    law = Law(Material("hgo", fibre, ["nu"]), None, "full")
    fit = Fit(law.names, law.get(), np.diag([0.1, 0.1, 2.9, 0.1, 2.9]) ** 2, 1, 1, 5, np.zeros(1))
    told = {name: sd for name, _, sd, _ in uncertain(law, fit)}
    assert told["fibre_1"] == pytest.approx(0.1) and told["fibre_exponent"] == pytest.approx(2.9)
    assert told["fibre_2"] == "not determined"  # 166 degrees are any direction
    fit = replace(fit, covariance=16 * np.eye(5), simulated=np.zeros(1))
    told = {name: sd for name, _, sd, _ in uncertain(law, fit)}
    assert told["mu"] == told["3 mu (E at nu = 1/2)"] == "not determined"


def test_an_export_of_an_incompressible_fit_says_how_far_it_is(tmp_path):
    l = np.linspace(1.1, 4.0, 12)
    _, found, fit = pulled(l, 0.4 * (l - l**-2))
    assert "nu = 0.45 (at most 0.49), and an rms in the tests of" in found
    start = in_double(Material("neo_hookean", {"E": 4e5 * 2.9, "nu": 0.45}))
    free = predicted("neo_hookean", start.begins | {"E": 4e5 * 2.9, "nu": 0.45}, rows("uniaxial x", l), False)  # fmt: skip
    assert fit.simulated == pytest.approx(free, rel=1e-5)
    path = tmp_path / "material.json"
    path.write_text(json.dumps(written(Law(start, None, "full"), fit, found)))
    with pytest.warns(UserWarning, match="material.json: fitted as incompressible"):
        read_source(path)


HEADER = "test,mode,first,second,stress_1,stress_2,sd_1\n"


@pytest.mark.parametrize(
    "text, match",
    [
        ("test,mode,first\n", "stress_1"),
        (HEADER.replace("sd_1", "colour"), "unknown column 'colour'"),
        (HEADER.replace(",", ";") + "a;uniaxial x;1,1;;1,2;;\n", "separate columns by commas"),
        (HEADER, "rows below the header"),
        (HEADER + "a,bending x,1,,1,,\n", "row 1: mode: expected uniaxial x"),
        (HEADER + "a,biaxial xx,1,1,1,,\n", "found 'biaxial xx'"),
        (HEADER + "a,uniaxial x,one,,1,,\n", "first: expected a number, found 'one'"),
        (HEADER + "a,uniaxial x,nan,,1,,\n", "first: expected a number, found 'nan'"),
        (HEADER + "a,uniaxial x,-1,,1,,\n", "positive stretches"),
        (HEADER + "a,biaxial xy,1.1,,1,,\n", "positive stretches"),
        (HEADER + "a,uniaxial x,1,,,,\n", "stress_1: expected a number, found none"),
        (HEADER + "a,shear xy,1,,1,2,\n", "stress_2: expected an empty cell"),
        (HEADER + "a,uniaxial x,1.2,1,1,,\n", "second: expected an empty cell .* strip .* biaxial"),
        (
            HEADER + "a,shear xy,0.2,1.2,1,,\n",
            "second: expected an empty cell in a shear test, found '1.2'$",
        ),
        (HEADER + ",uniaxial x,1.2,,1,,\n", "test: expected a name"),
        (HEADER.strip() + ",angle,angle\na,uniaxial x,1.2,,1,,,0,90\n", "two columns 'angle'"),
        (HEADER + "a,uniaxial x,1.1,,1e300,,\n", "stress_1: expected a number, found '1e300'"),
        (HEADER + "a,uniaxial x,1.1,,0,,\n", "expected stresses, found 0"),
        (HEADER + "a,uniaxial x,1.1,,1,,1e-300\n", "sd_1, sd_2: expected a positive number"),
        (HEADER + "a,uniaxial x,1,1,,1,,,5\n", "found 9 cells below 7 names in row 1"),
        (HEADER.replace("second", "first") + "a,uniaxial x,1,,1,,\n", "expected the columns"),
        (HEADER + "a,uniaxial x,0.1,,1,,\na,uniaxial x,0.2,,2,,\n", "found 2 of 2 .*strains"),
        (HEADER + "a,biaxial xy,1.2,1,-2,-1,\na,biaxial xy,0.8,1,2,1,\n", "found 2 of 2 .*sign"),
        (HEADER + "a,uniaxial x,1,,1,,0.1\nb,uniaxial x,1,,1,,\n", "beside every stress"),
    ],
)
def test_a_mistake_in_the_file_is_named(tmp_path, text, match):
    path = tmp_path / "tests.csv"
    path.write_text(text)
    with pytest.raises(DataError, match=match):
        read_tests(path, "Pa")


def test_a_biaxial_test_that_holds_its_second_stretch_below_1_may_push_or_pull_there():
    """Its sides would be narrower by themselves where it is pulled far, and wider where it is not: no sign is wrong."""
    l = np.linspace(1.05, 2.0, 8)
    states = rows("biaxial xy", l, 0.8)
    own = predicted("neo_hookean", {"E": E, "nu": 0.45}, [dict(r, stress_2=0.0) for r in states])
    both = [dict(r, stress_1=a, stress_2=b) for r, a, b in zip(states, own[::2], own[1::2])]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        measurements(both, "Pa", "here")
    with pytest.raises(DataError, match="the other sign of stresses"):
        measurements([dict(r, stress_1=-1.0) for r in rows("biaxial xy", l)], "Pa", "here")


def test_a_table_as_spreadsheets_write_it_is_read(tmp_path):
    """Spaces and nothing behind commas, empty rows, a remark above; R2 of one state is no number, without a word of numpy's."""
    path = tmp_path / "tests.csv"
    path.write_text(
        "# of Monday\ntest, mode, first, stress_1,\na, uniaxial x, 1.2, 3.0,,\n,,,\n\na\n"
    )
    with pytest.raises(DataError, match="row 2: mode: expected"):
        read_tests(path, "kPa")
    path.write_text(path.read_text()[:-2])
    data = read_tests(path, "kPa")
    named = tmp_path / "named.csv"
    named.write_text(path.read_text().replace("a, uniaxial", "#1, uniaxial"))
    assert read_tests(named, "kPa").names == ("#1",)
    assert data.value.tolist() == [3000.0] and data.kind.tolist() == ["uniaxial"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert math.isnan(mean_explained(data, data.value))


def test_the_legend_names_what_any_panel_shows_and_covers_none(tmp_path, monkeypatch):
    """It was in the last panel, over its points: of a last test of one stress, nothing named the second one of the others."""
    biaxial = [
        dict(r, stress_1=1.0, stress_2=2.0) for r in rows("biaxial xy", np.array([1.1, 1.2]))
    ]
    uniaxial = [dict(r, test="b", stress_1=1.0) for r in rows("uniaxial x", np.array([1.1, 1.2]))]
    data = measurements([dict(r, test="a") for r in biaxial] + uniaxial, "Pa", "here")
    monkeypatch.setattr(pyplot, "close", lambda figure: None)
    plot(tmp_path / "tests.png", data, SimpleNamespace(predicted=data.value, true=False), {}, "Pa")
    figure = pyplot.gcf()
    monkeypatch.undo()
    (legend,) = figure.legends
    assert {text.get_text() for text in legend.get_texts()} == {"stress_1", "stress_2", "fitted"}
    assert not any(panel.get_legend() for panel in figure.axes)
    pyplot.close(figure)


def test_of_one_test_the_row_and_the_whole_have_the_same_R2():
    """The row took the stresses of both axes as one curve, about one mean."""
    states = [dict(r, test="a", stress_1=s, stress_2=s / 3)
              for r, s in zip(rows("biaxial xy", np.array([1.1, 1.2, 1.3])), (1.0, 2.1, 2.9))]  # fmt: skip
    data = measurements(states, "Pa", "here")
    away = data.value + np.where(data.component == 0, 0.0, 0.2)
    whole, row = mean_explained(data, away), mean_explained(data, away, 0)
    assert whole == row != pytest.approx(explained(data.value, away))
    law = SimpleNamespace(adapter=None, material=SimpleNamespace(law="any"), unsure=[])
    fit = SimpleNamespace(predicted=away, names=[], effective=0, noise=1.0, simulated=None, other=None, true=False,
                          theta=np.zeros(0), covariance=np.zeros((0, 0)))  # fmt: skip
    (line,) = (
        each for each in table(law, data, fit, {}, "Pa").splitlines() if each.startswith("| a |")
    )
    assert line.split(" | ")[3] == f"{whole:.3f}"


def test_the_command_leaves_a_material_that_a_twin_reads(tmp_path):
    l = np.linspace(1.05, 1.5, 6)
    states = [*rows("uniaxial x", l), *rows("shear xy", l - 1, 0.0)]
    for state, P in zip(
        states, predicted("mooney_rivlin", {"E": E, "nu": NU, "second_share": 0.2}, states)
    ):
        state["stress_1"] = P / 1e3
    path, folder = tmp_path / "tests.csv", tmp_path / "run"
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(states[0]))
        writer.writeheader()
        writer.writerows(states)
    run = call("mosa/material_tests/__main__.py", f"tests={path}", "unit=kPa", "prior=mooney_rivlin", "starts=1",
               f"hydra.run.dir={folder}")  # fmt: skip
    assert run.returncode == 0, run.stdout + run.stderr
    found = json.loads((folder / "metrics.json").read_text())
    assert (
        found["rms"] < 1.0 and "left_out" in found and (folder / "tests.png").stat().st_size > 5000
    )
    kept = json.loads((folder / "material.json").read_text())["parameters"]
    assert kept["E"] * (1 + NU) / (1 + kept["nu"]) == pytest.approx(
        E, rel=1e-3
    )  # mu is what they tell
    with pytest.warns(UserWarning, match="specimen.ckpt: fitted as incompressible"):
        twin = Twin.load(folder / "checkpoints" / "specimen.ckpt")
    assert float(twin.body.material.physical()["E"]) == pytest.approx(kept["E"], rel=1e-5)


def test_what_cannot_be_fitted_is_said():
    words = ("tests=none.csv", "unit=Pa", "prior=von_mises", "symmetry=orthotropic")
    run = call("mosa/material_tests/__main__.py", *words)
    assert run.returncode != 0 and "none.csv" in run.stdout + run.stderr
    assert "symmetry: has no effect in this run" in run.stdout + run.stderr


def test_a_refused_adapter_is_not_called_by_its_internal_name():
    """adapter=mosa and adapter=linear are both `stress` inside."""
    prior = {"law": "neo_hookean", "parameters": {"E": E, "nu": NU}}
    with pytest.raises(ConfigError, match=r"^adapter: expected operator or none") as refused:
        build_law({"prior": prior, "adapter": {"name": "stress"}})
    assert "stress" not in str(refused.value)


def test_heart_muscle(reference_data):
    """Ten numbers: fibres along x and an orthotropic stiffness, at most 0.42 kPa on all 176 stresses of 16 curves."""
    path = reference_data / "real" / "tissue" / "myocardium_CANNsHEARTdata_shear05.xlsx"
    if not path.is_file():
        pytest.skip(f"no measurements at {path}")
    pytest.importorskip("openpyxl")
    import runpy

    heart = runpy.run_path("benchmarks/tissue_tests.py")["heart"]
    data = measurements(heart(), "kPa", "heart")
    values = {
        "E": 2.5e3,
        "nu": 0.49,
        "fibre_stiffness": 5e3,
        "fibre_exponent": 30.0,
        "dispersion": 0.0,
        "fibre": [1, 0, 0],
    }
    adapter = HyperelasticAdapter()
    adapter.switch_on(2.5e3, 0.49)
    law = Law(Material("hgo", values, ["fibre"]), adapter, "orthotropic")
    fit = Fitting(law, data, True, starts=1, seed=0).fit()
    found = figures(data, fit, {})
    assert len(data.value) == 176 and len(fit.names) == 10
    assert found["rms"] < 420 and found["rms_curves"] < 420 and found["R2"] > 0.86

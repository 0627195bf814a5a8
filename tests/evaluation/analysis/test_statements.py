"""Sentences at the end of a run: what they name, with which unit, and when they are there."""

import pytest

from mosa.evaluation.analysis.statements import determined_text, worse_text


@pytest.mark.parametrize(("law", "figures", "said"), [
    ("newtonian", {"id/mu": 224.5, "posterior/mu_relative_sd": 0.1}, "- mu = 224.5 Pa s, with a standard deviation of 10.0%."),
    ("herschel_bulkley", {"id/mu": 1e4, "posterior/mu_relative_sd": 0.1}, "- mu = 1e+04 Pa, with a standard deviation of 10.0%."),
    ("herschel_bulkley", {"id/viscosity": 10.0, "posterior/viscosity_relative_sd": 0.5},
     "- viscosity = 10 Pa s, with a standard deviation of 50.0%."),
    ("neo_hookean~damped", {"id/damping": 38.75, "posterior/damping_relative_sd": 3.863},
     "- damping is *not* determined (38.75 Pa s, with a standard deviation of 3.9 in its natural logarithm)."),
    ("drucker_prager", {"id/friction_angle": 39.2, "posterior/friction_angle_sd": 4.8},
     "- friction angle = 39.2 degrees, with a standard deviation of 4.8."),
    ("drucker_prager", {"id/friction_angle": 39.2, "posterior/friction_angle_sd": 21.0},
     "- friction angle is *not* determined (39.2 degrees, with a standard deviation of 21)."),
    ("stvk", {"id/nu": 0.48, "posterior/nu_sd": 0.144}, "- nu is *not* determined (0.480 with a standard deviation of 0.144)."),
    ("stvk", {"id/nu": 0.318, "posterior/nu_sd": 0.047}, "- nu = 0.318 with a standard deviation of 0.047."),
    ("stvk", {"id/E": 1.668e5, "posterior/E_relative_sd": 0.91},
     "- E = 1.668e+05 Pa, with a standard deviation of 0.91 in its natural logarithm: known to a factor of 2.5."),
    ("corotated", {"posterior/test/sd_m": 8e-3, "posterior/test/coverage": 0.44},
     "- Held-out positions after contact have a predicted standard deviation (not an error) of 8.0 mm (rms); 44% of the errors lie "
     "within two such deviations, where 95% should."),
])  # fmt: skip
def test_what_is_determined_has_its_unit(law, figures, said):
    assert said in determined_text(figures | {"posterior/draws": 12}, law).splitlines()


@pytest.mark.parametrize(("off", "said"), [(0.634, True), (0.019, False)])
def test_a_force_that_is_not_met_stands_before_the_numbers(off, said):
    """A load cell's curve with the wrong sign gave a tenth of E, "with a standard deviation of 17%"."""
    figures = {"forces/upper/rms_share": off, "forces/upper/allowed_share": 0.011, "id/E": 2.9e4,
               "posterior/E_relative_sd": 0.17, "posterior/draws": 12}  # fmt: skip
    first = determined_text(figures, "neo_hookean").splitlines()[2]
    assert first.startswith("- The force on upper is **not met**: off by 63%") == said
    assert first.startswith("- E = ") != said


@pytest.mark.parametrize(("own", "prior", "said"), [
    ({"rms_m": 0.0123}, {"rms_m": 0.00987}, "(rms [mm]: 12.30 against 9.87)"),
    ({"rms_m": 0.00987}, {"rms_m": 0.00987}, ""), ({"rms_m": 0.005, "psnr_crop": 24.0}, {"rms_m": 0.009, "psnr_crop": 24.0}, ""),
    ({"psnr_crop": 24.5}, {"psnr_crop": 26.0}, "(PSNR crop: 24.50 against 26.00)"), ({"rms_m": 0.01}, {}, ""),
])  # fmt: skip
def test_a_law_that_predicts_worse_than_its_prior_is_said_first(own, prior, said):
    figures = {f"test/{name}": value for name, value in own.items()}
    figures |= {f"prior/test/{name}": value for name, value in prior.items()}
    text = worse_text(figures)
    assert said in text and bool(text) == bool(said)


@pytest.mark.parametrize(
    ("errors", "weight", "said"),
    [((5e-3, 4.5e-3), 1, True), ((5e-3, 3e-3), 1, False), ((5e-3, 4.5e-3), 0, False)],
)
def test_cues_that_the_isotropic_law_did_not_use_are_said(errors, weight, said):
    figures = dict(zip(("held_back/isotropic_m", "held_back/operator_m"), errors))
    text = determined_text(figures | {"held_back/position_weight": float(weight)}, "corotated")
    assert text.endswith("Cues of rotation and stretch had no part in this law's numbers.") == said
    assert "losses.position" not in text


@pytest.mark.parametrize("taken, lines", [("isotropic", 0), ("operator", 2), ("stiffness", 1)])
def test_what_the_choice_of_a_law_left_out_is_not_given_as_measured(taken, lines):
    errors = {"isotropic": 5e-3, "operator": 6e-3, "stiffness": 6e-3} | {taken: 3e-3}
    found = {f"held_back/{name}_m": error for name, error in errors.items()}
    found |= {f"posterior/{name}": 0.0 for name in ("operator_determined", "stiffness_determined")}
    found |= {"posterior/draws": 12, "posterior/operator_numbers": 19, "posterior/stiffness_numbers": 50,
              "posterior/stiffest_cone_deg": 90, "id/stiffness_ratio": 1.0, "posterior/stiffness_ratio_sd": 0.0,
              **{f"id/stiffest_{n}": 0.0 for n in "xyz"}}  # fmt: skip
    text = determined_text(found, "corotated")
    assert sum(("+-" in line) + line.startswith("- Of") for line in text.splitlines()) == lines


def test_a_report_says_which_backbones_were_compared_and_why():
    errors = {"corotated": 12e-3, "stvk": 13e-3}
    found = {f"id_prior/compared/{law}_m": error for law, error in errors.items()}
    text = determined_text(found | {"id_prior/gain/stvk": 7.2}, "stvk")
    assert "Backbone: stvk." in text and "yield" not in text
    assert "corotated 12.00 mm, stvk 13.00 mm." in text and "about corotated" in text
    yields = found | {"id_prior/compared/von_mises_m": 11e-3}  # too little to be taken
    text = determined_text(yields | {"id_prior/gain/stvk": -3.0}, "corotated")
    assert "laws that yield or flow were compared" in text and "about corotated" in text
    assert "may be a solid that yields" in text
    flows = yields | {f"id_prior/compared/{name}_m": error for name, error in
                      {"newtonian": 4e-3, "von_mises": 4.9e-3, "drucker_prager": 5.1e-3}.items()}  # fmt: skip
    text = determined_text(flows, "newtonian")
    assert "the body may be a solid that yields (prior=von_mises)" in text and "sand" not in text
    assert "prior=herschel_bulkley," in text
    alone = determined_text(flows | {"id_prior/compared/newtonian_m": 3e-3}, "newtonian")
    assert "may be" not in alone and "herschel" not in alone

"""The tables and sentences that a run ends with."""

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from mosa.evaluation.analysis.tables import (
    columns_text,
    determined_text,
    parameter_table,
    worse_text,
)
from mosa.modules.body import material
from mosa.modules.body.material import LOG, register_form, taken, unit_of

PRIORS = Path(__file__).parents[3] / "conf" / "prior"


def cells_of(table):
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]


def test_both_stages_have_their_error_where_the_truth_is_known():
    figures = {"id_prior/E": 1.1e5, "id/E": 0.95e5, "id_prior/E_relative_error": 0.1, "id/E_relative_error": 0.05,
               "id_prior/E_ratio": 1.1, "id_prior/contact_offset_m": 0.01}  # fmt: skip
    rows = cells_of(parameter_table(figures, "neo_hookean"))
    assert rows[0] == ["parameter", "prior", "adapted", "error of prior", "error of adapted"]
    assert rows[2:] == [
        ["E [Pa]", "1.1e+05", "95000", "10.0%", "5.0%"],
        ["contact_offset_m", "0.01", "nan", "", ""],
    ]
    rows = cells_of(parameter_table(figures, "neo_hookean", ["contact_offset_m"]))
    assert [row[0] for row in rows[2:]] == ["E [Pa]"]
    assert parameter_table(figures, "neo_hookean", ["contact_offset_m", "E"]) == ""
    del (
        figures["id_prior/E_relative_error"],
        figures["id/E_relative_error"],
    )  # of a film without a truth
    rows = cells_of(parameter_table(figures, "neo_hookean", ["contact_offset_m"]))
    assert rows[0] == ["parameter", "prior", "adapted"] and rows[2:] == [
        ["E [Pa]", "1.1e+05", "95000"]
    ]


@pytest.mark.parametrize("file", sorted(PRIORS.glob("*.yaml")), ids=lambda file: file.stem)
def test_every_parameter_of_every_law_has_the_unit_that_its_configuration_says(file):
    """Whose comment lists the units in the order of the parameters: `# Pa s, Pa: where the fit starts`."""
    (line,) = [line for line in file.read_text().splitlines() if line.startswith("parameters:")]
    units = [unit.strip() for unit in line.partition("#")[2].split(":")[0].split(",")]
    prior = OmegaConf.load(file)
    said, named = dict(zip(prior.parameters, units, strict=True)), set()
    for law in prior.get("candidates", [prior.law]):
        names = taken(law, said)
        named.update(names)
        assert [unit_of(law, name) or "-" for name in names] == [said[name] for name in names]
        rows = cells_of(parameter_table({f"id_prior/{name}": 1.0 for name in names}, law))[2:]
        assert [row[0] for row in rows] == [
            name if said[name] == "-" else f"{name} [{said[name]}]" for name in names
        ]
    assert named == set(said)


def test_the_same_name_is_measured_as_the_law_of_a_mixture_has_it():
    assert (
        unit_of("herschel_bulkley+stvk", "mu") == "Pa"
        and unit_of("herschel_bulkley+stvk", "viscosity") == "Pa s"
    )
    assert unit_of("newtonian+herschel_bulkley", "kappa") == "Pa"


def test_a_parameter_of_another_package_has_the_unit_that_it_was_registered_with(monkeypatch):
    monkeypatch.setattr(material, "FORMS", dict(material.FORMS))
    monkeypatch.setattr(material, "UNITS", dict(material.UNITS))
    register_form("fibre_stiffness", LOG, unit="Pa")
    register_form("exponent", LOG)
    rows = cells_of(
        parameter_table({"id_prior/fibre_stiffness": 1.0, "id_prior/exponent": 1.0}, "stvk")
    )[2:]
    assert [row[0] for row in rows] == ["fibre_stiffness [Pa]", "exponent"]


@pytest.mark.parametrize(("law", "figures", "said"), [
    ("newtonian", {"id/mu": 224.5, "posterior/mu_relative_sd": 0.1}, "- mu = 224.5 Pa s, with a standard deviation of 10.0%."),
    ("herschel_bulkley", {"id/mu": 1e4, "posterior/mu_relative_sd": 0.1}, "- mu = 1e+04 Pa, with a standard deviation of 10.0%."),
    ("herschel_bulkley", {"id/viscosity": 10.0, "posterior/viscosity_relative_sd": 0.5},
     "- viscosity = 10 Pa s, with a standard deviation of 50.0%."),
    ("neo_hookean~damped", {"id/damping": 38.75, "posterior/damping_relative_sd": 3.863},
     "- damping is *not* determined (38.75 Pa s, with a standard deviation of 386.3%)."),
    ("drucker_prager", {"id/friction_angle": 39.2, "posterior/friction_angle_sd": 4.8},
     "- friction angle = 39.2 degrees, with a standard deviation of 4.8."),
    ("drucker_prager", {"id/friction_angle": 39.2, "posterior/friction_angle_sd": 21.0},
     "- friction angle is *not* determined (39.2 degrees, with a standard deviation of 21)."),
    ("stvk", {"id/nu": 0.48, "posterior/nu_sd": 0.144}, "- nu is *not* determined (0.480 with a standard deviation of 0.144)."),
    ("stvk", {"id/nu": 0.318, "posterior/nu_sd": 0.047}, "- nu = 0.318 with a standard deviation of 0.047."),
    ("stvk", {"id/E": 1.668e5, "posterior/E_relative_sd": 0.91},
     "- E = 1.668e+05 Pa, with a standard deviation of 91.0% of its logarithm: known to a factor of 2.5."),
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


def test_the_recording_that_no_column_names_is_said():
    figures = {
        f"{part}/psnr_crop": 30.0 for part in ("train", "train/drop_2", "test", "test/drop_3")
    }
    assert columns_text(figures, "drop_1") == (
        "Rows: *adapted*: the learned law. Columns: `train` is the recording drop_1, `train/...` the others that were learned "
        "from, `test/...` those held out, `test` their mean. "
        "Figures: *PSNR*, *SSIM*: likeness of pictures in a window around the body, more is better."
    )
    assert columns_text({"train/rms_m": 1.0, "floor/train/rms_m": 1.0}, "drop_1") == (
        "Rows: *floor*: the true law on the learner's grid and particles; *adapted*: the learned law. "
        "Columns: `train` is the recording drop_1. "
        "Figures: *rms*: root mean square distance of particles from their true places after contact."
    )
    held_back = {f"{part}/psnr_crop": 30.0 for part in ("train", "frames", "camera")}
    said = "Columns: `train` is the recording drop_1, `frames` its last frames, held out, `camera` its held-out cameras."
    assert said in columns_text(held_back, "drop_1")
    assert (
        columns_text({"test/a/psnr_crop": 30.0}, "a") == ""
    )  # of another scene than the one that was learned from


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

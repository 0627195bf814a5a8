"""The tables that a run ends with."""

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from mosa.evaluation.analysis.tables import columns_text, parameter_table
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

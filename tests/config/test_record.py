"""The record of a run: plain data that comes back as it was written, with decisions beside the settings, never in them."""

import pytest
import torch
from strangers import checkpoint, cube, saved

from mosa.config.build import build_body, world_of
from mosa.config.known_numbers import known_numbers
from mosa.config.record import BodyRecord, PosteriorRecord, RunRecord
from mosa.errors import ConfigError, DataError
from mosa.evaluation.uncertainty import INFLATION
from mosa.export.source import read_source
from mosa.modules.adapters.hyperelastic import HyperelasticAdapter
from mosa.modules.adapters.stress import StressAdapter
from mosa.modules.body.material import Material
from mosa.modules.fitting.identification_settings import IdentificationSettings
from mosa.modules.fitting.parameters import blocks_of, tensors_of
from mosa.types import Ground


def test_a_record_comes_back_as_it_was_written(tmp_path):
    written = saved()["mosa"]
    torch.save(written, tmp_path / "a.pt")
    found = RunRecord.read(torch.load(tmp_path / "a.pt", weights_only=True))
    assert found.plain() == written and found.body.plain() == {
        key: written[key] for key in BodyRecord.model_fields
    }


def test_what_was_decided_stands_beside_the_settings():
    given = saved("prior=auto", "world.walls={mode: separate}")["mosa"]
    record = RunRecord.read(given).body.but(law="stvk").on(Ground(0.0, "touch", 0.3))
    assert record.settings == given["settings"] and record.settings["prior"]["law"] == "auto"
    body, world = build_body(record, cube()), world_of(record)
    assert body.material.law == "stvk" and body.material.candidates == ()
    assert world.ground == Ground(0.0, "touch", 0.3) and len(world.planes) == 6
    assert build_body(RunRecord.read(given), cube()).material.candidates != ()


@pytest.mark.parametrize(("ground", "walls", "learned"), [
    (True, "null", True), (False, "null", False), (False, "{mode: separate}", True),
])  # fmt: skip
def test_a_contact_offset_is_learned_where_something_lies_still_below(ground, walls, learned):
    """Solids and driven sets keep their place from the body, whatever the offset is."""
    record = RunRecord.read(saved(f"world.walls={walls}")["mosa"]).body
    body = build_body(record if ground else record.but(ground=None), cube())
    blocks = blocks_of(body, adapter=False, heterogeneity=False, settings=IdentificationSettings())
    assert ("contact" in [block.name for block in blocks]) == learned
    assert len(tensors_of(body, adapter=False, heterogeneity=False)) == len(blocks)
    assert learned or float(body.contact.lift(None, 0.1).detach()) == 0.0


def test_a_ground_that_is_sought_is_one_that_the_body_sticks_to():
    record = RunRecord.read(saved()["mosa"]).body.on(Ground(0.0, "auto"))
    assert record.ground_is_sought and world_of(record).ground == Ground(0.0, "sticky")


@pytest.mark.parametrize(("key", "value", "message"), [
    ("more", 1, r"mosa\.more: unknown key"), ("dx", "a", r"mosa\.dx: expected a number"), ("law", "jelly", "jelly"),
    ("ground", {"height": 0.0, "mode": "glue"}, r"mosa\.ground\.mode: expected sticky or slip or separate or touch or auto"),
    ("world", {"gravity": [0, 1, 0], "up": [0, 1, 0], "box": [[-1] * 3, [1] * 3]}, "expected a pull against up"),
    ("starts", {"../x": {}}, "expected names like train"), ("version", 2, r"mosa\.version: expected 3"),
])  # fmt: skip
def test_what_is_no_record_is_named(key, value, message):
    with pytest.raises(ConfigError, match=message):
        RunRecord.read(saved()["mosa"] | {key: value})


def test_what_a_fit_said_is_read_from_its_checkpoint(tmp_path):
    """Of the numbers that another law learns too, with the standard deviations that results say."""
    names = ["E", "contact", "operator[0]"]
    covariance = torch.tensor([[0.04, 0.01, 0.0], [0.01, 0.02, 0.0], [0.0, 0.0, 1.0]]).double()
    said = {"names": names, "mean": torch.tensor([11.0, 0.3, 0.5]).double(), "covariance": covariance,
            "determined": torch.ones(3).double(), "model_error": 1e-3}  # fmt: skip
    path = checkpoint(
        tmp_path / "a.ckpt", change=lambda found: found["mosa"].update(posterior=said)
    )
    law = saved()["mosa"]["settings"]["prior"]["law"]
    found = known_numbers(str(path), Material(law, {"E": 1e5, "nu": 0.3}), None, "known")
    assert found.names == ["E"] and float(found.mean) == 11.0
    assert float(found.covariance) == pytest.approx(INFLATION**2 * 0.04)
    # its operator's numbers are those of a stiffness, and of nothing else of this name
    constant = StressAdapter(state_dependence="constant", no_pre=True, no_post=True)
    for adapter, more in ((HyperelasticAdapter(), ["operator[0]"]), (constant, [])):
        own = Material(law, {"E": 1e5, "nu": 0.3})
        assert known_numbers(str(path), own, adapter, "known").names == ["E", *more]
    for key, value, message in (
        (
            "covariance",
            covariance + torch.triu(torch.full((3, 3), 1e-3), 1),
            "a symmetric, positive definite",
        ),
        ("covariance", 1e-40 * covariance, "a symmetric, positive definite"),
        ("mean", said["mean"] + 1e3, "logarithms, numbers within 300"),
        ("names", ["E", "contact", "E"], "a list of names .*, each once"),
    ):
        with pytest.raises(ConfigError, match=f"expected {message}"):
            PosteriorRecord.read(said | {key: value})
    twice = tmp_path / "material.json"
    twice.write_text('{"law": "corotated", "stiffness": null, "stiffness": {}}')
    with pytest.raises(DataError, match=r"material\.json.*'stiffness' twice"):
        known_numbers(str(twice), Material(law, {"E": 1e5, "nu": 0.3}), None, "known")
    with pytest.raises(DataError, match=r"material\.json.*'stiffness' twice"):
        read_source(twice)
    with pytest.raises(
        DataError,
        match=r"known: .*: expected the checkpoint of an ended fit by Gauss-Newton.*Adam has none",
    ):
        known_numbers(str(checkpoint(tmp_path / "b.ckpt")), Material(law, {"E": 1e5, "nu": 0.3}), None, "known")  # fmt: skip

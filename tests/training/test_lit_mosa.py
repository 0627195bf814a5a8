"""The LightningModule apart from a fit."""

from types import SimpleNamespace

from mosa.modules.fitting.identification_settings import IdentificationSettings
from mosa.training import lit_mosa
from mosa.training.lit_mosa import LitMosa


def test_another_experiment_is_read_once_for_a_law(monkeypatch):
    """Stages and rivals ask for it; another law has other numbers, or refuses it."""
    read = []
    monkeypatch.setattr(
        lit_mosa, "known_numbers", lambda path, material, *_: read.append(material.law) or path
    )
    module = LitMosa({})
    module.body = SimpleNamespace(material=SimpleNamespace(law="corotated"), adapter=None)
    assert module.known is None and not read
    module.settings = IdentificationSettings(known="other.ckpt")
    assert [module.known, module.known] == ["other.ckpt"] * 2 and read == ["corotated"]
    module.body.material.law = "neo_hookean"
    assert module.known == "other.ckpt" and read == ["corotated", "neo_hookean"]

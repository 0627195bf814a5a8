"""The LightningModule apart from a fit."""

import warnings
from types import SimpleNamespace

import lightning as L
import pytest
import torch
from strangers import checkpoint, saved
from torch.utils.data import DataLoader

from mosa import SceneDataModule
from mosa.errors import ConfigError
from mosa.modules.fitting.identification_settings import IdentificationSettings
from mosa.modules.fitting.stages import Stage
from mosa.physics import exact_sums
from mosa.training import datamodule, lit_mosa
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


@pytest.mark.parametrize("other", ["scene=ring", "scene.sequence=test_60"])
def test_a_fit_goes_on_with_its_own_scene_alone(tmp_path, monkeypatch, other):
    """It trained silently on another scene's films, where those had as many particles."""
    module = LitMosa.load_from_checkpoint(checkpoint(tmp_path / "tiny.ckpt"))
    trainer = L.Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    data = SceneDataModule("debug=default", other)
    monkeypatch.setattr(datamodule, "load_sequences", lambda _: pytest.fail("the films were made"))
    for run in (trainer.fit, trainer.validate, trainer.test):
        with pytest.raises(
            ConfigError, match=r"a fit to this scene, found one to another.*scene\."
        ):
            run(module, datamodule=data)
    stored = torch.load(tmp_path / "tiny.ckpt", weights_only=True)
    lightning = {"epoch": 0, "global_step": 0, "pytorch-lightning_version": L.__version__}
    torch.save(stored | lightning | {"loops": {}, "callbacks": {}}, tmp_path / "tiny.ckpt")
    with pytest.raises(ConfigError, match=r"expected in the checkpoint a fit to this .*scene\."):
        trainer.fit(LitMosa(data.cfg), datamodule=data, ckpt_path=tmp_path / "tiny.ckpt")
    with pytest.raises(ConfigError, match=r"found one to another.*scene\."):
        LitMosa.load_from_checkpoint(tmp_path / "tiny.ckpt").on_load_checkpoint(
            saved("debug=default", other)
        )


@pytest.mark.parametrize("other", ["scene.holdout_cameras=[1]", "simulation.particles=150", "seed=1",
                                   "reconstruction.resolution=64", "rendering.margin=9", "fit.views=3"])  # fmt: skip
def test_module_and_data_have_one_configuration(monkeypatch, other):
    """A camera that the module held out was learned from, its settings named another body than its own, and modules of several
    seeds had one, the data's."""
    trainer = L.Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    data = SceneDataModule("debug=default")
    monkeypatch.setattr(datamodule, "load_sequences", lambda _: pytest.fail("the films were made"))
    with pytest.raises(ConfigError, match=f"one configuration for both.*{other.split('=')[0]}"):
        trainer.fit(LitMosa("debug=default", other), datamodule=data)


def test_a_loader_that_makes_batches_of_starts_is_named(tmp_path):
    """A height became a tensor of one number, which ended in an error of torch's."""
    module = LitMosa.load_from_checkpoint(checkpoint(tmp_path / "tiny.ckpt"))
    trainer = L.Trainer(accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False)  # fmt: skip
    starts = [{"height": 0.2, "frames": 2}]
    with pytest.raises(ConfigError, match=r"^predict: expected .*batch_size=None.* found batches"):
        trainer.predict(module, dataloaders=DataLoader(starts))
    (found,) = trainer.predict(module, dataloaders=DataLoader(starts, batch_size=None))
    assert len(found.x) == 2


def test_a_checkpoint_takes_no_hyperparameters_and_is_no_data(tmp_path):
    """Those of the call changed nothing, and the data were of the rabbit, whatever the checkpoint's scene."""
    path = checkpoint(tmp_path / "tiny.ckpt")
    with pytest.raises(ConfigError, match=r"expected no hyperparameters.* found cfg, lr; "):
        LitMosa.load_from_checkpoint(path, strict=True, lr=1, cfg={})
    with pytest.raises(ConfigError, match=r"SceneDataModule\(LitMosa\.load.*tiny\.ckpt'\)\.cfg\)"):
        SceneDataModule.load_from_checkpoint(path)
    cfg = LitMosa.load_from_checkpoint(path, strict=True).cfg
    assert SceneDataModule(cfg).cfg.scene.name == "tiny"


def test_a_checkpoint_is_fitted_on_with_a_data_module_alone(tmp_path):
    """Batches without it ended in an IndexError, or in a message about another configuration."""
    module = LitMosa.load_from_checkpoint(checkpoint(tmp_path / "tiny.ckpt"))
    trainer = L.Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    for run in (trainer.fit, trainer.validate):
        with pytest.raises(ConfigError, match=r"^LitMosa: expected a SceneDataModule.*its films"):
            run(module, DataLoader([0]))


@pytest.mark.parametrize("made", [LitMosa, SceneDataModule])
def test_a_script_has_the_same_bits_too(made):
    """The key was train.py's alone: a script on a GPU had others in every run."""
    try:
        made("scene=tiny", "debug=default")
        assert not torch.are_deterministic_algorithms_enabled()
        made("scene=tiny", "debug=default", "deterministic=true")
        assert torch.are_deterministic_algorithms_enabled()
    finally:
        exact_sums.use(False)


def test_a_bound_of_gradients_that_gauss_newton_has_not_is_named():
    module, adam = LitMosa({}), Stage(name="prior", iterations=1, lr=0.1, optimizer="adam")
    few = adam.but(optimizer="gauss_newton")
    module.stages = [few, few]
    with pytest.warns(UserWarning, match=r"trainer\.gradient_clip_val: has no effect in this run"):
        module.configure_gradient_clipping(None, 0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        module.configure_gradient_clipping(None)
        module.stages = [few, adam]
        module.configure_gradient_clipping(None, 0.5)

"""A key that is set and does nothing is said; one that does something is not."""

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

import mosa
from mosa.config.build import rehearse
from mosa.config.command_settings import TrainSettings
from mosa.config.effects import sentences
from mosa.modules.fitting import terms

CONF = Path(__file__).parents[2] / "conf"


def found(*overrides: str) -> list[str]:
    """Keys of the overrides that have no effect."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        values = OmegaConf.to_container(compose("train", overrides=list(overrides)), resolve=True)
    return [
        sentence.split(":")[0]
        for sentence in sentences(overrides, TrainSettings.read(values), rehearse(values))
    ]


def test_a_weight_of_another_package_s_term_is_said_beside_gauss_newton(monkeypatch):
    monkeypatch.setattr(terms, "TERMS", {**terms.TERMS, "mine": lambda step: None})
    assert found("+losses.mine=0.5") == ["losses.mine"]
    assert found("+losses.mine=0.5", "fit=adam") == []


def test_a_script_of_one_s_own_hears_it_too(monkeypatch):
    monkeypatch.setattr(terms, "TERMS", {**terms.TERMS, "mine": lambda step: None})
    for given in (["+losses.mine=0.5"], [mosa.compose("+losses.mine=0.5")]):
        with pytest.warns(UserWarning, match=r"losses\.mine: has no effect .*Gauss-Newton"):
            mosa.LitMosa(*given)
    with pytest.warns(UserWarning, match=r"fit\.joint\.lr: has no effect"):
        mosa.LitMosa("fit.joint.lr=0.1")


@pytest.mark.parametrize("overrides, expected", [
    (["losses.flow=0", "losses.rotation=0", "fit.joint.lr=0.1", "fit.clip=2"], ["losses.flow", "fit.joint.lr", "fit.clip"]),
    (["fit=adam", "losses.flow=0", "fit.joint.lr=0.1", "identification.count=5", "fit.joint.newton_iterations=3"],
     ["identification.count", "fit.joint.newton_iterations"]),
    (["fit.joint.newton_iterations=6", "fit.prior.iterations=6", "fit.joint.iterations=0"],
     ["fit.prior.iterations"]),
    (["adapter=mosa", "losses.flow=0", "fit.prior.lr=0.1", "fit.joint.lr=0.1", "identification.count=5"], ["fit.prior.lr"]),
    (["heterogeneity.hidden=8", "heterogeneity.most=20"], ["heterogeneity.hidden"]),
    (["heterogeneity.enabled=false", "heterogeneity.most=20"], ["heterogeneity.most"]),
    (["criterion=free", "criterion.gain=0.2"], ["criterion.gain"]),
    (["simulation.dx=0.01", "simulation.particles=500", "simulation.min_substeps=3"],
     ["simulation.particles", "simulation.min_substeps"]),
    (["reconstruction.carried.iterations=0", "reconstruction.carried.degree=2"], ["reconstruction.carried.degree"]),
    (["ablation=no_motion"], ["losses.flow"]), (["ablation=no_motion", "fit=adam"], []), (["ablation=no_rot"], []),
    (["ablation=no_rot", "adapter=none", "heterogeneity.enabled=false"], ["losses.rotation"]),
    (["ablation=no_rot", "adapter=none", "heterogeneity.enabled=false", "fit=adam"], []),
    (["losses.rotation=0", "losses.position=0", "adapter=none", "heterogeneity.enabled=false"], []),
    (["scene=tiny", "simulation.adaptive=true", "criterion=free", "simulation.min_substeps=3", "seed=3"], []),
])  # fmt: skip
def test_what_has_no_effect_is_said(overrides, expected):
    assert [key for key in found(*overrides)] == [each.split("=")[0] for each in expected]


def test_each_optimiser_has_its_own_number_of_iterations():
    """More iterations of Gauss-Newton did nothing without more of Adam."""
    for given, most in (([], 2), (["fit.joint.newton_iterations=6"], 6)):
        values = OmegaConf.to_container(mosa.compose("debug=default", *given), resolve=True)
        assert rehearse(values)[-1].iterations == most

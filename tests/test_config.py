"""Every combination of the config groups composes, and a switch changes what it names and nothing else."""

import itertools
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import MissingConfigException
from omegaconf import OmegaConf

from mosa.config import build_adapter, build_stages
from mosa.errors import ConfigError
from mosa.modules.body import SimulationSettings

ROOT = Path(__file__).parents[1]


def group(name: str) -> list[str]:
    return sorted(p.stem for p in (ROOT / "conf" / name).glob("*.yaml"))


def composed(*overrides: str) -> dict:
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return OmegaConf.to_container(compose("train", overrides=list(overrides)), resolve=False)


@pytest.mark.parametrize("scene", group("scene"))
def test_every_scene_with_every_prior_composes(scene):
    for prior, adapter in itertools.product(group("prior"), group("adapter")):
        config = composed(f"scene={scene}", f"prior={prior}", f"adapter={adapter}")
        assert config["prior"] and config["scene"]


@pytest.mark.parametrize("name", ["reconstruction", "simulation", "fit", "trainer", "logger", "ablation"])
def test_every_option_of_a_group_composes(name):
    for option in group(name):
        assert composed(f"{name}={option}")


@pytest.mark.parametrize("override", ["debug=defualt", "scene=rabit", "prior=jelly", "ablation=no_foo", "trainer=tpu"])
def test_a_mistyped_option_is_refused(override):
    with pytest.raises(MissingConfigException, match=override.split("=")[1]):
        composed(override)


@pytest.mark.parametrize("adapter, message", [
    ({"_target_": "mosa.modules.adapter.StressAdapter", "alpha": 2}, "adapter.alpha"),
    ({"_target_": "mosa.modules.direct.DirectAdapter", "no_C": True}, "no_C"),
    ({"_target_": "mosa.modules.adapter.StressAdapter", "alfa": 0.1}, "adapter.alfa: unknown key; expected one of alpha"),
    ({"_target_": "mosa.modules.adapter.Stress"}, "adapter._target_"),
])  # fmt: skip
def test_a_mistake_in_the_adapter_names_its_key(adapter, message):
    with pytest.raises(ConfigError, match=message):
        build_adapter(adapter)


@pytest.mark.parametrize("key, value", [("precision", 16), ("stride", 0), ("max_substeps", 2.5), ("courant", 0), ("dx", -1.0)])
def test_a_mistake_in_the_simulation_names_its_key(key, value):
    with pytest.raises(ConfigError, match=f"simulation.{key}"):
        SimulationSettings(**{"dx": 0.1, key: value})


def test_a_mistake_in_a_stage_names_its_key():
    fit = {name: {"iterations": 2, "lr": 0.1} for name in ("prior", "prior_eta", "joint")}
    with pytest.raises(ConfigError, match=r"fit\.joint\.lrr: unknown key; expected one of iterations, lr,"):
        build_stages(fit | {"joint": {"iterations": 2, "lrr": 1}}, heterogeneity=True, adapter=True)
    with pytest.raises(ConfigError, match=r"fit\.joint\.start"):
        build_stages(fit | {"joint": {"iterations": 2, "lr": 1, "start": "foo"}}, heterogeneity=True, adapter=True)


def flat(config, prefix="") -> dict:
    result = {}
    for key, value in config.items():
        result |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return result


EXPECTED = {
    "full": set(),
    "no_C": {"adapter.no_C"},
    "no_het": {"heterogeneity.enabled"},
    "no_pre": {"adapter.no_pre"},
    "no_post": {"adapter.no_post"},
    "no_flow": {"losses.flow"},
    "no_scale": {"losses.stretch"},
    "no_rot": {"losses.rotation"},
    "no_prior_stress": {"adapter.no_prior_stress"},
}


@pytest.mark.parametrize("name", sorted(EXPECTED))
def test_an_ablation_changes_the_switch_it_names_and_nothing_else(name):
    # the parts of the networks exist in the paper's adapter only
    whole = "paper" if any(key.startswith("adapter.") for key in EXPECTED[name]) else "full"
    full, ablated = flat(composed(f"ablation={whole}")), flat(composed(f"ablation={name}"))
    assert {k for k in full.keys() | ablated.keys() if full.get(k) != ablated.get(k)} == EXPECTED[name]

"""Every combination of the config groups composes, and a switch changes what it names and nothing else."""

import itertools
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

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

"""Every key of the YAML files is known, every other one is refused with the nearest; what is left out is named."""

import copy
import functools
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from mosa.config.keys import EVALUATION, SIMULATION, TRAINING
from mosa.config.known import check_known, paths, tree_of
from mosa.errors import ConfigError

ROOT = Path(__file__).parents[2]
CONF = ROOT / "conf"


@functools.cache
def composed(*overrides: str, name: str = "train") -> dict:
    """Not to be changed: composing takes longer than any test here."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return OmegaConf.to_container(compose(name, overrides=list(overrides)), resolve=False)


def check(*overrides: str) -> None:
    check_known(composed(*overrides), CONF, "train", TRAINING, EVALUATION)


def test_every_key_of_every_file_is_known():
    known = set(paths(tree_of(CONF, "train")))
    for file in CONF.glob("*/*.yaml"):
        text = file.read_text()
        found = {k: v for k, v in (yaml.safe_load(text) or {}).items() if k != "defaults"}
        if file.parent.name == "hydra":
            continue
        for path in paths(
            found if "@package _global_" in text.splitlines()[0] else {file.parent.name: found}
        ):
            assert path in known, (file, path)


@pytest.mark.parametrize("overrides", [
    [], ["ablation=no_stress"], ["ablation=paper"], ["debug=default"], ["fit=paper", "reconstruction=paper", "simulation=paper"],
    ["+prior.options.norm_eps=0"], ["+reconstruction.static.growth=0.1"], ["+fit.joint.converged=0.001"], ["adapter=direct"],
    ["trainer=gpu", "rendering=gsplat"], ["~losses.image"], ["adapter=none", "logger=none"],
])  # fmt: skip
def test_what_is_known_passes(overrides):
    check(*overrides)


@pytest.mark.parametrize(("override", "nearest"), [
    ("+foo=1", ""), ("+sed=1", "seed"), ("+world.wals=1", "world.walls"),
    ("+simulation.particels=9", "simulation.particles"),
    ("+fit.view=1", "fit.views"), ("+rendering.magrin=1", "rendering.margin"),
    ("+evaluation.sample=1", "evaluation.samples"),
    ("+adapter.alfa=0.1", "adapter.alpha"),
    ("+losses.colour=1", "losses."), ("+heterogeneity.amplitud=1", "heterogeneity.amplitude"),
])  # fmt: skip
def test_an_unknown_key_is_refused_with_the_nearest(override, nearest):
    key = override[1:].split("=")[0]
    values = copy.deepcopy(composed())
    part = functools.reduce(dict.__getitem__, key.split(".")[:-1], values)
    part[key.split(".")[-1]] = 1
    with pytest.raises(
        ConfigError, match=rf"^{key}: unknown key; the nearest known one is {nearest}"
    ):
        check_known(values, CONF, "train", TRAINING, EVALUATION)


@pytest.mark.parametrize(
    "key",
    [
        "seed",
        "scene",
        "adapter",
        "fit",
        "fit.views",
        "fit.prior",
        "world.colliders",
        "losses",
        "trainer",
        "simulation.stride",
        "rendering.backend",
        "identification.tolerance",
        "logger",
        "resume",
    ],
)
def test_a_key_that_was_deleted_is_named(key):
    values = copy.deepcopy(composed())
    *above, last = key.split(".")
    part = values
    for level in above:
        part = part[level]
    del part[last]
    with pytest.raises(ConfigError, match=rf"^{key}: expected this key, found none"):
        check_known(values, CONF, "train", TRAINING, EVALUATION)


def test_eval_has_its_own_keys():
    values = composed("ckpt_path=a", name="eval")
    check_known(values, CONF, "eval", EVALUATION, SIMULATION)
    with pytest.raises(
        ConfigError,
        match=r"^simulate\.hight: unknown key; the nearest known one is simulate\.height",
    ):
        check_known(
            values | {"simulate": values["simulate"] | {"hight": 1}},
            CONF,
            "eval",
            EVALUATION,
            SIMULATION,
        )


def test_a_group_without_an_option_is_one_message():
    found = subprocess.run(
        [sys.executable, "train.py", "adapter=null"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert found.returncode == 2 and "ConfigError: adapter: expected one of direct" in found.stderr
    assert "Traceback" not in found.stderr

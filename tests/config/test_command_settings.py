"""What each command may be told: every key has a type, a default and a description; every other one is refused with the nearest."""

import copy
import functools
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from pydantic_core import PydanticUndefined

from mosa.config.build import rehearse
from mosa.config.command_settings import EvalSettings, TrainSettings
from mosa.config.composition import CHOSEN, with_defaults
from mosa.config.leaf_settings import COMMANDS
from mosa.errors import ConfigError
from mosa.settings import annotation_of, described, fits, model_in, node_of

ROOT = Path(__file__).parents[2]
CONF = ROOT / "conf"


@functools.cache
def composed(*overrides: str, name: str = "train") -> dict:
    """Not to be changed: composing takes longer than any test here."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return OmegaConf.to_container(compose(name, overrides=list(overrides)), resolve=False)


@pytest.mark.parametrize("overrides", [
    [], ["ablation=no_stress"], ["ablation=paper"], ["debug=default"], ["fit=paper", "reconstruction=paper", "simulation=paper"],
    ["+prior.options.norm_eps=0"], ["reconstruction.static.relocate_every=50"], ["fit.joint.converged=0.001"], ["adapter=direct"],
    ["trainer=gpu"], ["~losses.image"], ["adapter=none", "logger=none"], ["~fit.views"], ["~world"], ["~rendering"],
])  # fmt: skip
def test_what_is_known_passes(overrides):
    TrainSettings.read(composed(*overrides))


@pytest.mark.parametrize(("key", "nearest"), [
    ("sed", "seed"), ("world.wals", "world.walls"), ("simulation.particels", "simulation.particles"), ("fit.view", "fit.views"),
    ("rendering.magrin", "rendering.margin"), ("evaluation.sample", "evaluation.samples"), ("fit.joint.lrr", "fit.joint.lr"),
    ("heterogeneity.amplitud", "heterogeneity.amplitude"), ("reconstruction.static.vews", "reconstruction.static.views"),
    ("losses.imag", "losses.image"), ("prior.options.norm_ep", "prior.options.norm_eps"),
])  # fmt: skip
def test_an_unknown_key_is_refused_with_the_nearest(key, nearest):
    values = copy.deepcopy(composed())
    *above, last = key.split(".")
    functools.reduce(lambda part, level: part.setdefault(level, {}), above, values)[last] = 1
    with pytest.raises(
        ConfigError,
        match=rf"^{key}: unknown key; expected one of .*{nearest.split('.')[-1]}.*; the nearest is {nearest}",
    ):
        rehearse(values)


@pytest.mark.parametrize("name", COMMANDS)
def test_what_a_file_composes_is_known_and_has_all_defaults(name):
    """Each command's own file, with what it needs, passes; every key of a model that has a default is in the configuration."""
    missing = {
        "eval": ["ckpt_path=a"],
        "splats": ["ply=a"],
        "material": ["unit=Pa"],
        "capture": ["videos=a", "poses=b", "output=c"],
    }
    values = composed(*missing.get(name, []), name=name)
    COMMANDS[name].read(values)
    for key, default in node_of(COMMANDS[name], CHOSEN).items():
        assert key in values and (not isinstance(default, dict) or set(default) <= set(values[key]))


@pytest.mark.parametrize("key", ["scene", "prior", "prior.law"])
def test_a_section_that_was_deleted_and_has_no_default_is_named(key):
    values = copy.deepcopy(composed())
    *above, last = key.split(".")
    del functools.reduce(dict.__getitem__, above, values)[last]
    with pytest.raises(ConfigError, match=rf"^{key}: expected this key, found none"):
        TrainSettings.read(values)


def test_a_section_that_is_given_in_part_keeps_the_defaults_of_its_place():
    given = {
        "scene": {},
        "prior": {"law": "corotated", "parameters": {}},
        "fit": {"joint": {"lr": 1}},
    }
    settings = TrainSettings.read(given)
    assert (settings.fit.joint.lr, settings.fit.joint.start) == (1.0, "prior")
    assert (settings.fit.prior.looks, settings.reconstruction.appearance.keep) == (8, 1.0)


def test_a_deleted_key_has_its_default():
    cfg = with_defaults(OmegaConf.create(composed("~world", "~fit.views", "seed=3")), "train")
    assert (cfg.world.colliders, cfg.fit.views, cfg.seed) == ([], 2, 3)


def fields_of(model, where=""):
    for name, f in model.model_fields.items():
        yield f"{where}{name}", f
        if (inner := model_in(annotation_of(f))) is not None:
            yield from fields_of(inner, f"{where}{name}.")


@pytest.mark.parametrize("name", COMMANDS)
def test_every_key_has_a_default_of_its_type_and_a_line_of_description(name):
    found = dict(fields_of(COMMANDS[name]))
    assert len(found) > 15
    for key, f in found.items():
        default = f.get_default(call_default_factory=True)
        assert f.description and described(annotation_of(f)), key
        if default is not PydanticUndefined:
            assert fits(annotation_of(f), default), key
        assert not fits(annotation_of(f), object()), key


def test_eval_has_its_own_keys():
    values = composed("ckpt_path=a", name="eval")
    with pytest.raises(
        ConfigError, match=r"^simulate\.hight: unknown key; .*; the nearest is simulate\.height"
    ):
        EvalSettings.read(values | {"simulate": values["simulate"] | {"hight": 1}})


@pytest.mark.parametrize("values, key", [
    ({"velocity": ["a", 0, 0]}, "velocity"), ({"velocity": 5}, "velocity"), ({"rotation": [1, 0, 0]}, "rotation"),
    ({"height": "abc"}, "height"), ({"frames": 0}, "frames"), ({"colliders": 5}, "colliders"),
])  # fmt: skip
def test_a_new_start_of_the_wrong_kind_is_named(values, key):
    with pytest.raises(ConfigError, match=rf"simulate\.{key}: expected "):
        EvalSettings.read({"ckpt_path": "a", "simulate": values})

"""A run's configuration in Python, as the command line composes it."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from mosa.config.extensions import load_extensions
from mosa.config.leaf_settings import COMMANDS
from mosa.errors import ConfigError
from mosa.settings import nearest, node_of
from mosa.system.machine_errors import causes

GROUPED = "scene"  # the group whose option a bare name chooses
PLUGINS = {"optuna": "sweep", "joblib": "sweep", "submitit_slurm": "sweep", "ray": "ray"}
"""Of Hydra, by the names of their options: extras of this package."""
CHOSEN = ("adapter", "trainer", "callbacks", "logger")  # their keys depend on the option


def current_folder() -> str:
    """Of the job that Hydra runs, for ${run_folder:} in conf/; outputs where there is none, as in a script or a notebook."""
    if not HydraConfig.initialized():
        return "outputs"
    hydra: Any = HydraConfig.get()
    return OmegaConf.select(hydra, "runtime.output_dir") or "outputs"  # --cfg has none


def searching() -> bool:
    """A sweeper that chooses by the runs' figures has begun this run, as Optuna's."""
    hydra: Any = HydraConfig.get() if HydraConfig.initialized() else OmegaConf.create()
    sweeper = OmegaConf.select(hydra, "sweeper._target_") or "BasicSweeper"
    return hydra.get("mode") == RunMode.MULTIRUN and not sweeper.endswith("BasicSweeper")


OmegaConf.register_new_resolver("run_folder", current_folder, replace=True)


STORE = ConfigStore.instance()
for command, model in COMMANDS.items():  # which conf/<command>.yaml begins with
    STORE.store(f"{command}_settings", node_of(model, CHOSEN))
# --help copies Hydra's repository once for each group, and with it this store, of which there is one: a second of copies
STORE.__deepcopy__ = lambda memo: STORE  # type: ignore[attr-defined]


def with_defaults(cfg: DictConfig, name: str) -> DictConfig:
    """A configuration of conf/<name>.yaml whose keys that were deleted (`~key`) have their defaults."""
    found = OmegaConf.merge(node_of(COMMANDS[name]), cfg)
    assert isinstance(found, DictConfig)
    return found


def configuration() -> str:
    """Folder of the configuration: inside of an installed package, beside it in a clone."""
    package = Path(__file__).parents[1]
    inside = package / "conf"
    return str(inside if inside.is_dir() else package.parent / "conf")


def keys_of(values: Any, where: str = "") -> Iterator[str]:
    """Of a configuration in plain containers, those of its sections too."""
    for key, value in values.items() if isinstance(values, dict) else ():
        yield f"{where}{key}"
        yield from keys_of(value, f"{where}{key}.")


def options_of(group: str) -> dict[str, list[str]]:
    """The options of a group of conf/, each with the keys of its file; empty for any other name."""
    files = {f.stem: OmegaConf.load(f) for f in sorted(Path(configuration(), group).glob("*.yaml"))}
    return {
        name: list(keys_of(OmegaConf.to_container(f), f"{group}.")) for name, f in files.items()
    }


def way_out(key: str) -> str:
    """The end of a message on a key that the configuration lacks: other options of its group that have it, keys of that name in its
    sections, or the nearest known key, with + where no file has that argument of a Trainer."""
    if key in ("run_dir", "out_dir", "output_dir"):
        return "; expected hydra.run.dir=<folder>"
    group, _, name = key.partition(".")
    options = options_of(group) if name else {}
    having = [option for option, keys in options.items() if key in keys]
    if having:
        having = [each for each in having if not any(each.startswith(f"{o}_") for o in having)]
        have = f"{', '.join(having)} {'have' if having[1:] else 'has'}"
        own = "; a built-in scene always brings its own held-out drops"
        rest = own if key == "scene.test" else ""
        return f"; {group}={have} it, the chosen {group} has not{rest}"
    section, _, last = key.rpartition(".")
    files = {each.rpartition(".")[::2] for keys in options.values() for each in keys}
    if near := nearest(last, [each for where, each in sorted(files) if where == section], section):
        return near
    known = [each for model in COMMANDS.values() for each in keys_of(node_of(model))]
    known = sorted({each for each in known if each != key})  # which another command may have
    if deeper := [each for each in known if each.endswith(f".{key}")]:
        return f"; expected {' or '.join(deeper[:3])}"
    if group == "trainer":
        from lightning import Trainer

        filed = options_of(group)["cpu"]
        whole = (f"{group}.{argument}" for argument in inspect.signature(Trainer).parameters)
        known += [argument if argument in filed else f"+{argument}" for argument in whole]
    near = nearest(key, known, "")
    return f"{near}=<value>" if "+" in near else near


def said_of(error: BaseException, given: Sequence[str] = ()) -> str:
    """What Hydra says of an override that it cannot take, and the options or the nearest key, where
    it does not name those. given: the overrides."""
    said = "\n".join(dict.fromkeys(str(e).split("\n    full_key")[0] for e in causes(error)))
    said = said.replace(
        "Cannot merge DictConfig with ListConfig",
        "expected a list, as [{...}], found a section, as {...}",
    )
    if found := re.search(r"Could not (?:load|find) '([\w/]+)/([^/']+)'", said):
        options = list(options_of(found[1]))
        if listed := re.search(r"Available options in '.*':((?:\s+\w+$)+)", said, re.MULTILINE):
            options = listed[1].split()
        said = (
            f"{found[1]}: expected one of {', '.join(options)}, found {found[2]}"
            f"{nearest(found[2], options, '')}; files of your own: hydra.searchpath=[file://<folder>], "
            f"which holds {found[1]}/{found[2]}.yaml"
        )
        if found[2] in PLUGINS:
            said = f"{found[1]}={found[2]}: expected its plugin of Hydra, found none; pip install 'mosa[{PLUGINS[found[2]]}]'"
    if "Config group override must be a string" in said and "NoneType" in said:
        said = "a group, as scene, prior or adapter: expected the name of an option, found null"
        words = (word.lstrip("+").partition("=") for word in given)
        empty = [key for key, _, value in words if "null" in value.split(",") and options_of(key)]
        for key in empty[:1]:
            options = list(options_of(key))
            way = f"{key}=none" if "none" in options else f"without {key}= it has its default"
            said = f"{key}: expected one of {', '.join(options)}, found null; {way}"
    if found := re.search(r"\.\nTo append to your config use \+([\w.]+)=.*", said):
        key = found[1]
        inner = re.search(r"\nKey '([^']+)' is not in struct", said)
        if inner and inner[1] not in key.split("."):  # of a section that was given as a whole
            whole = f"{key}.{inner[1]}"
            said, key = said.replace(inner[0], "").replace(f"'{key}'", f"'{whole}'"), whole
        said = said.replace(found[0], f"{way_out(key)}.")
    return said[:2000]


def compose(*overrides: str, name: str = "train") -> DictConfig:
    """`conf/<name>.yaml` with overrides as on the command line: `compose("scene=rabbit", "prior=neo_hookean")`.
    Imports the modules of `extensions`, as the commands do.

    Errors: ConfigError for an override that Hydra does not know, or an extension."""
    if wrong := [each for each in overrides if not isinstance(each, str)]:
        raise ConfigError(
            f"overrides: expected texts, as compose('scene=rabbit', 'seed=1'), found {wrong[0]!r}; of a list: compose(*list)"
        )
    try:
        with initialize_config_dir(configuration(), version_base="1.3"):
            cfg = hydra_compose(name, overrides=list(overrides))
    except (HydraException, ValueError) as error:  # the latter for `group=null`
        raise ConfigError(said_of(error, overrides)) from error
    load_extensions(OmegaConf.to_container(cfg).get("extensions"))  # type: ignore[union-attr]
    return cfg


def composed(
    first: str | Mapping[str, Any] | DictConfig | None, overrides: tuple[str, ...]
) -> DictConfig:
    """A whole configuration, from one (which takes no overrides), or from overrides, of which the first may be a scene's name."""
    if isinstance(first, Mapping | DictConfig):
        if overrides:
            raise TypeError(
                f"overrides: expected none beside a whole configuration, found {overrides}; give them to mosa.compose"
            )
        return first if isinstance(first, DictConfig) else OmegaConf.create(dict(first))
    named = isinstance(first, str) and "=" not in first
    given = () if first is None else (f"{GROUPED}={first}" if named else first,)
    return compose(*given, *overrides)

"""Which keys a configuration has: those of the YAML files it is composed from, and those that a schema names beside them.

There is no second list to keep: a key in any option of a group, or in a schema, is known; every other one is refused, with the
nearest that is known.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Mapping
from difflib import SequenceMatcher
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import yaml
from hydra.core.hydra_config import HydraConfig

from mosa.errors import ConfigError

ELSEWHERE = ("hydra", "trainer", "callbacks", "logger", "scene", "prior", "reconstruction", "fit.prior", "fit.prior_eta",
             "fit.joint", "world.walls", "phones", "world.colliders", "simulate.colliders",
             "world.driven", "simulate.driven", "world.forces")  # fmt: skip
"""Sections that are the arguments of what is built from them, or whose keys depend on a kind: there they are named."""
LOOSE = ("losses", "reconstruction", "prior", "adapter")
"""Sections of which any key may be left out: each has a default where it is read."""


@functools.cache
def tree_of(conf: Path, name: str) -> dict[str, Any]:
    """Every key of conf/<name>.yaml and of all options of all groups, nested, as a section or None; conf: the folder."""
    tree: dict[str, Any] = {}
    for file in [conf / f"{name}.yaml", *sorted(conf.glob("*/*.yaml"))]:
        if file.parent.name != "hydra":
            merge(tree, placed(file, main=file.parent == conf))
    return tree


def placed(file: Path, main: bool = False) -> dict[str, Any]:
    """The keys of a file, where Hydra puts them: in its group's section, or anywhere with the package _global_."""
    text = file.read_text()
    found = {key: value for key, value in (yaml.safe_load(text) or {}).items() if key != "defaults"}
    return (
        found
        if main or "@package _global_" in text.partition("\n")[0]
        else {file.parent.name: found}
    )


def merge(tree: dict[str, Any], more: Mapping[str, Any]) -> None:
    """Adds the keys of `more`; a key that is a section anywhere is one."""
    for key, value in more.items():
        if isinstance(value, Mapping):
            if not isinstance(tree.get(key), dict):
                tree[key] = {}
            merge(tree[key], value)
        else:
            tree.setdefault(key, None)


def paths(tree: Mapping[str, Any], above: str = "") -> Iterator[str]:
    """All keys, with dots between levels."""
    for key, value in tree.items():
        yield f"{above}{key}"
        if isinstance(value, Mapping):
            yield from paths(value, f"{above}{key}.")


def refuse_unknown(
    values: Mapping[str, Any], tree: Mapping[str, Any], schemas: Iterable[Mapping[str, Any]]
) -> None:
    """Errors: ConfigError naming the first key that neither the YAML files nor a schema know, and the nearest one they do."""
    known = set(paths(tree))
    patterns = [
        pattern for schema in schemas for pattern in schema if not pattern.endswith(".*")
    ]  # which say a kind, not a name
    for path in paths(values):
        if path in known or any(path.startswith(f"{section}.") for section in ELSEWHERE):
            continue
        levels = path.split(".")
        if any(
            len(levels) == len(p.split(".")) and all(map(fnmatchcase, levels, p.split(".")))
            for p in patterns
        ):
            continue
        nearest = max(known, key=lambda name: SequenceMatcher(None, path, name).ratio())
        raise ConfigError(f"{path}: unknown key; the nearest known one is {nearest}")


def refuse_missing(values: Mapping[str, Any], conf: Path, name: str) -> None:
    """Errors: ConfigError naming the first key that conf/<name>.yaml or every option of a group has, and the values have not."""
    have = set(paths(values))
    for path in needed(conf, name):
        if path not in have:
            way = (
                f"; choose an option, {path}=<name>"
                if path in groups_of(conf, name)
                else " (deleted with ~?)"
            )
            raise ConfigError(f"{path}: expected this key, found none{way}")


@functools.cache
def needed(conf: Path, name: str) -> tuple[str, ...]:
    """The keys that may not be left out."""
    main = yaml.safe_load((conf / f"{name}.yaml").read_text())
    found = list(paths({key: value for key, value in main.items() if key != "defaults"}))
    for group in groups_of(conf, name):
        options = [placed(file) for file in sorted((conf / group).glob("*.yaml"))]
        found += sorted(set.intersection(*(set(paths(option)) for option in options)))
    loose = tuple(f"{section}." for section in (*LOOSE, *ELSEWHERE))
    return tuple(path for path in found if not path.startswith(loose))


def check_known(
    values: Mapping[str, Any], conf: Path, name: str, *schemas: Mapping[str, Any]
) -> None:
    """What a configuration of conf/<name>.yaml has is known, and nothing is missing. Errors: ConfigError naming the key."""
    refuse_unknown(values, tree_of(conf, name), schemas)
    refuse_missing(values, conf, name)


def conf_folder() -> Path | None:
    """Where the running program's configuration was composed from; None where that is no folder, or nothing runs."""
    if not HydraConfig.initialized():
        return None
    sources = HydraConfig.get().runtime.config_sources
    found = next((Path(source.path) for source in sources if source.provider == "main"), None)
    return found if found is not None and found.is_dir() else None


@functools.cache
def groups_of(conf: Path, name: str) -> tuple[str, ...]:
    """The groups that conf/<name>.yaml takes an option of by default, and that fill a section of their own."""
    defaults = (yaml.safe_load((conf / f"{name}.yaml").read_text()) or {}).get("defaults", [])
    chosen = {
        group: option
        for entry in defaults
        if isinstance(entry, Mapping)
        for group, option in entry.items()
    }
    return tuple(
        group
        for group, option in chosen.items()
        if option is not None and group not in ("hydra", "ablation", "debug")
    )

"""Hydra's composition of the files of conf/ once for each choice of groups: it takes a tenth of a second, and most compositions
of the tests differ in overrides of values, which are applied after it. What is composed of other folders is not kept."""

import copy
from collections.abc import Callable
from dataclasses import astuple
from pathlib import Path

from hydra._internal import config_loader_impl
from hydra._internal.defaults_list import DefaultsList, Overrides

CONF = str(Path(__file__).parents[2] / "conf")
made = config_loader_impl.create_defaults_list
files = config_loader_impl.ConfigLoaderImpl._compose_config_from_defaults_list
known: dict[tuple, object] = {}


def once(repo, words: tuple, make: Callable[[], object]) -> object:
    """What `make` returns, which nobody changes, or what it returned before of the same files."""
    sources = repo.get_sources()
    if any(source.scheme() == "file" and source.path != CONF for source in sources):
        return make()
    places = tuple(source.path for source in sources)
    return known[key] if (key := (places, *words)) in known else known.setdefault(key, make())


def defaults_once(repo, config_name, overrides_list, **how) -> DefaultsList:
    values = Overrides(repo, overrides_list).config_overrides
    groups = [each for each in overrides_list if each not in values]
    words = (config_name, *(each.input_line for each in groups), *sorted(how.items()))
    found = once(repo, words, lambda: made(repo, config_name, groups, **how))
    return DefaultsList(found.defaults, found.defaults_tree, values, found.overrides)


def files_once(self, defaults, repo):
    return copy.deepcopy(
        once(repo, tuple(map(astuple, defaults)), lambda: files(self, defaults, repo))
    )


def compose_once() -> None:
    config_loader_impl.create_defaults_list = defaults_once
    config_loader_impl.ConfigLoaderImpl._compose_config_from_defaults_list = files_once

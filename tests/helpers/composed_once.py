"""Hydra's composition of the files of conf/ once for each choice of groups: it takes a tenth of a second, and most compositions
of the tests differ in overrides of values, which are applied after it. Other choices are composed of files that are read once.
What is composed of other folders is not kept.

What is kept and changed by whoever gets it is kept pickled: OmegaConf's copy of a configuration takes seven times as long."""

import pickle
from collections.abc import Callable
from dataclasses import astuple
from pathlib import Path

from hydra._internal import config_loader_impl
from hydra._internal.config_repository import ConfigRepository
from hydra._internal.defaults_list import DefaultsList, Overrides
from hydra.plugins.config_source import ConfigResult

CONF = str(Path(__file__).parents[2] / "conf")
made = config_loader_impl.create_defaults_list
files = config_loader_impl.ConfigLoaderImpl._compose_config_from_defaults_list
read = ConfigRepository.load_config
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
    words = tuple(map(astuple, defaults))
    return pickle.loads(once(repo, words, lambda: pickle.dumps(files(self, defaults, repo), -1)))


def read_once(self, config_path: str) -> ConfigResult | None:
    return pickle.loads(
        once(self, (read, config_path), lambda: pickle.dumps(read(self, config_path), -1))
    )


def compose_once() -> None:
    config_loader_impl.create_defaults_list = defaults_once
    config_loader_impl.ConfigLoaderImpl._compose_config_from_defaults_list = files_once
    ConfigRepository.load_config = read_once

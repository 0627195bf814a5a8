"""Laws, adapters, loss terms, metrics and data formats of other packages: modules that register them, named in `extensions`.

They are code of whoever starts the program: the command line and the YAML files name them, a checkpoint never does. Who loads a
checkpoint of a run that had some imports them before (docs/extending.md).
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from typing import Any

from mosa.errors import ConfigError, MosaError
from mosa.modules.adapters.registry import adapter_class
from mosa.modules.fitting.terms import term_names
from mosa.schema import NAMES, WEIGHT, Kind, arguments_of


def load_extensions(names: Sequence[str] | None) -> None:
    """Import the modules of these names, which register what they bring. Errors: ConfigError naming the module."""
    if not NAMES.fits(names or []):
        raise ConfigError(f"extensions: expected {NAMES.described}, found {names!r}")
    for name in names or ():
        if not all(part.isidentifier() for part in name.split(".")):
            raise ConfigError(
                f"extensions: expected the name of a module like my_package.my_law, found {name!r}"
            )
        try:
            importlib.import_module(name)
        except MosaError:
            raise
        except (Exception, SystemExit) as error:  # whatever the module does while it is imported
            reason = error if isinstance(error, ImportError) else f"{type(error).__name__}: {error}"
            raise ConfigError(
                f"extensions: expected a module that can be imported (installed, or in PYTHONPATH), found {name!r} "
                f"({' '.join(str(reason).split())[:300]})"
            ) from error


def registered_keys(values: Mapping[str, Any]) -> dict[str, Kind]:
    """Keys of the configuration that what is registered brings, and what each may be: a weight for each loss term, the arguments
    of the chosen adapter.

    Errors: ConfigError for an adapter that is not known."""
    section = values.get("adapter")
    build = adapter_class(section) if isinstance(section, Mapping) else None
    keys = {f"losses.{name}": WEIGHT for name in term_names(build)}
    if build is not None:
        anything = Kind("a value", lambda value: True)  # which the adapter checks itself
        keys |= {f"adapter.{name}": build.knobs.get(name, anything) for name in arguments_of(build)}
    return keys

"""Laws, adapters, loss terms, metrics and data formats of other packages: modules that register them, named in `extensions`.

They are code of whoever starts the program: the command line and the YAML files name them, a checkpoint never does. Who loads a
checkpoint of a run that had some imports them before (docs/extending.md)."""

from __future__ import annotations

import importlib
from collections.abc import Sequence

from mosa.errors import ConfigError, MosaError
from mosa.settings import Names, check


def load_extensions(names: Sequence[str] | None) -> None:
    """Import the modules of these names, which register what they bring. Errors: ConfigError naming the module."""
    check("extensions", names or [], Names)
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

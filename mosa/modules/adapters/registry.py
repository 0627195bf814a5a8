"""The adapters that a configuration may name: a name is looked up here, nothing else is ever imported or called for it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import nn

from mosa.errors import ConfigError
from mosa.settings import imported

ADAPTERS = {
    "hyperelastic": "mosa.modules.adapters.hyperelastic:HyperelasticAdapter",
    "stress": "mosa.modules.adapters.stress:StressAdapter",
    "direct": "mosa.baselines.direct:DirectAdapter",
    "nclaw": "mosa.baselines.nclaw:NeuralLaw",
    "neuma": "mosa.baselines.neuma:LowRankLaw",
    "interaction": "mosa.baselines.interaction:InteractionNetwork",
}
"""adapter.name -> module:class. A new adapter is one class whose keyword arguments are the keys of its YAML, and one line here, or
a call of `register_adapter` from another package."""


def register_adapter(name: str, place: str) -> None:
    """Make an adapter known by the name in its YAML. place: module:class, imported when a configuration asks for it.

    Errors: ConfigError if another adapter has the name."""
    if ADAPTERS.setdefault(name, place) != place:
        raise ConfigError(f"adapter.name: {name!r} is there already; choose another name")


def adapter_class(config: Mapping[str, Any]) -> type[nn.Module] | None:
    """The class that `name` names, None where there is none. Errors: ConfigError naming the key."""
    name = config.get("name")
    if name is None:
        return None
    if not isinstance(name, str) or name not in ADAPTERS:
        raise ConfigError(
            f"adapter.name: expected {', '.join(ADAPTERS)} or null, found {name!r}; one of another package is known "
            "once that is imported (extensions)"
        )
    adapter: type[nn.Module] = imported(f"adapter.name: {name!r}", ADAPTERS[name])
    return adapter

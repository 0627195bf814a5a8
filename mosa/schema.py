"""Kinds of single values, and settings whose fields have one: `knob` writes default and kind of a field once.

The dataclass checks itself by them, the check of a configuration and of a checkpoint follows from them (`mosa.config.keys`).
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import field, fields
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

from mosa.errors import ConfigError

LARGEST, MOST = 1e20, 10**9
"""Of numbers and of whole numbers without limits of their own: single precision and an array's length hold them."""


class Kind(NamedTuple):
    """described: as it stands in a message after 'expected'; fits: whether a value is one."""

    described: str
    fits: Callable[[Any], bool]


def is_number(value: Any) -> bool:
    """A finite number that is no flag."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def number(low: float, high: float = math.inf, *, above: bool = False, below: bool = False) -> Kind:
    """From `low`, or `above` it, to `high`, or `below` it."""
    start = f"above {low:g}" if above else f"of at least {low:g}"
    limit = f" and {'below' if below else 'at most'} {high:g}" if math.isfinite(high) else ""
    return Kind(
        f"a number {start}{limit}",
        lambda v: (
            is_number(v)
            and (v > low or (v == low and not above))
            and (v < high or (v == high and not below))
        ),
    )


def whole(low: int, high: int | None = None) -> Kind:
    high = MOST if high is None else high
    return Kind(
        f"a whole number of at least {low} and at most {high}",
        lambda v: isinstance(v, int) and not isinstance(v, bool) and low <= v <= high,
    )


def one_of(*names: str) -> Kind:
    return Kind(" or ".join(names), lambda v: isinstance(v, str) and v in names)


def or_null(kind: Kind) -> Kind:
    return Kind(f"{kind.described}, or null", lambda v: v is None or kind.fits(v))


def or_auto(kind: Kind) -> Kind:
    return Kind(f"{kind.described}, or auto", lambda v: v == "auto" or kind.fits(v))


def is_sequence(value: Any) -> bool:
    """A sequence as scene.also_train and scene.test name it (mosa/data/sequences.py)."""
    return isinstance(value, str) or (
        isinstance(value, Mapping) and isinstance(value.get("path"), str)
    )


TEXT = Kind("a text", lambda v: isinstance(v, str))
FOLDER = Kind("a folder", lambda v: isinstance(v, str) and bool(v.strip()))
FLAG = Kind("true or false", lambda v: isinstance(v, bool))
NAMES = Kind(
    "a list of names like [a, b]",
    lambda v: isinstance(v, list) and all(isinstance(name, str) for name in v),
)
SEQUENCES = Kind(
    "a list of names or folders like [a, b], or of sections like {path: a, frames: [0, 9]}",
    lambda v: isinstance(v, list) and all(map(is_sequence, v)),
)
SECTION = Kind("a section of keys", lambda v: isinstance(v, Mapping))
ENTRIES = Kind(
    "a list of sections",
    lambda v: isinstance(v, list) and all(isinstance(entry, Mapping) for entry in v),
)
THREE = Kind(
    "three numbers", lambda v: isinstance(v, list) and len(v) == 3 and all(map(is_number, v))
)
PLACE = Kind("three numbers, null for one that is left as it is",
             lambda v: isinstance(v, list) and len(v) == 3 and all(x is None or is_number(x) for x in v))  # fmt: skip
TURN = Kind(
    "four numbers, an axis and degrees",
    lambda v: isinstance(v, list) and len(v) == 4 and all(map(is_number, v)),
)
POSITIVE, WEIGHT, COUNT = number(0, LARGEST, above=True), number(0, LARGEST), whole(1)
WIDEST = 4096
"""Of a layer of a network: many times what any run has used, and far below what memory would not hold."""


def knob(default: Any, kind: Kind) -> Any:
    """A field of a settings dataclass."""
    return field(default=default, metadata={"kind": kind})


def kinds_of(settings: type, where: str) -> dict[str, Kind]:
    """Of the fields of a settings dataclass that have one, under `where`."""
    return {
        f"{where}.{f.name}": f.metadata["kind"] for f in fields(settings) if "kind" in f.metadata
    }


def check_knobs(settings: Any, where: str) -> None:
    """Every field is of its kind. Errors: ConfigError naming the first that is not, as a key below `where`."""
    values = {f.name: getattr(settings, f.name) for f in fields(settings)}
    check_kinds(
        values,
        {f.name: f.metadata["kind"] for f in fields(settings) if "kind" in f.metadata},
        where,
    )


def check_kinds(values: Mapping[str, Any], kinds: Mapping[str, Kind], where: str) -> None:
    """Every value that has a kind is of it. Errors: ConfigError naming the first that is not, as a key below `where`."""
    for name, value in values.items():
        if name in kinds and not kinds[name].fits(value):
            raise ConfigError(f"{where}.{name}: expected {kinds[name].described}, found {value!r}")


def arguments_of(build: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """What `build` can be given by name."""
    return {
        name: p
        for name, p in inspect.signature(build).parameters.items()
        if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
    }


def known_keys(
    where: str, build: Callable[..., Any], keys: Mapping[str, Any], *positional: Any
) -> Any:
    """build(*positional, **keys). Errors: ConfigError for a key that it does not take."""
    known = arguments_of(build)
    if unknown := [k for k in keys if k not in known]:
        raise ConfigError(
            f"{where}.{unknown[0]}: unknown key; expected one of {', '.join(list(known)[len(positional) :])}"
        )
    needed = [
        k
        for k, parameter in list(known.items())[len(positional) :]
        if parameter.default is parameter.empty
    ]
    if missing := [k for k in needed if k not in keys]:
        raise ConfigError(f"{where}.{missing[0]}: expected this key, found none")
    return build(*positional, **keys)


def check(values: Mapping[str, Any], *schemas: Mapping[str, Kind]) -> None:
    """Every value of a nested configuration that a schema knows is of its kind. Patterns stand for one level each.

    Errors: ConfigError with the key, what was expected and what was found, for the first that is not.
    """
    kinds = {pattern: kind for schema in schemas for pattern, kind in schema.items()}
    _check(values, kinds, ())


def _check(values: Mapping[str, Any], kinds: Mapping[str, Kind], path: tuple[str, ...]) -> None:
    for key, value in values.items():
        here = (*path, str(key))
        for pattern, kind in kinds.items():
            parts = pattern.split(".")
            if (
                len(parts) == len(here)
                and all(map(fnmatchcase, here, parts))
                and not kind.fits(value)
            ):
                raise ConfigError(f"{'.'.join(here)}: expected {kind.described}, found {value!r}")
        if isinstance(value, Mapping):
            _check(value, kinds, here)

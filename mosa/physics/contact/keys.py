"""What each key of a collider's entry may be: numbers are finite, lengths positive, lists as long as they should be."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal

from annotated_types import Interval

from mosa.errors import ConfigError
from mosa.physics.contact.planes import MODES
from mosa.settings import Expected, Section, Text, Weight, described, is_number, such
from mosa.settings import fits as is_one

FARTHEST = 1e6
"""Lengths and places [m] of a solid, and its speeds [m/s]: beyond, single precision has no centimetres left."""


def listed(value: Any) -> Any:
    """Plain lists of what may be a tensor, an array or a tuple."""
    value = value.tolist() if hasattr(value, "tolist") else value
    return list(value) if isinstance(value, tuple) else value


def told(text: str, valid: Callable[[Any], bool]) -> Any:
    """A type of which `valid` says what it is."""
    return Annotated[Any, Expected(text), such(valid)]


def numbers(count: int, further: Callable[[list], bool] = lambda v: True) -> Callable[[Any], bool]:
    return lambda v: (
        isinstance(listed(v), list)
        and len(listed(v)) == count
        and all(is_number(x) and abs(x) <= FARTHEST for x in listed(v))
        and further(listed(v))
    )


def rows(valid: Callable[[Any], bool], least: int = 1) -> Callable[[Any], bool]:
    return lambda v: (
        isinstance(listed(v), list) and len(listed(v)) >= least and all(map(valid, listed(v)))
    )


three = numbers(3)
Length = Annotated[float, Interval(gt=0, le=FARTHEST)]
Three = told(f"three finite numbers within {FARTHEST:g}", three)
Turn = told(
    "(ax, ay, az, degrees), four finite numbers with a non-zero axis",
    numbers(4, lambda v: any(v[:3])),
)
Velocity = told(
    f"three finite numbers within {FARTHEST:g}, or such a triple for each piece",
    lambda v: three(v) or rows(three)(v),
)
KEYS = {
    "radius": Length, "length": Length, "size": told("three lengths above 0 [m]", numbers(3, lambda v: min(v) > 0)),
    "path": Text, "spacing": Length, "scale": Length,
    "margin": Annotated[float, Interval(ge=0, le=FARTHEST)],
    "mode": Literal[tuple(MODES)], "friction": Weight, "name": Text, "position": Three, "rotation": Turn,
    "motion": Section, "normal": told("a non-zero vector of three finite numbers", numbers(3, any)),
}  # fmt: skip
MOTION = {
    "velocity": Velocity, "angular_velocity": Velocity,
    "times": told("ascending finite numbers",
                  lambda v: rows(is_number)(v) and all(a < b for a, b in zip(listed(v), listed(v)[1:]))),
    "waypoints": told("a list of poses {time, position, rotation}", rows(lambda v: isinstance(v, Mapping), 0)),
}  # fmt: skip
WAYPOINT = {"time": told("a finite number", is_number), "position": Three, "rotation": Turn}


def check_keys(item: Mapping, where: str) -> None:
    """Errors: ConfigError naming the first key whose value is not of its kind; keys without a value count as absent."""
    fits(item, KEYS, where)
    motion = item.get("motion") or {}
    fits(motion, MOTION, f"{where}.motion")
    for i, point in enumerate(motion.get("waypoints") or ()):
        at = f"{where}.motion.waypoints[{i}]"
        if missing := [key for key in ("time", "position") if point.get(key) is None]:
            raise ConfigError(
                f"{at}: expected time and position in each, found one without {missing[0]!r}"
            )
        if unknown := [key for key in point if key not in WAYPOINT]:
            raise ConfigError(
                f"{at}.{unknown[0]}: unknown key; expected one of {', '.join(WAYPOINT)}"
            )
        fits(point, WAYPOINT, at)


def fits(values: Mapping, kinds: Mapping[str, Any], where: str) -> None:
    """Errors: ConfigError naming the first value that is not of its kind."""
    for key, kind in kinds.items():
        if values.get(key) is not None and not is_one(kind, values[key]):
            raise ConfigError(
                f"{where}.{key}: expected {described(kind)}, found {str(values[key])[:120]!r}"
            )

"""What each key of a collider's entry may be: numbers are finite, lengths positive, lists as long as they should be."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal

from annotated_types import Interval

from mosa.physics.contact.planes import MODES
from mosa.settings import (  # fmt: skip
    Expected,
    Number,
    Section,
    Settings,
    Text,
    Weight,
    check_values,
    is_number,
    such,
)

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
Three = Annotated[Any, Expected(f"three finite numbers within {FARTHEST:g}"), such(three)]
Turn = Annotated[Any, Expected("(ax, ay, az, degrees), four finite numbers with a non-zero axis"),
                 such(numbers(4, lambda v: any(v[:3])))]  # fmt: skip
Velocity = Annotated[Any, Expected(f"three finite numbers within {FARTHEST:g}, or such a triple for each piece"),
                     such(lambda v: three(v) or rows(three)(v))]  # fmt: skip
Times = Annotated[Any, Expected("ascending finite numbers"),
                  such(lambda v: rows(is_number)(v) and all(a < b for a, b in zip(listed(v), listed(v)[1:])))]  # fmt: skip
Poses = Annotated[Any, Expected("two poses {time, position, rotation} or more"),
                  such(rows(lambda v: isinstance(v, Mapping), 2))]  # fmt: skip
KEYS = {
    "radius": Length, "length": Length, "size": told("three lengths above 0 [m]", numbers(3, lambda v: min(v) > 0)),
    "path": Text, "spacing": Length, "scale": Length,
    "margin": Annotated[float, Interval(ge=0, le=FARTHEST)],
    "mode": Literal[tuple(MODES)], "friction": Weight, "name": Text, "position": Three, "rotation": Turn,
    "motion": Section, "normal": told("a non-zero vector of three finite numbers", numbers(3, any)),
}  # fmt: skip


class Waypoint(Settings):
    """A pose of a motion's waypoints."""

    time: Number
    position: Three
    rotation: Turn | None = None


class MotionKeys(Settings):
    """An entry's motion; values without one count as absent."""

    velocity: Velocity | None = None
    angular_velocity: Velocity | None = None
    times: Times | None = None
    waypoints: Poses | None = None


def check_keys(item: Mapping, where: str) -> None:
    """Errors: ConfigError naming the first key whose value is not of its kind; keys without a value count as absent."""
    check_values({key: value for key, value in item.items() if value is not None}, KEYS, where)
    motion = MotionKeys.read(item.get("motion") or {}, f"{where}.motion")
    for i, point in enumerate(motion.waypoints or ()):
        Waypoint.read(point, f"{where}.motion.waypoints[{i}]")

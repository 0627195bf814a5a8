"""What each key of a collider's entry may be: numbers are finite, lengths positive, lists as long as they should be."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from mosa.errors import ConfigError
from mosa.physics.contact.planes import MODES
from mosa.schema import SECTION, WEIGHT, Kind, is_number, number, one_of

FARTHEST = 1e6
"""Lengths and places [m] of a solid, and its speeds [m/s]: beyond, single precision has no centimetres left."""


def listed(value: Any) -> Any:
    """Plain lists of what may be a tensor, an array or a tuple."""
    value = value.tolist() if hasattr(value, "tolist") else value
    return list(value) if isinstance(value, tuple) else value


def numbers(described: str, count: int, further: Callable[[list], bool] = lambda v: True) -> Kind:
    return Kind(
        described,
        lambda v: (
            isinstance(listed(v), list)
            and len(listed(v)) == count
            and all(is_number(x) and abs(x) <= FARTHEST for x in listed(v))
            and further(listed(v))
        ),
    )


def either(described: str, *kinds: Kind) -> Kind:
    return Kind(described, lambda v: any(kind.fits(v) for kind in kinds))


def rows(kind: Kind, described: str, least: int = 1) -> Kind:
    return Kind(
        described,
        lambda v: (
            isinstance(listed(v), list)
            and len(listed(v)) >= least
            and all(map(kind.fits, listed(v)))
        ),
    )


TEXT = Kind("a text", lambda v: isinstance(v, str))
LENGTH = number(0, FARTHEST, above=True)
THREE = numbers(f"three finite numbers within {FARTHEST:g}", 3)
TURN = numbers(
    "(ax, ay, az, degrees), four finite numbers with a non-zero axis", 4, lambda v: any(v[:3])
)
VELOCITY = either(
    f"three finite numbers within {FARTHEST:g}, or such a triple for each piece",
    THREE,
    rows(THREE, ""),
)
RISING = rows(Kind("", is_number), "")
KEYS = {
    "radius": LENGTH, "length": LENGTH, "size": numbers("three lengths above 0 [m]", 3, lambda v: min(v) > 0),
    "path": TEXT, "spacing": LENGTH, "scale": LENGTH, "margin": number(0, FARTHEST), "mode": one_of(*MODES),
    "friction": WEIGHT, "name": TEXT, "position": THREE, "rotation": TURN, "motion": SECTION,
    "normal": numbers("a non-zero vector of three finite numbers", 3, any),
}  # fmt: skip
MOTION = {
    "velocity": VELOCITY, "angular_velocity": VELOCITY,
    "times": Kind("ascending finite numbers",
                  lambda v: RISING.fits(v) and all(a < b for a, b in zip(listed(v), listed(v)[1:]))),
    "waypoints": rows(SECTION, "a list of poses {time, position, rotation}", 0),
}  # fmt: skip
WAYPOINT = {"time": Kind("a finite number", is_number), "position": THREE, "rotation": TURN}


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


def fits(values: Mapping, kinds: Mapping[str, Kind], where: str) -> None:
    """Errors: ConfigError naming the first value that is not of its kind."""
    for key, kind in kinds.items():
        if values.get(key) is not None and not kind.fits(values[key]):
            raise ConfigError(
                f"{where}.{key}: expected {kind.described}, found {str(values[key])[:120]!r}"
            )

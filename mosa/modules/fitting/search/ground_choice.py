"""Which contact with the ground is taken, of the distances that `ground_search` found. Reports read it too."""

from __future__ import annotations

import math
from collections.abc import Mapping

from mosa.types import RUBBING, Ground

NEARER = 0.9
"""Of the distance of the body that sticks, which another contact has to come below to be taken."""
EXPLAINED = 5.0
"""By so much of minus the logarithm of the posterior another contact has to explain the motion better, about the learned law, for
the fit to begin again on it."""


def named(ground: Ground) -> str:
    """A contact in words, as figures have it: sticky, or separate_0.4 and touch_0.4 with its friction."""
    return f"{ground.mode}_{ground.friction:.3g}" if ground.mode in RUBBING else ground.mode


def contact(name: str) -> tuple[str, float]:
    """(mode, friction) of a contact by `named`."""
    mode, _, friction = name.partition("_")
    return mode, float(friction or 0.0)


def taken_of(distances: Mapping[str, float]) -> str:
    """The contact that is taken, of distances [m] by `named`."""
    nearest = min(distances, key=distances.get)
    return nearest if distances[nearest] < NEARER * distances["sticky"] else "sticky"


def alike(distances: Mapping[str, float], mode: str) -> list[float]:
    """Frictions of a mode, of distances [m] by `named`, that come about as near (by `NEARER`) as the nearest of all contacts with
    friction, in order: the isotropic law does not tell them apart. Empty where none does."""
    sliding = {
        name: distance
        for name, distance in distances.items()
        if contact(name)[0] in RUBBING and math.isfinite(distance)
    }
    least = min(sliding.values(), default=math.inf)
    return sorted(friction for name, distance in sliding.items() for of, friction in [contact(name)]
                  if of == mode and NEARER * distance <= least)  # fmt: skip


def rivals_of(distances: Mapping[str, float]) -> list[tuple[str, float]]:
    """(mode, friction) of the contacts that may explain the learned law's motion better than sticking, of distances [m] by `named`:
    of each mode the roughest of those that are `alike`, as no sliding is seen where more friction changes nothing. Empty where a
    body that slides was taken, or no other can be simulated."""
    if taken_of(distances) != "sticky":
        return []
    return [(mode, max(frictions)) for mode in RUBBING if (frictions := alike(distances, mode))]


def learned_on(taken: str, gains: Mapping[str, float]) -> str:
    """The contact that a law is learned on in the end, by `named`: the best of those that the learned law was asked for where it
    explains the motion better than the one that was taken, by `EXPLAINED` at least, or by less where it is another friction of the
    same mode, as how a body slides hardly moves its law."""
    best = max(gains, key=gains.get)
    needed = 0.0 if contact(best)[0] == contact(taken)[0] else EXPLAINED
    return best if gains[best] > needed else taken

"""How a body and its ground touch, where nobody knows: the contact with which a calibrated law comes nearest to the motion.

Free rollouts tell a body that slides, as friction shows in where it goes afterwards. Whether one that hardly slides sticks, or
leaves the ground freely, an isotropic law cannot tell: its own mistakes are as large. The learned law can, when the fit has ended
(docs/identification.md#how-the-ground-is-touched).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from typing import Protocol

from mosa.errors import SimulationDiverged
from mosa.modules.body import Body
from mosa.progress import tqdm
from mosa.types import Ground

FRICTIONS = (0.15, 0.3, 0.6, 1.2)
"""Coulomb's coefficients of bodies that leave the ground freely, each twice the one before: cloth on steel to rubber on a table."""
BETWEEN = 2**0.5
"""The friction that explains the motion best is sought once more, this factor below and above."""
NEARER = 0.9
"""Of the distance of the body that sticks, which another contact has to come below to be taken."""
EXPLAINED = 5.0
"""By so much of minus the logarithm of the posterior another contact has to explain the motion better, about the learned law, for
the fit to begin again on it."""
TRIED = 3
"""Iterations of each calibration after the first, from that one's numbers on: how a body slides hardly moves its moduli."""
RIVAL_ITERATIONS = 3
"""In which a learned law is fitted to another contact, before the two are compared."""


class Calibration(Protocol):
    """What is asked of the identification (`identification.py`) that calibrates a body on a ground."""

    def search(self) -> float:
        """`search` of it."""

    def iterate(self) -> dict[str, float]:
        """One iteration of Gauss-Newton."""

    def distance(self) -> float:
        """Mean distance [m] of free rollouts from the cues."""


def named(ground: Ground) -> str:
    """A contact in words, as figures have it: sticky, or separate_0.4 with its friction."""
    return f"{ground.mode}_{ground.friction:.3g}" if ground.mode == "separate" else ground.mode


def taken_of(distances: Mapping[str, float]) -> str:
    """The contact that is taken, of distances [m] by `named`."""
    nearest = min(distances, key=distances.get)
    return nearest if distances[nearest] < NEARER * distances["sticky"] else "sticky"


def rival_of(distances: Mapping[str, float]) -> float | None:
    """Friction of the contact that may explain the learned law's motion better than sticking, of distances [m] by `named`: the
    roughest of those that leave the ground and are about as near as the nearest of them, as no sliding is seen where more friction
    changes nothing. None where a body that slides was taken, or no other can be simulated."""
    sliding = {float(name.removeprefix("separate_")): distance for name, distance in distances.items() if name != "sticky"}
    least = min(sliding.values(), default=math.inf)
    if taken_of(distances) != "sticky" or not math.isfinite(least):
        return None
    return max(friction for friction, distance in sliding.items() if NEARER * distance <= least)


def choose_ground(
    body: Body, height: float, calibration: Callable[[Ground], Calibration]
) -> tuple[Ground, dict[str, float]]:
    """(ground, mean distance [m] of every contact that was tried by `named`, infinite where it cannot be simulated); `body` is left
    calibrated on it.

    height [m]: of the ground; calibration: of the body on a ground. The body that sticks is calibrated first, with the search of a
    calibration; it is what is taken unless another contact is nearer by `NEARER`. Errors: SimulationDiverged where it cannot be.
    """
    found: dict[Ground, tuple[float, dict]] = {}

    def attempt(ground: Ground, searching: bool = False) -> float:
        running = calibration(ground)
        if searching:
            running.search()
        for _ in range(TRIED):
            running.iterate()
        found[ground] = running.distance(), numbers_of(body)
        return found[ground][0]

    sticky = Ground(height, "sticky")
    attempt(sticky, searching=True)

    def slide(friction: float) -> float:
        ground = Ground(height, "separate", friction)
        write(body, found[sticky][1])
        try:
            return attempt(ground)
        except SimulationDiverged:
            found[ground] = math.inf, {}
            return math.inf

    sliding = {friction: slide(friction) for friction in tqdm(FRICTIONS, "contact with the ground", leave=False)}
    nearest = min(sliding, key=sliding.get)
    if sliding[nearest] < NEARER * found[sticky][0]:
        for friction in (nearest / BETWEEN, nearest * BETWEEN):
            slide(friction)
    distances = {named(ground): distance for ground, (distance, _) in found.items()}
    best = next(ground for ground in found if named(ground) == taken_of(distances))
    write(body, found[best][1])
    return best, distances


def numbers_of(body: Body) -> dict[str, dict]:
    """What a calibration learns of a body, as it is now."""
    return {part: copy.deepcopy(getattr(body, part).state_dict()) for part in ("material", "contact")}


def write(body: Body, numbers: dict[str, dict]) -> None:
    """Set the body to `numbers_of` one."""
    for part, state in numbers.items():
        getattr(body, part).load_state_dict(state)

"""How a body and its ground touch, where nobody knows: the contact with which a calibrated law comes nearest to the motion.

Free rollouts tell a body that slides, as friction shows in where it goes afterwards. Whether one that hardly slides sticks, or
leaves the ground freely, an isotropic law cannot tell, nor with what friction it slides: its own mistakes are as large. The learned
law can, when the fit has ended (docs/uncertainty.md#how-the-ground-is-touched). Nor is it known whether a body meets it at its
surface (`touch`), as one of finite elements, or at a grid's nodes (`separate`): both are tried.

So a contact is chosen twice: by `choose_ground` with the isotropic law, before anything else is learned, and by `gains_of_contacts`
and `learned_on` with the learned one. Contacts have names (`named`), by which reports read their figures."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from mosa.errors import SimulationDiverged
from mosa.modules.body.body import Body
from mosa.modules.fitting.search.backbone import calibrate_as, calibrated
from mosa.system.progress import tqdm
from mosa.types import RUBBING, Ground

if TYPE_CHECKING:
    from mosa.modules.fitting.identification import Identification

FRICTIONS = (0.15, 0.3, 0.6, 1.2)
"""Coulomb's coefficients of bodies that leave the ground freely, each twice the one before: cloth on steel to rubber on a table."""
BETWEEN = 2**0.5
"""The friction that explains the motion best is sought once more, this factor below and above."""
TRIED = 3
"""Iterations of each calibration after the first, from that one's numbers on: how a body slides hardly moves its moduli."""
RIVAL_ITERATIONS = 3
"""In which a learned law is fitted to another contact, before the two are compared."""
ASKED = 4
"""Contacts that a learned law is usually fitted further on: its own, and one or two others where the body sticks, up to seven where
it slides."""
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
    finite = {name: distance for name, distance in distances.items() if math.isfinite(distance)}
    sliding = {name: finite[name] for name in finite if contact(name)[0] in RUBBING}
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


def better_friction(own: float, gain: Callable[[float], float]) -> tuple[float, float]:
    """(friction other than `own`, its gain): the one that gains most of those that are tried, halves or doubles for as long as they
    gain more, then once between (`BETWEEN`). gain: of a friction over `own`."""
    gains = {own: 0.0}

    def improves(friction: float) -> bool:
        before = max(gains.values())
        gains[friction] = gain(friction)
        return gains[friction] > before

    for factor in (0.5, 2.0):
        friction = own * factor
        while FRICTIONS[0] / 2 <= friction <= FRICTIONS[-1] * 2 and improves(friction):
            friction *= factor
        if max(gains.values()) > 0:
            break
    nearest = max(gains, key=gains.get)
    if nearest != own and not improves(nearest / BETWEEN):
        improves(nearest * BETWEEN)
    del gains[own]
    best = max(gains, key=gains.get)
    return best, gains[best]


def choose_ground(
    body: Body, known: Ground, calibration: Callable[[Ground], Identification]
) -> tuple[Ground, dict[str, float]]:
    """(ground, mean distance [m] of every contact that was tried by `named`, infinite where it cannot be simulated); `body` is left
    calibrated on it.

    known: height of the ground and its accuracy; calibration: of the body on a ground. The body that
    sticks is calibrated first, with the search of a calibration; it is taken unless another contact
    is clearly nearer (`taken_of`). Errors: SimulationDiverged where it cannot be simulated."""
    distances: dict[str, float] = {}
    grounds: dict[str, Ground] = {}
    numbers: dict[str, dict] = {}

    def attempt(ground: Ground, searching: bool = False) -> None:
        name, running = named(ground), calibration(ground)
        grounds[name], distances[name] = ground, math.inf
        if searching:
            running.search()
        for _ in range(TRIED):
            running.iterate()
        distances[name], numbers[name] = running.distance(), calibrated(body)

    def slide(ground: Ground) -> None:
        calibrate_as(body, numbers["sticky"])
        try:
            attempt(ground)
        except SimulationDiverged:
            pass  # its distance says so

    attempt(replace(known, mode="sticky", friction=0.0), searching=True)
    for mode, friction in tqdm(
        list(itertools.product(RUBBING, FRICTIONS)), "contact with the ground", leave=False
    ):
        slide(replace(known, mode=mode, friction=friction))
    if (nearest := taken_of(distances)) != "sticky":
        for factor in (1 / BETWEEN, BETWEEN):
            slide(replace(grounds[nearest], friction=grounds[nearest].friction * factor))
    best = taken_of(distances)
    calibrate_as(body, numbers[best])
    return grounds[best], distances


def gains_of_contacts(
    found: Ground, distances: Mapping[str, float], running: Any, fitted: Callable[[Ground], tuple[float, Any]]
) -> tuple[dict[Ground, float], Any]:  # fmt: skip
    """(by how much other contacts explain the motion better about the learned law than `found`, the fit on the best of them); of
    minus the logarithm of the posterior, minus infinity where a body cannot be simulated, empty where `distances` name no rival.

    distances: of `choose_ground`; running: the fit on `found`; fitted: (cost, fit) on a ground, begun where that one stands."""
    slides, rivals = found.mode in RUBBING, rivals_of(distances)
    if not slides and not rivals:
        return {}, None
    # gone on for as long, as a fit gains by that wherever it goes on; as it stands where it cannot go on
    own = min(running.cost(), fitted(found)[0])
    gains: dict[Ground, float] = {}
    best: Any = None  # one fit is kept, as each has a body

    def gain(mode: str, friction: float) -> float:
        nonlocal best
        ground = replace(found, mode=mode, friction=friction)
        cost, fit = fitted(ground)
        if own - cost > max(gains.values(), default=-math.inf):  # of equals the first
            best = fit
        gains[ground] = own - cost
        return gains[ground]

    if not slides:
        for mode, friction in rivals:
            gain(mode, friction)
        return gains, best
    friction, most = better_friction(found.friction, partial(gain, found.mode))
    for mode in RUBBING:
        if mode != found.mode and alike(distances, mode):
            gain(mode, friction if most > 0 else found.friction)
    return gains, best

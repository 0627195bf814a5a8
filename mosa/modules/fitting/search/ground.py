"""How a body and its ground touch, where nobody knows: the contact with which a calibrated law comes nearest to the motion.

Free rollouts tell a body that slides, as friction shows in where it goes afterwards. Whether one that hardly slides sticks, or
leaves the ground freely, an isotropic law cannot tell, nor with what friction it slides: its own mistakes are as large. The learned
law can, when the fit has ended (docs/uncertainty.md#how-the-ground-is-touched). Nor is it known whether a body
meets it at its surface (`touch`), as one of finite elements, or at a grid's nodes (`separate`): both are tried.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

from mosa.errors import SimulationDiverged
from mosa.modules.body.body import Body
from mosa.modules.fitting.search.backbone import Calibration, calibrate_as, calibrated
from mosa.modules.fitting.search.ground_choice import named, taken_of
from mosa.system.progress import tqdm
from mosa.types import RUBBING, Ground

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
    body: Body, known: Ground, calibration: Callable[[Ground], Calibration]
) -> tuple[Ground, dict[str, float]]:
    """(ground, mean distance [m] of every contact that was tried by `named`, infinite where it cannot be simulated); `body` is left
    calibrated on it.

    known: height of the ground and its accuracy; calibration: of the body on a ground. The body that
    sticks is calibrated first, with the search of a calibration; it is taken unless another contact
    is clearly nearer (`taken_of`). Errors: SimulationDiverged where it cannot be simulated.
    """
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

"""Where a calibration begins: the best of a coarse grid, a compass search for laws of more numbers; which law is the backbone."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch

from mosa.errors import ConfigError, SimulationDiverged
from mosa.modules.body.body import Body
from mosa.modules.body.material import FORMS, STIFFNESS
from mosa.modules.fitting.search.yielding import LASTS
from mosa.physics.constitutive.laws import law_named
from mosa.system.progress import tqdm

Calibration = Any
"""An `identification.Identification`, whose module imports this one."""
STIFFNESS_STEPS = (0.3, 0.6, 1.0, 1.5, 2.2, 3.2, 4.5, 7.0)
OFFSET_STEPS = (-0.2, 0.05, 0.3, 0.55, 0.8)
POISSON_STEPS = (0.32, 0.2, 0.42)
"""Grid of the search: multiples of the configured stiffness, contact offsets [cells], and Poisson numbers, the middle one first."""
NEAREST, ENTERED = 6, 3
"""Places of that grid at which all Poisson numbers are tried; its valleys in which Gauss-Newton begins."""
CONTACT, YIELD = "contact", "yield_stress"
"""Names among the numbers of a start: of the contact offset; of what takes its place in that grid where a law has it. Beside a
yield stress far from the truth, the best stiffness is a wrong one."""
YIELD_STEP, YIELD_STEPS = 1.1, 2
"""Of its logarithm, a factor of 3; so many of them up and down."""
FURTHER, FURTHEST = 1.5, 100.0
"""Where the best lies at an end of the multiples, these go on by such a factor, up to so much of the configuration's stiffness. The
yield stress goes on alike, by its own factor."""
STRIDES = {
    **dict.fromkeys((*STIFFNESS, "yield_stress"), 1.1), **dict.fromkeys(("viscosity", "damping", "bulk_damping"), 1.6),
    "cohesion": 0.5, "nu": 0.8, "friction_angle": 0.8, CONTACT: 0.15,
}  # fmt: skip
"""First steps of a compass search in unconstrained parameters: a factor of 3 (of 5 in a viscosity), or 0.1 in the middle of nu's
range and 17 degrees in that of the angle's."""
FINEST = 0.2
"""Of the first steps: there a compass search ends, and Gauss-Newton goes on."""
MANY = 4
"""Learned numbers from which a law has several valleys (a stiff and viscous one beside a soft one that yields early): there
Gauss-Newton is begun at several starts, as a search in one number after the other goes down the wrong one."""
WIDE = (0.3, 1.0, 3.2)
"""Multiples of the stiffness among these starts, each with the numbers that are no stiffness `moved`."""
BEGUN, FIRST, KEPT, LAST = 6, 2, 3, 3
"""Of these starts the nearest, beside the end of the compass search; iterations of each; how many go on, and for how many more."""


def compass(
    at: Callable[[dict[str, float]], float], row: dict[str, float], strides: dict[str, float]
) -> dict[str, float]:
    """The place that a compass search of at() ends at, begun at `row`: a step up or down in one number at a time, where it
    improves, and smaller steps where none does."""
    best, share = at(row), 1.0
    while share > FINEST:
        moved = False
        for name, stride in strides.items():
            for sign in (1.0, -1.0):
                step = row | {name: row[name] + sign * share * stride}
                found = at(step)
                if found < best:
                    best, row, moved = found, step, True
                    break
        if not moved:
            share *= 0.5
    return row


def moved(learned: Sequence[str]) -> list[dict[str, float]]:
    """Steps of the numbers that are no stiffness and no Poisson number: none, or a first step of the compass up or down in one or
    in two of them. All combinations of many numbers were too many."""
    others = [name for name in learned if name not in STIFFNESS and name != "nu"]
    return [{name: sign * STRIDES.get(name, 1.0) for name, sign in zip(some, signs)} for count in range(3)
            for some in itertools.combinations(others, count) for signs in itertools.product((-1, 1), repeat=count)]  # fmt: skip


def valleys(found: Mapping[tuple[int, int], float]) -> list[tuple[int, int]]:
    """Finite places of a grid that are no higher than their eight neighbours, the lowest first."""
    beside = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
    low = [place for place, value in found.items() if math.isfinite(value)
           and all(value <= found.get((place[0] + i, place[1] + j), math.inf) for i, j in beside)]  # fmt: skip
    return sorted(low, key=lambda place: found[place])


class Starts:
    """Places at which a calibration may start: unconstrained parameters by name, and their scores."""

    def __init__(self, calibration: Calibration) -> None:
        self.calibration, self.material = calibration, calibration.body.material
        self.learned, self._begins = self.material.learned, self.material.begins
        modulated = self.material.modulated
        self.modulated = [n for n in STIFFNESS if n in self.learned and n in modulated]
        self.yields = YIELD in self.learned and len(self.learned) < MANY
        self._scores: dict[tuple[float, ...], float] = {}
        self.failed: Exception | None = None  # of a start that cannot be simulated
        seats, body = len(calibration.newton.seats), calibration.body
        self._bodies = [*(copy.deepcopy(body) for _ in range(seats - 1)), body]

    def row(
        self, multiple: float, nu: float | None, further: Mapping[str, float]
    ) -> dict[str, float]:
        """Of a multiple of the stiffness, a Poisson number, None where it stays, and `further` numbers."""
        shift = math.log(multiple)
        row = {n: self._begins[n] + shift * (n in self.modulated) for n in self.learned}
        return row | ({} if nu is None else {"nu": FORMS["nu"].inverse(nu)}) | further

    def columns(self) -> dict[int, dict[str, float]]:
        """Of the grid, beside the stiffness: yield stresses of a law that has one and fewer than `MANY` numbers, or offsets."""
        if self.yields:
            return {j: self.yielding(j) for j in range(-YIELD_STEPS, YIELD_STEPS + 1)}
        cells = self.calibration.offsets
        return dict(enumerate({} if each is None else {CONTACT: each} for each in cells))

    def yielding(self, step: int) -> dict[str, float]:
        """So many steps from the configured yield stress."""
        return {YIELD: self._begins[YIELD] + step * YIELD_STEP}

    @torch.no_grad()
    def begin_at(self, row: dict[str, float], body: Body | None = None) -> None:
        """Set the numbers of the calibration's body, or of another one."""
        body = self.calibration.body if body is None else body
        for name, value in row.items():
            (body.contact.cells if name == CONTACT else body.material.raw[name]).fill_(value)

    def score(self, row: dict[str, float]) -> float:
        """[m], infinite where the body cannot be simulated there."""
        return self.scores([row])[0]

    def scores(self, rows: Sequence[dict[str, float]]) -> list[float]:
        """`score` of each, on as many threads as the calibration has seats."""
        new = {key: row for row in rows if (key := tuple(row.values())) not in self._scores}
        with ThreadPoolExecutor(len(self._bodies)) as pool:
            found = pool.map(self._tried, new.values())
            self._scores |= dict(zip(new, found))
        return [self._scores[tuple(row.values())] for row in rows]

    def _tried(self, row: dict[str, float]) -> float:
        body = self._bodies.pop()
        try:
            self.begin_at(row, body)
            return self.calibration.score(body=body)
        except (SimulationDiverged, ConfigError) as error:
            self.failed = error
            return math.inf
        finally:
            self._bodies.append(body)


def search(calibration: Calibration) -> float:
    """Start a calibration near the smallest score [m], which is returned.

    The deepest valleys of a coarse grid (`rows_of_grid`) come first; where there are several, Gauss-Newton begins in each, and the
    deepest after a few iterations is entered. Laws with parameters that the grid has not go on by a compass search in all of them
    (Kolda, Lewis, Torczon, SIAM Review 45, 2003), laws of `MANY` numbers by Gauss-Newton from its end and from other starts
    (`nearest_end`). Errors: those of `rows_of_grid` and `nearest_end`."""
    starts = Starts(calibration)
    columns, learned = starts.columns(), starts.learned
    rows = rows_of_grid(starts, columns)
    row, further = rows[0], set(learned) - {"E", "nu", *columns[0]}
    if further:
        row = compass(starts.score, row, {n: STRIDES.get(n, 1.0) for n in row})
    if len(learned) >= MANY:
        multiples = WIDE if starts.modulated else (1.0,)
        contact = {name: row[name] for name in (CONTACT,) if name in row}
        stiffnesses = [starts.row(m, None, contact) for m in multiples]
        moves = [(each, steps) for each in stiffnesses for steps in moved(learned)]
        wide = [each | {n: each[n] + step for n, step in steps.items()} for each, steps in moves]
        starts.scores(wide)
        begun = [row, *sorted(wide, key=starts.score)[:BEGUN]]
        return nearest_end(calibration, starts.begin_at, begun)
    if len(rows) > 1 and not further:
        return nearest_end(calibration, starts.begin_at, rows, kept=0)
    starts.begin_at(row)
    return starts.score(row)


def rows_of_grid(starts: Starts, columns: dict[int, dict[str, float]]) -> list[dict[str, float]]:
    """The deepest valleys, at most `ENTERED`, the lowest first, of a grid of stiffness and `columns`.

    It is searched at a middle Poisson number, further where its best is at an end of the stiffness or of the yield stress; the
    other Poisson numbers at the `NEAREST` best places. Errors: SimulationDiverged where none can be simulated."""
    middle, *others = POISSON_STEPS if "nu" in starts.learned else (None,)
    multiples = dict(enumerate(STIFFNESS_STEPS)) if starts.modulated else {0: 1.0}
    columns = dict(columns)
    grid: dict[tuple[int, int], float] = {}

    def add(some: Iterable[int], others: Iterable[int]) -> None:
        places = list(itertools.product(some, others))
        rows = [starts.row(multiples[i], middle, columns[j]) for i, j in places]
        grid.update(zip(places, starts.scores(rows)))

    def best() -> tuple[int, int]:
        """Of equal ones that with the lowest yield stress: higher ones that the motion does not reach tell nothing."""
        return min(grid, key=lambda place: (grid[place], place[1]))

    def beyond(axis: Mapping[int, Any], place: int) -> int | None:
        """The next place of an axis whose end this is."""
        return {min(axis): place - 1, max(axis): place + 1}.get(place)

    add(multiples, columns)
    while math.isfinite(grid[best()]):
        i, j = best()
        row = beyond(multiples, i) if starts.modulated else None
        column = beyond(columns, j) if starts.yields else None
        if row is not None and 1 / FURTHEST < (m := multiples[i] * FURTHER ** (row - i)) < FURTHEST:
            multiples[row] = m
            add([row], columns)
        elif column is not None and abs(column) * YIELD_STEP < math.log(FURTHEST):
            columns[column] = starts.yielding(column)
            add(multiples, [column])
        else:
            break
    if not math.isfinite(grid[best()]):
        raise SimulationDiverged(
            "fit.prior: none of the starts of the coarse grid can be simulated; set prior.parameters "
            f"nearer to the body's, or raise simulation.max_substeps ({starts.failed})"
        )
    numbers: dict[tuple[int, int], float | None] = {place: middle for place in grid}
    nearest = sorted(grid, key=grid.__getitem__)[:NEAREST]
    tried = [(place, nu) for place in nearest for nu in others]
    rows = [starts.row(multiples[i], nu, columns[j]) for (i, j), nu in tried]
    for (place, nu), found in zip(tried, starts.scores(rows)):
        if found < grid[place]:
            grid[place], numbers[place] = found, nu
    deepest = valleys(grid)[:ENTERED]
    return [starts.row(multiples[i], numbers[i, j], columns[j]) for i, j in deepest]


def nearest_end(
    calibration: Calibration,
    start_at: Callable[[dict[str, float]], None],
    rows: Sequence[dict[str, float]],
    kept: int = KEPT,
) -> float:
    """Gauss-Newton from several starts, the nearest `kept` of which after a few iterations go on.

    The calibration is left at the nearest end, as if it had not begun, and its score [m] is returned. Starts that cannot be
    simulated are left out; the error of the first is raised where none of them can."""
    body = calibration.body
    begun, here = calibration.state(), calibrated(body)
    ends: list[tuple[float, dict[str, dict], dict]] = []
    failed: SimulationDiverged | ConfigError | None = None
    for row in tqdm(rows, "starts of the calibration", leave=False):
        calibrate_as(body, here)  # the contact too
        start_at(row)
        try:
            ends.append(went_on(calibration, begun, FIRST))
        except (SimulationDiverged, ConfigError) as error:
            failed = failed or error
    if not ends and failed is not None:
        raise failed
    ends.sort(key=lambda end: end[0])
    for end in tqdm(ends[:kept], "the nearest of them", leave=False):
        calibrate_as(body, end[1])
        try:
            ends.append(went_on(calibration, end[2], LAST))
        except (SimulationDiverged, ConfigError):
            continue  # it stays where it was
    distance, numbers, _ = min(ends, key=lambda end: end[0])
    calibrate_as(body, numbers)
    calibration.restore(begun)
    return distance


def went_on(
    calibration: Calibration, state: dict, iterations: int
) -> tuple[float, dict[str, dict], dict]:
    """(score [m], numbers of the body, state) after further iterations. Errors: those of an iteration."""
    calibration.restore(state)
    for _ in range(iterations):
        calibration.iterate()
    return calibration.score(), calibrated(calibration.body), calibration.state()


def calibrated(body: Body) -> dict[str, dict]:
    """What a calibration learns of a body, as it is now."""
    return {
        part: copy.deepcopy(getattr(body, part).state_dict()) for part in ("material", "contact")
    }


def calibrate_as(body: Body, numbers: Mapping[str, dict]) -> None:
    """Set the body to `calibrated` numbers."""
    for part, state in numbers.items():
        getattr(body, part).load_state_dict(state)


TRIED = 4
"""Iterations after which candidates for the backbone are compared: from the best start of the grid they hardly move later."""


BETTER = 0.95
"""With a yield stress that the motion does not reach von Mises is an elastic law, and both have the same error. Of a letter of a
liquid and a trophy of sand, elastic laws soft enough to flow through the film have 1.2 times the true law's error."""


def choose_law(
    body: Body,
    candidates: Sequence[str],
    build: Callable[[], Calibration],
    lasts: Callable[[], float],
) -> dict[str, float]:
    """Calibrate candidates and leave `body` at the chosen one. Returns their errors of prediction [m], all by the elastic laws'
    criterion; infinite where a law cannot be simulated.

    The elastic law with the smallest error is chosen. Where the body stays deformed, or none can be simulated, laws that yield or
    flow are calibrated too, and the best of them is chosen if its error is below `BETTER` of the elastic one's.

    build: a calibration of `body`; lasts: the share of its change of shape that stays (`yielding`). Errors: SimulationDiverged
    where no law can be simulated."""
    errors: dict[str, float] = {}
    ends: dict[str, dict[str, dict]] = {}
    begun, gains = calibrated(body), None
    yielding = [law for law in candidates if not law_named(law).elastic]

    def best_of(laws: Sequence[str]) -> str | None:
        """Calibrates these; the best one, which `body` then is."""
        nonlocal gains
        for law in laws:
            body.material.law = law
            calibrate_as(body, begun)
            calibration, errors[law] = build(), math.inf
            try:
                calibration.search()
                for _ in range(TRIED):
                    calibration.iterate()
                gains = gains or calibration.gains
                errors[law] = calibration.score(gains)
            except SimulationDiverged:
                continue
            ends[law] = calibrated(body)
        best = min((law for law in laws if law in ends), key=errors.__getitem__, default=None)
        if best is not None:
            body.material.law = best
            calibrate_as(body, ends[best])
        return best

    best = best_of([law for law in candidates if law not in yielding])
    if yielding and (best is None or lasts() > LASTS):
        other = best_of(yielding)
        if best is None or (other is not None and errors[other] < BETTER * errors[best]):
            best = other
    if best is None:
        raise SimulationDiverged(
            f"prior=auto: none of {', '.join(candidates)} can be calibrated; set prior.parameters nearer "
            "to the body's"
        )
    body.choose(best)
    calibrate_as(body, ends[best])
    return errors

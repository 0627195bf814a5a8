"""Stress-strain tests as csv: one row for each measured state, homogeneous deformation, nominal or true stress.

    test,mode,angle,first,second,stress_1,stress_2,sd_1,sd_2
    tension,uniaxial x,0,1.05,,3.1,,,
    strip,biaxial xy,0,1.05,1.0,3.4,1.2,0.2,0.1
    block,shear xy,0,0.2,,0.5,,,

test: any name, rows of one name are one curve (or two) and are left out together. mode: `uniaxial a` (first: the stretch along axis
a, the other two faces free), `biaxial ab` (first and second: the stretches along a and b, the third face free; planar tension is
second = 1, equibiaxial second = first), `shear ab` (first: gamma; the face of normal a slides along b). stress_1, stress_2:
force over the undeformed area, or the area now, along the first and the second axis, of shear along b; an empty cell was not
measured. sd_1, sd_2: their standard deviations, of all rows or of none. angle [degrees]: of the specimen's x axis from the
material's, about z. The columns angle, second, stress_2, sd_1 and sd_2 may be left out."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from warnings import warn

import numpy as np

from mosa.data.io.tables import read_table
from mosa.errors import DataError
from mosa.physics.contact.colliders import warn_of_radians
from mosa.settings import LARGEST

UNITS = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6}
COLUMNS = ("test", "mode", "angle", "first", "second", "stress_1", "stress_2", "sd_1", "sd_2")
NEEDED = ("test", "mode", "first", "stress_1")
AXES = "xyz"
KINDS = {"uniaxial": 1, "biaxial": 2, "shear": 2}  # axes that a mode names


@dataclass(frozen=True)
class Measurements:
    """n states and m measured stresses. names: of the tests.

    test: (n,) which test; kind: (n,) names of `KINDS`; axes: (n, 2), the second -1 of `uniaxial`; angle: (n,) [rad]; given: (n, 2)
    stretches, or gamma and 0. row: (m,) the state of a stress; component: (m,) 0 or 1, the stress along the first or the second
    axis; value, sd: (m,) [Pa], sd NaN where none was given."""

    names: tuple[str, ...]
    test: np.ndarray
    kind: np.ndarray
    axes: np.ndarray
    angle: np.ndarray
    given: np.ndarray
    row: np.ndarray
    component: np.ndarray
    value: np.ndarray
    sd: np.ndarray

    def without(self, test: int) -> np.ndarray:
        """(m,) bool: the stresses of the other tests."""
        return self.test[self.row] != test

    def only(self, stresses: np.ndarray) -> Measurements:
        """Those `stresses` (m,) bool, and their states alone."""
        states, row = np.unique(self.row[stresses], return_inverse=True)
        parts = {k: getattr(self, k)[states] for k in ("test", "kind", "axes", "angle", "given")}
        parts |= {k: getattr(self, k)[stresses] for k in ("component", "value", "sd")}
        return replace(self, row=row, **parts)


def strained(data: Measurements) -> float:
    """The largest logarithm of a stretch, 0 of shears alone."""
    return float(np.abs(np.log(data.given[np.not_equal(data.kind, "shear")])).max(initial=0.0))


def read_tests(path: str | Path, unit: str) -> Measurements:
    """The tests of a csv file. unit: of its stresses, a name of `UNITS`. Errors: DataError naming file, line and column."""
    path = Path(path)
    try:
        header, rows = read_table(path)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"tests: {path}: expected a csv file of tests, found {error}") from error
    missing = [name for name in NEEDED if name not in header]
    strange = [name for name in header if name not in COLUMNS]
    twice = [name for name in header if header.count(name) > 1]
    if names := missing or strange or twice:
        kind = "no" if missing else "an unknown column" if strange else "two columns"
        raise DataError(
            f"tests: {path}: expected the columns {', '.join(NEEDED)}, and if wanted "
            f"{', '.join(name for name in COLUMNS if name not in NEEDED)}; found {kind} {names[0]!r}"
        )
    if not rows:
        raise DataError(f"tests: {path}: expected rows below the header, found none")
    found = measurements([dict(zip(header, row)) for row in rows], unit, str(path))
    if not found.value.any():
        raise DataError(f"tests: {path}: stress_1: expected stresses, found 0 in every row")
    return found


def measurements(rows: Sequence[dict], unit: str, where: str) -> Measurements:
    """As `read_tests`, of rows by column. Errors: DataError naming `where`, row and column."""
    names: list[str] = []
    states, stresses = [], []
    for i, row in enumerate(rows):
        line = f"tests: {where}: row {i + 1}"
        kind, _, axes = str(row["mode"]).strip().partition(" ")
        fits = KINDS.get(kind) == len(axes) == len(set(axes)) and set(axes) <= set(AXES)
        if not fits:
            raise DataError(
                f"{line}: mode: expected uniaxial x, biaxial xy, shear xy or other axes of xyz, found {row['mode']!r}"
            )

        def cell(name: str, row=row, line=line) -> float:
            text = row.get(name)
            if text is None or str(text).strip() == "":
                return math.nan
            try:
                number = float(text)
            except ValueError:
                number = math.inf
            if not abs(number) <= LARGEST:
                raise DataError(f"{line}: {name}: expected a number, found {text!r}")
            return number

        first, second = cell("first"), cell("second")
        if kind != "biaxial":
            for unread in ("second", "stress_2", "sd_2"):
                if not math.isnan(cell(unread)):
                    held = "; a strip whose width is held is biaxial, its second stretch 1"
                    raise DataError(
                        f"{line}: {unread}: expected an empty cell in a {kind} test, found {row[unread]!r}"
                        + held * (kind == "uniaxial")
                    )
            second = 1.0 if kind == "uniaxial" else 0.0
        if math.isnan(first) or math.isnan(second) or (kind != "shear" and min(first, second) <= 0):
            raise DataError(
                f"{line}: first, second: expected {'a shear' if kind == 'shear' else 'positive stretches'}, "
                f"found {row.get('first')!r}, {row.get('second')!r}"
            )
        name = str(row["test"] or "").strip()
        if not name:
            raise DataError(f"{line}: test: expected a name, found an empty cell")
        if name not in names:
            names.append(name)
        places = [AXES.index(a) for a in axes] + [-1] * (2 - len(axes))
        angle = cell("angle")
        angle = 0.0 if math.isnan(angle) else math.radians(angle)
        measured = [(k, cell(f"stress_{k + 1}"), cell(f"sd_{k + 1}")) for k in (0, 1)]
        if math.isnan(measured[0][1]) and math.isnan(measured[1][1]):
            raise DataError(f"{line}: stress_1: expected a number, found none")
        states.append((names.index(name), kind, places, angle, (first, second)))
        stresses += [(i, k, v, sd) for k, v, sd in measured if not math.isnan(v)]
    test, kinds, axis, angles, given = (np.array(part) for part in zip(*states))
    for each in np.unique(np.degrees(angles)):
        warn_of_radians(f"tests: {where}: angle", float(each), stacklevel=3)
    row_of, component, value, sd = (np.array(part) for part in zip(*stresses))
    if 0 < np.isnan(sd).sum() < len(sd) or (sd <= 1 / LARGEST).any():
        raise DataError(
            f"tests: {where}: sd_1, sd_2: expected a positive number beside every stress, or none at all"
        )
    # where both stretches are above 1, or both below, each has the sign of its stress; one alone may be against its own
    strain = given - 1
    told = (kinds != "shear") & (strain.prod(1) >= 0)
    along = strain[row_of, component] * value * told[row_of]
    pulled = (along != 0) & (np.abs(value) > 0.05 * np.abs(value).max())
    against = pulled & (along < 0)
    if 2 * against.sum() > pulled.sum():
        raise DataError(
            f"tests: {where}: first, second: expected stretches above 1 under tension, below 1 under pressure, "
            f"found {against.sum()} of {pulled.sum()} otherwise: strains, or the other sign of stresses?"
        )
    if against.any():
        warn(
            f"tests: {where}: first, second: {against.sum()} of the stresses pull at a stretch below 1, or press above 1: strains?",
            stacklevel=2,
        )
    strain[kinds == "shear"] += 1
    size = np.abs(strain).max(1)
    rest = np.abs(value[(size <= 1e-3 * size.max())[row_of]])
    if (left := rest.max(initial=0.0)) > 0.05 * np.abs(value).max():
        warn(
            f"tests: {where}: stress_1, stress_2: expected 0 at rest (a stretch of 1, a shear of 0), found up to {left:.4g} there: "
            "strains in per cent (a stretch is 1 + strain/100), a preload or an offset to be subtracted, or a loop, of which a law "
            "has one branch?",
            stacklevel=2,
        )
    scale = UNITS[unit]
    return Measurements(
        tuple(names), test, kinds, axis, angles, given, row_of, component, scale * value, scale * sd
    )

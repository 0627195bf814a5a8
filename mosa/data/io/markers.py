"""Recordings of tracked points: read from c3d and csv, release from rest, alignment, resampling."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mosa.data.io.tables import number, read_table
from mosa.errors import ConfigError, DataError

COLUMNS = ("time", "name", "x", "y", "z")
UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "": 1e-3}
"""Of a c3d file, which means millimetres where it says nothing."""
AT_REST = 0.2
"""Seconds at the start of a recording in which nothing moves, where the release is sought."""
SEEN = 0.05
"""Of the largest displacement: points that have moved by more have been let go; hands that do so
move them by less."""
EARLY = 0.4
"""Of the largest displacement: up to there it grows as the square of the time since the release."""
BENT = 0.1
"""Of the growth of that displacement's root: a distance (rms) from a line beyond which it is none."""
SWINGS = 4
"""Periods of an oscillation that say when it began."""
MIRRORED = 1 / 3
"""Of the distance of aligned points: that of points mirrored, below which they are said to be."""
JUMP = 0.3
"""Of the points' extent: no body is deformed by so much within a sample."""
FROZEN, DIGITS = 0.1, 4
"""Of the largest step, and last digits: a point that moves by more before and after does not stand
still between."""
TORN, STILL = 3.0, 0.01
"""Of the steps beside: a step of all points that is so many times longer is no motion. Where these
are below that share of it, the points were at rest, and were moved."""
GAP = 2.5
"""Samples apart between which a recording is interpolated; a longer gap stays one."""


@dataclass(frozen=True)
class Recording:
    """names: M points; times: (n,) [s] ascending; positions: (n, M, 3) [m], NaN where one was not
    seen."""

    names: tuple[str, ...]
    times: np.ndarray
    positions: np.ndarray

    def of(self, names: Sequence[str], where: str) -> np.ndarray:
        """(n, len(names), 3) [m] of the points of these names. Errors: ConfigError."""
        if unknown := [name for name in names if name not in self.names]:
            known = ", ".join(self.names)
            raise ConfigError(f"{where}: expected points of {known}, found {unknown[0]!r}")
        return self.positions[:, [self.names.index(name) for name in names]]

    def at(self, times: np.ndarray) -> np.ndarray:
        """(T, M, 3) [m] at other times, by a cubic spline: lines between samples would take 3 % from
        an oscillation of 13 samples a period. NaN in a gap, and outside."""
        found = np.full((len(times), len(self.names), 3), np.nan)
        most = GAP * float(np.median(np.diff(self.times)))
        for m in range(len(self.names)):
            there = np.isfinite(self.positions[:, m]).all(1)
            if there.sum() < 2:
                continue
            known, values = self.times[there], self.positions[there, m]
            after = np.clip(np.searchsorted(known, times, side="left"), 1, len(known) - 1)
            slack = 1e-6 * most
            inside = (times >= known[0] - slack) & (times <= known[-1] + slack)
            kept = inside & (known[after] - known[after - 1] <= most)
            found[kept, m] = CubicSpline(known, values)(times[kept])
        return found


def read_markers(path: Path) -> Recording:
    """A recording of a .c3d file, or of a .csv file with the columns time [s], name, x, y, z [m]:
    one row for each point in each frame; a row that is missing, or has no numbers, was not seen.

    Errors: DataError naming the file and, of a csv, its row; ConfigError without the package."""
    readers = {".c3d": _read_c3d, ".csv": _read_csv}
    if path.suffix.lower() not in readers:
        raise DataError(f"{path}: expected a recording .c3d or .csv")
    if not path.is_file():
        raise DataError(f"{path}: file not found")
    found = readers[path.suffix.lower()](path)
    if len(found.times) < 2 or not np.isfinite(found.positions).any():
        raise DataError(f"{path}: expected at least two frames of points, found fewer")
    if (apart := float(np.median(np.diff(found.times)))) > AT_REST:
        raise DataError(f"{path}: expected times in seconds, found samples {apart:g} s apart")
    if len(set(found.names)) < len(found.names):
        raise DataError(f"{path}: expected every point's name once, found {found.names}")
    check_moves_on(found, str(path))
    return found


def check_moves_on(found: Recording, where: str) -> None:
    """No point stands still to the last digit and moves on, or jumps away from the others. Errors:
    DataError naming the point and the times."""
    moves = np.diff(found.positions, axis=0)
    steps = np.linalg.norm(moves, axis=-1)
    digit = np.abs(moves[np.nan_to_num(moves) != 0]).min(initial=np.inf)  # of a rounded file
    fast = steps > max(FROZEN * np.nan_to_num(steps).max(), DIGITS * digit)
    for m, name in enumerate(found.names):
        ends = np.flatnonzero(np.diff(np.r_[False, steps[:, m] == 0, False])).reshape(-1, 2)
        for first, last in ends[ends[:, 0] > 0]:
            before, long, over = first - 1, last - first > 1, last == len(steps)
            if not over and not long:  # one sample, of all points: of one of them it is chance
                long = moves[before, m] @ moves[last, m] > 0 and not (steps[first] > 0).any()
            if fast[before, m] and long and (over or fast[last, m]):
                raise DataError(
                    f"{where}: expected points that move on, found {name!r} at one place from "
                    f"{found.times[first]:g} to {found.times[last]:g} s in the middle of a motion: "
                    "a recording that froze? Leave these rows out"
                )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of frames in which nothing is seen
        place = np.nanmedian(found.positions, 0)
        size = np.nanmax(np.nanmax(place, 0) - np.nanmin(place, 0))
        together = np.nanmedian(moves, 1)
        alone = np.linalg.norm(moves - together[:, None], axis=-1)
        middle = np.nanmedian(found.positions, 1)
        wide = np.nanmax(np.nanmax(middle, 0) - np.nanmin(middle, 0))
    for t, m in np.argwhere(alone > JUMP * size)[:1]:
        raise DataError(
            f"{where}: expected points that move with the others, found {found.names[m]!r} "
            f"{alone[t, m]:.2g} m away from them within one sample at {found.times[t + 1]:g} s: "
            "exchanged names? Leave these rows out"
        )
    step = np.nan_to_num(np.linalg.norm(together, axis=-1), nan=np.inf)
    beside = np.stack([np.roll(step, k)[2:-2] for k in (-2, -1, 1, 2)]).max(0)
    jumps = (TORN * beside < step[2:-2]) & (step[2:-2] < beside / STILL)
    for t in 2 + np.flatnonzero(jumps & (step[2:-2] > FROZEN * wide))[:1]:
        warnings.warn(
            f"{where}: expected points that move on, found all of them {step[t]:.2g} m away within one "
            f"sample at {found.times[t + 1]:g} s, in a motion of {beside[t - 2]:.2g} m a sample: "
            "was a stretch cut out? Leave out what is before it or after it",
            stacklevel=3,
        )


def _read_c3d(path: Path) -> Recording:
    try:
        import c3d
    except ImportError as error:
        raise ConfigError(
            f"{path}: a c3d file needs the package c3d (pip install 'mosa[markers]', or c3d), "
            "which is not installed; or write a csv with time, name, x, y, z"
        ) from error
    try:
        with warnings.catch_warnings(), path.open("rb") as file:
            warnings.simplefilter("ignore")  # of files without analog data
            reader = c3d.Reader(file)
            names = tuple(str(label).strip() for label in reader.point_labels)
            rate, unit = float(reader.point_rate), reader.get("POINT:UNITS")
            unit = "" if unit is None else unit.string_value.strip().lower()
            points = np.array([frame[:, :4] for _, frame, _ in reader.read_frames()], dtype=float)
    except Exception as error:  # whatever the parser finds
        raise DataError(
            f"{path}: expected a c3d file of points, found a damaged or other one "
            f"({type(error).__name__}: {error})"
        ) from error
    if unit not in UNITS or rate <= 0 or points.ndim != 3 or points.shape[1] != len(names):
        raise DataError(
            f"{path}: expected named points in m, cm or mm at a rate above 0, found the unit "
            f"{unit!r}, {rate} Hz, shape {points.shape}, {len(names)} names"
        )
    positions = UNITS[unit] * points[..., :3]
    positions[points[..., 3] < 0] = np.nan
    return Recording(names, np.arange(len(points)) / rate, positions)


def _read_csv(path: Path) -> Recording:
    rows: dict[tuple[float, str], list[float]] = {}
    try:
        header, table = read_table(path)
        if any(header.count(key) != 1 for key in COLUMNS):
            found = ", ".join(header)
            raise DataError(
                f"{path}: expected the columns {', '.join(COLUMNS)}, each once, found {found}"
            )
        for i, row in enumerate(table, 1):
            cells = dict(zip(header, row))
            at = f"{path}, row {i}"
            time, *place = (number(cells[each], f"{at}: {each}") for each in ("time", *"xyz"))
            if (key := (time, cells["name"])) in rows:
                raise DataError(f"{at}: {key[1]!r} at {time} s for a second time")
            rows[key] = place
    except (OSError, csv.Error, ValueError) as error:
        raise DataError(f"{path}: expected rows of {', '.join(COLUMNS)} ({error})") from error
    times = np.array(sorted({time for time, _ in rows}))
    names = tuple(dict.fromkeys(name for _, name in rows))
    if not np.isfinite(times).all():
        raise DataError(f"{path}: expected finite times [s], found others")
    positions = np.full((len(times), len(names), 3), np.nan)
    frame = {time: i for i, time in enumerate(times.tolist())}
    for (time, name), place in rows.items():
        positions[frame[time], names.index(name)] = place
    return Recording(names, times, positions)


def released(times: np.ndarray, positions: np.ndarray, where: str) -> float:
    """When points (n, M, 3) [m] that are at rest at first are let go [s], to a part of a sample.

    A force that acts at once moves them by the square of the time since then: the root of their
    early displacement is a line, which ends at the release. Errors: DataError."""
    rest = times - times[0] <= AT_REST
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of frames in which nothing is seen
        away = positions - np.nanmedian(positions[rest], 0)
        moved = np.nanmean(np.linalg.norm(away, axis=-1), 1)
        largest, still = np.nanmax(moved), np.nanmax(moved[rest])
    threshold = max(SEEN * largest, 2 * still)
    gone = np.flatnonzero(moved > threshold)
    if not len(gone) or not threshold < EARLY * largest:
        raise DataError(
            f"{where}: expected points at rest for {AT_REST} s and then let go, found them moving "
            f"by {1e3 * still:.3g} mm of {1e3 * largest:.3g} mm by then; set scene.start [s]"
        )
    first = int(gone[0])
    early = first + int(np.argmax(moved[first:] > EARLY * largest))
    chosen = np.arange(first, max(early, first + 2))
    chosen = chosen[np.isfinite(moved[chosen])]
    root = np.sqrt(moved[chosen])
    slope, height = np.polyfit(times[chosen], root, 1)
    if np.std(root - slope * times[chosen] - height) > BENT * np.ptp(root):
        raise DataError(
            f"{where}: expected points at rest until they are let go, found a slow motion at {times[first]:.3g} s that becomes "
            "faster later: points that drift, or are moved by hands? Set scene.start [s]"
        )
    found = times[first] if slope <= 0 else -height / slope
    if found < times[0]:
        raise DataError(f"{where}: expected rest at first, found points moving; set scene.start")
    return float(min(found, times[first]))


def swung(times: np.ndarray, positions: np.ndarray, where: str) -> float:
    """When points (n, M, 3) [m] that were let go would have been let go at once [s]: the turning
    point from which the oscillation that follows begins.

    Hands let go over some milliseconds, in which a body already falls, but slower than by itself:
    `released` finds their start, and the oscillation is late by a part of them. Fitted are level,
    frequency, decay and phase of the mean of all points along the direction in which it moves most,
    over `SWINGS` periods from the end of the first half. Errors: DataError."""
    begin = released(times, positions, where)
    moved = np.nanmean(positions - np.nanmedian(positions[times <= begin], 0), 1)
    after = (times > begin) & np.isfinite(moved).all(1)
    t = times[after] - begin
    direction = np.linalg.svd(moved[after] - moved[after].mean(0), full_matrices=False)[2][0]
    y = moved[after] @ direction
    y /= y.std()

    def model(p: np.ndarray, t: np.ndarray) -> np.ndarray:
        phase = p[1] * t
        return p[0] + np.exp(-p[2] * phase) * (p[3] * np.cos(phase) + p[4] * np.sin(phase))

    even = np.linspace(t[0], t[-1], len(t))
    power = np.abs(np.fft.rfft(np.interp(even, t, y - y.mean()), 16 * len(t)))
    omega = 2 * np.pi * np.fft.rfftfreq(16 * len(t), even[1] - even[0])[power.argmax()]
    period = 2 * np.pi / omega
    kept = (t >= period / 2) & (t <= (SWINGS + 0.5) * period)
    if kept.sum() < 10 or t[-1] < 2.5 * period:
        raise DataError(
            f"{where}: expected two periods and more of an oscillation after the release at "
            f"{begin:.3f} s, found fewer; set scene.start=auto, or [s]"
        )
    start = [y.mean(), omega, 0.03, -y.mean(), 0.0]
    fit = least_squares(lambda p: model(p, t[kept]) - y[kept], start).x
    # the slope vanishes where tan(phase) = (b - ratio a)/(a + ratio b)
    a, b, ratio = fit[3], fit[4], fit[2]
    turn = np.arctan((b - ratio * a) / (a + ratio * b)) / fit[1]
    return float(begin + turn)


def alignment(
    seen: np.ndarray, known: Mapping[str, Sequence[float]], where: str
) -> tuple[np.ndarray, np.ndarray, float]:
    """(rotation R (3, 3), translation t (3,) [m], rms distance [m]) that take points seen (M, 3)
    to R p + t nearest to the known ones (M, by name), by least squares (Kabsch, Acta
    Crystallographica A 32, 1976). Errors: ConfigError."""
    target = np.array([list(map(float, place)) for place in known.values()]).reshape(-1, 3)
    there = np.isfinite(seen).all(1)
    if there.sum() < 3:
        raise ConfigError(f"{where}: expected three points that are seen at rest, found fewer")
    a, b = seen[there], target[there]
    p, q = a - a.mean(0), b - b.mean(0)
    U, S, Vh = np.linalg.svd(p.T @ q)
    if S[1] < 1e-6 * S[0]:
        raise ConfigError(f"{where}: expected points that are not on one line")
    R = Rotation.align_vectors(q, p)[0].as_matrix()
    t = b.mean(0) - R @ a.mean(0)
    off, mirrored = (np.sqrt(((p @ M.T - q) ** 2).sum(1).mean()) for M in (R, (U @ Vh).T))
    if mirrored < MIRRORED * off:  # where U Vh is a rotation, both are the same
        raise ConfigError(
            f"{where}: expected a recording in right-handed axes, found its points {1e3 * off:.2g} "
            f"mm (rms) from their places, and {1e3 * mirrored:.2g} mm with one axis mirrored"
        )
    return R, t, float(off)

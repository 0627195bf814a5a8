"""One parabola through what all phones see of a free fall: clocks, readout, and with gravity's acceleration scale and down.

A thrown body's centre of mass moves as c0 + v0 t + a t^2 / 2, seen by phone v in row r of frame k at the time
t = t_k + offset_v + readout_v (r / rows - 1/2), readout_v being the time in which its sensor is read from the first row to the
last. In the world of the poses a is gravity's direction and, over 9.81 m/s^2, the world's scale. The centre of a silhouette is
not that of mass, and poses are a little wrong: each phone has a constant shift in its picture, small by assumption.

A readout can be told from a fall: with it the clock is ahead the lower the body is seen, which a parabola cannot follow.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from mosa.capture.alignment import centres_at
from mosa.capture.mattes import Track
from mosa.capture.phones import Phone
from mosa.errors import DataError

READOUT, READOUT_SD = 0.015, 0.010  # [s] prior: sensors of phones are read in 8 to 30 ms
SHIFT = 0.04  # sd of a silhouette's centre from the projected centre of mass, in object radii
POSE = 1.5e-3  # [rad] of a phone's direction
ROUGH = 0.05  # radii of the object within which triangulated centres of a fall lie on a parabola
OUTLIER = 3.5  # standard deviations from which on a frame at an end of the window is no free fall
FEWEST = 5
NOISE = 0.05  # [px] Least noise that is assumed of a centre
OUTLINE = 0.003
"""The same in radii of the object: what a hull leaves of the difference between an outline's centre and the body's. With it the
errors of the two synthetic films of docs/capture.md are as large as is said."""
SCANS = {"down": (1, 1), "up": (1, -1), "right": (0, 1), "left": (0, -1)}
"""Where the sensor's next row lies in the picture -> axis of a pixel, sign."""


@dataclass(frozen=True)
class Knowledge:
    """What is known beforehand; None where the fall has to say it. scale: metres per unit of the poses; up: (3,) of their world;
    gravity [m/s^2]; readout [s]: of all phones or by name; scan: down | up | left | right, of all or by name."""

    gravity: float = 9.81
    scale: float | None = None
    up: np.ndarray | None = None
    readout: float | Mapping[str, float] | None = None
    scan: Mapping[str, str] | str = "down"

    def readout_of(self, name: str) -> float | None:
        return self.readout.get(name) if isinstance(self.readout, Mapping) else self.readout

    def scan_of(self, name: str) -> tuple[int, int]:
        return SCANS[self.scan if isinstance(self.scan, str) else self.scan.get(name, "down")]


@dataclass(frozen=True)
class Fall:
    """What the free fall says, in the unit U of the poses' world and on the first phone's clock.

    position, velocity, acceleration: (3,) at time `origin` [s]; offsets, readouts: (V,) [s]; shifts: (V, 2) [px]; window: first and
    last time [s] of free fall; scale [m/U]; up: (3,); noise [px] of a centre; frames: centres that were used; *_sd: one standard
    deviation, the larger of what the residuals and what leaving out a phone at a time say; up_sd [degrees].
    """

    origin: float
    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    offsets: np.ndarray
    readouts: np.ndarray
    shifts: np.ndarray
    window: tuple[float, float]
    scale: float
    up: np.ndarray
    noise: float
    frames: int
    offsets_sd: np.ndarray
    readouts_sd: np.ndarray
    scale_sd: float
    up_sd: float

    def at(self, times: np.ndarray) -> np.ndarray:
        """(T, 3) of the centre in free fall."""
        t = np.asarray(times)[..., None] - self.origin
        return self.position + self.velocity * t + 0.5 * self.acceleration * t**2


def row_share(phone: Phone, pixels: np.ndarray, knowledge: Knowledge) -> np.ndarray:
    """(...) in [-1/2, 1/2]: how late in the readout pixels (..., 2) are taken."""
    axis, sign = knowledge.scan_of(phone.name)
    return sign * (pixels[..., axis] / phone.camera.size[axis] - 0.5)


def longest_parabola(times: np.ndarray, points: np.ndarray, tolerance: float) -> tuple[int, int]:
    """First and last index of the part of a track (T, 3) that follows one parabola to `tolerance` (root mean square) and bends
    most: an object at rest follows one too. NaNs end a part. Errors: DataError without any."""
    best, found = 0.0, None
    for i in range(len(times) - FEWEST + 1):
        for j in range(i + FEWEST, len(times) + 1):
            if not np.isfinite(points[i:j]).all():
                break
            t = times[i:j] - times[i]
            design = np.stack([np.ones_like(t), t, 0.5 * t * t], 1)
            solution = np.linalg.lstsq(design, points[i:j], rcond=None)[0]
            if np.sqrt(np.square(points[i:j] - design @ solution).sum(1).mean()) > tolerance:
                break  # longer ones from here fit worse
            bend = float(np.linalg.norm(solution[2])) * t[-1] ** 2 / 8
            if bend > best:
                best, found = bend, (i, j - 1)
    if found is None or best < tolerance:
        raise DataError(
            f"no free fall: expected {FEWEST} frames in which two phones see the whole object, "
            f"whose fall bends off a straight line by {tolerance:.2g} units of the poses, found "
            f"{best:.2g}; let it fall from higher up, or set flight=[<from>, <to>]"
        )
    return found


def rough_window(
    phones: list[Phone], tracks: list[Track], offsets: np.ndarray
) -> tuple[float, float]:
    """First and last time [s] of free fall on the first phone's clock."""
    times = tracks[0].times
    points = centres_at(phones, tracks, offsets, times)
    depth = np.nanmedian(np.linalg.norm(points - phones[0].camera.centre, axis=1))
    radius = float(np.median(tracks[0].radii[tracks[0].seen])) / phones[0].camera.K[0, 0] * depth
    first, last = longest_parabola(times, points, ROUGH * radius)
    return float(times[first]), float(times[last])


class Problem:
    """Residuals of a window. Numbers: position, velocity, acceleration in units of depth, then per phone offset (but the first's),
    readout, shift. until [s]: end of the frames that are read, the window's where 0."""

    def __init__(self, phones, tracks, offsets, window, knowledge: Knowledge, until: float = 0.0):
        self.phones, self.knowledge, self.window = phones, knowledge, window
        end = until or window[1]
        self.origin = 0.5 * (window[0] + window[1])
        self.start = offsets
        self.times, self.pixels, self.shares, self.sigma = [], [], [], []
        for phone, track, offset in zip(phones, tracks, offsets):
            when = track.times + offset
            within = (when >= window[0] - 1e-9) & (when <= end + 1e-9)
            inside = np.flatnonzero(track.seen & within)
            self.times.append(track.times[inside])
            self.pixels.append(track.centres[inside])
            self.shares.append(row_share(phone, track.centres[inside], knowledge))
            radius = float(np.median(track.radii[inside])) if len(inside) else 1.0
            self.sigma.append(np.hypot(SHIFT * radius, POSE * phone.camera.K[0, 0]))
        self.radius = float(np.median([np.median(track.radii[track.seen]) for track in tracks]))
        points = centres_at(phones, tracks, offsets, np.linspace(*window, 12))
        good = np.isfinite(points[:, 0])
        t = np.linspace(*window, 12)[good] - self.origin
        design = np.stack([np.ones_like(t), t, 0.5 * t * t], 1)
        self.rough = np.linalg.lstsq(design, points[good], rcond=None)[0]
        away = [np.linalg.norm(self.rough[0] - phone.camera.centre) for phone in phones]
        self.depth = float(np.mean(away))
        self.readouts = [knowledge.readout_of(phone.name) for phone in phones]

    def begin(self) -> np.ndarray:
        V, readouts = len(self.phones), [READOUT if r is None else r for r in self.readouts]
        motion = (self.rough / self.depth).ravel()
        return np.concatenate([motion, np.zeros(V - 1), readouts, np.zeros(2 * V)])

    def parts(self, numbers: np.ndarray):
        V = len(self.phones)
        motion = numbers[:9].reshape(3, 3) * self.depth
        offsets = self.start + np.concatenate([[0.0], numbers[9 : 8 + V]])
        readouts = numbers[8 + V : 8 + 2 * V]
        return motion, offsets, readouts, numbers[8 + 2 * V : 8 + 4 * V].reshape(V, 2)

    def path(self, numbers: np.ndarray, times: np.ndarray) -> np.ndarray:
        """(n, 3) of the centre, times (n,) [s] counted from the origin."""
        position, velocity, acceleration = self.parts(numbers)[0]
        return position + velocity * times[:, None] + 0.5 * acceleration * times[:, None] ** 2

    def misses(self, numbers: np.ndarray) -> list[np.ndarray]:
        """Per phone (n, 2) [px]: seen minus expected."""
        _, offsets, readouts, shifts = self.parts(numbers)
        found = []
        for v, phone in enumerate(self.phones):
            t = self.times[v] + offsets[v] + readouts[v] * self.shares[v] - self.origin
            points = self.path(numbers, t)
            expected = phone.camera.project(points) if len(points) else np.zeros((0, 2))
            found.append(self.pixels[v] - expected - shifts[v])
        return found

    def residuals(self, numbers: np.ndarray, noise: float, without: int | None) -> np.ndarray:
        motion, offsets, readouts, shifts = self.parts(numbers)
        size, scale, up = np.linalg.norm(motion[2]), self.knowledge.scale, self.knowledge.up
        misses = enumerate(self.misses(numbers))
        parts = [miss.ravel() / noise for v, miss in misses if v != without]
        parts += [(shifts / np.array(self.sigma)[:, None]).ravel()]
        parts += [[(r - READOUT) / READOUT_SD if known is None else (r - known) / 1e-5]
                  for r, known in zip(readouts, self.readouts)]  # fmt: skip
        if scale is not None:
            parts += [[(size * scale / self.knowledge.gravity - 1) / 3e-3]]
        if up is not None:
            parts += [np.cross(motion[2], up) / size / np.linalg.norm(up) / 5e-3]
        # the first clock is the others', and of a phone that is left out nothing is asked
        parts += [1e-3 * (offsets - self.start) / 1e-2]
        return np.concatenate(parts)

    def solve(self, numbers: np.ndarray, noise: float, without: int | None = None):
        return least_squares(
            self.residuals, numbers, args=(noise, without), x_scale="jac", method="trf", max_nfev=60
        )


def fit_fall(
    phones: list[Phone], tracks: list[Track], offsets: np.ndarray, knowledge: Knowledge,
    flight: tuple[float, float] | None = None,
) -> Fall:  # fmt: skip
    """The fall from rough offsets (V,) [s]. flight: first and last time of it, where they are known. Errors: DataError."""
    window = flight or rough_window(phones, tracks, offsets)
    interval = max(track.clip.interval for track in tracks)
    noise, numbers = 1.0, None
    for attempt in range(8):
        problem = Problem(phones, tracks, offsets, window, knowledge)
        count = sum(map(len, problem.times))
        if count < 3 * len(phones) or window[1] - window[0] < 3 * interval:
            raise DataError(
                f"no free fall: {count} centres from {window[0]:.3f} to {window[1]:.3f} s on the "
                f"clock of {phones[0].name} are left of {3 * len(phones)} needed; let the object "
                "fall from higher up, or set flight=[<from>, <to>]"
            )
        numbers = problem.solve(problem.begin() if numbers is None else numbers, noise).x
        misses = problem.misses(numbers)
        every = np.concatenate([m.ravel() for m in misses])
        noise = max(NOISE, OUTLINE * problem.radius, 1.4826 * float(np.median(np.abs(every))))
        offsets = problem.parts(numbers)[1]
        numbers[9 : 8 + len(phones)] = 0  # the clocks' changes
        narrower = flight or trimmed(problem, misses, offsets, noise, window, interval)
        if attempt >= 2 and narrower == window:
            break
        window, numbers = narrower, None if narrower != window else numbers
    if flight is None:
        window = without_release(problem, noise, window, interval)
    problem = Problem(phones, tracks, offsets, window, knowledge)
    solution = problem.solve(problem.begin(), noise)
    return described(problem, solution, noise, count)


def trimmed(
    problem: Problem, misses, offsets, noise: float, window, interval: float
) -> tuple[float, float]:
    """The window without an interval at an end in which the centres are off, by more than noise, from the parabola."""
    when = np.concatenate([t + o for t, o in zip(problem.times, offsets)])
    off = np.concatenate([np.square(m).sum(1) for m in misses]) / (2 * noise**2)
    first, last = window
    for _ in range(3):
        head, tail = off[when < first + interval], off[when > last - interval]
        worst = max(head.mean() if len(head) else 0, tail.mean() if len(tail) else 0)
        if worst < OUTLIER or last - first < (FEWEST + 1) * interval:
            break
        if len(head) and head.mean() == worst:
            first += interval
        else:
            last -= interval
        inside = (when >= first) & (when <= last)
        when, off = when[inside], off[inside]
    return first, last


def without_release(problem: Problem, noise: float, window, interval: float) -> tuple[float, float]:
    """The window without its beginning, in which the object may have hung still: it would be off the parabola by g t^2 / 2 only,
    which for the first hundredths of a second is less than is noticed, and is enough to shift acceleration and readouts."""
    focal = float(np.mean([phone.camera.K[0, 0] for phone in problem.phones]))
    size = float(np.linalg.norm(problem.rough[2]))
    margin = (2 * OUTLIER * noise * problem.depth / focal / size) ** 0.5
    first, last = window
    return (first + margin, last) if last - first - margin > (FEWEST + 1) * interval else window


def described(problem: Problem, solution, noise: float, count: int) -> Fall:
    """The numbers with what they may be off by."""
    V, knowledge = len(problem.phones), problem.knowledge
    motion, offsets, readouts, shifts = problem.parts(solution.x)
    size = float(np.linalg.norm(motion[2]))
    data = np.concatenate([m.ravel() for m in problem.misses(solution.x)])
    inflate = max(1.0, float(np.square(data).mean()) / noise**2)
    covariance = np.linalg.pinv(solution.jac.T @ solution.jac) * inflate
    direction = motion[2] / size
    slope = direction @ covariance[6:9, 6:9] @ direction * problem.depth**2
    across = np.trace(covariance[6:9, 6:9]) * problem.depth**2 - slope
    scale_sd, up_sd = np.sqrt(slope) / size, np.degrees(np.sqrt(max(across, 0)) / size)
    sd = np.sqrt(np.diag(covariance))
    if (
        V > 3
    ):  # a phone's mistakes are in all of its frames: leaving it out says more than residuals
        others = [problem.parts(problem.solve(solution.x, noise, v).x)[0][2] for v in range(V)]
        sizes = np.linalg.norm(others, axis=1)
        sines = np.linalg.norm(np.cross(others, direction), axis=1) / sizes
        turns = np.degrees(np.arcsin(np.clip(sines, 0, 1)))
        scale_sd = max(scale_sd, np.sqrt((V - 1) / V * np.square(sizes / sizes.mean() - 1).sum()))
        up_sd = max(up_sd, np.sqrt((V - 1) / V * np.square(turns).sum()))
    scale = knowledge.gravity / size if knowledge.scale is None else knowledge.scale
    up = -direction if knowledge.up is None else knowledge.up / np.linalg.norm(knowledge.up)
    return Fall(
        problem.origin, *motion, offsets, readouts, shifts, problem.window, scale, up, noise, count,
        np.concatenate([[0.0], sd[9 : 8 + V]]), sd[8 + V : 8 + 2 * V], float(scale * scale_sd), float(up_sd),
    )  # fmt: skip

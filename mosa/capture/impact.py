"""The clocks once more, with what follows the free fall: an impact is one moment for all phones.

In a fall a clock that is late by a millisecond looks like a shift of the picture, a focal length that is a little off, or an
outline whose centre wanders: what tells them apart is the change of the speed from its beginning to its end. At the ground the
speed changes its sign within a hundredth of a second, and a late phone sees the body too high before and too low after it. Where
the body goes then nobody knows: from the end of the free fall on the parabola gets a free curve on top, one for all phones, which
begins with the parabola's position, velocity and acceleration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.interpolate import BSpline

from mosa.capture.alignment import centres_at
from mosa.capture.fall import Fall, Knowledge, Problem
from mosa.capture.mattes import Track
from mosa.capture.phones import Phone

AFTER = 0.2  # [s] from the end of the free fall on that are read
STEP = 0.006  # [s] between knots; a body of some centimetres turns around within two or more
OUTLINE = 0.016  # radii by which a deforming body's outline leaves the common path
BEND = 0.3  # sd of the curve's third differences from knot to knot [radii]: holds to 20 m/s
LEAST = 4  # frames of each phone after the free fall, below which there is no impact to be seen


class Impact(Problem):
    """A fall's problem whose path goes on through the impact. After its numbers those of the curve, in units of depth."""

    def __init__(self, phones, tracks, fall: Fall, knowledge: Knowledge):
        until = fall.window[1] + AFTER
        super().__init__(phones, tracks, fall.offsets, fall.window, knowledge, until)
        self.begun = fall
        end = until - self.origin
        first = fall.window[1] - self.origin
        inner = np.linspace(first, end, round(AFTER / STEP) + 1)
        self.knots = np.concatenate([[first] * 3, inner, [end] * 3])
        count = len(self.knots) - 4
        # the first three vanish: the curve joins the parabola smoothly
        self.bend = np.diff(np.eye(count), 3, axis=0)[:, 3:]
        focal = float(np.mean([phone.camera.K[0, 0] for phone in phones]))
        self.size = self.radius / focal  # of the object, in units of depth
        self.base = 8 + 4 * len(phones)
        self.late = [t + o > fall.window[1] for t, o in zip(self.times, fall.offsets)]

    @property
    def seen(self) -> bool:
        """Whether every phone saw what followed."""
        return min(int(late.sum()) for late in self.late) >= LEAST

    def curve(self, times: np.ndarray) -> np.ndarray:
        """(n, K) what each number of the curve adds at times [s] from the origin."""
        inside = np.clip(times, self.knots[0], self.knots[-1])
        return BSpline.design_matrix(inside, self.knots, 3).toarray()[:, 3:]

    def begin(self) -> np.ndarray:
        """At the fall, and a curve through where lines of sight meet after it."""
        fall = self.begun
        motion = np.stack([fall.position, fall.velocity, fall.acceleration]) / self.depth
        own = motion.ravel(), np.zeros(len(self.phones) - 1), fall.readouts, fall.shifts.ravel()
        times = np.linspace(self.knots[0], self.knots[-1], 3 * self.bend.shape[1])
        tracks = [Track(None, t, p, np.ones(len(t))) for t, p in zip(self.times, self.pixels)]
        seen = centres_at(self.phones, tracks, fall.offsets, times + self.origin)
        beside = (seen - fall.at(times + self.origin)) / self.depth
        good = np.isfinite(beside[:, 0])
        matrix = np.concatenate([self.curve(times[good]) / OUTLINE, self.bend / BEND])
        right = np.concatenate([beside[good] / OUTLINE, np.zeros((len(self.bend), 3))])
        return np.concatenate([*own, np.linalg.lstsq(matrix, right, rcond=None)[0].ravel()])

    def path(self, numbers: np.ndarray, times: np.ndarray) -> np.ndarray:
        beside = self.depth * self.curve(times) @ numbers[self.base :].reshape(-1, 3)
        return super().path(numbers, times) + beside

    def misses(self, numbers: np.ndarray) -> list[np.ndarray]:
        """Per phone (n, 2): seen minus expected [px], after the fall in pixels of as many standard deviations in it."""
        share = min(1.0, self.begun.noise / (OUTLINE * self.radius))
        both = zip(self.late, super().misses(numbers))
        return [np.where(late[:, None], share, 1.0) * miss for late, miss in both]

    def residuals(
        self, numbers: np.ndarray, noise: float, without: int | None = None
    ) -> np.ndarray:
        bends = self.bend @ numbers[self.base :].reshape(-1, 3) / (BEND * self.size)
        return np.concatenate([super().residuals(numbers, noise, without), bends.ravel()])


def through_impact(
    phones: list[Phone], tracks: list[Track], fall: Fall, knowledge: Knowledge
) -> Fall:
    """The fall with clocks and a path that are the impact's too; as it is where some phone does not see what followed.

    Scale, down and readouts stay those of the free flight alone: what is read of a collision pulls at the parabola's bend, of the
    scale of a rigid body by more than a percent, of the readouts by two milliseconds."""
    readouts = {phone.name: float(readout) for phone, readout in zip(phones, fall.readouts)}
    problem = Impact(phones, tracks, fall, replace(knowledge, readout=readouts))
    if not problem.seen:
        return fall
    solution = problem.solve(problem.begin(), fall.noise)
    (position, velocity, acceleration), offsets, _, shifts = problem.parts(solution.x)
    data = np.concatenate([miss.ravel() for miss in problem.misses(solution.x)]) / fall.noise
    inflate = max(1.0, float(np.square(data).mean()))
    covariance = np.linalg.pinv(solution.jac.T @ solution.jac) * inflate
    sd, V = np.sqrt(np.diag(covariance)), len(phones)
    return replace(
        fall, position=position, velocity=velocity, acceleration=acceleration, offsets=offsets, shifts=shifts,
        offsets_sd=np.concatenate([[0.0], sd[9 : 8 + V]]),
    )  # fmt: skip

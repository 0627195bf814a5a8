"""Frames of common times from phones that expose at times of their own, row by row.

What a frame shows is first moved along the path of the object's centre in that picture, each row from the time it was read at to
the wanted one; what is left, deformation and turning, is interpolated by optical flow between the frames around, row by row too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.interpolate import BSpline

from mosa.capture.fall import Fall, Knowledge, row_share
from mosa.capture.mattes import Matting, Track, matted_frames
from mosa.capture.phones import Phone
from mosa.data.checks.cameras import HOLE
from mosa.data.images.reading import fill_holes
from mosa.errors import DataError
from mosa.system.limits import counted

NEAR = 0.02  # share of a frame within which a wanted time is that of a frame
KNOTS = 2  # of the common path in the shortest time between frames
SMOOTH = 1e-3  # weight of the change of acceleration between knots; a line of sight has 1
AROUND = 0.6  # radii of the object beside it in which flow is looked for


@dataclass(frozen=True)
class Exposure:
    """How a phone exposes. times: (T,) [s] of its frames' middle rows on the common clock; readout [s], along `axis` of a pixel in
    the direction of `sign`; centres: (T, 2) [px] of the object; path: the same at any common time
    within `span`."""

    phone: Phone
    times: np.ndarray
    readout: float
    axis: int
    sign: int
    centres: np.ndarray
    path: Callable[[np.ndarray], np.ndarray]
    span: tuple[float, float]

    @cached_property
    def own_times(self) -> np.ndarray:
        """(T,) [s] at which the object's centre was read in each frame, that of the middle row where it is not seen."""
        place = self.centres[:, self.axis] / self.phone.camera.size[self.axis] - 0.5
        return self.times + self.readout * self.sign * np.nan_to_num(place)

    @property
    def seen_times(self) -> np.ndarray:
        """(n,) common times at which the frames' own centres were read."""
        return self.own_times[np.isfinite(self.centres[:, 0])]


def common_path(
    phones: list[Phone], tracks: list[Track], fall: Fall, knowledge: Knowledge
) -> tuple[BSpline, float, float]:
    """(path (3,) of the object at a common time [s], first and last time of it), to which the lines of sight of all phones
    come nearest.

    Six phones of 60 frames a second see the object 360 times a second: an impact that is over in two frames of one of them.
    """
    times, rows, values = [], [], []
    step = min(track.clip.interval for track in tracks) / KNOTS
    for v, (phone, track) in enumerate(zip(phones, tracks)):
        seen = track.seen
        late = fall.readouts[v] * row_share(phone, track.centres[seen], knowledge)
        own = track.times[seen] + fall.offsets[v] + late
        # seen minus where it falls: of the phone's pose, and of its side of the object
        free = (own >= fall.window[0]) & (own <= fall.window[1])
        off = (track.centres[seen][free] - phone.camera.project(fall.at(own[free]))).mean(0)
        rays = phone.camera.rays(track.centres[seen] - off)
        across = np.eye(3) - rays[:, :, None] * rays[:, None]
        times.append(own)
        rows.append(across)
        values.append(across @ phone.camera.centre)
    every, across, values = np.concatenate(times), np.concatenate(rows), np.concatenate(values)
    low, high = max(t.min() for t in times), min(t.max() for t in times)
    inside = (every >= low) & (every <= high)
    every, across, values = every[inside], across[inside], values[inside]
    sizes, remedy = [max(4, (high - low) // step)] * 2, "cut the videos, or set fps"
    count, _ = counted("knots of the videos' path", sizes, remedy, each=144)
    knots = np.concatenate([[low] * 3, np.linspace(low, high, count), [high] * 3])
    basis = BSpline.design_matrix(np.clip(every, low, high), knots, 3).toarray()
    n = basis.shape[1]
    matrix = np.einsum("kab,ki,kj->iajb", across, basis, basis).reshape(3 * n, 3 * n)
    right = np.einsum("ka,ki->ia", values, basis).ravel()
    bend = np.diff(np.eye(n), 3, axis=0)  # where nobody looks the acceleration goes on
    matrix += SMOOTH * np.kron(bend.T @ bend, np.eye(3))
    return BSpline(knots, np.linalg.solve(matrix, right).reshape(n, 3), 3), float(low), float(high)


def exposure_of(
    v: int, phone: Phone, track: Track, fall: Fall, knowledge: Knowledge, common: tuple[BSpline, float, float],
) -> Exposure:  # fmt: skip
    """Of phone v of a fall; common: of `common_path`. What of a phone's own centres lies beside that path is interpolated
    linearly."""
    spline, low, high = common
    times = track.times + fall.offsets[v]
    seen = track.seen
    own = times[seen] + fall.readouts[v] * row_share(phone, track.centres[seen], knowledge)
    inside = (own >= low) & (own <= high)
    beside = track.centres[seen][inside] - phone.camera.project(spline(own[inside]))

    def path(time: np.ndarray) -> np.ndarray:
        t = np.clip(np.atleast_1d(time), low, high)
        rest = np.stack([np.interp(t, own[inside], beside[:, axis]) for axis in (0, 1)], -1)
        found = phone.camera.project(spline(t)) + rest
        return found if np.ndim(time) else found[0]

    scan, readout = knowledge.scan_of(phone.name), float(fall.readouts[v])
    return Exposure(phone, times, readout, *scan, track.centres, path, (low, high))


def common_times(
    exposures: list[Exposure], window: tuple[float, float], *, before: float, after: float, rate: float | None,
) -> np.ndarray:  # fmt: skip
    """(T,) [s], evenly spaced, from `before` seconds before the free fall ends to `after` after it, as far as every phone has a
    whole object in the frames around. rate [1/s]: None for the slowest phone's. Errors: DataError where less than five are left."""
    slowest = max(float(np.median(np.diff(e.times))) for e in exposures)
    step = slowest if rate is None else 1 / rate
    # the first phone's frames lie on the grid, so that of it nothing has to be made up
    first = exposures[0].times[np.abs(exposures[0].times - window[1]).argmin()]
    low, high = int(np.floor(before / step)), int(np.floor(after / step))
    grid = first + step * np.arange(-low, high + 1)
    good = [all(between(e, t) is not None for e in exposures) and t > window[0] for t in grid]
    bad = np.flatnonzero(~np.array(good))
    begin, end = max(bad[bad <= low], default=-1) + 1, min(bad[bad > low], default=len(grid))
    if end - begin < 5 or low - begin < 1:
        raise DataError(
            f"{end - begin} common frames ({low - begin} of them in free fall): expected five in "
            "which every phone sees the whole object, two of them in free fall; film with more "
            "room around, longer, or change before=, after="
        )
    return grid[begin:end]


def between(exposure: Exposure, time: float) -> tuple[int, int] | None:
    """The frames that were taken before and after a time, where the object was; the same twice where one was taken at it. None
    where there is no such pair with a whole object."""
    own = exposure.own_times
    after = int(np.searchsorted(own, time))
    if not 0 < after < len(own):
        return None
    gap = own[after] - own[after - 1]
    for k in (after - 1, after):
        if abs(own[k] - time) < NEAR * gap and np.isfinite(exposure.centres[k, 0]):
            return k, k
    usual = float(np.median(np.diff(exposure.times)))
    whole = np.isfinite(exposure.centres[after - 1 : after + 1, 0]).all()
    return (after - 1, after) if whole and gap <= 2.5 * usual else None


def around(exposure: Exposure, pair: tuple[int, int]) -> list[int]:
    """The frames of a pair and, where the object is whole in them too, those before and after: what the motion between is read
    from."""
    k0, k1 = pair
    own, usual = exposure.own_times, float(np.median(np.diff(exposure.times)))
    found = sorted({k0, k1})
    for k, beside in ((k0 - 1, k0), (k1 + 1, k1)):
        there = 0 <= k < len(own) and np.isfinite(exposure.centres[k, 0])
        if there and abs(own[k] - own[beside]) < 2.5 * usual:
            found.append(k)
    return sorted(found)


def moved(
    picture: np.ndarray, exposure: Exposure, frame: int, time: float
) -> tuple[np.ndarray, np.ndarray]:
    """A frame (H, W, C) of 8 bits as it would have been exposed at one time, were the object's motion that of its centre in the
    picture; in [0, 1]. And the times (H or W,) [s] at which what its lines then show was read."""
    height, width = picture.shape[:2]
    wanted = exposure.path(np.asarray(time))
    size = (width, height)[exposure.axis]
    line = np.arange(size) + 0.5
    source, shift, when = line, np.zeros((size, 2)), np.zeros(size)
    # where a row comes from depends on when it was read: a contraction by velocity times readout over size
    for _ in range(4):
        when = exposure.times[frame] + exposure.readout * exposure.sign * (source / size - 0.5)
        shift = exposure.path(when) - wanted
        source = line + shift[:, exposure.axis]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    dx, dy = np.expand_dims(shift.T.astype(np.float32), 2 if exposure.axis == 1 else 1)
    around = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": 0}
    source = picture.astype(np.float32) / 255
    return cv2.remap(source, x + dx, y + dy, cv2.INTER_CUBIC, **around), when


def lagrange(nodes: np.ndarray, at: float) -> np.ndarray:
    """(n, L) weights of values at nodes (n, L) in the polynomial through them, at one place."""
    every = range(len(nodes))
    factors = ([(at - nodes[k]) / (nodes[j] - nodes[k]) for k in every if k != j] for j in every)
    return np.stack([np.prod(own, axis=0) if own else np.ones_like(nodes[0]) for own in factors])


def blended(
    pictures: list[np.ndarray], when: np.ndarray, anchors: list[int], time: float, axis: int, centre: np.ndarray,
    radius: float,
) -> np.ndarray:  # fmt: skip
    """What premultiplied RGBA pictures (H, W, 4) of n frames, moved along the path, would show at one time.

    when: (n, L) [s] at which their lines were read; anchors: numbers of the one or two pictures around that time, which are drawn
    along the flows to the others. How far is a polynomial in time through all of them, line by line: what a line shows was read up
    to some milliseconds before or after the centre, in which a body deforms, and between two frames it does not do so evenly."""
    height, width = pictures[0].shape[:2]
    reach = (1 + AROUND) * 2 * radius
    x0, y0 = (max(0, int(c - reach)) for c in centre)
    x1, y1 = min(width, int(centre[0] + reach) + 1), min(height, int(centre[1] + reach) + 1)
    parts = [np.ascontiguousarray(p[y0:y1, x0:x1]) for p in pictures]
    lines = when[:, y0:y1, None] if axis == 1 else when[:, None, x0:x1]
    weights = lagrange(lines, time).astype(np.float32)
    shares = np.ones(1)
    if len(anchors) == 2:
        one, two = (lines[a] for a in anchors)
        late = np.clip((time - one) / (two - one), 0, 1).astype(np.float32)[..., None]
        shares = [1 - late, late]

    shades = (np.clip(p[..., :3].mean(-1) + 1 - p[..., 3], 0, 1) for p in parts)
    greys = [np.round(255 * shade).astype(np.uint8) for shade in shades]
    flow_of = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    x, y = np.meshgrid(np.arange(x1 - x0, dtype=np.float32), np.arange(y1 - y0, dtype=np.float32))
    inside = np.zeros_like(parts[0])
    for a, share in zip(anchors, shares):
        by = np.zeros((y1 - y0, x1 - x0, 2), np.float32)
        for k in range(len(parts)):
            if k != a:
                by += weights[k][..., None] * flow_of.calc(greys[a], greys[k], None)
        places, border = (x - by[..., 0], y - by[..., 1]), cv2.BORDER_REPLICATE
        inside += share * cv2.remap(parts[a], *places, cv2.INTER_CUBIC, borderMode=border)
    found = np.zeros_like(pictures[0])
    found[y0:y1, x0:x1] = inside
    return found


def resampled(exposure: Exposure, track: Track, matting: Matting, times: np.ndarray) -> np.ndarray:
    """(T, H, W, 4) uint8, straight alpha, of a phone at common times (T,) [s]."""
    pairs = [between(exposure, float(t)) for t in times]
    used = [around(exposure, pair) for pair in pairs]
    first, last = min(u[0] for u in used), max(u[-1] for u in used)
    frames, needed = {}, {k for u in used for k in u}
    for i, color, matte in matted_frames(track.clip, matting, first, last):
        if i in needed:  # 8 bits: of slow motion in 4K there are gigabytes of them
            both = np.concatenate([color * matte[..., None], matte[..., None]], -1)
            frames[i] = np.round(255 * both).astype(np.uint8)
    radius = float(np.median(track.radii[track.seen]))
    found = []
    for time, (k0, k1), near in zip(times, pairs, used):
        pictures, when = zip(*(moved(frames[k], exposure, k, float(time)) for k in near))
        picture = pictures[0]
        if len(near) > 1:
            anchors = [near.index(k) for k in sorted({k0, k1})]
            centre = exposure.path(np.asarray(time))
            picture = blended(
                list(pictures), np.stack(when), anchors, time, exposure.axis, centre, radius
            )
        found.append(without_tunnels(straight(picture)))
    return np.stack(found)


def straight(picture: np.ndarray) -> np.ndarray:
    """uint8 with straight alpha of a premultiplied one; below a percent of coverage there is nothing."""
    alpha = np.clip(picture[..., 3:], 0, 1)
    alpha = np.where(alpha < 0.01, 0, alpha)
    color = np.where(alpha > 0, picture[..., :3] / np.maximum(alpha, 0.01), 1.0)
    return np.round(255 * np.clip(np.concatenate([color, alpha], -1), 0, 1)).astype(np.uint8)


def without_tunnels(picture: np.ndarray) -> np.ndarray:
    """A picture (H, W, 4) of 8 bits whose enclosed holes of up to `HOLE` of its coverage are closed, with the colours around them:
    to move a picture can close off what had been a thin opening, and a hull is carved through by every hole."""
    matte = picture[..., 3].astype(np.float32) / 255
    closed = fill_holes(matte, int(HOLE * (matte > 0.5).sum()))
    holes = closed > matte
    if not holes.any():
        return picture
    near = cv2.dilate(holes.astype(np.uint8), np.ones((3, 3), np.uint8)) & (matte < 0.9)
    painted = cv2.inpaint(np.ascontiguousarray(picture[..., :3]), near, 3, cv2.INPAINT_TELEA)
    colors = np.where(holes[..., None], painted, picture[..., :3])
    return np.concatenate([colors, np.round(255 * closed)[..., None].astype(np.uint8)], -1)

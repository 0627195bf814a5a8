"""The centre of an outline is not the projected centre of a body, and less so the more the side from which it is seen changes.

A phone looks at a body that falls past it first from below, then from above: its outline's centre wanders against the body by a few
hundredths of its size, which looks like another acceleration. The visual hull of the rigid body in flight, from frames of the
whole fall, says by how much."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mosa.capture.fall import Fall, Knowledge, row_share
from mosa.capture.mattes import Track
from mosa.capture.phones import Phone
from mosa.system.limits import counted

PITCH = 1 / 18  # of the hull's grid, in radii of the object
REACH = 2.2
VIEWS = 3  # frames of each phone that carve it
SAMPLES = 9  # times of the fall at which the outline is seen; a parabola fits them
MAX_CENTRE_OFFSET = 0.3  # outline's centre to body's [radii] above which the hull is rejected


def radius_of(phones: list[Phone], tracks: list[Track], fall: Fall) -> float:
    """Of the object, in units of the poses."""
    found = []
    for phone, track in zip(phones, tracks):
        away = np.linalg.norm(phone.camera.centre - fall.position)
        found.append(np.median(track.radii[track.seen]) / phone.camera.K[0, 0] * away)
    return float(np.median(found))


def hull_in_flight(
    phones: list[Phone], tracks: list[Track], fall: Fall, knowledge: Knowledge
) -> np.ndarray:
    """(N, 3) points of the visual hull relative to the falling centre, in units of the poses; the body does not turn."""
    radius = radius_of(phones, tracks, fall)
    steps = np.arange(-REACH, REACH + PITCH, PITCH) * radius
    points = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    first, last = fall.window
    for v, (phone, track) in enumerate(zip(phones, tracks)):
        times = track.times + fall.offsets[v]
        inside = np.flatnonzero(track.seen & (times >= first) & (times <= last))
        spread = np.linspace(0, len(inside) - 1, VIEWS + 2)[1:-1].round().astype(int)
        for k in np.unique(inside[spread]) if len(inside) else ():
            own = times[k] + fall.readouts[v] * row_share(phone, track.centres[k], knowledge)
            pixels = phone.camera.project(points + fall.at(own))
            # each point when its row is read
            when = times[k] + fall.readouts[v] * row_share(phone, pixels, knowledge)
            pixels = phone.camera.project(points + fall.at(when))
            points = points[track.shows(k, pixels)]
    return points


def outline_centre(phone: Phone, points: np.ndarray, pitch: float) -> np.ndarray:
    """(2,) [px] centre of what points (N, 3), `pitch` apart, cover in a phone's picture."""
    pixels = phone.camera.project(points)
    depth = np.linalg.norm(points.mean(0) - phone.camera.centre)
    cell = pitch / depth * phone.camera.K[0, 0]
    cells = np.floor((pixels - pixels.min(0)) / cell)[:, ::-1]
    where, remedy = f"{phone.name}: cells of an outline", "look at the phone's pose"
    covered = np.zeros(counted(where, cells.max(0) + 1, remedy), bool)
    covered[tuple(cells.astype(int).T)] = True
    rows, columns = np.nonzero(covered)
    return pixels.min(0) + cell * np.array([columns.mean() + 0.5, rows.mean() + 0.5])


def corrected(
    phones: list[Phone], tracks: list[Track], fall: Fall, knowledge: Knowledge
) -> list[Track] | None:
    """The tracks with centres at which the body's own centre would be seen during the fall, outside of its window moved as at its
    end; None where the mattes have no common hull."""
    points = hull_in_flight(phones, tracks, fall, knowledge)
    radius = radius_of(phones, tracks, fall)
    if len(points) * (PITCH * radius) ** 3 < 0.3 * radius**3:  # of a ball it is 4.2
        return None
    times = np.linspace(*fall.window, SAMPLES)
    # a place of the body's own, or the centre would wander from one correction to the next
    middle = points.mean(0)
    found = []
    for v, (phone, track) in enumerate(zip(phones, tracks)):
        places = fall.at(times)
        seen = [outline_centre(phone, points + c, PITCH * radius) for c in places]
        off = np.stack(seen) - phone.camera.project(places + middle)
        if np.abs(off).max() > MAX_CENTRE_OFFSET * float(np.median(track.radii[track.seen])):
            return None
        curve = np.polyfit(times - fall.origin, off, 2)
        t = np.clip(track.times + fall.offsets[v], *fall.window) - fall.origin
        wandered = curve[0] * t[:, None] ** 2 + curve[1] * t[:, None] + curve[2]
        found.append(replace(track, centres=track.centres - wandered))
    return found


def without_common(phones: list[Phone], fall: Fall) -> np.ndarray:
    """(V, 2) [px] by which phones see the body beside the fall, less what a shift of the body as a whole would explain best: that
    belongs to the fall, and would move the body against the floor."""
    step = 1e-4 * float(np.linalg.norm(phones[0].camera.centre - fall.position))
    moved = [[(phone.camera.project((fall.position + step * axis)[None]) - phone.camera.project(fall.position[None]))[0] / step
              for axis in np.eye(3)] for phone in phones]  # fmt: skip
    matrix = np.array(moved).transpose(0, 2, 1).reshape(-1, 3)
    shifts = fall.shifts.ravel()
    return (shifts - matrix @ np.linalg.lstsq(matrix, shifts, rcond=None)[0]).reshape(-1, 2)


def shifted(phone: Phone, shift: np.ndarray) -> Phone:
    """A phone whose picture of everything lies shift (2,) [px] further on: to first order one that is turned by a little."""
    K = phone.camera.K.copy()
    K[:2, 2] += shift
    return replace(phone, camera=replace(phone.camera, K=K))

"""Clocks of phones that were started by hand, to a fraction of a frame: the lines of sight meet only at the right offsets."""

from __future__ import annotations

import numpy as np

from mosa.capture.mattes import Track
from mosa.capture.phones import Phone, nearest_point
from mosa.errors import DataError

MISS = 0.15
"""Radii of the object by which lines of sight of one moment may pass each other (`mosa.data.checks.cameras.AGREEMENT`: right
calibrations have up to 0.15)."""
MOVING = 0.15  # share of a track's fastest motion from which on a frame counts
FINE = 0.25  # step of the search, in frames
FINEST = 0.004  # [s] of it: no phone's films need a finer one to begin with
LOST = 0.5  # share of a track that may find no partner
COST_TOLERANCE = 0.1  # difference of cost (a share) below which two time offsets count as equal


def moving_frames(track: Track) -> np.ndarray:
    """Numbers of the frames in which the object moves, and the frames beside them are seen too."""
    step = np.linalg.norm(np.diff(track.centres, axis=0), axis=1) / np.diff(track.times)
    speed = np.full(len(track.times), np.nan)
    speed[1:-1] = 0.5 * (step[1:] + step[:-1])
    if not np.isfinite(speed).any():
        return np.zeros(0, int)
    return np.flatnonzero(np.nan_to_num(speed) > MOVING * np.nanpercentile(speed, 95))


def pixels_at(track: Track, times: np.ndarray) -> np.ndarray:
    """Centres (..., 2) at times of the track's own clock, linear between neighbouring frames, NaN where one is not seen."""
    after = np.clip(np.searchsorted(track.times, times), 1, len(track.times) - 1)
    t0, t1 = track.times[after - 1], track.times[after]
    share = ((times - t0) / (t1 - t0))[..., None]
    found = (1 - share) * track.centres[after - 1] + share * track.centres[after]
    return np.where(((share >= 0) & (share <= 1)), found, np.nan)


def disagreement(
    phones: tuple[Phone, Phone], tracks: tuple[Track, Track], offsets: np.ndarray
) -> np.ndarray:
    """(K,) in [0, 1] for K offsets [s] by which the second phone's clock is to be put forward: mean over the first's moving frames
    of how far its line of sight passes the second's, (distance / MISS radii)^2, at most 1, which it is where there is none."""
    one, two = phones
    frames = moving_frames(tracks[0])
    if len(frames) == 0:
        return np.ones(len(offsets))
    rays = one.camera.rays(tracks[0].centres[frames])
    normals = np.cross(two.camera.centre - one.camera.centre, rays)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    pixels = pixels_at(tracks[1], tracks[0].times[frames][None] - offsets[:, None])
    other = two.camera.rays(np.nan_to_num(pixels).reshape(-1, 2)).reshape(*pixels.shape[:2], 3)
    radius = float(np.median(tracks[1].radii[tracks[1].seen])) / two.camera.K[0, 0]
    angle = np.abs((other * normals).sum(-1)) / radius
    cost = np.minimum((angle / MISS) ** 2, 1)
    return np.where(np.isfinite(pixels[..., 0]), cost, 1.0).mean(1)


def coarse_offsets(phones: list[Phone], tracks: list[Track], most: float) -> np.ndarray:
    """(V,) [s] to add to each phone's clock so that all have the first one's, to about half a frame.

    Phones are placed one after the other against all that are placed, at each turn the one whose offset is told most sharply: of
    two that face each other, with the object between them, nothing tells it. most [s]: offsets that are looked at. Errors:
    DataError naming the phone whose lines of sight meet the others' at none of them."""
    for phone, track in zip(phones, tracks):
        if len(moving_frames(track)) < 3:
            raise DataError(
                f"{phone.video}: expected an object that moves through at least 3 frames, whole and away from the border, found a "
                f"whole object in {int(track.seen.sum())} of {len(track.times)} frames; look at its plate, or its mask "
                "(white where the object is), and film with more room around the fall"
            )
    step = max(FINE * min(track.clip.interval for track in tracks), FINEST)
    grid = np.arange(-most, most + step, step)
    offsets, placed = np.zeros(len(phones)), [0]
    while len(placed) < len(phones):
        costs = {}
        for v in set(range(len(phones))) - set(placed):
            cost = np.zeros(len(grid))
            for u in placed:
                pair, seen = (phones[u], phones[v]), (tracks[u], tracks[v])
                cost += disagreement(pair, seen, grid - offsets[u])
                cost += disagreement(pair[::-1], seen[::-1], offsets[u] - grid)
            costs[v] = cost / (2 * len(placed))
        lost = {v: cost.min() > LOST for v, cost in costs.items()}
        wide = {v: int((c < c.min() + COST_TOLERANCE).sum()) for v, c in costs.items()}
        v = min(costs, key=lambda v: (lost[v], wide[v]))
        best = int(costs[v].argmin())
        if costs[v][best] > LOST:
            others = ", ".join(phones[u].name for u in placed)
            raise DataError(
                f"{phones[v].video}: its lines of sight meet those of {others} at no offset within {most:g} s (at the best, "
                f"{grid[best]:.3f} s, in {1 - costs[v][best]:.0%} of the frames): expected one fall filmed by phones whose poses "
                "belong together; look for a wrong pose, or raise max_offset"
            )
        offsets[v] = grid[best]
        placed.append(v)
    return offsets


def centres_at(
    phones: list[Phone], tracks: list[Track], offsets: np.ndarray, times: np.ndarray
) -> np.ndarray:
    """(T, 3) where the lines of sight meet at times of the first phone's clock; NaN with fewer than two."""
    pixels = np.stack([pixels_at(track, times - offset) for track, offset in zip(tracks, offsets)])
    origins = np.stack([phone.camera.centre for phone in phones])
    rays = np.stack([phone.camera.rays(np.nan_to_num(p)) for phone, p in zip(phones, pixels)])
    seen = np.isfinite(pixels[..., 0])
    found = np.full((len(times), 3), np.nan)
    for t in range(len(times)):
        if seen[:, t].sum() >= 2:
            found[t] = nearest_point(origins[seen[:, t]], rays[seen[:, t], t])
    return found

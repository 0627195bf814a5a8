"""Bodies of the built-in scenes: signed distances of their parts, smoothly joined, and the colours painted on them.

A shape lives in its own frame: y up, the ground at y = 0, looking along +x; lengths in metres. Distances are exact for spheres
and capsules, first order near the surface for ellipsoids, and grow a little inside a blend.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Field = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Shape:
    """distance: points (M, 3) [m] to signed distance (M,) [m], negative inside; color: points and a generator to (M, 3) RGB in
    [0, 1]; bounds: (2, 3) box that holds it [m]."""

    distance: Field
    color: Callable[[np.ndarray, np.random.Generator], np.ndarray]
    bounds: np.ndarray


def ellipsoid(points: np.ndarray, center, radii) -> np.ndarray:
    """Distance to an axis-parallel ellipsoid: level k over its gradient's length, k (k - 1)/|grad k|."""
    r = points - np.asarray(center)
    radii = np.asarray(radii)
    level = np.linalg.norm(r / radii, axis=-1)
    slope = np.linalg.norm(r / radii**2, axis=-1)
    inner = level < 1e-6
    return np.where(inner, -radii.min(), level * (level - 1) / np.where(inner, 1.0, slope))


def sphere(points: np.ndarray, center, radius: float) -> np.ndarray:
    return np.linalg.norm(points - np.asarray(center), axis=-1) - radius


def capsule(points: np.ndarray, start, end, radius: float, end_radius: float | None = None) -> np.ndarray:
    """Distance to a capsule; with `end_radius` its radius changes linearly along the axis."""
    start, axis = np.asarray(start), np.asarray(end) - np.asarray(start)
    along = np.clip((points - start) @ axis / (axis @ axis), 0, 1)
    end_radius = radius if end_radius is None else end_radius
    return np.linalg.norm(points - start - along[:, None] * axis, axis=-1) - (radius + along * (end_radius - radius))


def join(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Union with a fillet where both distances differ by less than `width` [m] (quadratic smooth minimum)."""
    h = np.maximum(width - np.abs(a - b), 0) / width
    return np.minimum(a, b) - 0.25 * width * h * h


def mirrored(points: np.ndarray) -> np.ndarray:
    """Points with their z made positive, for parts that come in pairs."""
    return points * np.array([1, 1, 0]) + np.abs(points) * np.array([0, 0, 1])


def step(value: np.ndarray, edge: float, width: float) -> np.ndarray:
    """0 below `edge` - width/2, 1 above `edge` + width/2, smooth between."""
    t = np.clip((value - edge) / width + 0.5, 0, 1)
    return t * t * (3 - 2 * t)


def blend(color: np.ndarray, other, amount: np.ndarray) -> np.ndarray:
    """Colour (M, 3) moved towards `other` by `amount` (M,) in [0, 1]."""
    return color + amount[:, None] * (np.asarray(other) - color)


def waves(points: np.ndarray, rng: np.random.Generator, wavelength: float, count: int = 24) -> np.ndarray:
    """Smooth random field (M,) of unit variance: a sum of plane waves of about that wavelength [m]."""
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    numbers = directions * (2 * np.pi / wavelength) * rng.uniform(0.75, 1.25, (count, 1))
    phases = rng.uniform(0, 2 * np.pi, count)
    return np.sqrt(2 / count) * np.cos(points @ numbers.T + phases).sum(-1)


def coat(
    points: np.ndarray, rng: np.random.Generator, base, first, second, *, patch: float, grain: float
) -> np.ndarray:
    """Patches of two colours on a base, with a finer mottle over all: a texture in which every turn and stretch shows."""
    color = np.broadcast_to(np.asarray(base, dtype=float), points.shape).copy()
    color = blend(color, first, step(waves(points, rng, patch), 0.45, 0.35))
    color = blend(color, second, step(waves(points, rng, 0.8 * patch), 0.85, 0.35))
    shade = 0.10 * waves(points, rng, grain) + 0.07 * waves(points, rng, 1.6 * grain)
    tint = np.stack([waves(points, rng, 1.3 * grain) for _ in range(3)], -1)
    return color * (1 + np.clip(shade, -0.3, 0.3))[:, None] + 0.03 * tint


# --- rabbit ---------------------------------------------------------------------------------------------------------------

LEFT_EAR = ((0.018, 0.180, 0.030), (0.004, 0.227, 0.045))
RIGHT_EAR = ((0.018, 0.180, -0.030), (-0.014, 0.217, -0.058))


def ear(points: np.ndarray, start, end, margin: float = 0.0) -> np.ndarray:
    """A leaf: narrower at the head, widest half way, `margin` [m] wider all round."""
    middle = np.add(start, end) / 2
    lower = capsule(points, start, middle, 0.0205 + margin, 0.0255 + margin)
    return np.minimum(lower, capsule(points, middle, end, 0.0255 + margin, 0.0200 + margin))


def rabbit_distance(points: np.ndarray) -> np.ndarray:
    """A sitting rabbit, 0.25 m from feet to ear tip: body, haunches, feet, paws, head, ears of unequal pose, tail.

    Stout: every part is at least two cells of a learner's grid (0.02 m) thick, so that its law and not its grid decides.
    """
    both = mirrored(points)
    body = ellipsoid(points, (-0.012, 0.080, 0.0), (0.092, 0.080, 0.080))
    body = join(body, ellipsoid(both, (-0.030, 0.045, 0.052), (0.052, 0.045, 0.038)), 0.020)
    body = join(body, sphere(points, (-0.108, 0.062, 0.0), 0.026), 0.014)
    feet = capsule(both, (0.000, 0.022, 0.054), (0.060, 0.020, 0.048), 0.022, 0.020)
    paws = capsule(both, (0.050, 0.085, 0.032), (0.078, 0.040, 0.026), 0.024, 0.020)
    body = join(join(body, feet, 0.020), paws, 0.016)
    head = join(
        ellipsoid(points, (0.036, 0.145, 0.0), (0.062, 0.052, 0.058)), sphere(both, (0.080, 0.132, 0.012), 0.024), 0.020
    )
    body = join(body, head, 0.030)
    for start, end in (LEFT_EAR, RIGHT_EAR):
        body = join(body, ear(points, start, end), 0.016)
    return body


def rabbit_color(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A spotted coat; white muzzle, chest, feet and tail; pink nose and inner ears; one dark ear."""
    both = mirrored(points)
    color = coat(points, rng, (0.90, 0.78, 0.60), (0.76, 0.42, 0.20), (0.33, 0.20, 0.14), patch=0.10, grain=0.028)
    white, pink = (0.97, 0.94, 0.90), (0.93, 0.56, 0.56)
    edge = waves(points, rng, 0.03) * 0.002
    for part in (
        sphere(points, (0.100, 0.126, 0.0), 0.030), sphere(points, (-0.110, 0.062, 0.0), 0.029),
        sphere(points, (0.088, 0.084, 0.0), 0.032), capsule(both, (0.05, 0.016, 0.05), (0.09, 0.014, 0.04), 0.026),
        sphere(both, (0.090, 0.040, 0.026), 0.020),
    ):  # fmt: skip
        color = blend(color, white, step(-(part + edge), 0.0, 0.006))
    color = blend(color, (0.30, 0.18, 0.13), step(-ear(points, *RIGHT_EAR, margin=0.004), 0.0, 0.008))
    for start, end in (LEFT_EAR, RIGHT_EAR):
        front = np.array([0.020, 0.004, 0.0])
        color = blend(
            color, pink, step(-ear(points, np.add(start, front), np.add(end, front), margin=-0.008), 0.0, 0.006)
        )
    color = blend(color, pink, step(-sphere(points, (0.105, 0.141, 0.0), 0.0110), 0.0, 0.004))
    color = blend(color, (0.07, 0.05, 0.05), step(-sphere(both, (0.080, 0.162, 0.040), 0.0125), 0.0, 0.004))
    color = blend(color, (1.0, 1.0, 1.0), step(-sphere(both, (0.0875, 0.1685, 0.0405), 0.0045), 0.0, 0.002))
    return np.clip(color, 0.02, 1.0)


# --- peanut ---------------------------------------------------------------------------------------------------------------


def upright(points: np.ndarray) -> np.ndarray:
    """Points of the lying peanut in a frame where its long axis is y, from 0 to 0.26 m."""
    return np.stack([0.066 - points[:, 1], points[:, 0] + 0.13, points[:, 2]], -1)


def peanut_distance(points: np.ndarray) -> np.ndarray:
    """A peanut in its shell, 0.26 m long, lying along x: two bulbs, a waist, a bent axis, ribs along it."""
    stood = upright(points)
    bent = stood - np.array([1.0, 0.0, 0.0]) * 0.012 * np.sin(np.pi * stood[:, 1:2] / 0.26)
    lower = ellipsoid(bent, (0.0, 0.075, 0.0), (0.066, 0.075, 0.062))
    upper = ellipsoid(bent, (0.0, 0.190, 0.008), (0.055, 0.070, 0.057))
    angle = np.arctan2(bent[:, 2], bent[:, 0])
    away = np.hypot(bent[:, 0], bent[:, 2]) / 0.05
    ribs = 0.0012 * np.cos(9 * angle) * np.clip(away, 0, 1) * np.cos(2 * np.pi * bent[:, 1] / 0.045) ** 2
    return join(lower, upper, 0.035) - ribs


def peanut_color(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A painted shell: ochre with patches of green and dark red, a pale band round the waist on one side."""
    color = coat(points, rng, (0.86, 0.66, 0.36), (0.28, 0.52, 0.42), (0.58, 0.20, 0.16), patch=0.11, grain=0.028)
    points = upright(points)
    band = step(0.016 - np.abs(points[:, 1] - 0.135 - 0.2 * points[:, 0]), 0.0, 0.008) * step(points[:, 2], -0.02, 0.04)
    color = blend(color, (0.95, 0.90, 0.80), band)
    color = blend(color, (0.20, 0.28, 0.55), step(-sphere(points, (0.05, 0.215, 0.02), 0.022), 0.0, 0.006))
    return np.clip(color, 0.02, 1.0)


# --- mandarin -------------------------------------------------------------------------------------------------------------


def mandarin_distance(points: np.ndarray) -> np.ndarray:
    """A mandarin, 0.19 m high and 0.21 m wide: a flattened ball with shallow lobes and a stub of a stalk, leaning a little."""
    centre = np.array([0.0, 0.085, 0.0])
    x, y, z = (points - centre).T
    leaning = np.stack([0.985 * x - 0.174 * y, 0.174 * x + 0.985 * y, z], -1)
    away = np.hypot(leaning[:, 0], leaning[:, 2])
    angle = np.arctan2(leaning[:, 2], leaning[:, 0])
    lobes = 0.0025 * np.cos(10 * angle) * np.clip(away / 0.06, 0, 1) ** 2
    ball = ellipsoid(leaning, (0.0, 0.0, 0.0), (0.105, 0.083, 0.100)) - lobes
    return join(ball, capsule(leaning, (0.0, 0.070, 0.0), (0.012, 0.092, 0.004), 0.022, 0.019), 0.012)


def mandarin_color(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Orange peel with green and dark patches, a green stalk, a pale label on one side."""
    color = coat(points, rng, (0.95, 0.56, 0.12), (0.98, 0.78, 0.26), (0.66, 0.26, 0.10), patch=0.09, grain=0.026)
    color = blend(color, (0.26, 0.46, 0.18), step(points[:, 1], 0.158, 0.012))
    color = blend(color, (0.95, 0.95, 0.90), step(-sphere(points, (0.080, 0.105, 0.055), 0.028), 0.0, 0.004))
    color = blend(color, (0.16, 0.30, 0.60), step(-sphere(points, (0.084, 0.105, 0.060), 0.016), 0.0, 0.004))
    return np.clip(color, 0.02, 1.0)


# --- chick ----------------------------------------------------------------------------------------------------------------


def chick_distance(points: np.ndarray) -> np.ndarray:
    """A sitting chick, 0.22 m high: an egg of a body, a round head, a blunt beak, wings and a tail."""
    both = mirrored(points)
    body = ellipsoid(points, (-0.010, 0.075, 0.0), (0.095, 0.075, 0.080))
    body = join(body, sphere(points, (0.035, 0.160, 0.0), 0.060), 0.030)
    body = join(body, capsule(points, (0.080, 0.156, 0.0), (0.105, 0.150, 0.0), 0.024, 0.020), 0.012)
    body = join(body, ellipsoid(both, (-0.020, 0.085, 0.078), (0.055, 0.036, 0.024)), 0.016)
    return join(body, capsule(points, (-0.085, 0.095, 0.0), (-0.118, 0.122, 0.0), 0.028, 0.021), 0.016)


def chick_color(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Yellow down with brown and pale patches, an orange beak, dark eyes of two sizes."""
    both = mirrored(points)
    color = coat(points, rng, (0.96, 0.84, 0.36), (0.72, 0.50, 0.20), (0.98, 0.95, 0.80), patch=0.09, grain=0.026)
    beak = capsule(points, (0.090, 0.154, 0.0), (0.112, 0.149, 0.0), 0.026, 0.024)
    color = blend(color, (0.93, 0.48, 0.14), step(-beak, 0.0, 0.006))
    color = blend(color, (0.07, 0.05, 0.05), step(-sphere(both, (0.074, 0.184, 0.038), 0.013), 0.0, 0.003))
    color = blend(color, (0.24, 0.38, 0.62), step(-sphere(points, (-0.010, 0.080, 0.100), 0.022), 0.0, 0.005))
    return np.clip(color, 0.02, 1.0)


SHAPES = {
    "rabbit": Shape(rabbit_distance, rabbit_color, np.array([[-0.15, -0.01, -0.10], [0.13, 0.27, 0.10]])),
    "peanut": Shape(peanut_distance, peanut_color, np.array([[-0.15, -0.03, -0.09], [0.15, 0.16, 0.09]])),
    "mandarin": Shape(mandarin_distance, mandarin_color, np.array([[-0.13, -0.02, -0.12], [0.13, 0.21, 0.12]])),
    "chick1": Shape(chick_distance, chick_color, np.array([[-0.16, -0.02, -0.12], [0.15, 0.24, 0.12]])),
}

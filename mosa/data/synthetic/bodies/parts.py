"""What the bodies of the built-in scenes are made of: signed distances of parts, their joints, and paint.

A shape lives in its own frame: y up, the ground at y = 0, looking along +x; lengths in metres. Distances are exact for spheres
and capsules, first order near the surface for ellipsoids, and grow a little inside a blend."""

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


def capsule(
    points: np.ndarray, start, end, radius: float, end_radius: float | None = None
) -> np.ndarray:
    """Distance to a capsule; with `end_radius` its radius changes linearly along the axis."""
    start, axis = np.asarray(start), np.asarray(end) - np.asarray(start)
    along = np.clip((points - start) @ axis / (axis @ axis), 0, 1)
    end_radius = radius if end_radius is None else end_radius
    away = np.linalg.norm(points - start - along[:, None] * axis, axis=-1)
    return away - (radius + along * (end_radius - radius))


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


def cover(color: np.ndarray, part: np.ndarray, other, edge: float) -> np.ndarray:
    """Colour (M, 3) with `other` inside of a part of distance (M,) [m], soft over `edge` [m]."""
    return blend(color, other, step(-part, 0.0, edge))


def spot(color: np.ndarray, points: np.ndarray, center, radius: float, other, edge: float):
    """Colour (M, 3) with `other` within `radius` of a centre [m], soft over `edge` [m]."""
    return cover(color, sphere(points, center, radius), other, edge)


def waves(
    points: np.ndarray, rng: np.random.Generator, wavelength: float, count: int = 24
) -> np.ndarray:
    """Smooth random field (M,) of unit variance: a sum of plane waves of about that wavelength [m]."""
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    numbers = directions * (2 * np.pi / wavelength) * rng.uniform(0.75, 1.25, (count, 1))
    phases = rng.uniform(0, 2 * np.pi, count)
    return np.sqrt(2 / count) * np.cos(points @ numbers.T + phases).sum(-1)


def coat(
    points: np.ndarray, rng: np.random.Generator, colors, *, patch: float, grain: float
) -> np.ndarray:
    """Patches of the second and third of three colours on the first, with a finer mottle over all: a texture in which every turn
    and stretch shows. patch, grain: wavelengths [m]."""
    base, first, second = colors
    color = np.broadcast_to(np.asarray(base, dtype=float), points.shape).copy()
    color = blend(color, first, step(waves(points, rng, patch), 0.45, 0.35))
    color = blend(color, second, step(waves(points, rng, 0.8 * patch), 0.85, 0.35))
    shade = 0.10 * waves(points, rng, grain) + 0.07 * waves(points, rng, 1.6 * grain)
    tint = np.stack([waves(points, rng, 1.3 * grain) for _ in range(3)], -1)
    return color * (1 + np.clip(shade, -0.3, 0.3))[:, None] + 0.03 * tint


def shape(distance: Field, color, low, high) -> Shape:
    """low, high: corners of the box that holds it [m]. No colour is quite black."""
    painted = lambda points, rng: np.clip(color(points, rng), 0.02, 1.0)  # noqa: E731
    return Shape(distance, painted, np.array([low, high]))

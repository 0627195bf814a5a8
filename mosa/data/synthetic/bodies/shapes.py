"""Bodies of the built-in scenes: parts smoothly joined, and the colours painted on them. Those with gaps between limbs, which no
silhouette shows from all sides, are in `open_shapes.py`."""

from __future__ import annotations

import numpy as np

from mosa.data.synthetic.bodies.open_shapes import (
    calf_color,
    calf_distance,
    gorilla_color,
    gorilla_distance,
    ring_color,
    ring_distance,
)
from mosa.data.synthetic.bodies.parts import (
    blend,
    capsule,
    coat,
    cover,
    ellipsoid,
    join,
    mirrored,
    shape,
    sphere,
    spot,
    step,
    waves,
)
from mosa.data.synthetic.bodies.standin_shapes import STANDIN_SHAPES

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
    cheeks = sphere(both, (0.080, 0.132, 0.012), 0.024)
    head = join(ellipsoid(points, (0.036, 0.145, 0.0), (0.062, 0.052, 0.058)), cheeks, 0.020)
    body = join(body, head, 0.030)
    for start, end in (LEFT_EAR, RIGHT_EAR):
        body = join(body, ear(points, start, end), 0.016)
    return body


def rabbit_color(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A spotted coat; white muzzle, chest, feet and tail; pink nose and inner ears; one dark ear."""
    both = mirrored(points)
    colors = (0.90, 0.78, 0.60), (0.76, 0.42, 0.20), (0.33, 0.20, 0.14)
    color = coat(points, rng, colors, patch=0.10, grain=0.028)
    white, pink = (0.97, 0.94, 0.90), (0.93, 0.56, 0.56)
    edge = waves(points, rng, 0.03) * 0.002
    for part in (
        sphere(points, (0.100, 0.126, 0.0), 0.030), sphere(points, (-0.110, 0.062, 0.0), 0.029),
        sphere(points, (0.088, 0.084, 0.0), 0.032), capsule(both, (0.05, 0.016, 0.05), (0.09, 0.014, 0.04), 0.026),
        sphere(both, (0.090, 0.040, 0.026), 0.020),
    ):  # fmt: skip
        color = cover(color, part + edge, white, 0.006)
    color = cover(color, ear(points, *RIGHT_EAR, margin=0.004), (0.30, 0.18, 0.13), 0.008)
    for start, end in (LEFT_EAR, RIGHT_EAR):
        front = np.array([0.020, 0.004, 0.0])
        inner = ear(points, np.add(start, front), np.add(end, front), margin=-0.008)
        color = cover(color, inner, pink, 0.006)
    color = spot(color, points, (0.105, 0.141, 0.0), 0.0110, pink, 0.004)
    color = spot(color, both, (0.080, 0.162, 0.040), 0.0125, (0.07, 0.05, 0.05), 0.004)
    return spot(color, both, (0.0875, 0.1685, 0.0405), 0.0045, (1.0, 1.0, 1.0), 0.002)


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
    along = np.cos(2 * np.pi * bent[:, 1] / 0.045) ** 2
    ribs = 0.0012 * np.cos(9 * angle) * np.clip(away, 0, 1) * along
    return join(lower, upper, 0.035) - ribs


def peanut_color(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A painted shell: ochre with patches of green and dark red, a pale band round the waist on one side."""
    colors = (0.86, 0.66, 0.36), (0.28, 0.52, 0.42), (0.58, 0.20, 0.16)
    color = coat(points, rng, colors, patch=0.11, grain=0.028)
    points = upright(points)
    waist = np.abs(points[:, 1] - 0.135 - 0.2 * points[:, 0])
    band = step(0.016 - waist, 0.0, 0.008) * step(points[:, 2], -0.02, 0.04)
    color = blend(color, (0.95, 0.90, 0.80), band)
    return spot(color, points, (0.05, 0.215, 0.02), 0.022, (0.20, 0.28, 0.55), 0.006)


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
    return join(
        ball, capsule(leaning, (0.0, 0.070, 0.0), (0.012, 0.092, 0.004), 0.022, 0.019), 0.012
    )


def mandarin_color(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Orange peel with green and dark patches, a green stalk, a pale label on one side."""
    colors = (0.95, 0.56, 0.12), (0.98, 0.78, 0.26), (0.66, 0.26, 0.10)
    color = coat(points, rng, colors, patch=0.09, grain=0.026)
    color = blend(color, (0.26, 0.46, 0.18), step(points[:, 1], 0.158, 0.012))
    color = spot(color, points, (0.080, 0.105, 0.055), 0.028, (0.95, 0.95, 0.90), 0.004)
    return spot(color, points, (0.084, 0.105, 0.060), 0.016, (0.16, 0.30, 0.60), 0.004)


# --- chick ----------------------------------------------------------------------------------------------------------------


def chick_distance(points: np.ndarray) -> np.ndarray:
    """A sitting chick, 0.22 m high: an egg of a body, a round head, a blunt beak, wings and a tail."""
    both = mirrored(points)
    body = ellipsoid(points, (-0.010, 0.075, 0.0), (0.095, 0.075, 0.080))
    body = join(body, sphere(points, (0.035, 0.160, 0.0), 0.060), 0.030)
    part = capsule(points, (0.080, 0.156, 0.0), (0.105, 0.150, 0.0), 0.024, 0.020)
    body = join(body, part, 0.012)
    body = join(body, ellipsoid(both, (-0.020, 0.085, 0.078), (0.055, 0.036, 0.024)), 0.016)
    part = capsule(points, (-0.085, 0.095, 0.0), (-0.118, 0.122, 0.0), 0.028, 0.021)
    return join(body, part, 0.016)


def chick_color(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Yellow down with brown and pale patches, an orange beak, dark eyes of two sizes."""
    both = mirrored(points)
    colors = (0.96, 0.84, 0.36), (0.72, 0.50, 0.20), (0.98, 0.95, 0.80)
    color = coat(points, rng, colors, patch=0.09, grain=0.026)
    beak = capsule(points, (0.090, 0.154, 0.0), (0.112, 0.149, 0.0), 0.026, 0.024)
    color = cover(color, beak, (0.93, 0.48, 0.14), 0.006)
    color = spot(color, both, (0.074, 0.184, 0.038), 0.013, (0.07, 0.05, 0.05), 0.003)
    return spot(color, points, (-0.010, 0.080, 0.100), 0.022, (0.24, 0.38, 0.62), 0.005)


# --- second chick ---------------------------------------------------------------------------------------------------------


def chick2_distance(points: np.ndarray) -> np.ndarray:
    """A standing chick, 0.24 m high: round belly, small head on a neck, wings held out unequally, two feet, a raised tail."""
    body = ellipsoid(points, (0.0, 0.098, 0.0), (0.078, 0.066, 0.068))
    neck = capsule(points, (0.035, 0.125, 0.0), (0.062, 0.176, 0.006), 0.042, 0.032)
    body = join(join(body, neck, 0.022), sphere(points, (0.066, 0.195, 0.008), 0.045), 0.014)
    part = capsule(points, (0.100, 0.190, 0.012), (0.124, 0.182, 0.014), 0.022, 0.019)
    body = join(body, part, 0.010)
    for tip, side in (((-0.030, 0.075, 0.118), 0.056), ((-0.020, 0.128, -0.116), -0.056)):
        body = join(body, capsule(points, (0.012, 0.112, side), tip, 0.029, 0.022), 0.014)
    for ankle, toe in (
        ((0.000, 0.026, 0.038), (0.038, 0.022, 0.044)),
        ((-0.014, 0.026, -0.038), (0.020, 0.022, -0.046)),
    ):
        leg = capsule(points, (ankle[0], 0.060, ankle[2]), ankle, 0.026, 0.024)
        body = join(body, join(leg, capsule(points, ankle, toe, 0.024, 0.022), 0.010), 0.014)
    part = capsule(points, (-0.060, 0.105, 0.0), (-0.108, 0.158, 0.006), 0.030, 0.021)
    return join(body, part, 0.016)


def chick2_color(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Pale down with brown and russet patches, red beak and feet, one dark wing tip, eyes of two sizes."""
    colors = (0.93, 0.86, 0.66), (0.62, 0.40, 0.22), (0.80, 0.52, 0.24)
    color = coat(points, rng, colors, patch=0.085, grain=0.026)
    red = (0.86, 0.30, 0.16)
    beak = capsule(points, (0.108, 0.188, 0.013), (0.128, 0.181, 0.014), 0.024)
    color = cover(color, beak, red, 0.005)
    color = blend(color, red, step(0.030 - points[:, 1], 0.0, 0.006))
    color = spot(color, points, (-0.024, 0.130, -0.122), 0.030, (0.22, 0.17, 0.15), 0.006)
    for center, radius in (((0.092, 0.216, 0.040), 0.012), ((0.094, 0.214, -0.026), 0.010)):
        color = spot(color, points, center, radius, (0.06, 0.05, 0.06), 0.003)
    return color


# --- rainbow ball ---------------------------------------------------------------------------------------------------------

RAINBOW = (
    (0.86, 0.16, 0.16), (0.95, 0.55, 0.12), (0.96, 0.86, 0.20), (0.24, 0.66, 0.28), (0.18, 0.44, 0.80), (0.48, 0.24, 0.62),
)  # fmt: skip


def rainbowball_distance(points: np.ndarray) -> np.ndarray:
    """A ball of 0.2 m."""
    return sphere(points, (0.0, 0.100, 0.0), 0.100)


def rainbowball_color(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Six segments of a leaning ball, each of another width, lightly mottled, with a white cap and a dark patch on one side."""
    arm = points - np.array([0.0, 0.100, 0.0])
    axis = np.array([0.35, 0.85, 0.40]) / np.linalg.norm([0.35, 0.85, 0.40])
    side = np.cross(axis, [1.0, 0.0, 0.0]) / np.linalg.norm(np.cross(axis, [1.0, 0.0, 0.0]))
    turn = np.arctan2(arm @ np.cross(axis, side), arm @ side) + 0.25 * waves(points, rng, 0.09)
    turn = np.mod(turn + 0.4 * np.sin(turn), 2 * np.pi) / (2 * np.pi) * len(RAINBOW)
    color = np.broadcast_to(np.asarray(RAINBOW[0]), points.shape).copy()
    for k in range(1, len(RAINBOW)):
        color = blend(color, RAINBOW[k], step(turn, float(k), 0.08))
    mottle = 0.09 * waves(points, rng, 0.028) + 0.06 * waves(points, rng, 0.045)
    color = color * (1 + np.clip(mottle, -0.3, 0.3))[:, None]
    color = blend(color, (0.96, 0.96, 0.94), step(arm @ axis, 0.084, 0.006))
    return spot(color, points, (-0.06, 0.05, 0.07), 0.030, (0.14, 0.14, 0.20), 0.005)


# --- cylinder -------------------------------------------------------------------------------------------------------------


CYLINDER_AXIS = np.array([0.30, 0.92, 0.18]) / np.linalg.norm([0.30, 0.92, 0.18])


def cylinder_distance(points: np.ndarray) -> np.ndarray:
    """A cylinder, 0.2 m long and 0.17 m wide, its edges rounded by 0.012 m; it leans and lands on an edge."""
    rounding, half = 0.012, 0.1
    arm = points - np.array([0.0, 0.122, 0.0])
    along = arm @ CYLINDER_AXIS
    away = np.linalg.norm(arm - along[:, None] * CYLINDER_AXIS, axis=-1) - (0.085 - rounding)
    over = np.abs(along) - (half - rounding)
    inside, beyond = np.minimum(np.maximum(away, over), 0), np.maximum([away, over], 0)
    return inside + np.hypot(*beyond) - rounding


def cylinder_color(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Grey rubber with blue and ochre patches, a red spot on one side, a white one near the top of another."""
    colors = (0.62, 0.64, 0.66), (0.20, 0.36, 0.66), (0.86, 0.66, 0.28)
    color = coat(points, rng, colors, patch=0.085, grain=0.026)
    color = spot(color, points, (0.090, 0.080, 0.020), 0.034, (0.80, 0.20, 0.18), 0.006)
    return spot(color, points, (-0.040, 0.160, 0.075), 0.030, (0.95, 0.94, 0.90), 0.006)


SHAPES = {
    "cylinder": shape(cylinder_distance, cylinder_color, (-0.13, -0.02, -0.12), (0.13, 0.27, 0.12)),
    "rabbit": shape(rabbit_distance, rabbit_color, (-0.15, -0.01, -0.10), (0.13, 0.27, 0.10)),
    "peanut": shape(peanut_distance, peanut_color, (-0.15, -0.03, -0.09), (0.15, 0.16, 0.09)),
    "mandarin": shape(mandarin_distance, mandarin_color, (-0.13, -0.02, -0.12), (0.13, 0.21, 0.12)),
    "chick1": shape(chick_distance, chick_color, (-0.16, -0.02, -0.12), (0.15, 0.24, 0.12)),
    "chick2": shape(chick2_distance, chick2_color, (-0.14, -0.01, -0.15), (0.15, 0.25, 0.15)),
    "rainbowball": shape(
        rainbowball_distance, rainbowball_color, (-0.11, -0.01, -0.11), (0.11, 0.21, 0.11)
    ),
    "gorilla": shape(gorilla_distance, gorilla_color, (-0.15, -0.01, -0.16), (0.19, 0.28, 0.16)),
    "calf": shape(calf_distance, calf_color, (-0.17, -0.01, -0.11), (0.19, 0.28, 0.11)),
    **STANDIN_SHAPES,
    "ring": shape(ring_distance, ring_color, (-0.13, -0.01, -0.13), (0.13, 0.22, 0.13)),
}

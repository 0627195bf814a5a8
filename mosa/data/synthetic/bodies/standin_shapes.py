"""Bodies that stand in for the nine scenes of PAC-NeRF, whose own shapes are not used: half a metre large, and named alike.

The tube of toothpaste is a tenth of that, as there."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from mosa.data.synthetic.bodies.parts import capsule, coat, ellipsoid, join, mirrored, shape, sphere

LEAN = np.array([0.35, 0.86, 0.37]) / np.linalg.norm([0.35, 0.86, 0.37])


def painted(colors, size: float) -> Callable[[np.ndarray, np.random.Generator], np.ndarray]:
    """A coat of three colours; size: of its patches, 1 for a body of half a metre."""

    def color(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return coat(points, rng, colors, patch=0.17 * size, grain=0.052 * size)

    return color


def torus(points: np.ndarray, center, axis: np.ndarray, radius: float, tube: float) -> np.ndarray:
    """Distance to a torus about a unit axis."""
    arm = points - np.asarray(center)
    along = arm @ axis
    return np.hypot(np.linalg.norm(arm - along[:, None] * axis, axis=-1) - radius, along) - tube


def torus_distance(points: np.ndarray) -> np.ndarray:
    """A thick ring that leans a little, 0.47 m across."""
    return torus(points, (0.0, 0.155, 0.0), LEAN, 0.160, 0.075)


def bird_distance(points: np.ndarray) -> np.ndarray:
    """A sitting bird: egg-shaped body, head with a beak, folded wings, a tail held up."""
    both = mirrored(points)
    body = ellipsoid(points, (0.0, 0.150, 0.0), (0.215, 0.150, 0.150))
    body = join(body, sphere(points, (0.130, 0.300, 0.0), 0.098), 0.060)
    part = capsule(points, (0.205, 0.290, 0.0), (0.270, 0.268, 0.0), 0.048, 0.042)
    body = join(body, part, 0.024)
    body = join(body, ellipsoid(both, (-0.050, 0.170, 0.140), (0.130, 0.075, 0.055)), 0.035)
    part = capsule(points, (-0.180, 0.200, 0.0), (-0.290, 0.285, 0.0), 0.060, 0.048)
    return join(body, part, 0.035)


def cat_distance(points: np.ndarray) -> np.ndarray:
    """A sitting cat: a pear of a body, head with two ears, forelegs, a tail laid round."""
    both = mirrored(points)
    chest = sphere(points, (0.030, 0.240, 0.0), 0.095)
    body = join(ellipsoid(points, (-0.030, 0.130, 0.0), (0.150, 0.130, 0.130)), chest, 0.060)
    body = join(body, sphere(points, (0.065, 0.350, 0.0), 0.095), 0.040)
    part = capsule(both, (0.055, 0.400, 0.055), (0.050, 0.455, 0.075), 0.048, 0.042)
    body = join(body, part, 0.020)
    part = capsule(both, (0.090, 0.210, 0.060), (0.115, 0.048, 0.065), 0.052, 0.048)
    body = join(body, part, 0.030)
    part = capsule(points, (-0.150, 0.060, 0.030), (-0.170, 0.055, 0.190), 0.052, 0.045)
    return join(body, part, 0.035)


def playdoh_distance(points: np.ndarray) -> np.ndarray:
    """A lump of dough, pressed flat on two sides."""
    beside = sphere(points, (0.110, 0.120, 0.070), 0.110)
    lump = join(ellipsoid(points, (0.0, 0.160, 0.0), (0.170, 0.160, 0.140)), beside, 0.060)
    return np.maximum(lump, np.abs(points @ np.array([0.28, 0.10, 0.955])) - 0.115)


def droplet_distance(points: np.ndarray) -> np.ndarray:
    """A drop with a blunt tip."""
    tip = capsule(points, (0.0, 0.190, 0.0), (0.0, 0.330, 0.0), 0.120, 0.045)
    return join(sphere(points, (0.0, 0.150, 0.0), 0.150), tip, 0.050)


def letter_distance(points: np.ndarray) -> np.ndarray:
    """A letter E of round strokes."""
    stem = capsule(points, (-0.100, 0.060, 0.0), (-0.100, 0.380, 0.0), 0.060)
    for height, reach in ((0.060, 0.120), (0.220, 0.080), (0.380, 0.110)):
        stem = join(
            stem, capsule(points, (-0.100, height, 0.0), (reach, height, 0.0), 0.060, 0.052), 0.020
        )
    return stem


def cream_distance(points: np.ndarray) -> np.ndarray:
    """A swirl of cream: three rings one on the other, each narrower, and a tip."""
    up = np.array([0.0, 1.0, 0.0])
    middle = sphere(points, (0.0, 0.080, 0.0), 0.080)
    body = join(torus(points, (0.0, 0.070, 0.0), up, 0.110, 0.070), middle, 0.040)
    body = join(body, torus(points, (0.010, 0.165, 0.0), up, 0.065, 0.062), 0.030)
    part = capsule(points, (0.0, 0.200, 0.0), (0.020, 0.320, 0.010), 0.075, 0.045)
    return join(body, part, 0.040)


def toothpaste_distance(points: np.ndarray) -> np.ndarray:
    """A short piece of paste, bent, 0.05 m high."""
    joints = (
        (-0.016, 0.008, 0.0),
        (0.006, 0.010, 0.006),
        (0.012, 0.026, 0.002),
        (0.000, 0.041, -0.004),
    )
    return np.min([capsule(points, a, b, 0.009) for a, b in pairwise(joints)], 0)


def trophy_distance(points: np.ndarray) -> np.ndarray:
    """A cup of sand: foot, stem, filled bowl."""
    foot = ellipsoid(points, (0.0, 0.060, 0.0), (0.140, 0.060, 0.140))
    stem = capsule(points, (0.0, 0.080, 0.0), (0.0, 0.200, 0.0), 0.062)
    bowl = ellipsoid(points, (0.0, 0.300, 0.0), (0.150, 0.115, 0.150))
    return join(join(foot, stem, 0.040), bowl, 0.050)


LOOKS = {
    "torus": ((0.30, 0.55, 0.85), (0.90, 0.78, 0.30), (0.15, 0.2, 0.4)),
    "bird": ((0.55, 0.75, 0.40), (0.90, 0.85, 0.50), (0.30, 0.25, 0.2)),
    "cat": ((0.85, 0.60, 0.35), (0.55, 0.30, 0.16), (0.95, 0.92, 0.86)),
    "playdoh": ((0.90, 0.35, 0.40), (0.98, 0.75, 0.30), (0.4, 0.2, 0.5)),
    "droplet": ((0.35, 0.65, 0.90), (0.15, 0.35, 0.70), (0.9, 0.95, 1.0)),
    "letter": ((0.85, 0.30, 0.25), (0.30, 0.30, 0.70), (0.95, 0.85, 0.4)),
    "cream": ((0.97, 0.93, 0.85), (0.80, 0.55, 0.45), (0.55, 0.4, 0.35)),
    "toothpaste": ((0.55, 0.85, 0.85), (0.95, 0.95, 0.95), (0.2, 0.4, 0.7)),
    "trophy": ((0.85, 0.70, 0.35), (0.60, 0.42, 0.20), (0.98, 0.9, 0.7)),
}
"""Colours of the coats."""
BOUNDS = {
    "torus": ((-0.26, -0.02, -0.26), (0.26, 0.33, 0.26)),
    "bird": ((-0.36, -0.02, -0.22), (0.33, 0.42, 0.22)),
    "cat": ((-0.25, -0.02, -0.26), (0.20, 0.52, 0.26)),
    "playdoh": ((-0.20, -0.02, -0.18), (0.25, 0.34, 0.20)),
    "droplet": ((-0.17, -0.02, -0.17), (0.17, 0.40, 0.17)),
    "letter": ((-0.18, -0.02, -0.08), (0.20, 0.46, 0.08)),
    "cream": ((-0.20, -0.02, -0.20), (0.20, 0.38, 0.20)),
    "toothpaste": ((-0.03, -0.004, -0.02), (0.03, 0.054, 0.02)),
    "trophy": ((-0.18, -0.02, -0.18), (0.18, 0.44, 0.18)),
}
"""Corners of the boxes that hold them [m]."""
DISTANCES = {
    "torus": torus_distance,
    "bird": bird_distance,
    "cat": cat_distance,
    "playdoh": playdoh_distance,
    "droplet": droplet_distance,
    "letter": letter_distance,
    "cream": cream_distance,
    "toothpaste": toothpaste_distance,
    "trophy": trophy_distance,
}

STANDIN_SHAPES = {
    name: shape(distance, painted(LOOKS[name], 0.1 if name == "toothpaste" else 1.0), *BOUNDS[name])
    for name, distance in DISTANCES.items()
}

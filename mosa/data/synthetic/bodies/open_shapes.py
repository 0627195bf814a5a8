"""Bodies of the built-in scenes with gaps: between limbs, under a chin, through a ring. A visual hull fills parts of them."""

from __future__ import annotations

import numpy as np

from mosa.data.synthetic.bodies.parts import (
    blend,
    capsule,
    coat,
    ellipsoid,
    join,
    sphere,
    spot,
    step,
    waves,
)

# --- gorilla --------------------------------------------------------------------------------------------------------------

# shoulder, elbow, fist; hip, knee, heel, toe: mid-stride, so that no side is the mirror of the other
ARMS = (
    ((0.050, 0.178, 0.062), (0.092, 0.112, 0.108), (0.122, 0.028, 0.104)),
    ((0.050, 0.178, -0.062), (0.056, 0.110, -0.116), (0.030, 0.028, -0.118)),
)
LEGS = (
    ((-0.066, 0.100, 0.044), (-0.056, 0.072, 0.082), (-0.088, 0.026, 0.080), (-0.050, 0.025, 0.092)),
    ((-0.066, 0.100, -0.044), (-0.034, 0.068, -0.070), (-0.052, 0.026, -0.066), (-0.016, 0.025, -0.070)),
)  # fmt: skip


def limb(points: np.ndarray, joints, radii) -> np.ndarray:
    """Capsules from joint to joint, with the radius of each joint."""
    pairs = zip(joints, joints[1:], radii, radii[1:])
    return np.min([capsule(points, a, b, r, s) for a, b, r, s in pairs], 0)


def gorilla_distance(points: np.ndarray) -> np.ndarray:
    """A gorilla walking on its knuckles, 0.26 m high: a leaning trunk, a head with a muzzle, arms and legs away from the body."""
    body = capsule(points, (-0.062, 0.116, 0.0), (0.040, 0.166, 0.0), 0.058, 0.066)
    muzzle = sphere(points, (0.136, 0.198, 0.010), 0.028)
    head = join(sphere(points, (0.104, 0.214, 0.006), 0.044), muzzle, 0.016)
    body = join(body, head, 0.024)
    for joints in ARMS:
        body = join(body, limb(points, joints, (0.034, 0.028, 0.028)), 0.016)
    for joints in LEGS:
        body = join(body, limb(points, joints, (0.040, 0.030, 0.026, 0.024)), 0.016)
    return body


def gorilla_color(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Brown fur with grey and russet patches, a pale back, a bare face and fists, dark eyes."""
    colors = (0.40, 0.32, 0.27), (0.58, 0.54, 0.50), (0.55, 0.30, 0.18)
    color = coat(points, rng, colors, patch=0.085, grain=0.027)
    edge = waves(points, rng, 0.035) * 0.004
    back = sphere(points, (-0.050, 0.190, 0.010), 0.052)
    color = blend(color, (0.74, 0.72, 0.68), step(-back + edge, 0.0, 0.010))
    color = spot(color, points, (0.146, 0.204, 0.010), 0.036, (0.62, 0.48, 0.40), 0.005)
    for joints in ARMS:
        color = spot(color, points, joints[2], 0.031, (0.64, 0.50, 0.42), 0.006)
    for center, radius in (((0.137, 0.230, 0.030), 0.010), ((0.139, 0.229, -0.014), 0.008)):
        color = spot(color, points, center, radius, (0.05, 0.04, 0.04), 0.003)
    return color


# --- calf -----------------------------------------------------------------------------------------------------------------

# hip or shoulder, knee, hoof
FEET = (
    ((0.066, 0.130, 0.034), (0.074, 0.080, 0.044), (0.080, 0.024, 0.046)),
    ((0.066, 0.130, -0.034), (0.062, 0.080, -0.044), (0.048, 0.024, -0.046)),
    ((-0.078, 0.132, 0.034), (-0.082, 0.082, 0.044), (-0.106, 0.024, 0.046)),
    ((-0.078, 0.132, -0.034), (-0.070, 0.082, -0.044), (-0.076, 0.024, -0.046)),
)


def calf_distance(points: np.ndarray) -> np.ndarray:
    """A calf in mid-stride, 0.27 m high and 0.33 m long: a long trunk on four legs, a neck, a head held forward, ears, a tail."""
    body = join(
        capsule(points, (-0.082, 0.152, 0.0), (0.062, 0.154, 0.0), 0.048, 0.050),
        ellipsoid(points, (-0.012, 0.142, 0.0), (0.075, 0.052, 0.054)), 0.020,
    )  # fmt: skip
    part = capsule(points, (0.074, 0.168, 0.0), (0.108, 0.224, 0.004), 0.036, 0.031)
    body = join(body, part, 0.018)
    muzzle = capsule(points, (0.122, 0.226, 0.004), (0.148, 0.206, 0.008), 0.028, 0.024)
    head = join(sphere(points, (0.112, 0.232, 0.004), 0.035), muzzle, 0.012)
    for tip in ((0.098, 0.250, 0.052), (0.096, 0.242, -0.046)):
        root = (0.104, 0.240, 0.02 * np.sign(tip[2]))
        head = join(head, capsule(points, root, tip, 0.018, 0.016), 0.008)
    body = join(body, head, 0.014)
    for joints in FEET:
        body = join(body, limb(points, joints, (0.030, 0.025, 0.0235)), 0.014)
    part = capsule(points, (-0.116, 0.176, 0.0), (-0.142, 0.118, 0.012), 0.021, 0.019)
    return join(body, part, 0.010)


def calf_color(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """White hide with brown and dark patches, a pink muzzle, dark hooves, eyes of two sizes."""
    colors = (0.90, 0.87, 0.82), (0.52, 0.32, 0.20), (0.26, 0.20, 0.18)
    color = coat(points, rng, colors, patch=0.09, grain=0.026)
    color = spot(color, points, (0.166, 0.198, 0.008), 0.030, (0.90, 0.62, 0.60), 0.005)
    color = blend(color, (0.24, 0.20, 0.19), step(0.018 - points[:, 1], 0.0, 0.006))
    for center, radius in (((0.136, 0.252, 0.030), 0.010), ((0.137, 0.250, -0.022), 0.008)):
        color = spot(color, points, center, radius, (0.05, 0.04, 0.05), 0.003)
    return color


# --- ring -----------------------------------------------------------------------------------------------------------------

RING_AXIS = np.array([0.56, 0.62, 0.55]) / np.linalg.norm([0.56, 0.62, 0.55])
RING_RADIUS, RING_TUBE = 0.088, 0.023
RING_CENTER = np.array([0.0, RING_RADIUS * np.sqrt(1 - RING_AXIS[1] ** 2) + RING_TUBE, 0.0])


def ring_distance(points: np.ndarray) -> np.ndarray:
    """A thin ring that leans: 0.222 m across, its tube 0.046 m thick. Exact."""
    arm = points - RING_CENTER
    along = arm @ RING_AXIS
    away = np.linalg.norm(arm - along[:, None] * RING_AXIS, axis=-1)
    return np.hypot(away - RING_RADIUS, along) - RING_TUBE


def ring_color(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Painted rubber: teal with ochre and dark red patches, and one white stretch."""
    colors = (0.30, 0.62, 0.60), (0.86, 0.66, 0.28), (0.56, 0.18, 0.20)
    color = coat(points, rng, colors, patch=0.08, grain=0.025)
    white = RING_CENTER + np.array([0.07, -0.04, -0.03])
    return spot(color, points, white, 0.036, (0.94, 0.93, 0.88), 0.006)

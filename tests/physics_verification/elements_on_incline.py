"""A flat elastic block on an incline in plane strain by finite elements, Coulomb's law at its lowest nodes: no grid, no particles.

The control of `incline.released`: what the model itself does when gravity begins at once, with and without damping.
"""

from __future__ import annotations

import math

import numpy as np

LENGTH, HEIGHT, DENSITY, GRAVITY = 0.4, 0.12, 1000.0, 9.8


def stiffness(lam: float, mu: float, h: float) -> np.ndarray:
    """(8, 8) of a square bilinear element of edge h, by four Gauss points; independent of h in plane strain."""
    D = np.array([[lam + 2 * mu, lam, 0], [lam, lam + 2 * mu, 0], [0, 0, mu]])
    K, g = np.zeros((8, 8)), 1 / math.sqrt(3)
    for a in (-g, g):
        for b in (-g, g):
            dx = np.array([-(1 - b), 1 - b, 1 + b, -(1 + b)]) / (2 * h)
            dy = np.array([-(1 - a), -(1 + a), 1 + a, 1 - a]) / (2 * h)
            B = np.zeros((3, 8))
            B[0, 0::2], B[1, 1::2], B[2, 0::2], B[2, 1::2] = dx, dy, dy, dx
            K += B.T @ D @ B * h * h / 4
    return K


def released_elements(angle: float, friction: float, *, E: float = 1e6, nu: float = 0.3, across: int = 20, damping: float = 0.0,
                      seconds: float = 0.4, courant: float = 0.1) -> tuple[float, float]:  # fmt: skip
    """(way [m], mean speed over the last quarter of the time [m/s]) down the incline. angle [degrees]; across: elements of the
    block's length; damping [s]: of the stress, over that of the strain's rate (Kelvin and Voigt)."""
    h, up = LENGTH / across, round(across * HEIGHT / LENGTH)
    lam, mu, t = E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu)), math.radians(angle)
    K, nodes = stiffness(lam, mu, h), np.arange((across + 1) * (up + 1)).reshape(across + 1, up + 1)
    corners = np.stack(
        [nodes[:-1, :-1], nodes[1:, :-1], nodes[1:, 1:], nodes[:-1, 1:]], -1
    ).reshape(-1, 4)
    index = np.stack([2 * corners, 2 * corners + 1], -1).reshape(-1, 8)
    mass = np.repeat(np.bincount(corners.ravel()) * DENSITY * h * h / 4, 2)
    pull = np.tile([GRAVITY * math.sin(t), -GRAVITY * math.cos(t)], nodes.size)
    u, v = np.zeros(2 * nodes.size), np.zeros(2 * nodes.size)
    low, dt = nodes[:, 0], courant * h / math.sqrt((lam + 2 * mu) / DENSITY)
    steps, track = round(seconds / dt), []
    for step in range(steps):
        force = -(u[index] + damping * v[index]) @ K
        v = v + dt * (np.bincount(index.ravel(), force.ravel(), minlength=len(u)) / mass + pull)
        normal = (
            -u[2 * low + 1] / dt - v[2 * low + 1]
        )  # change of velocity that keeps a node above the incline
        change = np.maximum(normal, 0.0)
        along = v[2 * low]
        v[2 * low + 1] += change
        v[2 * low] = np.where(
            change > 0, np.sign(along) * np.maximum(np.abs(along) - friction * change, 0.0), along
        )
        u = u + dt * v
        if step in (steps * 3 // 4, steps - 1):
            track.append(float((mass[0::2] * u[0::2]).sum() / mass[0::2].sum()))
    return track[1], (track[1] - track[0]) / (steps - 1 - steps * 3 // 4) / dt

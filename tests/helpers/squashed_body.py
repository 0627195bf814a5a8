"""A body with a known, non-affine motion, drawn by ray marching its analytic inverse map: truth that no splat had a hand in."""

from __future__ import annotations

import numpy as np
import torch

from mosa.types import Cameras, Ground, Scene, Truth

RADII = np.array([0.07, 0.11, 0.08])


def _parameters(time: float, last: float) -> tuple[float, float, float, np.ndarray, np.ndarray]:
    """Squash, bulge, bend, rotation and translation at a time: free fall first, then the body is squashed and bends."""
    contact = 0.4 * last
    late = max(0.0, time - contact) / (last - contact)
    squash, bend = 0.30 * np.sin(0.5 * np.pi * late), 0.9 * late
    angle = 0.5 * time / last
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    fall = min(time, contact)
    height = 0.30 - 1.6 * fall - 4.9 * fall**2 - 0.05 * late
    return squash, 0.5 * squash, bend, rotation, np.array([0.02 + 0.3 * time, height, 0.01])


def forward(rest: np.ndarray, time: float, last: float) -> np.ndarray:
    """Deformed positions (M, 3) [m] of rest positions (M, 3) [m]."""
    squash, bulge, bend, rotation, translation = _parameters(time, last)
    level = rest[:, 1] / RADII[1]
    y = rest[:, 1] * (1 - squash * (0.7 - 0.2 * level))
    swell = 1 + bulge * (0.8 - 0.5 * level)
    x = rest[:, 0] * swell + bend * rest[:, 1] ** 2
    return np.stack([x, y, rest[:, 2] * swell], -1) @ rotation.T + translation


def backward(points: np.ndarray, time: float, last: float) -> np.ndarray:
    """Inverse of `forward`."""
    squash, bulge, bend, rotation, translation = _parameters(time, last)
    local = (points - translation) @ rotation
    # y = a Y + b Y^2, the root that is continuous with squash = 0
    a, b = 1 - 0.7 * squash, 0.2 * squash / RADII[1]
    y = local[:, 1]
    rest_y = y / a if b == 0 else 2 * y / (a + np.sqrt(np.maximum(a * a + 4 * b * y, 1e-9)))
    swell = 1 + bulge * (0.8 - 0.5 * rest_y / RADII[1])
    swell = np.where(np.abs(swell) < 0.2, 0.2, swell)
    return np.stack([(local[:, 0] - bend * rest_y**2) / swell, rest_y, local[:, 2] / swell], -1)


def inside(rest: np.ndarray) -> np.ndarray:
    """Level function: negative inside the rest ellipsoid."""
    return np.sqrt(((rest / RADII) ** 2).sum(-1)) - 1


def color(rest: np.ndarray) -> np.ndarray:
    """Smooth texture over rest positions, (M, 3) in [0, 1]."""
    waves = np.array([[45.0, 20.0, 10.0], [-15.0, 50.0, 25.0], [20.0, -30.0, 55.0]])
    return 0.5 + 0.35 * np.sin(rest @ waves.T + np.array([0.3, 1.1, 2.0]))


def cameras(count: int, size: int) -> Cameras:
    """Cameras around and above, looking at the middle of the motion."""
    target = np.array([0.04, 0.22, 0.0])
    K, w2c = [], []
    for i in range(count):
        azimuth, elevation = 2 * np.pi * i / count, 0.15 + 0.75 * (i % 3) / 2
        back = np.array(
            [
                np.cos(azimuth) * np.cos(elevation),
                np.sin(elevation),
                np.sin(azimuth) * np.cos(elevation),
            ]
        )
        z = -back
        x = np.cross(z, [0, 1.0, 0])
        x /= np.linalg.norm(x)
        axes = np.stack([x, np.cross(z, x), z])
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = axes, -axes @ (target + 1.2 * back)
        K.append([[2.4 * size, 0, size / 2], [0, 2.4 * size, size / 2], [0, 0, 1]])
        w2c.append(matrix)
    return Cameras(
        torch.tensor(np.array(K), dtype=torch.float32),
        torch.tensor(np.array(w2c), dtype=torch.float32),
        size,
        size,
        tuple(f"camera_{i}" for i in range(count)),
    )


def draw(
    view: Cameras, time: float, last: float, oversample: int = 2
) -> tuple[np.ndarray, np.ndarray]:
    """Image (H, W, 3) on white and matte (H, W) of one camera: sphere tracing in rest space, then averaging of sub-pixels."""
    size = view.width * oversample
    pixel = (np.arange(size) + 0.5) / oversample
    u, v = np.meshgrid(pixel, pixel)
    K, w2c = view.K[0].double().numpy(), view.w2c[0].double().numpy()
    rays = np.stack(
        [(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1
    ).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    rays, start = rays @ w2c[:3, :3], -w2c[:3, :3].T @ w2c[:3, 3]
    centre = forward(np.zeros((1, 3)), time, last)[0]
    along = rays @ (centre - start)
    near = np.linalg.norm(start + along[:, None] * rays - centre, axis=-1) < 0.16
    depth = along - 0.16
    active = np.flatnonzero(near)
    for _ in range(60):
        gap = inside(backward(start + depth[active, None] * rays[active], time, last))
        depth[active] += 0.035 * gap
        active = active[depth[active] < along[active] + 0.16]
    hit = np.zeros(len(rays), bool)
    hit[active] = inside(backward(start + depth[active, None] * rays[active], time, last)) < 0.02
    image = np.ones((len(rays), 3))
    image[hit] = color(backward(start + depth[hit, None] * rays[hit], time, last))
    blocks = (view.height, oversample, view.width, oversample)
    return (
        image.reshape(*blocks, 3).mean((1, 3)).astype(np.float32),
        hit.reshape(blocks).mean((1, 3)).astype(np.float32),
    )


def make_scene(*, views: int = 8, frames: int = 8, size: int = 96, frame_dt: float = 0.02) -> Scene:
    """The scene with its truth; held-out cameras and frames: none."""
    rig = cameras(views, size)
    times = np.arange(frames) * frame_dt
    drawn = [[draw(rig.select([v]), t, times[-1]) for t in times] for v in range(views)]
    images = torch.from_numpy(np.array([[d[0] for d in row] for row in drawn]))
    mattes = torch.from_numpy(np.array([[d[1] for d in row] for row in drawn]))
    axis = np.linspace(-1, 1, 21)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3) * RADII
    rest = grid[inside(grid) < 0]
    positions = np.stack([forward(rest, t, times[-1]) for t in times])
    as_tensor = lambda a: torch.as_tensor(a, dtype=torch.float32)  # noqa: E731
    truth = Truth(as_tensor(rest), as_tensor(positions), torch.eye(3), as_tensor([0.3, -1.6, 0.0]))
    return Scene(
        "squashed_body",
        "train",
        images,
        mattes,
        rig,
        as_tensor(times),
        as_tensor([0, -9.8, 0]),
        as_tensor([0, 1.0, 0]),
        Ground(0.0),
        as_tensor([[-0.5, 0.0, -0.5], [0.5, 0.6, 0.5]]),
        1000.0,
        torch.ones(3),
        True,
        truth=truth,
        fingerprint=f"squashed_body-{views}-{frames}-{size}",
    )

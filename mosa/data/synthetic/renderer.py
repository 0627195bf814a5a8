"""Pictures of a deformed surface by ray casting: not the renderer that learns, so nothing of its errors is in the data."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from mosa.data.synthetic.raycast_kernels import cast
from mosa.data.synthetic.surface import Surface, vertex_normals
from mosa.physics.launching import ON_CPU
from mosa.types import Cameras

LIGHT = np.array([0.45, 0.80, 0.40]) / np.linalg.norm([0.45, 0.80, 0.40])
AMBIENT = 0.62
SAMPLES = 2


@ON_CPU
def render_surface(surface: Surface, vertices: np.ndarray, cameras: Cameras) -> np.ndarray:
    """RGBA (V, H, W, 4) uint8, straight alpha, of the surface with its vertices at (M, 3) [m]; 2x2 rays per pixel."""
    normals = vertex_normals(vertices, surface.triangles)
    mesh = wp.Mesh(
        wp.array(vertices.astype(np.float32), dtype=wp.vec3, device="cpu"),
        wp.array(surface.triangles.ravel(), dtype=wp.int32, device="cpu"),
    )
    colors = wp.array(np.clip(surface.colors, 0, 1).astype(np.float32), dtype=wp.vec3, device="cpu")
    normals = wp.array(normals.astype(np.float32), dtype=wp.vec3, device="cpu")
    pictures = np.zeros((len(cameras), cameras.height, cameras.width, 4), np.uint8)
    for v in range(len(cameras)):
        K, w2c = cameras.K[v].double().numpy(), cameras.w2c[v].double().numpy()
        x0, y0, x1, y1 = window(vertices, K, w2c, cameras.width, cameras.height)
        if x1 <= x0 or y1 <= y0:
            continue
        part = wp.zeros((y1 - y0, x1 - x0), dtype=wp.vec4, device="cpu")
        wp.launch(cast, (y1 - y0, x1 - x0), device="cpu", inputs=[
            mesh.id, colors, normals, wp.mat44(*np.linalg.inv(w2c).ravel().tolist()), wp.vec2(K[0, 0], K[1, 1]),
            wp.vec2(K[0, 2], K[1, 2]), x0, y0, x1 - x0, SAMPLES, wp.vec3(*LIGHT.tolist()), AMBIENT, part,
        ])  # fmt: skip
        pictures[v, y0:y1, x0:x1] = np.round(255 * np.clip(part.numpy(), 0, 1)).astype(np.uint8)
    return pictures


def window(
    vertices: np.ndarray, K: np.ndarray, w2c: np.ndarray, width: int, height: int
) -> tuple[int, int, int, int]:
    """Pixels (x0, y0, x1, y1) that the projected vertices lie in."""
    seen = vertices @ w2c[:3, :3].T + w2c[:3, 3]
    pixel = seen @ K.T
    pixel = pixel[:, :2] / pixel[:, 2:]
    low, high = np.floor(pixel.min(0)).astype(int) - 1, np.ceil(pixel.max(0)).astype(int) + 1
    return max(low[0], 0), max(low[1], 0), min(high[0], width), min(high[1], height)


def ring_of_cameras(
    count: int, size: int, *, target, distance: float, elevations: tuple[float, ...], field: float, turn: float,
) -> Cameras:  # fmt: skip
    """Cameras around a target, looking at it, at elevations [rad] that take turns. field: half width seen at the target [m];
    turn: azimuth of the first one [rad]."""
    K, w2c = [], []
    for i in range(count):
        azimuth, elevation = turn + 2 * np.pi * i / count, elevations[i % len(elevations)]
        flat = np.cos(elevation)
        back = np.array([np.cos(azimuth) * flat, np.sin(elevation), np.sin(azimuth) * flat])
        right = np.cross(-back, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(-back, right), -back])
        pose[:3, 3] = -pose[:3, :3] @ (np.asarray(target) + distance * back)
        focal = 0.5 * size * distance / field
        K.append([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
        w2c.append(pose)
    K, w2c = (torch.tensor(np.array(a), dtype=torch.float32) for a in (K, w2c))
    return Cameras(K, w2c, size, size, tuple(str(i) for i in range(count)))

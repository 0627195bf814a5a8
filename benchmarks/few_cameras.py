"""A closed mesh around the particles of a body at rest, in another scale and pose: what a scan of it would give.

    python benchmarks/few_cameras.py rest.ply shape.ply

The surface is where the particles' density, smoothed over one spacing, falls to half of that
inside. The mesh is turned by 100 degrees about (1, 2, -1), made 41.7 times larger and moved
(docs/few_cameras.md).
"""

import sys
from pathlib import Path

import numpy as np
import warp as wp
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mosa.data.formats.particles import read_ply

SCALE, SHIFT = 41.7, (120.0, -35.0, 60.0)
AXIS, DEGREES = (1.0, 2.0, -1.0), 100.0


def surface_of(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Vertices (P, 3), triangles (T, 3) and the volume of the mesh around particles (N, 3)."""
    near = cKDTree(points).query(points, k=13)[0][:, 12]
    spacing = float(np.median(near)) / (13 / (4 / 3 * np.pi)) ** (1 / 3)
    pitch = spacing / 2
    low = points.min(0) - 4 * spacing
    shape = np.ceil((points.max(0) + 4 * spacing - low) / pitch).astype(int) + 1
    counts = np.zeros(shape)
    np.add.at(counts, tuple(((points - low) / pitch).round().astype(int).T), 1.0)
    density = ndimage.gaussian_filter(counts, spacing / pitch)
    inside = float(np.quantile(density[density > 0.5 * density.max()], 0.4))
    field = wp.array((density / inside).astype(np.float32), dtype=wp.float32, device="cpu")
    cubes = wp.MarchingCubes(*(int(n) for n in shape))
    cubes.surface(field, 0.5)
    vertices = cubes.verts.numpy().astype(np.float64)
    triangles = cubes.indices.numpy().reshape(-1, 3)
    corners = vertices[triangles]
    volume = (corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    if volume < 0:
        triangles = triangles[:, ::-1]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)  # fmt: skip
    print(f"{len(area)} triangles, {int((area <= 0).sum())} without an area")
    return low + pitch * vertices, triangles, abs(volume) * pitch**3


def main(rest: str, out: str) -> None:
    points = read_ply(Path(rest)).numpy().astype(np.float64)
    vertices, triangles, volume = surface_of(points)
    print(f"volume {volume:.6g} m^3, extent {np.ptp(vertices, axis=0).round(4).tolist()} m")
    axis = np.array(AXIS) / np.linalg.norm(AXIS)
    turn = Rotation.from_rotvec(np.radians(DEGREES) * axis)
    import trimesh

    mesh = trimesh.Trimesh(SCALE * turn.apply(vertices) + SHIFT, triangles, process=True)
    print(f"closed: {mesh.is_watertight}")
    mesh.export(out)


if __name__ == "__main__":
    main(*sys.argv[1:])

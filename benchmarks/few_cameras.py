"""A closed mesh around the particles of a body at rest, in another scale and pose: what a scan of it would give.

    python benchmarks/few_cameras.py rest.ply shape.ply

The surface is a level of the particles' density, smoothed over one spacing; it encloses as much as
the particles have at the density inside. The mesh is turned by 100 degrees about (1, 2, -1), made 41.7 times larger and moved
(docs/few_cameras.md).
"""

import sys
from pathlib import Path

import numpy as np
import trimesh
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
    pitch = 0.8 * spacing
    low = points.min(0) - 4 * spacing
    shape = np.ceil((points.max(0) + 4 * spacing - low) / pitch).astype(int) + 1
    counts = np.zeros(shape)
    np.add.at(counts, tuple(((points - low) / pitch).round().astype(int).T), 1.0)
    density = ndimage.gaussian_filter(counts, spacing / pitch)
    deep = ndimage.binary_erosion(density > 0.25 * density.max(), iterations=3)
    nodes = round(len(points) / density[deep].mean())  # that the particles' volume has
    level = np.sort(density, axis=None)[-nodes - 1 : -nodes + 1].mean()
    field = wp.array((density / level).astype(np.float32), dtype=wp.float32, device="cpu")
    cubes = wp.MarchingCubes(*(int(n) for n in shape))
    cubes.surface(field, 1.0)
    vertices = cubes.verts.numpy().astype(np.float64)
    triangles = cubes.indices.numpy().reshape(-1, 3)
    corners = vertices[triangles]
    volume = (corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    triangles = triangles[:, ::-1] if volume < 0 else triangles
    return low + pitch * vertices, triangles, abs(volume) * pitch**3


def main(rest: str, out: str) -> None:
    points = read_ply(Path(rest)).numpy().astype(np.float64)
    vertices, triangles, volume = surface_of(points)
    print(f"volume {volume:.6g} m^3, extent {np.ptp(vertices, axis=0).round(4).tolist()} m")
    axis = np.array(AXIS) / np.linalg.norm(AXIS)
    turn = Rotation.from_rotvec(np.radians(DEGREES) * axis)
    mesh = trimesh.Trimesh(SCALE * turn.apply(vertices) + SHIFT, triangles, process=True)
    print(f"{len(mesh.faces)} triangles, closed: {mesh.is_watertight}")
    mesh.export(out)


if __name__ == "__main__":
    main(*sys.argv[1:])

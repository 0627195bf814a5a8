"""Triangle meshes as colliders: a lattice of signed distances, computed once in float64.

The nearest triangle comes from Warp's mesh queries, the distance to it is recomputed in float64; the sign is that of the
generalised winding number (Jacobson et al. 2013), which a closed mesh has near 1 inside and 0 outside.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import warp as wp
from torch import Tensor

from mosa.errors import ConfigError, DataError
from mosa.physics.launching import ON_CPU
from mosa.system.limits import counted

MAX_LATTICE = 2**24
FARTHEST, SMALLEST = 1e6, 1e-6
"""[m] of a vertex, of the longest extent."""


@dataclass(frozen=True)
class SignedDistanceField:
    """Distances [m] on a regular lattice. values: (nx, ny, nz) float64; origin: (3,) [m] of the first node; spacing [m];
    margin [m]: how far the lattice reaches beyond the surface."""

    values: Tensor
    origin: tuple[float, float, float]
    spacing: float
    margin: float

    @property
    def longest_side(self) -> float:
        """Of the box about the mesh [m], to a spacing or two."""
        return self.spacing * (max(self.values.shape) - 1) - 2 * self.margin


@wp.kernel(module="mosa.physics.contact.mesh", enable_backward=False)
def _nearest(
    mesh: wp.uint64, points: wp.array(dtype=wp.vec3), reach: wp.float32, face: wp.array(dtype=int),
    sign: wp.array(dtype=wp.float32),
):  # fmt: skip
    i = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, points[i], reach)
    face[i] = -1
    if query.result:
        face[i] = query.face
        sign[i] = query.sign


def triangle_distance(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(M,) distances of points (M, 3) to their triangles (M, 3, 3): to the plane over the inside, else to the nearest edge."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    inside = np.ones(len(points), dtype=bool)
    nearest = np.full(len(points), np.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        edge, arm = q - p, points - p
        along = np.clip((arm * edge).sum(1) / (edge * edge).sum(1), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(arm - along[:, None] * edge, axis=1))
        inside &= (np.cross(edge, arm) * normal).sum(1) >= 0
    flat = np.abs(((points - a) * normal).sum(1)) / area
    return np.where(inside, flat, nearest)


def field_of_triangles(
    vertices: Tensor | np.ndarray,
    triangles: Tensor | np.ndarray,
    spacing: float | None = None,
    margin: float | None = None,
) -> SignedDistanceField:
    """Signed distances to a closed, consistently oriented mesh. vertices: (P, 3) [m]; triangles: (T, 3) indices.

    spacing [m] of the lattice (None: the longest extent over 48); margin [m] beyond the mesh, at least two
    spacings (None: a sixth of the longest extent).
    Errors: ConfigError: shapes, indices, no area, not closed, lattice too large."""
    points, index = np.asarray(vertices, dtype=np.float64), np.asarray(triangles, dtype=np.int64)
    if points.shape[1:] != (3,) or index.shape[1:] != (3,) or not len(index):
        raise ConfigError(
            f"mesh: expected vertices (P, 3) and triangles (T, 3), found {points.shape} and {index.shape}"
        )
    if not np.isfinite(points).all() or index.min() < 0 or index.max() >= len(points):
        raise ConfigError(f"mesh: expected finite vertices and indices from 0 to {len(points) - 1}")
    if (far := float(np.abs(points).max())) > FARTHEST:
        raise ConfigError(
            f"mesh: expected vertices within {FARTHEST:g} m, found one at {far:.3g} m: check scale"
        )
    points, index = _welded(points, index)
    directed = np.concatenate([index[:, [0, 1]], index[:, [1, 2]], index[:, [2, 0]]])
    keys, counts = np.unique(directed, axis=0, return_counts=True)
    if (counts > 1).any() or not np.array_equal(keys, np.unique(directed[:, ::-1], axis=0)):
        raise ConfigError(
            f"mesh: expected a closed surface, each edge between two triangles of one orientation; found open or doubled edges "
            f"among {len(index)} triangles: fill its holes"
        )
    corners = points[index]
    edges = corners[:, 1:] - corners[:, :1]
    if not np.cross(edges[:, 0], edges[:, 1]).any(1).all():
        raise ConfigError("mesh: expected triangles with an area, found a degenerate one")
    if (corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum() < 0:
        raise ConfigError(
            "mesh: its triangles face inwards (negative volume): turn their orientation around"
        )
    extent = float((points.max(0) - points.min(0)).max())
    if extent < SMALLEST:
        raise ConfigError(
            f"mesh: expected an extent of at least {SMALLEST:g} m, found {extent:.3g} m: check scale"
        )
    spacing = extent / 48 if spacing is None else spacing
    if not spacing > 0:
        raise ConfigError(f"mesh: spacing: expected a positive number [m], found {spacing}")
    margin = max(2 * spacing, extent / 6 if margin is None else margin)
    low = points.min(0) - margin
    dims = counted(f"mesh: nodes at spacing {spacing:.3g} m", np.ceil((points.max(0) + margin - low) / spacing) + 1,
                   "use a larger spacing or a smaller margin", most=MAX_LATTICE)  # fmt: skip
    axes = [low[i] + spacing * np.arange(dims[i]) for i in range(3)]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    values = torch.from_numpy(_signed_distance(points, index, lattice)).reshape(dims)
    return SignedDistanceField(values, tuple(low.tolist()), float(spacing), margin)


@ON_CPU
def _signed_distance(points: np.ndarray, index: np.ndarray, at: np.ndarray) -> np.ndarray:
    centre = points.mean(0)  # float32 queries are finest near the origin
    mesh = wp.Mesh(
        wp.array((points - centre).astype(np.float32), dtype=wp.vec3, device="cpu"),
        wp.array(index.reshape(-1).astype(np.int32), dtype=wp.int32, device="cpu"), support_winding_number=True,
    )  # fmt: skip
    face = wp.zeros(len(at), dtype=int, device="cpu")
    sign = wp.zeros(len(at), dtype=wp.float32, device="cpu")
    queries = wp.array((at - centre).astype(np.float32), dtype=wp.vec3, device="cpu")
    wp.launch(_nearest, len(at), inputs=[mesh.id, queries, 1e30, face, sign], device="cpu")
    return np.sign(sign.numpy()) * triangle_distance(at, points[index[face.numpy()]])


def _welded(points: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices at one place become one: files often repeat them for normals and texture."""
    unique, inverse = np.unique(points, axis=0, return_inverse=True)
    return unique, inverse.reshape(-1)[index]


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (P, 3) and triangles (T, 3) of an OBJ, PLY or STL file; faces with more corners are cut into fans.

    Errors: ConfigError naming the file."""
    path = Path(path)
    if not path.is_file():
        raise ConfigError(f"mesh: no file {path}")
    readers = {".obj": _read_obj, ".ply": _read_ply, ".stl": _read_stl}
    if path.suffix.lower() not in readers:
        raise ConfigError(f"mesh: {path}: expected a file .obj, .ply or .stl")
    try:
        vertices, faces = readers[path.suffix.lower()](path)
        triangles = np.array(
            [(f[0], f[i], f[i + 1]) for f in faces for i in range(1, len(f) - 1)], dtype=np.int64
        ).reshape(-1, 3)
        if not len(vertices) or not len(triangles):
            raise ConfigError(f"mesh: {path}: expected triangles, found none: empty, or damaged?")
    except DataError as error:
        raise ConfigError(f"mesh: {error}") from error
    except ConfigError:
        raise
    except Exception as error:  # whatever a parser finds: the file is not what its name says
        raise ConfigError(
            f"mesh: {path} cannot be read ({type(error).__name__}: {error})"
        ) from error
    return vertices, triangles


def field_of_mesh(
    path: Path, spacing: float | None = None, margin: float | None = None, scale: float = 1.0
) -> SignedDistanceField:
    """Signed distances to the mesh of a file (`read_mesh`), times `scale` to metres.

    Errors: ConfigError naming the file."""
    vertices, triangles = read_mesh(path)
    try:
        return field_of_triangles(scale * vertices, triangles, spacing, margin)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def _read_stl(path: Path) -> tuple[np.ndarray, list]:
    try:
        import trimesh
    except ImportError as error:
        raise ConfigError(
            f"mesh: {path}: an STL file needs the package trimesh, which is not installed: "
            "pip install trimesh, or write an OBJ or PLY file"
        ) from error
    mesh = trimesh.load(path, file_type="stl", force="mesh")
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces).tolist()


def _read_obj(path: Path) -> tuple[np.ndarray, list]:
    vertices, faces = [], []
    for line in path.read_text().splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            vertices.append([float(w) for w in words[1:4]])
        elif words[:1] == ["f"]:
            corners = [int(w.split("/")[0]) for w in words[1:]]
            faces.append([c - 1 if c > 0 else len(vertices) + c for c in corners])
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), faces


def _read_ply(path: Path) -> tuple[np.ndarray, list]:
    from plyfile import PlyData

    from mosa.system.ply import check_ply

    check_ply(path)
    data = PlyData.read(str(path))
    vertex, face = data["vertex"], data["face"]
    name = next(p.name for p in face.properties if p.name in ("vertex_indices", "vertex_index"))
    return np.stack([vertex[k] for k in "xyz"], 1).astype(np.float64), [list(f) for f in face[name]]

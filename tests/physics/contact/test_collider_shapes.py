"""Signed distances of the colliders' shapes against closed forms and scipy; gradient and curvature against differences."""

import numpy as np
import pytest
import torch
import warp as wp
from scipy.spatial import ConvexHull, cKDTree

from mosa.errors import ConfigError
from mosa.physics.contact.colliders import (
    Box,
    Capsule,
    Collider,
    Cylinder,
    HalfSpace,
    Sphere,
    pack_colliders,
)
from mosa.physics.contact.mesh import field_of_mesh, field_of_triangles
from mosa.physics.contact.reference import signed_distance as twin
from mosa.physics.contact.shapes import shape_functions

functions = shape_functions(wp.float64)
signed_distance, curvature = functions.signed_distance, functions.curvature


@wp.kernel(module="unique", enable_backward=False)
def evaluate(
    q: wp.array(dtype=wp.vec3d), b: wp.array(dtype=wp.vec3d), shapes: wp.array2d(dtype=wp.float64),
    codes: wp.array2d(dtype=int), fields: wp.array(dtype=wp.float64), phi: wp.array(dtype=wp.float64),
    g: wp.array(dtype=wp.vec3d), h: wp.array(dtype=wp.vec3d),
):  # fmt: skip
    i = wp.tid()
    a, n = signed_distance(q[i], 1, shapes, codes, fields)
    phi[i] = a
    g[i] = n
    h[i] = curvature(q[i], 1, shapes, codes, fields, b[i])


def run(shape, q, b=None):
    """(phi (M,), gradient (M, 3), curvature along b (M, 3)); a mesh before it, so that offsets are not 0."""
    packed = pack_colliders(
        [Collider(CUBE_FIELD), Collider(shape)], torch.float64, torch.device("cpu")
    )
    b = torch.zeros_like(q) if b is None else b
    phi, g, h = torch.zeros(len(q)).double(), torch.zeros_like(q), torch.zeros_like(q)
    kinds = [wp.vec3d, wp.vec3d, wp.float64, wp.int32, wp.float64, wp.float64, wp.vec3d, wp.vec3d]
    arrays = [
        wp.from_torch(t.contiguous(), dtype=k) for t, k in zip([q, b, *packed, phi, g, h], kinds)
    ]
    wp.launch(evaluate, len(q), inputs=arrays, device="cpu")
    return phi, g, h


CUBE_FACES = [[0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4], [2, 6, 7], [2, 7, 3], [0, 4, 6], [0, 6, 2],
              [1, 3, 7], [1, 7, 5]]  # fmt: skip
CUBE = np.array([[z, y, x] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * [0.3, 0.2, 0.1]
CUBE_FIELD = field_of_triangles(CUBE, CUBE_FACES, spacing=0.025, margin=0.2)
SHAPES = {"half space": HalfSpace(), "sphere": Sphere(0.3), "capsule": Capsule(0.15, 0.4), "cylinder": Cylinder(0.2, 0.5),
          "box": Box((0.6, 0.4, 0.2)), "field": CUBE_FIELD}  # fmt: skip


def projected(shape, q):
    """Distance to the nearest point of the solid, written down; inside: minus the distance to the nearest face."""
    q = q.numpy()
    if isinstance(shape, HalfSpace):
        return q[:, 2]
    if isinstance(shape, Sphere):
        return np.sqrt((q**2).sum(1)) - shape.radius
    if isinstance(shape, Capsule):
        nearest = np.clip(q[:, 2], -shape.length / 2, shape.length / 2)
        return np.hypot(np.hypot(q[:, 0], q[:, 1]), q[:, 2] - nearest) - shape.radius
    if isinstance(shape, Cylinder):
        rho, half = np.hypot(q[:, 0], q[:, 1]), shape.length / 2
        nearest = np.stack([q[:, 0] * np.minimum(1, shape.radius / rho), q[:, 1] * np.minimum(1, shape.radius / rho),
                            np.clip(q[:, 2], -half, half)], 1)  # fmt: skip
        depth = np.minimum(shape.radius - rho, half - np.abs(q[:, 2]))
    else:
        half = np.array(shape.size) / 2
        nearest = np.clip(q, -half, half)
        depth = (half - np.abs(q)).min(1)
    return np.where(depth > 0, -depth, np.linalg.norm(q - nearest, axis=1))


@pytest.fixture(scope="module")
def points():
    generator = torch.Generator().manual_seed(3)
    return 0.8 * (torch.rand(2000, 3, generator=generator, dtype=torch.float64) - 0.5)


@pytest.mark.parametrize("name", SHAPES)
def test_distance_gradient_and_curvature(name, points):
    shape = SHAPES[name]
    b = torch.randn(points.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    phi, g, h = run(shape, points, b)
    inside = phi < 1e29  # of the lattice
    assert (phi < 0).sum() > 50 and (phi[inside] > 0).sum() > 50
    torch.testing.assert_close(phi[inside], twin(shape, points)[inside], rtol=0, atol=1e-14)
    if name != "field":
        np.testing.assert_allclose(phi, projected(shape, points), rtol=0, atol=1e-14)
        torch.testing.assert_close(
            g.norm(dim=1), torch.ones(len(points)).double(), rtol=0, atol=1e-14
        )
    step = 1e-6
    (phi_plus, g_plus, _), (phi_minus, g_minus, _) = (
        run(shape, points + s * step * b) for s in (1, -1)
    )
    along = (phi_plus - phi_minus)[inside] / (2 * step)
    slope = (g * b).sum(1)[inside]
    turned = ((g_plus - g_minus) / (2 * step))[inside]
    # differences across an edge of the distance are no derivative; few of 2000 points are that near to one
    smooth = (turned - h[inside]).norm(dim=1) < 1e-5 * (1 + h[inside].norm(dim=1))
    assert smooth.float().mean() > 0.995
    torch.testing.assert_close(slope[smooth], along[smooth], rtol=1e-7, atol=1e-8)
    assert h[inside].norm(dim=1).max() > 1 or name == "half space"


@pytest.mark.parametrize("name", SHAPES)
def test_special_points_are_finite(name):
    """Centre, axis, edges, corners: a unit gradient and a finite curvature, whichever side is taken."""
    q = torch.tensor(
        [
            [0, 0, 0],
            [0, 0, 0.1],
            [0, 0, 0.25],
            [0.2, 0, 0.25],
            [0.3, 0.2, 0.1],
            [0.3, 0, 0],
            [0, 0, 0.2],
        ]
    ).double()
    phi, g, h = run(SHAPES[name], q, torch.ones_like(q))
    assert torch.isfinite(phi).all() and torch.isfinite(g).all() and torch.isfinite(h).all()
    if name != "field":
        torch.testing.assert_close(g.norm(dim=1), torch.ones(len(q)).double(), rtol=0, atol=1e-14)


def test_field_of_a_box_is_its_distance():
    """At the nodes of the lattice the exact distance; between them to second order away from edges."""
    nodes = torch.cartesian_prod(*[torch.arange(n) for n in CUBE_FIELD.values.shape]).double()
    nodes = nodes * CUBE_FIELD.spacing + torch.tensor(CUBE_FIELD.origin)
    expected = projected(Box((0.6, 0.4, 0.2)), nodes)
    np.testing.assert_allclose(CUBE_FIELD.values.reshape(-1), expected, rtol=0, atol=1e-7)
    assert (expected < -0.05).sum() > 10


def test_field_of_a_polyhedron():
    """A drawn convex polyhedron: inside, the largest of scipy's face distances; outside, the distance to dense surface samples."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(40, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    hull = ConvexHull(points)
    faces = hull.simplices.copy()
    a, b, c = (points[faces[:, i]] for i in range(3))
    flip = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(1) < 0
    faces[flip] = faces[flip][:, [0, 2, 1]]
    field = field_of_triangles(points, faces, spacing=0.15)
    axes = [
        np.array(field.origin)[i] + field.spacing * np.arange(field.values.shape[i])
        for i in range(3)
    ]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    found = field.values.reshape(-1).numpy()
    level = (nodes @ hull.equations[:, :3].T + hull.equations[:, 3]).max(1)
    assert ((level < 0) == (found < 0)).all()
    np.testing.assert_allclose(found[level < 0], level[level < 0], rtol=0, atol=1e-12)
    weights = rng.dirichlet(np.ones(3), size=(len(faces), 3000))
    samples = np.einsum("fsk,fkd->fsd", weights, points[faces]).reshape(-1, 3)
    distance, _ = cKDTree(samples).query(nodes[level > 0.1])
    np.testing.assert_allclose(found[level > 0.1], distance, rtol=0, atol=5e-3)
    assert (found[level > 0.1] <= distance + 1e-12).all()


def test_mesh_files(tmp_path):
    """OBJ with quadrilaterals and repeated vertices, and the binary PLY of the same triangles."""
    from plyfile import PlyData, PlyElement

    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    lines, n = [], 0
    for quad in quads:
        lines += [f"v {1000 * x} {1000 * y} {1000 * z}" for x, y, z in CUBE[quad]]
        lines.append("f " + " ".join(f"{n + i + 1}//1" for i in (3, 2, 1, 0)))
        n += 4
    (tmp_path / "box.obj").write_text("\n".join(lines))
    vertex = np.array([tuple(v) for v in CUBE], dtype=[("x", "f8"), ("y", "f8"), ("z", "f8")])
    face = np.array([(f,) for f in CUBE_FACES], dtype=[("vertex_indices", "i4", (3,))])
    PlyData([PlyElement.describe(vertex, "vertex"), PlyElement.describe(face, "face")]).write(
        str(tmp_path / "box.ply")
    )
    for name, scale in (("box.obj", 1e-3), ("box.ply", 1.0)):
        field = field_of_mesh(tmp_path / name, spacing=0.025, margin=0.2, scale=scale)
        torch.testing.assert_close(field.values, CUBE_FIELD.values, rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    "vertices, faces, options, match",
    [
        (CUBE, CUBE_FACES[:-1], {}, "closed surface"),
        (CUBE, [[c, b, a] for a, b, c in CUBE_FACES], {}, "face inwards"),
        (CUBE, [[0, 1, 9]], {}, "indices from 0 to 7"),
        (CUBE, CUBE_FACES, {"spacing": -1.0}, "spacing"),
        (CUBE, CUBE_FACES, {"spacing": 1e-4}, "use a larger spacing"),
        (CUBE, CUBE_FACES, {"margin": 1e12}, "use a larger spacing or a smaller margin"),
        (CUBE[:, :2], CUBE_FACES, {}, r"vertices \(P, 3\)"),
    ],
)
def test_errors(vertices, faces, options, match):
    with pytest.raises(ConfigError, match=match):
        field_of_triangles(vertices, faces, **options)


def test_unreadable_files(tmp_path):
    with pytest.raises(ConfigError, match=r"no file .*absent\.obj"):
        field_of_mesh(tmp_path / "absent.obj")
    (tmp_path / "a.3ds").write_text("")
    with pytest.raises(ConfigError, match=r"a\.3ds: expected a file"):
        field_of_mesh(tmp_path / "a.3ds")
    (tmp_path / "a.ply").write_text("no ply")
    with pytest.raises(ConfigError, match=r"a\.ply: expected a PLY file"):
        field_of_mesh(tmp_path / "a.ply")
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3")
    with pytest.raises(ConfigError, match=r"a\.obj: mesh: expected a closed surface"):
        field_of_mesh(tmp_path / "a.obj")
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999999999999999")
    with pytest.raises(ConfigError, match=r"a\.obj cannot be read \(OverflowError"):
        field_of_mesh(tmp_path / "a.obj")

"""A body of known shape is found in mattes that another rasteriser drew: an L whose file has another unit and pose."""

import functools

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mosa.data.hull import Volume
from mosa.data.synthetic.renderer import ring_of_cameras
from mosa.errors import DataError
from mosa.reconstruction.geometry.known import Solid
from mosa.reconstruction.pose import known, outlines
from mosa.reconstruction.pose.known import known_centres, known_start, register_known
from mosa.reconstruction.pose.outlines import Similarities
from mosa.types import REST, Ground, KnownBody, Scene

SCALE, SIZE, SPACE = 0.0031, 96, 4
CORNERS = np.array([[0, 0], [60, 0], [60, 20], [24, 20], [24, 90], [0, 90]], float)
PARTS = ([0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5])  # of its face, triangles
THICK = 30.0
SPIN, VELOCITY, GRAVITY = (1.0, -2.0, 1.5), (0.2, -0.3, -0.1), (0.0, -9.8, 0.0)
POSE = Rotation.from_euler("xyz", [40, -70, 25], degrees=True).as_matrix()
CENTER, DT = np.array([0.03, 0.8, -0.02]), 1 / 30


def vertices(depth: float = THICK) -> np.ndarray:
    """(12, 3) of the L in the file's units."""
    return np.array([[x, y, z] for z in (0.0, depth) for x, y in CORNERS])


def written(path, depth: float = THICK, faces: int | None = None) -> KnownBody:
    """An OBJ file of the L; of its first `faces` triangles."""
    n = len(CORNERS)
    triangles = [(c, b, a) for a, b, c in PARTS] + [(a + n, b + n, c + n) for a, b, c in PARTS]
    for i in range(n):
        j = (i + 1) % n
        triangles += [(i, j, j + n), (i, j + n, i + n)]
    lines = [f"v {x} {y} {z}" for x, y, z in vertices(depth)]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in triangles[:faces]]
    path.write_text("\n".join(lines))
    return KnownBody(str(path), None, str(depth))


def middle() -> np.ndarray:
    """(3,) centre of the L's volume, in the file's units."""
    areas, centres = np.array([24 * 90.0, 36 * 20.0]), np.array([[12, 45], [42, 10]])
    return np.append(areas @ centres / areas.sum(), THICK / 2)


def placed(t: float) -> np.ndarray:
    """(12, 3) [m] of the L in flight at `t` [s]."""
    turn = Rotation.from_rotvec(np.array(SPIN) * t).as_matrix() @ POSE
    center = CENTER + np.array(VELOCITY) * t + 0.5 * np.array(GRAVITY) * t**2
    return SCALE * (vertices() - middle()) @ turn.T + center


def silhouette(corners: np.ndarray, K: np.ndarray, w2c: np.ndarray) -> np.ndarray:
    """(H, W) shares of pixels: the L is two boxes, whose silhouettes are convex."""
    seen = corners @ w2c[:3, :3].T + w2c[:3, 3]
    pixels = (seen @ K.T)[:, :2] / seen[:, 2:]
    picture = np.zeros((SIZE * SPACE, SIZE * SPACE), np.uint8)
    foot = (corners[3] - corners[4]) * 20 / 70 + corners[3]  # where the upright meets the ground
    rear = (corners[9] - corners[10]) * 20 / 70 + corners[9]
    more = np.stack([foot, rear]) @ w2c[:3, :3].T + w2c[:3, 3]
    more = (more @ K.T)[:, :2] / more[:, 2:]
    upright = np.concatenate([pixels[[0, 4, 5, 6, 10, 11]], more])
    lying = pixels[[0, 1, 2, 6, 7, 8]]
    back = np.concatenate([lying, pixels[[3, 9]] + (pixels[[0, 6]] - more)])
    for points in (upright, back):
        hull = cv2.convexHull(points.astype(np.float32))[:, 0]
        fixed = np.round((hull * SPACE - 0.5) * 256).astype(np.int32)
        cv2.fillConvexPoly(picture, fixed, 255, shift=8)
    return picture.reshape(SIZE, SPACE, SIZE, SPACE).mean((1, 3)) / 255


@functools.cache
def film(views: int, frames: int) -> tuple[torch.Tensor, object]:
    rig = ring_of_cameras(
        views, SIZE, target=(0, 0.7, 0), distance=1.2, elevations=(0.2, 0.5), field=0.28, turn=0.3
    )
    mattes = [
        [silhouette(placed(DT * t), K.numpy(), w2c.numpy()) for t in range(frames)]
        for K, w2c in zip(rig.K.double(), rig.w2c.double())
    ]
    return torch.from_numpy(np.array(mattes)).float(), rig


def scene_of(body: KnownBody, views: int, frames: int, **more) -> Scene:
    mattes, rig = film(views, frames)
    box = torch.tensor([[-0.6, 0.0, -0.6], [0.6, 1.2, 0.6]])
    return Scene(
        name="bracket", sequence="train", images=mattes[..., None].expand(*mattes.shape, 3), mattes=mattes,
        cameras=rig, times=DT * torch.arange(frames), gravity=torch.tensor(GRAVITY), up=torch.tensor([0.0, 1, 0]),
        ground=Ground(0.0), box=box, density=1000.0, background=torch.zeros(3), synthetic=False, body=body, **more,
    )  # fmt: skip


def apart(found, t: float = 0.0) -> float:
    """Largest distance [m] of the L's corners from where they are."""
    place = found.place
    R, center, size = place.rotation[0], place.center[0], place.size[0]
    at = (torch.from_numpy(vertices()).float() - found.solid.centre) / found.solid.unit
    return float((size * at @ R.T + center - torch.from_numpy(placed(t)).float()).norm(dim=1).max())


def test_steps_change_misses_as_their_derivatives_say():
    """Of a torus, whose distance is smooth where outlines touch it."""
    axis = torch.linspace(-0.7, 0.7, 85).double()
    x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
    distance = (((x**2 + z**2).sqrt() - 0.35) ** 2 + y**2).sqrt() - 0.15
    low = torch.full((3,), -0.7).double()
    solid = Solid(Volume(distance, low, float(axis[1] - axis[0])), 1.0, torch.zeros(3))
    mattes, rig = film(3, 1)
    rays = outlines.outline_rays(mattes[:, 0], rig).some(60)
    rays = type(rays)(*(v.double() if v.is_floating_point() else v for v in vars(rays).values()))
    turn, center = torch.from_numpy(POSE), torch.from_numpy(CENTER)
    at = Similarities(turn[None], center[None], torch.tensor([90 * SCALE]).double())
    residual, J = outlines.misses(solid, at, rays)
    told = (J.abs().sum(-1) > 0) & (residual.abs() < 5)
    assert int(told.sum()) > 40
    for k in range(7):
        step = torch.zeros(1, 7).double()
        step[0, k] = 1e-4
        after, before = (
            outlines.misses(solid, at.moved(sign * step, solid.reach), rays)[0] for sign in (1, -1)
        )
        slope = (after - before) / 2e-4
        off = (slope - J[..., k]).abs() / J.norm(dim=-1)
        # normals are differences over cells of a ninth of the tube's radius
        assert float(off[told].quantile(0.9)) < 0.11


def test_three_cameras_find_pose_and_scale(tmp_path):
    found = register_known(scene_of(written(tmp_path / "bracket.obj"), 3, 1, start=REST))
    assert apart(found) < 0.004  # a pixel is 5 mm wide there
    assert float(found.place.size[0]) / found.solid.unit == pytest.approx(SCALE, rel=0.02)
    assert min(found.overlap.values()) > 0.95
    body = found.body(40)
    assert body.occupied_volume() == pytest.approx(SCALE**3 * THICK * (24 * 90 + 36 * 20), rel=0.04)


def test_one_camera_finds_the_scale_by_the_fall(tmp_path):
    scene = scene_of(written(tmp_path / "bracket.obj"), 1, 4, last_free_frame=3)
    found = register_known(scene)
    assert float(found.place.size[0]) / found.solid.unit == pytest.approx(SCALE, rel=0.03)
    assert found.frames == 4 and 0 < found.deviation < 0.05
    assert apart(found) < 0.05  # mostly along the line of sight, 1.2 m away
    centres = known_centres(scene, found.place)
    fallen = torch.tensor(GRAVITY) / 2 * (3 * DT) ** 2 + 3 * DT * torch.tensor(VELOCITY)
    assert float((centres[3] - centres[0] - fallen).norm()) < 0.01


def test_outlines_find_a_start_that_colours_miss(tmp_path):
    """The duck's colours, learned by one camera, put its held-out start half a turn off."""
    scene = scene_of(written(tmp_path / "bracket.obj"), 3, 3, last_free_frame=2)
    rest = register_known(scene).place
    turn = torch.from_numpy(Rotation.from_euler("y", 150, degrees=True).as_matrix()).float()
    wrong = rest.turned(turn, rest.center[0] + 0.01, rest.center[0])
    rotation, center, velocity, spin = known_start(
        scene, wrong, rest, rest.center[0], register=True
    )
    assert float((rotation - torch.eye(3)).norm()) < 0.05
    assert float((center - rest.center[0]).norm()) < 0.005
    assert torch.allclose(velocity, torch.tensor(VELOCITY), atol=0.1)
    assert torch.allclose(spin, torch.tensor(SPIN), atol=0.6)


def test_a_pose_that_outlines_leave_is_the_colours(tmp_path, monkeypatch):
    """As of a torus: the search keeps one pose of those about its axis, whichever."""
    scene = scene_of(written(tmp_path / "bracket.obj"), 3, 3, last_free_frame=2)
    found = register_known(scene)
    searched, turn = known.searched, torch.tensor(POSE).float()

    def turned(*given, **named):
        poses, costs = searched(*given, **named)
        return Similarities(turn @ poses.rotation, poses.center, poses.size), costs

    monkeypatch.setattr(known, "searched", turned)
    rotation = known.alike(found.solid, scene, found.place).rotation
    assert float((rotation - found.place.rotation).norm()) < 0.05


def test_one_camera_and_no_fall_is_refused_without_a_scale(tmp_path):
    body = written(tmp_path / "bracket.obj")
    with pytest.raises(DataError, match=r"scene.body.scale=<metres per unit"):
        register_known(scene_of(body, 1, 1, start=REST))


def test_another_shape_is_refused(tmp_path):
    flat = written(tmp_path / "flat.obj", depth=200.0)
    with pytest.raises(DataError, match=r"intersection over union in camera 0 .*: another body"):
        register_known(scene_of(flat, 3, 1, start=REST))

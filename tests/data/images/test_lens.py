"""Undoing a lens: what it bent comes back to where a pinhole camera sees it, by formulas written anew here."""

import json

import cv2
import imageio.v3 as iio
import numpy as np
import pytest
import torch
from written_scenes import opengl_pose

from mosa.data.images.lens import lens_of
from mosa.data.images.reading import composite
from mosa.data.scene import load_scene
from mosa.data.synthetic.bodies.shapes import SHAPES
from mosa.data.synthetic.renderer import render_surface, ring_of_cameras
from mosa.data.synthetic.surface import extract_surface
from mosa.errors import DataError
from mosa.rendering.cameras import scale_cameras

SIZE, FINE = 160, 3
BARREL = {"k1": -0.5, "k2": 0.3, "k3": -0.1, "p1": 0.012, "p2": -0.008}
PINCUSHION = {"k1": 0.7, "k2": 0.9, "p1": -0.01, "p2": 0.006}
FISHEYE = {"k1": -0.5, "k2": 0.3, "k3": -0.1, "k4": 0.05}


def bent(points: np.ndarray, c: dict, fisheye: bool) -> np.ndarray:
    """Normalised coordinates (..., 2) behind the lens: Brown's and Kannala's formulas."""
    x, y = points[..., 0], points[..., 1]
    r2 = x**2 + y**2
    k1, k2, k3, k4, p1, p2 = (c.get(n, 0.0) for n in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if fisheye:
        r = np.sqrt(r2).clip(1e-12)
        t = np.arctan(r)
        return points * (t / r * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8))[..., None]
    s = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return np.stack(
        [
            s * x + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
            s * y + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        ],
        -1,
    )


def straight(points: np.ndarray, c: dict, fisheye: bool) -> np.ndarray:
    """The inverse of `bent`, by fixed point iteration."""
    found = points.copy()
    for _ in range(80):
        found = found + 0.7 * (points - bent(found, c, fisheye))
    assert np.abs(bent(found, c, fisheye) - points).max() < 1e-9
    return found


def sight_lines(c: dict, fisheye: bool, focal: float) -> np.ndarray:
    """Normalised pinhole coordinates that the lens shows in each of the finer pixels of its image."""
    centre = (np.arange(FINE * SIZE) + 0.5) / FINE - SIZE / 2  # px from the principal point
    return straight(np.stack(np.meshgrid(centre, centre), -1) / focal, c, fisheye)


def photograph(picture: np.ndarray, seen: np.ndarray, reach: float) -> np.ndarray:
    """What the lens makes of a pinhole's premultiplied RGBA (H, W, 4) that sees up to `reach`: (SIZE, SIZE, 4), area averages."""
    places = ((seen / reach + 1) * len(picture) / 2 - 0.5).astype(np.float32)
    taken = cv2.remap(picture, places[..., 0], places[..., 1], cv2.INTER_LINEAR)
    return cv2.resize(taken, (SIZE, SIZE), interpolation=cv2.INTER_AREA)


@pytest.fixture(scope="module")
def rabbit():
    """The built-in rabbit's surface in three frames, and three cameras around it."""
    surface = extract_surface(SHAPES["rabbit"], 0.008, np.random.default_rng(0))
    rig = ring_of_cameras(
        3, SIZE, target=(0, 0.2, 0), distance=0.6, elevations=(0.2, 0.6), field=0.23, turn=0.4
    )
    return (
        surface,
        [surface.vertices + np.array([0.02, lift, 0.01]) for lift in (0.09, 0.07, 0.05)],
        rig,
    )


def capture(folder, rabbit, c: dict, fisheye: bool, camera_model: str | None):
    """A folder with transforms.json of the rabbit seen through a lens."""
    surface, frames, rig = rabbit
    focal, sight = (
        float(rig.K[0, 0, 0]),
        0.75,
    )  # tangent of half the angle that the fine pinhole images see
    wide = scale_cameras(rig, FINE * 1.5)
    wide.K[:, 0, 0] = wide.K[:, 1, 1] = wide.width / 2 / sight
    (folder / "images").mkdir(parents=True)
    entries, seen = [], sight_lines(c, fisheye, focal)
    for t, vertices in enumerate(frames):
        for v, picture in enumerate(render_surface(surface, vertices, wide)):
            soft = picture.astype(np.float32) / 255
            soft[..., :3] *= soft[..., 3:]
            taken = photograph(soft, seen, sight)
            taken[..., :3] /= taken[..., 3:].clip(1e-6)
            name = f"images/{v}_{t}.png"
            iio.imwrite(folder / name, np.round(255 * taken.clip(0, 1)).astype(np.uint8))
            pose = opengl_pose(rig.w2c[v]).tolist()
            entries.append(
                {"file_path": name, "time": t / 24, "camera": str(v), "transform_matrix": pose}
            )
    document = {
        "fl_x": focal,
        "fl_y": focal,
        "cx": SIZE / 2,
        "cy": SIZE / 2,
        "w": SIZE,
        "h": SIZE,
        "frames": entries,
        **c,
    }
    (folder / "transforms.json").write_text(
        json.dumps(document | ({"camera_model": camera_model} if camera_model else {}))
    )
    return folder


def load(folder, **keys):
    world = {
        "gravity": [0, -9.8, 0],
        "box": [[-1.0, -0.1, -1.0], [1.0, 1.0, 1.0]],
        "ground": {"height": 0.0},
    }
    return load_scene(format="transforms", path=str(folder), **world, **keys)


def agreement(scene, rabbit) -> tuple[float, float]:
    """Least overlap of the silhouettes, and PSNR [dB] inside of them, of a loaded scene and of what pinholes would see."""
    surface, frames, _ = rabbit
    overlap, errors = [], []
    for t, vertices in enumerate(frames):
        for v, picture in enumerate(render_surface(surface, vertices, scene.cameras)):
            picture = picture.astype(np.float32) / 255
            there, found = picture[..., 3] > 0.5, scene.mattes[v, t].numpy() > 0.5
            overlap.append((there & found).sum() / (there | found).sum())
            image = composite(picture[..., :3], picture[..., 3], np.ones(3, np.float32))
            errors.append(np.square(image - scene.images[v, t].numpy())[there])
    return float(min(overlap)), float(-10 * np.log10(np.concatenate(errors).mean()))


@pytest.fixture(scope="module")
def unbent(rabbit, tmp_path_factory):
    """(overlap, PSNR) of footage without any distortion: what pixels and 8 bits cost."""
    return agreement(
        load(capture(tmp_path_factory.mktemp("lens") / "plain", rabbit, {}, False, None)), rabbit
    )


@pytest.mark.parametrize(
    ("c", "model"), [(BARREL, None), (PINCUSHION, "OPENCV"), (FISHEYE, "OPENCV_FISHEYE")]
)
def test_a_scene_seen_through_a_lens_is_that_of_a_pinhole(rabbit, unbent, tmp_path, c, model):
    """One interpolation more than plain footage: 0.5 % of the silhouette, a fifteenth of a pixel all around it, and 4 dB (measured:
    0.1 to 0.4 %, 2.1 to 2.8 dB). Left bent, footage fails by far."""
    folder = capture(tmp_path / "bent", rabbit, c, model == "OPENCV_FISHEYE", model)
    scene = load(folder)
    overlap, psnr = agreement(scene, rabbit)
    assert overlap > unbent[0] - 0.005
    assert psnr > unbent[1] - 4
    assert torch.allclose(scene.cameras.w2c, rabbit[2].w2c, atol=1e-6)
    assert (
        float((scene.images[scene.mattes == 0] - 1).abs().max()) < 1.5 / 255
    )  # no rim of a colour that was behind no matte
    document = folder / "transforms.json"
    left = json.loads(document.read_text())
    document.write_text(
        json.dumps({k: v for k, v in left.items() if k not in c and k != "camera_model"})
    )
    overlap, psnr = agreement(load(folder), rabbit)
    assert overlap < unbent[0] - 0.03 and psnr < unbent[1] - 10


@pytest.mark.parametrize(("c", "fisheye"), [(BARREL, False), (PINCUSHION, False), (FISHEYE, True)])
def test_a_pinhole_s_pixels_lie_where_the_formulas_put_them(c, fisheye):
    """Off the middle, with two focal lengths, pixel centres at half integers: 1e-4 px, what float32 maps hold."""
    K = np.array([[210.0, 0, 75.3], [0, 190.0, 64.9], [0, 0, 1]])
    lens = lens_of(K, c, 160, 120, fisheye=fisheye, where="here")
    x, y = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
    lines = np.stack([(x - lens.K[0, 2]) / lens.K[0, 0], (y - lens.K[1, 2]) / lens.K[1, 1]], -1)
    expected = bent(lines, c, fisheye) * [210.0, 190.0] + [75.3, 64.9] - 0.5
    assert np.abs(lens.places - expected).max() < 1e-4
    if not fisheye:  # all that the pinhole camera shows was seen
        assert expected.min() > -1 and expected[..., 0].max() < 160 and expected[..., 1].max() < 120


def test_what_the_straight_image_does_not_show_is_counted():
    lens = lens_of(
        np.array([[80.0, 0, 80], [0, 80, 80], [0, 0, 1]]),
        {"k1": 0.2},
        160,
        160,
        fisheye=False,
        where="here",
    )
    edge, middle = np.zeros((160, 160), np.float32), np.zeros((160, 160), np.float32)
    edge[70:90, :6] = 1
    middle[60:100, 60:100] = 1
    corner = np.zeros((160, 160), np.float32)
    corner[:3, :3] = 1
    assert lens.lost(edge) > 0.3 and lens.lost(middle) == 0 and lens.lost(corner) < 0.5


def test_an_object_that_is_cut_is_said(rabbit, tmp_path):
    folder = capture(tmp_path / "close", rabbit, PINCUSHION | {"k2": 6.0}, False, None)
    with pytest.warns(
        UserWarning, match=r"camera 0: undoing its lens distortion cuts off up to .*% of the object"
    ):
        load(folder)


def test_no_coefficients_are_no_lens():
    assert (
        lens_of(np.eye(3), {"k1": 0.0, "p2": 0.0, "fl_x": 3.0}, 16, 16, fisheye=False, where="here")
        is None
    )


@pytest.mark.parametrize(("change", "message"), [
    ({"k4": 0.1}, r"frames\[0\]: k4 = 0.1: programs disagree on its meaning"),
    ({"k1": -9.0}, r"frames\[0\]: the lens distortion k1 = -9 cannot be undone over the whole image"),
    ({"k1": 1e5}, "the lens distortion k1 = 100000 cannot be undone"),
    ({"k1": 0.1, "p1": 0.1, "camera_model": "OPENCV_FISHEYE"}, "a fisheye has no p1, p2"),
    ({"k1": 0.1, "p1": 0.1, "is_fisheye": True}, "a fisheye has no p1, p2"),
    ({"camera_model": "EQUIRECTANGULAR"}, r"frames\[0\]: camera_model: expected one of .*PINHOLE.*, found 'EQUIRECTANGULAR'"),
    ({"k1": "a lot"}, "k1: expected a finite number"),
])  # fmt: skip
def test_what_cannot_be_undone_is_named(transforms_folder, change, message):
    document = transforms_folder / "transforms.json"
    document.write_text(json.dumps(json.loads(document.read_text()) | change))
    with pytest.raises(DataError, match=message):
        load(transforms_folder)

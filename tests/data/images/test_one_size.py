"""Cameras of different image sizes say what the same cameras with images of one size say: a twin of that is at hand."""

import json
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from blocks_film import WORLD, block_scene
from written_scenes import export_pacnerf, export_transforms

from mosa.data.checks.cameras import lines_of_sight
from mosa.data.checks.validation import validate
from mosa.data.hull import visual_hull
from mosa.data.scene import load_scene
from mosa.errors import DataError
from mosa.rendering.cameras import crop_cameras, crop_images, rays


def ball_scene(center=(0.1, 0.3, 0.0), size=48, radius=0.15, samples=4, frames=3, **camera):
    """A grey ball seen by six cameras as it falls from rest; mattes are coverages of samples x samples points a pixel."""
    from mosa.data.synthetic.renderer import ring_of_cameras

    scene = block_scene(6, frames)
    options = {
        "target": (0, 0.3, 0),
        "distance": 1.5,
        "elevations": (0.2, 0.6),
        "field": 0.6,
        "turn": 0.4,
    }
    fine = ring_of_cameras(6, size * samples, **(options | camera))
    origins, directions = rays(fine)
    centers = torch.tensor(center) + 0.5 * scene.gravity * scene.times[:, None] ** 2
    hits = []
    for place in centers:
        arm = place - origins[:, None, None]
        hits.append(
            (arm - (arm * directions).sum(-1, keepdim=True) * directions).norm(dim=-1) < radius
        )
    mattes = torch.nn.functional.avg_pool2d(torch.stack(hits, 1).float(), samples)
    return replace(
        scene,
        cameras=ring_of_cameras(6, size, **(options | camera)),
        mattes=mattes,
        images=1 - 0.5 * mattes[..., None].expand(-1, -1, -1, -1, 3),
    )


def cut(scene, left=0, top=0, right=0, bottom=0):
    """The scene as cameras with smaller images see it: columns and rows are cut off."""
    views, size = (
        len(scene.cameras),
        (scene.cameras.width - left - right, scene.cameras.height - top - bottom),
    )
    x0, y0 = torch.full((views,), left), torch.full((views,), top)
    crop = [crop_images(stack, x0, y0, *size, axis=2) for stack in (scene.images, scene.mattes)]
    return replace(
        scene, images=crop[0], mattes=crop[1], cameras=crop_cameras(scene.cameras, x0, y0, *size)
    )


def mixed(folder, layout, whole, other, cameras):
    """One folder of the scene `whole` in which some cameras are those of the scene `other`, read again."""
    if layout == "transforms":
        parts = [
            export_transforms(scene, folder / name)
            for scene, name in ((whole, "whole"), (other, "other"))
        ]
        documents = [json.loads((part / "transforms.json").read_text()) for part in parts]
        entries = []
        for a, b in zip(*(document["frames"] for document in documents)):
            chosen, source = (b, parts[1]) if int(a["camera"]) in cameras else (a, parts[0])
            entries.append(chosen | {"file_path": str(source / chosen["file_path"])})
        (folder / "transforms.json").write_text(json.dumps({"frames": entries}))
    else:
        parts = [
            export_pacnerf(scene, place)
            for scene, place in ((whole, folder), (other, folder.parent / "other"))
        ]
        entries, others = (json.loads((part / "all_data.json").read_text()) for part in parts)
        for k, entry in enumerate(others):
            v, t = (int(n) for n in entry["file_path"].removesuffix(".png").split("_")[1:])
            if v in cameras:
                entries[k] = entry
                (folder / "data" / f"a_{v}_{t}.png").write_bytes(
                    (parts[1] / "data" / f"a_{v}_{t}.png").read_bytes()
                )
        (folder / "all_data.json").write_text(json.dumps(entries))
    return load_scene(format=layout, path=str(folder), **WORLD)


def hull(scene, frame=0):
    return visual_hull(
        scene.mattes[:, frame],
        scene.cameras,
        torch.tensor([[-0.3, 0.0, -0.3], [0.5, 0.6, 0.4]]),
        pitch=0.02,
    )


def same_hull(found, expected, frame=0):
    a, b = hull(found, frame), hull(expected, frame)
    return (
        a.values.shape == b.values.shape and float((a.values - b.values).abs().max()) < 0.01
    )  # mattes are kept in 8 bits


@pytest.mark.parametrize("layout", ["transforms", "pacnerf"])
def test_smaller_images_are_surrounded(tmp_path, layout):
    """Cameras 1 and 4 with 6 columns and 10 rows less, at the left, right and top: the object is whole in all."""
    whole = ball_scene()
    scene = mixed(tmp_path / "data", layout, whole, cut(whole, left=4, right=2, top=10), (1, 4))
    assert scene.mattes.shape == whole.mattes.shape and scene.cameras.names == whole.cameras.names
    for v in range(
        6
    ):  # every pixel of the object is where the camera has it, whatever was put around it
        shift = (scene.cameras.K[v] - whole.cameras.K[v])[:2, 2].round().int().tolist()
        moved = torch.roll(whole.mattes[v], (shift[1], shift[0]), (1, 2))
        assert torch.allclose(scene.mattes[v], moved, atol=0.51 / 255)
        assert torch.allclose(
            scene.images[v], 1 - 0.5 * moved[..., None].expand(-1, -1, -1, 3), atol=1.01 / 255
        )
    assert same_hull(scene, whole)
    assert not same_hull(
        replace(scene, cameras=whole.cameras), whole
    )  # principal points that stay behind are noticed


def test_finer_images_are_reduced(tmp_path, caplog):
    """Two cameras of twice the resolution: their images average to the twin's coverages."""
    whole, fine = ball_scene(samples=4), ball_scene(size=96, samples=2)
    caplog.set_level("INFO", "mosa")
    scene = mixed(tmp_path, "transforms", whole, fine, (0, 5))
    assert "0 96x96, 1 48x48, " in caplog.text and "brought to 48x48 px" in caplog.text
    assert scene.mattes.shape == whole.mattes.shape
    assert torch.allclose(scene.cameras.K, whole.cameras.K, atol=1e-4)
    assert torch.allclose(scene.mattes, whole.mattes, atol=1.01 / 255)
    assert same_hull(scene, whole)


def test_an_object_that_is_cut_stays_cut(tmp_path):
    """The ball falls over the lower border of all cameras, below which the narrower ones say nothing: the hull keeps it."""
    ball = ball_scene(
        center=(0.0, 0.38, 0.0), radius=0.2, frames=5, samples=5
    )  # no coverage is a half, which 8 bits would move
    last = int((ball.mattes[:, 4] > 0.5).any(2).nonzero()[:, 1].amax())
    whole = cut(ball, bottom=ball.cameras.height - last + 3)
    assert all(bool((whole.mattes[v, 4, -1] > 0.5).any()) for v in range(6))
    scene = mixed(tmp_path, "transforms", whole, cut(whole, top=6), (1, 4))
    assert (
        scene.cameras.height == whole.cameras.height
        and same_hull(scene, whole)
        and same_hull(scene, whole, 4)
    )
    assert lines_of_sight(scene, 4)[0] == lines_of_sight(whole, 4)[0] == []
    # put into the middle instead, an empty matte below the border would say that nothing is there
    middle = torch.cat([whole.mattes[:, :, 3:], torch.zeros_like(whole.mattes[:, :, :3])], 2)
    K = whole.cameras.K.clone()
    K[:, 1, 2] -= 3
    assert not same_hull(
        replace(whole, mattes=middle, cameras=replace(whole.cameras, K=K)), whole, 4
    )


def test_a_camera_that_says_nothing_on_both_sides_is_refused(tmp_path):
    whole = ball_scene(radius=0.25)
    rows = (whole.mattes[1, 0] > 0.5).any(1).nonzero()[:, 0]
    narrow = cut(whole, top=int(rows[0]) + 2, bottom=whole.cameras.height - int(rows[-1]) + 1)
    with pytest.raises(
        DataError,
        match=r"transforms.json: camera 1: expected images of the other cameras' size, .*one height",
    ):
        mixed(tmp_path, "transforms", whole, narrow, (1,))


def test_images_of_one_camera_have_one_size(tmp_path):
    folder = export_transforms(ball_scene(), tmp_path / "capture")
    file = folder / "images" / "2_001.png"
    iio.imwrite(file, np.array(iio.imread(file))[:-2])
    with pytest.raises(
        DataError,
        match=r"2_001.png: expected 48x48 px \(as 2_000.png of the same camera\), found 48x46",
    ):
        load_scene(format="transforms", path=str(folder), **WORLD)


def test_images_of_one_size_are_left_as_they_are(tmp_path, caplog):
    caplog.set_level("INFO", "mosa")
    whole = ball_scene()
    scene = load_scene(
        format="transforms", path=str(export_transforms(whole, tmp_path / "capture")), **WORLD
    )
    assert torch.equal(scene.cameras.K, whole.cameras.K) and not caplog.records
    assert validate(scene) is scene

"""What is written in a layout is read back; frames, cameras and times are taken from where the layout says they are."""

import json
import random
import shutil

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from blocks_film import WORLD, assert_same_footage, clouds_of
from written_scenes import export_particles, export_transforms

from mosa.data.formats.transforms import read_transforms
from mosa.data.scene import held_out_sequences, load_scene


def pacnerf(folder, **keys):
    return load_scene(format="pacnerf", path=str(folder), **WORLD, **keys)


def transforms(folder, **keys):
    return load_scene(format="transforms", path=str(folder), **WORLD, **keys)


def test_pacnerf_round_trip(blocks, pacnerf_folder):
    scene = pacnerf(pacnerf_folder)
    assert_same_footage(scene, blocks)
    assert scene.cameras.names == ("0", "1", "2")
    assert scene.name == "blocks"
    assert not scene.synthetic


def test_a_point_lands_where_the_opengl_pose_puts_it(pacnerf_folder):
    """Independent of our exporter's inverse: u = K diag(1, -1, -1) R^T (X - t) with the file's own c2w."""
    scene = pacnerf(pacnerf_folder)
    entry = next(
        e
        for e in json.loads((pacnerf_folder / "all_data.json").read_text())
        if "r_1_" in e["file_path"]
    )
    c2w, K = np.array(entry["c2w"]), np.array(entry["intrinsic"])
    point = np.array([0.07, 0.21, -0.05])
    seen = K @ (np.diag([1, -1, -1]) @ c2w[:, :3].T @ (point - c2w[:, 3]))
    w2c = scene.cameras.w2c[1].double().numpy()
    found = scene.cameras.K[1].double().numpy() @ (w2c[:3, :3] @ point + w2c[:3, 3])
    assert np.allclose(found, seen, atol=1e-4)
    assert seen[2] > 0


def test_list_order_does_not_matter(blocks, pacnerf_folder):
    listing = pacnerf_folder / "all_data.json"
    entries = json.loads(listing.read_text())
    random.Random(1).shuffle(entries)
    listing.write_text(json.dumps(entries))
    assert_same_footage(pacnerf(pacnerf_folder), blocks)


def test_files_of_kinds_that_are_not_used_need_not_exist_and_negative_frames_are_no_footage(
    blocks, pacnerf_folder
):
    listing = pacnerf_folder / "all_data.json"
    entries = json.loads(listing.read_text())
    entries += [{**entries[0], "file_path": "./data/r_0_-1.png", "time": -1.0}]
    listing.write_text(json.dumps(entries))
    shutil.copy(pacnerf_folder / "data" / "a_0_0.png", pacnerf_folder / "data" / "r_0_-1.png")
    assert pacnerf(pacnerf_folder).frames == blocks.frames


def test_painted_background_stands_in_for_alpha(blocks, pacnerf_folder):
    for file in sorted((pacnerf_folder / "data").glob("a_*.png")):
        _, v, t = file.stem.split("_")
        image = (255 * blocks.images[int(v), int(t)].numpy()).round().astype(np.uint8)
        iio.imwrite(file.with_name(file.name.replace("a_", "m_")), image)
        file.unlink()
    scene = pacnerf(pacnerf_folder)
    inside = blocks.images.amin(-1) < 0.98
    assert torch.equal(scene.mattes > 0.5, inside)


def test_derived_folders_are_never_opened(pacnerf_folder):
    before = pacnerf(pacnerf_folder).fingerprint
    for name in ("derived", "gic_outputs"):
        (pacnerf_folder / name).mkdir()
        (pacnerf_folder / name / "hulls.npz").write_bytes(b"not to be read")
    (pacnerf_folder / "transforms_test.json").write_text("{ not json")
    assert pacnerf(pacnerf_folder).fingerprint == before


@pytest.mark.parametrize("masks", [False, True])
def test_transforms_round_trip(blocks, tmp_path, masks):
    scene = transforms(export_transforms(blocks, tmp_path / "capture", masks=masks))
    assert_same_footage(scene, blocks)
    assert scene.name == "capture"


def test_transforms_without_labels_times_extensions_and_with_a_field_of_view(
    blocks, transforms_folder
):
    file = transforms_folder / "transforms.json"
    document = json.loads(file.read_text())
    K = blocks.cameras.K[0]
    document["camera_angle_x"] = 2 * float(torch.atan(0.5 * blocks.cameras.width / K[0, 0]))
    for entry in document["frames"]:
        entry["file_path"] = "./" + entry["file_path"].removesuffix(".png")
        for key in ("time", "camera", "fl_x", "fl_y", "cx", "cy"):
            del entry[key]
    file.write_text(json.dumps(document))
    assert_same_footage(transforms(file, fps=24.0), blocks)


def test_a_field_of_view_of_each_axis(blocks, transforms_folder):
    file = transforms_folder / "transforms.json"
    document, K = json.loads(file.read_text()), blocks.cameras.K[0]
    document["camera_angle_x"] = 2 * float(torch.atan(0.5 * blocks.cameras.width / K[0, 0]))
    document["camera_angle_y"] = 2 * float(
        torch.atan(0.5 * blocks.cameras.height / (1.2 * K[1, 1]))
    )
    for entry in document["frames"]:
        del entry["fl_x"], entry["fl_y"]
    file.write_text(json.dumps(document))
    with pytest.warns(UserWarning, match="expected focal lengths of square pixels"):
        found = transforms(file).cameras.K[0]
    assert torch.allclose(found.diagonal(), K.diagonal() * torch.tensor([1.0, 1.2, 1.0]))


def test_a_frame_rate_beside_rounded_times_and_a_frame_that_was_left_out(
    blocks, transforms_folder, recwarn
):
    """Times of 3 digits (0.042, 0.083) were said to be of another rate, and a missing frame moved all after it unsaid."""
    file = transforms_folder / "transforms.json"
    document = json.loads(file.read_text())
    assert float(blocks.times[1]) == pytest.approx(1 / 24)
    for entry in document["frames"]:
        entry["time"] = round(entry["time"], 3)
    file.write_text(json.dumps(document))
    assert_same_footage(transforms(file, fps=24.0), blocks)
    assert not [w for w in recwarn if "scene.fps" in str(w.message)]
    left = sorted({entry["time"] for entry in document["frames"]})[2]
    document["frames"] = [entry for entry in document["frames"] if entry["time"] != left]
    file.write_text(json.dumps(document))
    with pytest.warns(UserWarning, match="0.042 to 0.083 s apart: expected .* no frame left out"):
        read_transforms(file, fps=24.0)


def test_published_numbers_are_those_of_published_films(pacnerf_folder):
    """A film of one's own in a folder called torus was compared with the torus of PAC-NeRF."""
    own = pacnerf_folder.rename(pacnerf_folder.parent / "torus")
    assert pacnerf(own).known_parameters == {}


def test_scaling_halves_images_and_intrinsics(blocks, pacnerf_folder):
    scene = pacnerf(pacnerf_folder, scale=0.5)
    assert scene.images.shape == (3, 5, 16, 16, 3)
    assert torch.allclose(scene.cameras.K[:, :2], blocks.cameras.K[:, :2] / 2, atol=1e-4)
    mean = blocks.mattes.unflatten(-1, (16, 2)).unflatten(-3, (16, 2)).mean((-1, -3))
    assert torch.allclose(scene.mattes, mean, atol=1e-6)


def test_frames_cameras_and_the_last_free_frame_are_chosen_by_the_numbers_in_the_files(
    blocks, pacnerf_folder
):
    scene = pacnerf(
        pacnerf_folder, frames=[1, 4], holdout_cameras=[2], holdout_frames=[4], last_free_frame=2
    )
    assert torch.allclose(scene.times, blocks.times[1:])
    assert scene.last_free_frame == 1
    assert scene.training_cameras == [0, 1]
    assert scene.training_frames == [0, 1, 2]
    assert pacnerf(pacnerf_folder, holdout_frames=2).holdout_frames == (3, 4)


def test_frame_rate_overrides_the_times_of_the_data(pacnerf_folder):
    assert torch.allclose(pacnerf(pacnerf_folder, fps=25.0).times, torch.arange(5) / 25)


def test_particles_are_ordered_by_number(blocks, pacnerf_folder, tmp_path):
    positions = clouds_of(blocks, frames=12)
    folder = export_particles(positions, tmp_path / "ply")
    for file in folder.glob("*.ply"):  # unpadded: 10 sorts before 2 as text
        file.rename(folder / f"{int(file.stem)}.ply")
    clouds = pacnerf(pacnerf_folder, particles=str(folder)).particles
    assert len(clouds) == blocks.frames
    assert torch.equal(clouds[2], positions[2])


def test_fingerprint_follows_everything_learning_depends_on(pacnerf_folder):
    plain = pacnerf(pacnerf_folder).fingerprint
    assert pacnerf(pacnerf_folder).fingerprint == plain
    changed = [
        pacnerf(pacnerf_folder, **k).fingerprint
        for k in (
            {"holdout_cameras": [1]},
            {"frames": [0, 3]},
            {"fps": 25.0},
            {"density": 900.0},
            {"scale": 0.5},
        )
    ]
    file = pacnerf_folder / "data" / "a_2_4.png"
    pixels = np.array(iio.imread(file))
    pixels[20, 15, 0] ^= 1
    iio.imwrite(file, pixels)
    changed.append(pacnerf(pacnerf_folder).fingerprint)
    assert len({plain, *changed}) == 7


def test_only_built_in_scenes_bring_held_out_sequences(pacnerf_folder):
    assert held_out_sequences(format="pacnerf", path=str(pacnerf_folder), **WORLD) == []


def test_the_real_bird(reference_data):
    """Its README: 11 cameras, 14 frames at 24 per second, f = 965.68 px of 800; up is +y and the ground is y = 0."""
    if not (reference_data / "pacnerf" / "bird" / "data").is_dir():
        pytest.skip("no pacnerf/bird in the reference data")
    scene = load_scene(
        format="pacnerf",
        root=str(reference_data),
        path="pacnerf/bird",
        frames=[0, 6],
        scale=0.125,
        **WORLD,
    )
    assert scene.images.shape == (11, 7, 100, 100, 3)
    assert torch.allclose(scene.times.diff(), torch.full((6,), 1 / 24), atol=1e-6)
    assert scene.cameras.K[0, 0, 0].item() == pytest.approx(965.68 / 8, rel=1e-4)
    # rays through the matte centroids meet in the object: its centre falls along the measured parabola
    centers = torch.stack([meeting_point(scene, t) for t in (0, 5)])
    fall = centers[1, 1] - centers[0, 1]
    t = 5 / 24
    assert fall.item() == pytest.approx(-0.502 * t - 4.9 * t * t, abs=0.02)
    # rays pass a point inside the bird, which is 0.6 m long, and not one of a mirrored or shifted world
    assert meeting_spread(scene, 0) < 0.03


def lines(scene, frame):
    from mosa.rendering.cameras import rays

    origins, directions = rays(scene.cameras)
    weight = scene.mattes[:, frame, ..., None]
    mean = (directions * weight).sum((1, 2)) / weight.sum((1, 2))
    return origins, mean / mean.norm(dim=-1, keepdim=True)


def meeting_point(scene, frame):
    origins, along = lines(scene, frame)
    across = torch.eye(3) - along[:, :, None] * along[:, None]
    return torch.linalg.solve(across.sum(0), (across @ origins[..., None]).sum(0))[:, 0]


def meeting_spread(scene, frame):
    origins, along = lines(scene, frame)
    arm = meeting_point(scene, frame) - origins
    return float((arm - (arm * along).sum(-1, keepdim=True) * along).norm(dim=-1).mean())


def test_particles_beside_the_images_are_found(blocks, pacnerf_folder, tmp_path):
    positions = clouds_of(blocks)
    export_particles(positions, pacnerf_folder / "ply")
    assert torch.equal(
        pacnerf(pacnerf_folder, particles="ply", root=str(tmp_path / "elsewhere")).particles[2],
        positions[2],
    )

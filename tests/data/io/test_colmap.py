"""COLMAP models, both forms, against the numbers they were written from; and what is said of damaged ones."""

import json
import struct

import numpy as np
import pytest
from filming import cameras, in_world
from scipy.spatial.transform import Rotation

from mosa.capture.phones import Camera
from mosa.capture.poses import belongs, read_phones, read_poses, scene_points
from mosa.data.formats.footage import OPENGL_TO_OPENCV
from mosa.data.io.colmap import MODELS, read_model, read_points
from mosa.errors import DataError

LENS = (0.05, -0.02, 0.001, -0.002)


def model(folder, *, binary: bool, count: int = 3, lens: str = "OPENCV") -> list[Camera]:
    """Write a model of the first cameras; returns them."""
    made = [in_world(camera) for camera in cameras()[:count]]
    number = MODELS[lens][0]
    cams, images, points = (
        [struct.pack("<Q", count)],
        [struct.pack("<Q", count)],
        [struct.pack("<Q", 2)],
    )
    text = [["# one", ""], ["# one"], ["# one"]]
    for i, camera in enumerate(made):
        values = [camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2], *LENS]
        q, t = np.roll(Rotation.from_matrix(camera.w2c[:3, :3]).as_quat(), 1), camera.w2c[:3, 3]
        name = f"shots/phone {i}.jpg"
        cams.append(struct.pack("<iiQQ8d", 10 + i, number, *camera.size, *values))
        images.append(struct.pack("<i7di", 5 + i, *q, *t, 10 + i) + name.encode() + b"\0" + struct.pack("<Q", 1)
                      + struct.pack("<ddq", 1.0, 2.0, -1))  # fmt: skip
        text[0].append(
            f"{10 + i} {lens} {camera.size[0]} {camera.size[1]} "
            + " ".join(map(repr, map(float, values)))
        )
        text[1] += [
            f"{5 + i} " + " ".join(repr(float(x)) for x in [*q, *t]) + f" {10 + i} {name}",
            "1.0 2.0 -1" if i else "",
        ]
    for i, xyz in enumerate(([0.1, 0.2, 0.3], [4.0, 5.0, 6.0])):
        points.append(struct.pack("<Q3d3BdQii", i, *xyz, 1, 2, 3, 0.5, 1, 5, 0))
        text[2].append(f"{i} " + " ".join(map(str, xyz)) + " 1 2 3 0.5 5 0")
    for name, parts, lines in zip(("cameras", "images", "points3D"), (cams, images, points), text):
        if binary:
            (folder / f"{name}.bin").write_bytes(b"".join(parts))
        else:
            (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    return made


@pytest.mark.parametrize("binary", [False, True])
def test_a_model_is_read_as_it_was_written(tmp_path, binary):
    made = model(tmp_path, binary=binary)
    found = read_model(tmp_path)
    assert list(found) == [f"shots/phone {i}.jpg" for i in range(3)]
    for camera, other in zip(made, found.values()):
        np.testing.assert_allclose(other.K, camera.K)
        np.testing.assert_allclose(other.w2c, camera.w2c, atol=1e-12)
        assert other.size == camera.size and dict(other.coefficients) == dict(
            zip(("k1", "k2", "p1", "p2"), LENS)
        )
    np.testing.assert_array_equal(read_points(tmp_path), [[0.1, 0.2, 0.3], [4, 5, 6]])
    np.testing.assert_array_equal(scene_points(tmp_path), read_points(tmp_path))


def test_rays_undo_the_projection_through_a_lens():
    plain = cameras()[0]
    points = np.random.default_rng(0).uniform([-0.2, 0.1, -0.2], [0.2, 0.5, 0.2], (20, 3))
    for lens, fisheye in (
        ({}, False),
        ({"k1": 0.1, "p2": 0.01}, False),
        ({"k1": 0.05, "k3": 0.01}, True),
    ):
        camera = Camera(plain.K, plain.w2c, plain.size, "", lens, fisheye)
        way = points - camera.centre
        np.testing.assert_allclose(
            camera.rays(camera.project(points)),
            way / np.linalg.norm(way, axis=1, keepdims=True),
            atol=1e-6,
        )


@pytest.mark.parametrize("name, damage, said", [
    ("images.txt", lambda text: text.replace(" 11 shots", " 99 shots"), r"images\.txt.*CAMERA_ID 99"),
    ("images.txt", lambda text: text.replace("5 -0.", "5 -7."), r"images\.txt.*unit quaternion"),
    ("cameras.txt", lambda text: text.replace("OPENCV", "FOV"), r"cameras\.txt, line 3.*undistort"),
    ("cameras.txt", lambda text: text.replace("0.05 ", ""), r"cameras\.txt, line 3.*8 parameters"),
    ("cameras.txt", lambda text: text.replace("160", "wide"), r"cameras\.txt, line 3.*numbers"),
    ("cameras.txt", lambda text: text.replace("160", "inf"), r"cameras\.txt, line 3.*whole numbers"),
    ("cameras.txt", lambda text: "10.5" + text.partition("10")[2], r"cameras\.txt, line 1.*CAMERA_ID MODEL|whole numbers"),
    ("images.txt", lambda text: text.replace(" 11 shots", " nan shots"), r"images\.txt.*whole numbers"),
])  # fmt: skip
def test_a_damaged_text_model_is_named(tmp_path, name, damage, said):
    model(tmp_path, binary=False)
    file = tmp_path / name
    before = file.read_text()
    file.write_text(damage(before))
    assert file.read_text() != before
    with pytest.raises(DataError, match=said):
        read_model(tmp_path)


def test_a_cut_binary_model_is_named(tmp_path):
    model(tmp_path, binary=True)
    for name in ("cameras.bin", "images.bin"):
        whole = (tmp_path / name).read_bytes()
        for length in (4, len(whole) // 2, len(whole) - 30):
            (tmp_path / name).write_bytes(whole[:length])
            with pytest.raises(DataError, match=r"damaged|end of the file"):
                read_model(tmp_path)
        (tmp_path / name).write_bytes(whole)
    (tmp_path / "cameras.bin").unlink()
    with pytest.raises(DataError, match=r"cameras\.bin: file not found"):
        read_model(tmp_path)


@pytest.mark.parametrize("content, said", [
    (b"1 0.5 0.5\n", r"points3D\.txt, line 1: expected POINT3D_ID X Y Z"), (b"\xff\xfe", r"points3D\.txt: .* damaged file"),
])  # fmt: skip
def test_damaged_points_are_named(tmp_path, content, said):
    (tmp_path / "points3D.txt").write_bytes(content)
    with pytest.raises(DataError, match=said):
        read_points(tmp_path)


def test_a_model_that_claims_more_than_any_memory_is_damaged(tmp_path):
    (tmp_path / "points3D.bin").write_bytes(
        struct.pack("<Q", 2) + bytes(43) + struct.pack("<Q", 2**62) + bytes(100)
    )
    with pytest.raises(
        DataError, match=r"points3D\.bin: expected points of a COLMAP model, found a damaged file"
    ):
        read_points(tmp_path)


@pytest.mark.parametrize("changed, said", [
    ({"w": 0}, "image size w, h of at least 1 px"), ({"fl_x": 0}, "focal length fl_x"), ({"fl_y": -200.0}, "focal length fl_y"),
    ({"cx": 1e9}, "principal point"), ({"k1": 1e3}, r"k1|lens|distort"),
])  # fmt: skip
def test_a_lens_that_cannot_be_is_refused_before_any_video_is_read(tmp_path, changed, said):
    frames = []
    for i, camera in enumerate(cameras()[:3]):
        pose = np.linalg.inv(camera.w2c) @ OPENGL_TO_OPENCV
        frames.append(
            {
                "file_path": f"phone{i}.jpg",
                "transform_matrix": pose.tolist(),
                "fl_x": 200.0,
                "w": 160,
                "h": 120,
            }
        )
    sizes = {f"phone{i}.mp4": (160, 120) for i in range(3)}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    assert len(read_phones(tmp_path, tmp_path, sizes)) == 3
    frames[1] |= changed
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    with pytest.raises(DataError, match=said):
        read_phones(tmp_path, tmp_path, sizes)


def test_transforms_and_colmap_say_the_same(tmp_path):
    made = model(tmp_path, binary=True)
    frames = []
    for i, camera in enumerate(made):
        pose = np.linalg.inv(camera.w2c) @ OPENGL_TO_OPENCV
        frames.append({"file_path": f"images/phone {i}.jpg", "transform_matrix": pose.tolist(), "fl_x": camera.K[0, 0],
                       "fl_y": camera.K[1, 1], "cx": camera.K[0, 2], "cy": camera.K[1, 2]})  # fmt: skip
    (tmp_path / "ns").mkdir()
    document = {
        "w": 160,
        "h": 120,
        "camera_model": "OPENCV",
        **dict(zip(("k1", "k2", "p1", "p2"), LENS)),
        "frames": frames,
    }
    (tmp_path / "ns" / "transforms.json").write_text(json.dumps(document))
    for one, other in zip(read_poses(tmp_path).values(), read_poses(tmp_path / "ns").values()):
        np.testing.assert_allclose(one.w2c, other.w2c, atol=1e-9)
        np.testing.assert_allclose(
            one.project(np.array([[0.1, 0.2, 0.3]])), other.project(np.array([[0.1, 0.2, 0.3]]))
        )


def test_a_pose_belongs_to_the_video_of_its_name():
    mine = (
        "phone1.jpg",
        "a/phone1.png",
        "phone1/0001.jpg",
        "phone1_12.jpg",
        "phone1 frame 3.png",
        "phone1-frame0003.png",
    )
    assert all(belongs(name, "phone1") for name in mine)
    assert not any(
        belongs(name, "phone1")
        for name in ("phone12.jpg", "phone.jpg", "phone1b.jpg", "phone10/1.jpg", "1.jpg")
    )


def test_poses_that_do_not_fit_the_videos_are_named(tmp_path):
    model(tmp_path, binary=False)
    sizes = {f"phone {i}.mp4": (320, 240) for i in range(3)}
    phones = read_phones(tmp_path, tmp_path, sizes)
    np.testing.assert_allclose(
        phones[1].camera.K[:2], 2 * read_model(tmp_path)["shots/phone 1.jpg"].K[:2]
    )
    with pytest.raises(DataError, match=r"no pose for .*other\.mp4"):
        read_phones(tmp_path, tmp_path, {**sizes, "other.mp4": (320, 240)})
    with pytest.raises(
        DataError,
        match=r"frames of 320x180: expected the poses of images with the video's field of view",
    ):
        read_phones(tmp_path, tmp_path, {**sizes, "phone 1.mp4": (320, 180)})
    with pytest.raises(DataError, match="at least 3 videos"):
        read_phones(tmp_path, tmp_path, {"phone 1.mp4": (320, 240)})
    text = (tmp_path / "images.txt").read_text().replace("phone 2.jpg", "phone 1_7.jpg")
    (tmp_path / "images.txt").write_text(text)
    with pytest.raises(DataError, match=r"phone 1 stands elsewhere than in"):
        read_phones(tmp_path, tmp_path, {k: v for k, v in sizes.items() if "2" not in k})
    with pytest.raises(
        DataError, match=r"expected a COLMAP model .* or transforms.json, found neither"
    ):
        (tmp_path / "empty").mkdir()
        read_poses(tmp_path / "empty")


@pytest.mark.parametrize(
    "places",
    [
        ("sparse/0", "sparse/1"),
        ("0", "1"),
        ("sparse/0", "sparse/2"),
        ("sparse/0", "sparse/10"),
        ("sparse", "sparse/1"),
        (".", "sparse/0"),
    ],
)
def test_of_several_models_the_one_with_most_images_is_taken(tmp_path, places):
    for place, count in zip(places, (2, 3)):
        (tmp_path / place).mkdir(parents=True, exist_ok=True)
        model(tmp_path / place, binary=place.endswith("1"), count=count)
    assert len(read_poses(tmp_path)) == 3


@pytest.mark.parametrize("change", [
    lambda lines: [line for line in lines if line], lambda lines: [line for line in lines if line and "2.0 -1" not in line],
    lambda lines: [*lines, ""], lambda lines: [*lines, "", ""], lambda lines: ["# a comment", *lines],
])  # fmt: skip
def test_empty_lines_of_points_may_be_left_out(tmp_path, change):
    made = model(tmp_path, binary=False)
    file = tmp_path / "images.txt"
    file.write_text("\n".join(change(file.read_text().splitlines())) + "\n")
    found = read_model(tmp_path)
    assert list(found) == [f"shots/phone {i}.jpg" for i in range(3)]
    assert all(np.allclose(a.w2c, b.w2c) for a, b in zip(made, found.values()))


@pytest.mark.parametrize("names", [
    ("clip", "clip 2", "clip 3"), ("a", "a_1", "a_2"), ("b-1", "b", "b-1-2"), ("x.1", "x", "x.2"), ("p frame 1", "p", "p 2"),
])  # fmt: skip
def test_a_name_that_continues_another_is_a_phone_of_its_own(tmp_path, names):
    made = model(tmp_path, binary=False)
    text = (tmp_path / "images.txt").read_text()
    for i, name in enumerate(names):
        text = text.replace(f"phone {i}.jpg", f"{name}.jpg")
    (tmp_path / "images.txt").write_text(text)
    phones = read_phones(tmp_path, tmp_path, {f"{name}.mp4": made[0].size for name in names})
    assert all(np.allclose(phone.camera.w2c, own.w2c) for phone, own in zip(phones, made))


@pytest.mark.parametrize(
    "index, factor, refused",
    [(0, 1.1, True), (0, 0.97, True), (2, 1.2, True), (3, 0.8, True), (0, 1.005, False)],
)
def test_intrinsics_of_one_phone_are_compared(tmp_path, index, factor, refused):
    made = model(tmp_path, binary=False)
    lines = (tmp_path / "cameras.txt").read_text().splitlines()
    words = lines[-1].split()
    words[0], words[4 + index] = "99", repr(float(words[4 + index]) * factor)
    (tmp_path / "cameras.txt").write_text("\n".join([*lines, " ".join(words)]) + "\n")
    images = (tmp_path / "images.txt").read_text().splitlines()
    again = images[-2].replace(" 12 shots/phone 2.jpg", " 99 shots/phone 2_7.jpg")
    (tmp_path / "images.txt").write_text("\n".join([*images, again, ""]) + "\n")
    sizes = {f"phone {i}.mp4": made[0].size for i in range(3)}
    if not refused:
        return read_phones(tmp_path, tmp_path, sizes)
    with pytest.raises(
        DataError, match=r"phone 2 has other intrinsics than in .*single_camera_per"
    ):
        read_phones(tmp_path, tmp_path, sizes)


@pytest.mark.parametrize("file, change, said", [
    ("images", lambda t: t.replace("phone 1", "phone 0"), "image shots/phone 0.jpg: expected every image once"),
    ("cameras", lambda t: t + t, "expected every CAMERA_ID once, found 10 twice"),
    ("images", lambda t: "\ufeff" + t, None), ("cameras", lambda t: "\ufeff" + t, None),
])  # fmt: skip
def test_what_is_there_twice_is_named_and_a_byte_order_mark_is_passed_over(
    tmp_path, file, change, said
):
    model(tmp_path, binary=False)
    path = tmp_path / f"{file}.txt"
    path.write_text(change(path.read_text()), encoding="utf-8")
    if said is None:
        assert len(read_model(tmp_path)) == 3
    else:
        with pytest.raises(DataError, match=said):
            read_model(tmp_path)

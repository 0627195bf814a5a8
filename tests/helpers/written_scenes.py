"""Writing a scene out in the layouts that can be read: to look at it in other programs, and to test the loaders."""

from __future__ import annotations

import json
import pickle
import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

from mosa.data.formats.footage import OPENGL_TO_OPENCV
from mosa.types import Cameras, Scene


def seen_by(scene: Scene, some: Sequence[int]) -> Scene:
    """As these of its cameras see it."""
    cameras = scene.cameras.select(list(some))
    return replace(
        scene, images=scene.images[list(some)], mattes=scene.mattes[list(some)], cameras=cameras
    )


def opengl_pose(w2c: torch.Tensor) -> np.ndarray:
    """c2w (4, 4) with OpenGL axes."""
    return np.linalg.inv(w2c.double().numpy()) @ OPENGL_TO_OPENCV


def rgba(scene: Scene, camera: int, frame: int) -> np.ndarray:
    """(H, W, 4) uint8 with straight alpha: the background is taken out of pixels that it shows through."""
    alpha = scene.mattes[camera, frame].numpy()[..., None]
    behind = (1 - alpha) * scene.background.numpy()
    color = np.where(
        alpha > 0, (scene.images[camera, frame].numpy() - behind) / np.maximum(alpha, 1e-6), 1.0
    )
    return np.round(255 * np.clip(np.concatenate([color, alpha], -1), 0, 1)).astype(np.uint8)


def export_pacnerf(scene: Scene, folder: str | Path) -> Path:
    """Write all_data.json and data/a_<camera>_<frame>.png; cameras are numbered in order."""
    folder = Path(folder)
    (folder / "data").mkdir(parents=True, exist_ok=True)
    entries = []
    for v in range(len(scene.cameras)):
        pose, K = opengl_pose(scene.cameras.w2c[v])[:3].tolist(), scene.cameras.K[v].tolist()
        for t, time in enumerate(scene.times.tolist()):
            iio.imwrite(folder / "data" / f"a_{v}_{t}.png", rgba(scene, v, t))
            entries.append(
                {"file_path": f"./data/r_{v}_{t}.png", "time": time, "c2w": pose, "intrinsic": K}
            )
    (folder / "all_data.json").write_text(json.dumps(entries, indent=1))
    return folder


def export_transforms(scene: Scene, folder: str | Path, *, masks: bool = False) -> Path:
    """Write transforms.json and images/<camera>_<frame>.png, mattes as alpha or, with `masks`, as files of their own."""
    folder = Path(folder)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    frames = []
    for v, name in enumerate(scene.cameras.names):
        K = scene.cameras.K[v]
        for t, time in enumerate(scene.times.tolist()):
            picture = rgba(scene, v, t)
            entry = {
                "file_path": f"images/{name}_{t:03d}.png", "time": time, "camera": name,
                "transform_matrix": opengl_pose(scene.cameras.w2c[v]).tolist(),
                "fl_x": K[0, 0].item(), "fl_y": K[1, 1].item(), "cx": K[0, 2].item(), "cy": K[1, 2].item(),
            }  # fmt: skip
            iio.imwrite(folder / entry["file_path"], picture[..., :3] if masks else picture)
            if masks:
                entry["mask_path"] = f"images/{name}_{t:03d}_mask.png"
                iio.imwrite(folder / entry["mask_path"], picture[..., 3])
            frames.append(entry)
    document = {"w": scene.cameras.width, "h": scene.cameras.height, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document, indent=1))
    return folder


def export_spring_gaus(scene: Scene, folder: str | Path) -> Path:
    """Write camera.json, frame.json and <camera>/<frame>.png."""
    folder, cameras = Path(folder), []
    for v, name in enumerate(scene.cameras.names):
        (folder / f"camera_{name}").mkdir(parents=True, exist_ok=True)
        pose = opengl_pose(scene.cameras.w2c[v]).tolist()
        cameras.append({"camera": f"camera_{name}", "K": scene.cameras.K[v].tolist(), "c2w": pose})
        for t in range(len(scene.times)):
            iio.imwrite(folder / f"camera_{name}" / f"{t:03d}.png", rgba(scene, v, t))
    (folder / "camera.json").write_text(json.dumps(cameras, indent=1))
    (folder / "frame.json").write_text(
        json.dumps([{f"{t:03d}": time} for t, time in enumerate(scene.times.tolist())], indent=1)
    )
    return folder


def export_spring_gaus_real(
    scene: Scene, folder: str | Path, photographs: Cameras, masks: torch.Tensor, *, ending: str = ".png", hit: int = 3,
) -> Path:  # fmt: skip
    """Write a capture with the object `bun` and its sequence `0`; returns the sequence's file. photographs: cameras of static
    pictures in another unit and pose, masks: (P, H, W) of these; of the film's cameras the focal length is theirs."""
    static, dynamic = Path(folder) / "static", Path(folder) / "dynamic"
    for part in ("colmap/bun", "masks/bun"):
        (static / part).mkdir(parents=True)
    images = [struct.pack("<Q", len(photographs))]
    for i, w2c in enumerate(photographs.w2c.double().numpy()):
        q = np.roll(Rotation.from_matrix(w2c[:3, :3]).as_quat(), 1)
        images += [
            struct.pack("<i7di", i + 1, *q, *w2c[:3, 3], 1),
            f"P{i:03}.JPG\0".encode(),
            bytes(8),
        ]
        mask = np.round(255 * masks[i].numpy()).astype(np.uint8)
        iio.imwrite(static / "masks" / "bun" / f"P{i:03}.png", mask)
    K = photographs.K[0].double()
    size = photographs.width, photographs.height
    camera = struct.pack("<QiiQQ4d", 1, 1, 1, *size, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    (static / "colmap/bun/cameras.bin").write_bytes(camera)
    (static / "colmap/bun/images.bin").write_bytes(b"".join(images))
    poses, sequence = {}, {"hit_frame": hit}
    for v, name in enumerate(scene.cameras.names):
        w2c = scene.cameras.w2c[v].double().numpy()
        turn = Rotation.from_matrix(w2c[:3, :3]).as_rotvec()
        poses[f"C{name}"] = {"rvecs": turn[:, None].tolist(), "tvecs": w2c[:3, 3:].tolist()}
        sequence[f"C{name}"] = [f"{t:05}{ending}" for t in range(scene.frames)]
        for t, picture in enumerate(sequence[f"C{name}"]):
            pixels = rgba(scene, v, t)
            for kind, part in (("images", pixels[..., :3]), ("masks", pixels[..., 3])):
                file = dynamic / f"videos_{kind}" / f"C{name}" / picture
                file.parent.mkdir(parents=True, exist_ok=True)
                iio.imwrite(file if kind == "images" else file.with_suffix(".png"), part)
    (dynamic / "sequences" / "bun").mkdir(parents=True)
    (dynamic / "cameras_calib.json").write_text(json.dumps(poses))
    (dynamic / "sequences" / "bun" / "0.json").write_text(json.dumps(sequence))
    return dynamic / "sequences" / "bun" / "0.json"


def export_phystwin(
    scene: Scene, folder: str | Path, body: np.ndarray, controller: np.ndarray, *, test: int
) -> Path:
    """Write a case. body: (T, N, 3), controller: (T, n, 3) [m]; test: first frame of the split's test."""
    folder = Path(folder)
    for v in range(len(scene.cameras)):
        (folder / "color" / str(v)).mkdir(parents=True)
        (folder / "mask" / str(v) / "1").mkdir(parents=True)
        (folder / "mask" / f"mask_info_{v}.json").write_text('{"0": "hand", "1": "sloth"}')
        for t in range(scene.frames):
            pixels = rgba(scene, v, t)
            iio.imwrite(folder / "color" / str(v) / f"{t}.png", pixels[..., :3])
            iio.imwrite(folder / "mask" / str(v) / "1" / f"{t}.png", pixels[..., 3])
    poses = [np.linalg.inv(w2c) for w2c in scene.cameras.w2c.double().numpy()]
    seen = np.ones(body.shape[:2], bool)
    points = {"object_points": body, "object_colors": np.zeros_like(body), "object_visibilities": seen,
              "object_motions_valid": seen, "controller_points": controller,
              "surface_points": body[0, :1], "interior_points": body[0, :1]}  # fmt: skip
    for name, value in (("calibrate", poses), ("final_data", points)):
        (folder / f"{name}.pkl").write_bytes(pickle.dumps(value))
    (folder / "metadata.json").write_text(json.dumps({"intrinsics": scene.cameras.K.tolist()}))
    (folder / "split.json").write_text(
        json.dumps({"frame_len": scene.frames, "train": [0, test], "test": [test, scene.frames]})
    )
    return folder


def export_particles(positions: torch.Tensor, folder: str | Path) -> Path:
    """Write (T, M, 3) positions [m] as <frame>.ply."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for t, points in enumerate(positions.numpy()):
        vertices = np.array(
            [tuple(p) for p in points.astype("f4")], dtype=[("x", "f4"), ("y", "f4"), ("z", "f4")]
        )
        PlyData([PlyElement.describe(vertices, "vertex")]).write(folder / f"{t:03d}.ply")
    return folder

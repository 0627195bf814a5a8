"""Writing a scene out in the layouts that can be read: to look at it in other programs, and to test the loaders."""

from __future__ import annotations

import json
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch
from plyfile import PlyData, PlyElement

from mosa.data.formats.footage import OPENGL_TO_OPENCV
from mosa.types import Scene


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

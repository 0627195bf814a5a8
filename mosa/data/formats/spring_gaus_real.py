"""Spring-Gaus' layout of real captures (docs/data.md): static photographs show the rest shape in
COLMAP's scale and pose, three still cameras film the motion. Its z axis points down."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from mosa.data.checks.cameras import misses
from mosa.data.formats.footage import Footage, footage_of, frame_range, read_json
from mosa.data.formats.particles import kept_cloud
from mosa.data.formats.scene_from_footage import scene_from_footage
from mosa.data.formats.views import read_views, split_mask
from mosa.data.hull import hull_bounds, visual_hull
from mosa.data.images.reading import check_amount, matte_of, read_image, resize
from mosa.data.io.colmap import Camera, read_model
from mosa.errors import DataError
from mosa.types import Cameras, Scene

WIDE = 640  # pixels across the reduced masks of photographs
VOXELS = 64  # along the longest side of the rest shape
AROUND = 0.9  # half of the searched box, over the nearest photograph's distance


def load_spring_gaus_real(
    path: str | Path,
    *,
    frames=None,
    fps=120.0,
    scale=1.0,
    fill_holes=0,
    name=None,
    body: dict[str, Any] | None = None,
    last_free_frame=None,
    cache=None,
    **world,
) -> Scene:
    """Scene of <capture>/dynamic/sequences/<object>/<sequence>.json.

    fps: of the film, which no file says; body: {shape, scale} as of `scene_from_footage`: without a
    shape it is the visual hull of the static masks, which is kept in `cache`; last_free_frame: the
    one before the file's hit_frame if it is not given. `world`: other keyword arguments of
    `scene_from_footage`. Errors: DataError naming file and field, ConfigError."""
    file = Path(path)
    if file.suffix != ".json" or file.parent.parent.name != "sequences" or len(file.parents) < 4:
        wanted = "<capture>/dynamic/sequences/<object>/<sequence>.json"
        raise DataError(f"scene.path: expected {wanted}, found {file}")
    capture, thing = file.parents[3], file.parent.name
    photographs = read_model(capture / "static" / "colmap" / thing)
    footage, hit = read_sequence(file, photographs, frames, fps, scale, fill_holes)
    given = {} if body is None else dict(body)
    if given.get("shape") is None:
        given["shape"] = kept_cloud(rest_points(capture / "static" / "masks" / thing, photographs), cache)  # fmt: skip
    if last_free_frame is None and hit - 1 in footage.frames and world.get("start") != "rest":
        last_free_frame = hit - 1
    return scene_from_footage(footage, name=name or thing, body=given, last_free_frame=last_free_frame, **world)  # fmt: skip


def read_sequence(
    file: Path, photographs: dict[str, Camera], frames, fps: float, scale: float, fill: int
) -> tuple[Footage, int]:
    """(footage of the film, number of the frame in which the body hits the ground).

    The cameras of the film have the focal length of the photographs, in widths and heights of their
    pictures, and look along their middle."""
    document = read_json(file)
    hit = document.pop("hit_frame", None) if isinstance(document, dict) else None
    if isinstance(hit, bool) or not isinstance(hit, int) or not document:
        raise DataError(
            f"{file}: expected an object with hit_frame and a list of pictures for each camera, "
            f"found hit_frame {hit!r}"
        )
    counts = {camera: len(names) if isinstance(names, list) else -1 for camera, names in document.items()}  # fmt: skip
    if len(set(counts.values())) > 1 or min(counts.values()) < 1:
        raise DataError(f"{file}: expected as many pictures of each camera, found {counts}")
    for camera, names in document.items():
        for one in (camera, *names):
            if not isinstance(one, str) or one in ("", "..") or Path(one).name != one:
                raise DataError(f"{file}, {camera}: expected names of files, found {str(one)[:80]!r}")  # fmt: skip
    dynamic = file.parents[2]
    poses, focal = read_json(dynamic / "cameras_calib.json"), relative_focal(photographs)
    calibration = {}
    for camera, names in document.items():
        where = f"{dynamic / 'cameras_calib.json'}, {camera}"
        if not isinstance(poses, dict) or not isinstance(poses.get(camera), dict):
            raise DataError(f"{where}: expected rvecs and tvecs of the camera, found none")
        w2c = np.eye(4)
        w2c[:3, :3] = cv2.Rodrigues(three(poses[camera].get("rvecs"), f"{where}, rvecs"))[0]
        w2c[:3, 3] = three(poses[camera].get("tvecs"), f"{where}, tvecs")
        height, width = read_image(dynamic / "videos_images" / camera / names[0]).shape[:2]
        size = np.array([width, height])
        K = np.eye(3)
        K[[0, 1], [0, 1]], K[:2, 2] = focal * size, size / 2
        calibration[camera] = K, w2c
    numbers = frame_range(list(range(max(counts.values()))), frames, str(file))

    scaled, images, mattes = read_views(
        calibration, numbers, lambda camera, frame: dynamic / "videos_images" / camera / document[camera][frame],
        lambda camera, picture, pixels: split_mask(picture, pixels, dynamic / "videos_masks" / camera / f"{picture.stem}.png"),
        file.name, scale=scale, fill=fill)  # fmt: skip
    return footage_of(scaled, images, mattes, numbers, [k / fps for k in numbers], str(file)), hit


def three(value: Any, where: str) -> np.ndarray:
    """(3,) of nested lists. Errors: DataError beginning with `where`."""
    try:
        found = np.array(value, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError):
        found = np.zeros(0)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise DataError(f"{where}: expected three finite numbers, found {str(value)[:80]}")
    return found


def relative_focal(photographs: dict[str, Camera]) -> np.ndarray:
    """(2,) focal lengths over width and height. Errors: DataError for lenses that are not undone."""
    for camera in photographs.values():
        if camera.fisheye or any(camera.coefficients.values()):
            raise DataError(
                f"{camera.where}: expected a pinhole, found lens distortion; undistort the photographs and their masks "
                "(colmap image_undistorter)"
            )
    return np.median([c.K.diagonal()[:2] / c.size for c in photographs.values()], axis=0)


def rest_points(masks: Path, photographs: dict[str, Camera]) -> np.ndarray:
    """(M, 3) points that fill the visual hull of the masks, in COLMAP's axes and unit."""
    first = next(iter(photographs.values())).size
    width, height = min(WIDE, first[0]), round(first[1] * min(1.0, WIDE / first[0]))
    check_amount(len(photographs), width, height)
    mattes, K = [], []
    for name, camera in photographs.items():
        file = (masks / name).with_suffix(".png")
        mattes.append(resize(matte_of(file, read_image(file)), width, height))
        K.append(np.diag([width / camera.size[0], height / camera.size[1], 1.0]) @ camera.K)
    w2c = torch.from_numpy(np.stack([camera.w2c for camera in photographs.values()]))
    cameras = Cameras(torch.from_numpy(np.stack(K)).float(), w2c.float(), width, height, tuple(photographs))  # fmt: skip
    origins = -(w2c[:, :3, :3].transpose(1, 2) @ w2c[:, :3, 3:])[..., 0]
    middle, _ = misses(origins, w2c[:, 2, :3], torch.ones(len(w2c)))
    half = AROUND * (origins - middle).norm(dim=1).min()
    box = torch.stack([middle - half, middle + half]).float()
    views = torch.from_numpy(np.stack(mattes))
    try:
        bounds = hull_bounds(views, cameras, box)
        pitch = float((bounds[1] - bounds[0]).max()) / VOXELS
        hull = visual_hull(views, cameras, bounds, pitch=pitch)
    except DataError as error:
        raise DataError(
            f"{masks}: expected masks of one object, in the pictures that COLMAP's poses are of ({error})"
        ) from error
    return hull.points()[hull.values > 0.5].numpy()

"""Which pose belongs to which video: COLMAP models, or transforms.json as Nerfstudio and Blender write it."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from mosa.capture.phones import Camera, Phone, plausible
from mosa.data.formats.footage import read_json
from mosa.data.formats.transforms import camera_matrix, entries_of, shot_of
from mosa.data.images.lens import COEFFICIENTS
from mosa.data.io.colmap import is_model, read_model, read_points
from mosa.errors import DataError

VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm")
FEWEST = 3  # phones from which places and clocks can be told
MOVED, TURNED = 0.01, 0.5  # most by which one phone's poses may differ: share of extent, degrees
FOCUS = 0.02  # of the focal length, by which intrinsics of one phone may differ


def read_phones(
    videos: str | Path, poses: str | Path, sizes: dict[str, tuple[int, int]]
) -> list[Phone]:
    """One phone for each of the videos whose frame sizes [px] are given (name of the file -> width, height).

    Errors: DataError naming the video without a pose, or the poses that do not belong together."""
    folder = Path(videos)
    cameras = read_poses(poses)
    centres = np.array([camera.centre for camera in cameras.values()])
    extent = float(np.ptp(centres, axis=0).max())
    phones, stems = [], [Path(file).stem for file in sizes]
    for file, size in sizes.items():
        video = folder / file
        longer = [stem for stem in stems if len(stem) > len(video.stem)]
        mine = {name: camera for name, camera in cameras.items()
                if belongs(name, video.stem) and not any(belongs(name, s) for s in longer)}  # fmt: skip
        if not mine:
            raise DataError(
                f"{poses}: no pose for {video}: expected an image named {video.stem}.<ending>, {video.stem}_<number>, or "
                f"in a folder {video.stem}, found {', '.join(list(cameras)[:8])}"
            )
        one = plausible(still(mine, extent, video.stem))
        phones.append(Phone(video.stem, resized(one, size, video), video))
    if len(phones) < FEWEST:
        raise DataError(f"{folder}: expected at least {FEWEST} videos, found {len(phones)}")
    return phones


def read_poses(path: str | Path) -> dict[str, Camera]:
    """Image name -> camera, of a COLMAP model's folder or a transforms.json (or a folder with one)."""
    place = Path(path)
    if (model := model_folder(place)) is not None:
        return read_model(model)
    if place.is_dir():
        if not (place / "transforms.json").is_file():
            wanted = "a COLMAP model (cameras.bin and images.bin, or .txt) or transforms.json"
            raise DataError(f"{place}: expected {wanted}, found neither")
        place = place / "transforms.json"
    return read_transforms_poses(place)


def model_folder(place: Path) -> Path | None:
    """Where a COLMAP model lies, in the folder or as COLMAP nests it, of several the one with the most images, as COLMAP numbers
    parts that it could not join in no order; None where there is none."""
    numbered = (*sorted(place.glob("[0-9]*")), *sorted(place.glob("sparse/[0-9]*")))
    places = [place, place / "sparse", *numbered]
    return max(filter(is_model, places), key=lambda f: len(read_model(f)), default=None)


def scene_points(path: str | Path) -> np.ndarray:
    """(N, 3) points of the surroundings in the poses' world; none where poses bring none."""
    model = model_folder(Path(path))
    return np.zeros((0, 3)) if model is None else read_points(model)


def read_transforms_poses(file: Path) -> dict[str, Camera]:
    """Poses and lenses of a transforms.json; its images are not read. Errors: DataError naming entry and key."""
    document, found = read_json(file), {}
    for where, entry in entries_of(file, document):
        shot = shot_of(where, entry, document)
        width, height = (int(shot.intrinsics.get(key, 0)) for key in ("w", "h"))
        if min(width, height) < 1:
            raise DataError(
                f"{where}: expected an image size w, h of at least 1 px, found {width}, {height}"
            )
        K = camera_matrix(shot, width, height)
        lens = {name: shot.intrinsics[name] for name in COEFFICIENTS if name in shot.intrinsics}
        found[str(entry["file_path"])] = Camera(K, shot.w2c, (width, height), where, lens, shot.fisheye)  # fmt: skip
    return found


def belongs(image: str, phone: str) -> bool:
    """Whether an image of that name is one of a phone's: phone.jpg, phone_0003.png, images/phone/17.jpg."""
    path = Path(image)
    if phone in path.parts[:-1]:
        return True
    named = re.escape(phone) + r"([ _.-]+\d+|[ _.-]*frame[ _.-]*\d+)?"
    return re.fullmatch(named, path.stem) is not None


def still(cameras: dict[str, Camera], extent: float, phone: str) -> Camera:
    """The one camera that all poses of a phone are. Errors: DataError where they differ."""
    (name, one), *others = cameras.items()
    for _, camera in others:
        away = float(np.linalg.norm(camera.centre - one.centre))
        turn = camera.w2c[:3, :3] @ one.w2c[:3, :3].T
        angle = math.degrees(math.acos(np.clip(0.5 * (np.trace(turn) - 1), -1, 1)))
        if away > MOVED * extent or angle > TURNED:
            raise DataError(
                f"{camera.where}: phone {phone} stands elsewhere than in {name}, by {away:.3g} "
                f"(the cameras span {extent:.3g}) and {angle:.2g} degrees: expected phones that "
                "stand still"
            )
        other = np.abs(camera.K / camera.size[0] - one.K / one.size[0]).max()
        if other > FOCUS * one.K[0, 0] / one.size[0]:
            raise DataError(
                f"{camera.where}: phone {phone} has other intrinsics than in {name}, at the same place: expected one lens a phone; "
                "give its images one camera (COLMAP: ImageReader.single_camera_per_folder), or use one image of each"
            )
    return one


def resized(camera: Camera, size: tuple[int, int], video: Path) -> Camera:
    """The camera for frames of another size of the same field of view. Errors: DataError where the sides' ratio differs."""
    factor = size[0] / camera.size[0], size[1] / camera.size[1]
    if abs(factor[0] / factor[1] - 1) > 2e-3:
        raise DataError(
            f"{camera.where}: intrinsics are for {camera.size[0]}x{camera.size[1]} px, but {video} has frames of "
            f"{size[0]}x{size[1]}: expected the poses of images with the video's field of view; take them from a frame "
            "of each video, not from photographs"
        )
    return replace(camera, K=np.diag([*factor, 1.0]) @ camera.K, size=size)

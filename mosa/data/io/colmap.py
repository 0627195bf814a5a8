"""COLMAP's sparse models: cameras, images and points of either form (https://colmap.github.io/format.html)."""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from mosa.errors import DataError

HALF = 0.5  # pixel centres lie at half integers here and in COLMAP, at whole numbers in OpenCV

MODELS = {
    "SIMPLE_PINHOLE": (0, ("f", "cx", "cy")),
    "PINHOLE": (1, ("fx", "fy", "cx", "cy")),
    "SIMPLE_RADIAL": (2, ("f", "cx", "cy", "k1")),
    "RADIAL": (3, ("f", "cx", "cy", "k1", "k2")),
    "OPENCV": (4, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    "OPENCV_FISHEYE": (5, ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
    "SIMPLE_RADIAL_FISHEYE": (8, ("f", "cx", "cy", "k1")),
    "RADIAL_FISHEYE": (9, ("f", "cx", "cy", "k1", "k2")),
}
"""Model -> number in binary files, names of its parameters. Others (FULL_OPENCV, FOV, THIN_PRISM_FISHEYE) are refused."""
BY_NUMBER = {number: name for name, (number, _) in MODELS.items()}
POINTS = re.compile(r"[-+.\deE\s]+")  # A line of an image's points: numbers by threes
MAX_ENTRIES = 100_000  # cameras or images; the count of a damaged file may be any number

Intrinsics = tuple[np.ndarray, dict[str, float], bool, tuple[int, int]]


@dataclass(frozen=True)
class Camera:
    """K: (3, 3) [px, pixel centres at half integers]; w2c: (4, 4), OpenCV axes, length unit of the poses; size: (width, height)
    [px]; coefficients: k1 to k4, p1, p2 of the lens (`mosa.data.images.lens`); where: file and entry, for messages."""

    K: np.ndarray
    w2c: np.ndarray
    size: tuple[int, int]
    where: str
    coefficients: Mapping[str, float] = field(default_factory=dict)
    fisheye: bool = False

    @property
    def centre(self) -> np.ndarray:
        """(3,) in the world of the poses."""
        return -self.w2c[:3, :3].T @ self.w2c[:3, 3]

    def lens(self) -> np.ndarray:
        """Coefficients in OpenCV's order."""
        names = ("k1", "k2", "k3", "k4") if self.fisheye else ("k1", "k2", "p1", "p2", "k3")
        return np.array([self.coefficients.get(name, 0.0) for name in names])

    def opencv_K(self) -> np.ndarray:
        return self.K - HALF * np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of points (N, 3) of the world, lens included."""
        seen = points @ self.w2c[:3, :3].T + self.w2c[:3, 3]
        if not self.fisheye and not any(self.coefficients.values()):
            return (seen @ self.K.T)[:, :2] / seen[:, 2:]
        none, lens = np.zeros(3), cv2.fisheye if self.fisheye else cv2
        found = lens.projectPoints(seen.reshape(-1, 1, 3), none, none, self.opencv_K(), self.lens())
        return found[0].reshape(-1, 2) + HALF

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions (N, 3) in the world of what pixels (N, 2) show."""
        flat = np.asarray(pixels, np.float64).reshape(-1, 1, 2) - HALF
        lens = cv2.fisheye if self.fisheye else cv2
        flat = lens.undistortPoints(flat, self.opencv_K(), self.lens()).reshape(-1, 2)
        rays = np.concatenate([flat, np.ones((len(flat), 1))], 1) @ self.w2c[:3, :3]
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def is_model(folder: Path) -> bool:
    return any((folder / f"images{ending}").is_file() for ending in (".bin", ".txt"))


def read_model(folder: Path) -> dict[str, Camera]:
    """Image name -> camera. Errors: DataError naming file and line, or entry."""
    readers = {".bin": (binary_cameras, binary_images), ".txt": (text_cameras, text_images)}
    for ending, (cameras_of, images_of) in readers.items():
        images, cameras = folder / f"images{ending}", folder / f"cameras{ending}"
        if images.is_file():
            if not cameras.is_file():
                raise DataError(
                    f"{cameras}: file not found; a COLMAP model has it beside {images.name}"
                )
            try:
                return assembled(cameras_of(cameras), images_of(images), images)
            except (struct.error, UnicodeDecodeError, OverflowError) as error:
                found = f"found a damaged file ({error}); export it again"
                raise DataError(f"{folder}: expected a COLMAP model, {found}") from error
    raise DataError(f"{folder}: expected images.bin or images.txt of a COLMAP model, found neither")


Images = list[tuple[str, int, np.ndarray, np.ndarray]]  # name, camera, quaternion, translation


def assembled(cameras: dict[int, Intrinsics], images: Images, file: Path) -> dict[str, Camera]:
    found = {}
    for name, number, quaternion, shift in images:
        where = f"{file}, image {name}"
        if name in found:
            raise DataError(f"{where}: expected every image once, found it twice")
        if number not in cameras:
            known = sorted(cameras)
            raise DataError(
                f"{where}: expected one of the cameras {known}, found CAMERA_ID {number}"
            )
        norm = float(np.linalg.norm(quaternion))
        if not np.isfinite([*quaternion, *shift]).all() or abs(norm - 1) > 1e-3:
            found = f"{list(quaternion)}, {list(shift)}"
            raise DataError(f"{where}: expected a unit quaternion, a finite shift, found {found}")
        K, coefficients, fisheye, size = cameras[number]
        w2c = np.eye(4)
        # COLMAP writes w first, scipy last
        w2c[:3, :3] = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
        w2c[:3, 3] = shift
        found[name] = Camera(K, w2c, size, where, coefficients, fisheye)
    if not found:
        raise DataError(f"{file}: expected registered images, found none")
    return found


def intrinsics(model: str, width: int, height: int, values: list[float], where: str) -> Intrinsics:
    if model not in MODELS:
        raise DataError(
            f"{where}: expected a camera model of {', '.join(MODELS)}, found {model}; undistort the images, or choose "
            "one of these in COLMAP (ImageReader.camera_model)"
        )
    names = MODELS[model][1]
    if len(values) != len(names):
        wanted = f"the {len(names)} parameters {', '.join(names)} of {model}"
        raise DataError(f"{where}: expected {wanted}, found {len(values)}")
    given = dict(zip(names, values))
    fx, fy = given.get("fx", given.get("f")), given.get("fy", given.get("f"))
    sized = 0 < width < 1e5 and 0 < height < 1e5
    if not (np.isfinite(values).all() and fx > 0 and fy > 0 and sized):
        found = f"{given} for {width}x{height} px"
        raise DataError(f"{where}: expected positive focal lengths and sizes, found {found}")
    K = np.array([[fx, 0, given["cx"]], [0, fy, given["cy"]], [0, 0, 1]])
    coefficients = {name: value for name, value in given.items() if name[0] in "kp"}
    return K, coefficients, model.endswith("FISHEYE"), (width, height)


def numbers(words: list[str], where: str) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise DataError(f"{where}: expected numbers, found {' '.join(words)[:80]!r}") from error


def whole(words: list[str], where: str) -> list[int]:
    found = numbers(words, where)
    if not all(value.is_integer() and abs(value) < 2**63 for value in found):
        raise DataError(f"{where}: expected whole numbers, found {' '.join(words)[:80]!r}")
    return [int(value) for value in found]


def lines_of(file: Path) -> list[tuple[int, str]]:
    """Numbered lines that are no comments, empty ones included. Errors: DataError."""
    try:
        lines = file.read_text("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        found = f"found a damaged file ({error}); export it again"
        raise DataError(f"{file}: expected the text of a COLMAP model, {found}") from error
    return [(i, line.strip()) for i, line in enumerate(lines, 1) if not line.startswith("#")]


def text_cameras(file: Path) -> dict[int, Intrinsics]:
    found = {}
    for i, line in lines_of(file):
        words, where = line.split(), f"{file}, line {i}"
        if not words:
            continue
        if len(words) < 5:
            wanted = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS"
            raise DataError(f"{where}: expected {wanted}, found {line[:80]!r}")
        number, width, height = whole([words[0], *words[2:4]], where)
        if number in found:
            raise DataError(f"{where}: expected every CAMERA_ID once, found {number} twice")
        found[number] = intrinsics(words[1], width, height, numbers(words[4:], where), where)
    return found


def text_images(file: Path) -> Images:
    """An image takes two lines, the second of which, its points, is passed over; some programs leave it out where it is empty."""
    found, named = [], False
    for i, line in lines_of(file):
        named, points = not named, named and len(line.split()) % 3 == 0
        if not line or (points and POINTS.fullmatch(line)):
            continue
        named = True
        words, where = line.split(maxsplit=9), f"{file}, line {i}"
        if len(words) < 10:
            wanted = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            raise DataError(f"{where}: expected {wanted}, found {line[:80]!r}")
        (_, number), values = whole([words[0], words[8]], where), numbers(words[1:8], where)
        found.append((words[9], number, np.array(values[:4]), np.array(values[4:])))
    return found


def binary_cameras(file: Path) -> dict[int, Intrinsics]:
    data, found = file.read_bytes(), {}
    count, at = counted(data, file), 8
    for _ in range(count):
        number, model, width, height = struct.unpack_from("<iiQQ", data, at)
        where = f"{file}, camera {number}"
        if model not in BY_NUMBER:
            known = ", ".join(MODELS)
            raise DataError(f"{where}: expected a camera model of {known}, found number {model}")
        names = MODELS[BY_NUMBER[model]][1]
        values = struct.unpack_from(f"<{len(names)}d", data, at + 24)
        at += 24 + 8 * len(names)
        found[number] = intrinsics(BY_NUMBER[model], width, height, list(values), where)
    return found


def binary_images(file: Path) -> Images:
    data, found = file.read_bytes(), []
    count, at = counted(data, file), 8
    for _ in range(count):
        _, *values, number = struct.unpack_from("<i7di", data, at)
        end = data.find(b"\0", at + 64)
        if end < 0:
            raise DataError(f"{file}: expected an image's name, found the end of the file")
        name = data[at + 64 : end].decode()
        (points,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * points
        found.append((name, number, np.array(values[:4]), np.array(values[4:])))
    return found


def read_points(folder: Path) -> np.ndarray:
    """(N, 3) points of a model, none where it has no file of them. Errors: DataError."""
    text, binary = folder / "points3D.txt", folder / "points3D.bin"
    if binary.is_file():
        data, at, found = binary.read_bytes(), 8, []
        try:
            for _ in range(counted(data, binary, 100 * MAX_ENTRIES)):
                found.append(struct.unpack_from("<3d", data, at + 8))
                at += 51 + 8 * struct.unpack_from("<Q", data, at + 43)[0]
        except (struct.error, OverflowError) as error:
            found = f"found a damaged file ({error}); export it again"
            raise DataError(f"{binary}: expected points of a COLMAP model, {found}") from error
    elif text.is_file():
        lines = [(line.split(maxsplit=4), i) for i, line in lines_of(text) if line]
        found = [point(words, f"{text}, line {i}") for words, i in lines]
    else:
        return np.zeros((0, 3))
    points = np.array(found, float).reshape(-1, 3)
    return points[np.isfinite(points).all(1)]


def point(words: list[str], where: str) -> list[float]:
    if len(words) < 4:
        raise DataError(f"{where}: expected POINT3D_ID X Y Z, found {' '.join(words)[:80]!r}")
    return numbers(words[1:4], where)


def counted(data: bytes, file: Path, most: int = MAX_ENTRIES) -> int:
    (count,) = struct.unpack_from("<Q", data, 0)
    if count > most:
        raise DataError(f"{file}: expected at most {most} entries, found {count}: no COLMAP model")
    return count

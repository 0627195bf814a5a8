"""The world of a capture: metres, y up, z towards the first phone, the ground at 0; and its files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from mosa.capture.fall import Fall
from mosa.capture.phones import Camera, Phone
from mosa.data.formats.footage import OPENGL_TO_OPENCV, Footage, matrix, number, read_json
from mosa.data.formats.transforms import read_transforms
from mosa.data.hull import occupancy
from mosa.errors import DataError
from mosa.system.whole_files import write_whole

FILE = "capture.json"
REACH, PITCH = 2.2, 1 / 20  # object radii in which the lowest point is sought, step of the search
FOOT = 0.1  # share of its widest level's area from which on a hull's level is the body's
AROUND, LAYER, FEWEST = 10.0, 0.06, 15
"""Radii around the landing in which points belong to the floor, half a layer's thickness in radii, and how many make one."""
FLOOR = 3.0  # object radii around the landing in which the floor has one colour
GAIN = 3.0  # largest factor between phones' colours that counts as exposure


@dataclass(frozen=True)
class World:
    """X = scale R (x - origin) [m] of the poses' world x. R: (3, 3); origin: (3,)."""

    scale: float
    R: np.ndarray
    origin: np.ndarray

    def points(self, x: np.ndarray) -> np.ndarray:
        return self.scale * (x - self.origin) @ self.R.T

    def pose(self, camera: Camera) -> np.ndarray:
        """(4, 4), camera to world, OpenCV axes."""
        pose = np.eye(4)
        pose[:3, :3] = self.R @ camera.w2c[:3, :3].T
        pose[:3, 3] = self.points(camera.centre)
        return pose

    def lowered(self, height: float) -> World:
        """The world whose zero is at that height [m] of this one."""
        return World(self.scale, self.R, self.origin + height / self.scale * self.R[1])

    def written(self) -> dict:
        return {"scale": self.scale, "rotation": self.R.tolist(), "origin": self.origin.tolist()}


def world_of(fall: Fall, phones: list[Phone], ground: np.ndarray | None) -> World:
    """From scale and up of a fall; its origin below where the free fall ends, at the height of `ground` (3,), a point of the floor
    in the poses' world, or at the height of the centre there."""
    up = fall.up
    end = fall.at(np.array(fall.window[1]))
    towards = phones[0].camera.centre - end
    towards = towards - up * (towards @ up)
    towards /= np.linalg.norm(towards)
    R = np.stack([np.cross(up, towards), up, towards])
    height = 0.0 if ground is None else float((ground - end) @ up)
    return World(fall.scale, R, end + height * up)


def read_world(folder: str | Path) -> World:
    """Of an earlier capture by the same phones. Errors: DataError."""
    file = Path(folder) / FILE if Path(folder).is_dir() else Path(folder)
    document = read_json(file)
    found = document.get("world") if isinstance(document, Mapping) else None
    if not isinstance(found, Mapping) or not {"scale", "rotation", "origin"} <= set(found):
        raise DataError(
            f"{file}: expected the record of a capture with world.scale, rotation, origin: "
            "name the folder that mosa-capture wrote"
        )
    origin = matrix([found["origin"]], (1, 3), f"{file}, world.origin")[0]
    scale = number(found["scale"], f"{file}, world.scale")
    R = matrix(found["rotation"], (3, 3), f"{file}, world.rotation")
    if not scale > 0:
        raise DataError(f"{file}, world.scale: expected a number above 0, found {scale:g}")
    if not (np.abs(R @ R.T - np.eye(3)).max() < 1e-3 and np.linalg.det(R) > 0):
        raise DataError(f"{file}, world.rotation: expected a rotation matrix, found {R.tolist()}")
    return World(scale, R, origin)


def write_images(folder: Path, phone: Phone, pictures: np.ndarray) -> None:
    """(T, H, W, 4) uint8 as images/<phone>_<frame>.png."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for k, picture in enumerate(pictures):
        _, content = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA))
        file = folder / "images" / f"{phone.name}_{k:03d}.png"
        try:
            file.write_bytes(content)  # OpenCV's own writing says nothing of a full disk
        except OSError as error:
            raise DataError(f"output: {file} cannot be written ({error.strerror})") from error


def write_transforms(folder: Path, phones: list[Phone], times: np.ndarray, world: World) -> Path:
    """transforms.json of images that `write_images` wrote; times: (T,) [s]."""
    entries = []
    for phone in phones:
        camera, pose = phone.camera, world.pose(phone.camera) @ OPENGL_TO_OPENCV
        for k, time in enumerate(times):
            entries.append({
                "file_path": f"images/{phone.name}_{k:03d}.png", "time": round(float(time - times[0]), 9), "camera": phone.name,
                "transform_matrix": pose.tolist(), "fl_x": camera.K[0, 0], "fl_y": camera.K[1, 1], "cx": camera.K[0, 2],
                "cy": camera.K[1, 2], "w": camera.size[0], "h": camera.size[1], **camera.coefficients,
                "camera_model": "OPENCV_FISHEYE" if camera.fisheye else "OPENCV",
            })  # fmt: skip
    file = folder / "transforms.json"
    write_whole(file, json.dumps({"frames": entries}, indent=1))
    return file


def lowest_points(folder: Path, centres: np.ndarray, radius: float, scale: float) -> np.ndarray:
    """(T, 2) [m] heights of `lowest_of_hull` in each frame of a written capture; centres: (T, 3), radius [m]; scale: of
    the images."""
    footage = read_transforms(folder, scale=scale)
    return np.array([lowest_of_hull(footage, t, c, radius) for t, c in enumerate(centres)])


def lowest_of_hull(
    footage: Footage, frame: int, centre: np.ndarray, radius: float
) -> tuple[float, float]:
    """Heights [m] of the hull's tip, and of the lowest level with FOOT of its widest level's area. Below a flat underside a hull
    ends in a cone of the lowest phone's slope, so that the ground lies between. NaNs where it is empty, or cut by the search."""
    steps = np.arange(-REACH, REACH, PITCH)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1) * radius + centre
    values = occupancy(torch.from_numpy(grid).float(), footage.mattes[:, frame], footage.cameras)
    area = (values.clamp(0.0, 1.0) > 0.5).float().sum((0, 2)).numpy()
    inside = np.flatnonzero(area)
    if len(inside) == 0 or inside[0] == 0:
        return float("nan"), float("nan")
    foot = np.flatnonzero(area >= FOOT * area.max())[0]
    return tuple(float(centre[1] + radius * (steps[k] - 0.5 * PITCH)) for k in (inside[0], foot))


def ground_height(lowest: np.ndarray, pixel: float) -> tuple[float, float]:
    """Height [m] of the ground and what it may be off by, from (T, 2) heights of `lowest_of_hull`: the least, of medians of three
    frames, which a single bad matte does not lower. pixel [m]: at the object. Errors: DataError."""
    good = lowest[np.isfinite(lowest).all(1)]
    if len(good) < 3:
        raise DataError(
            "ground: the object's lowest point is not seen; name a point of the floor with ground=[x, y, z], in the "
            "world of the poses"
        )
    smooth = np.median(np.lib.stride_tricks.sliding_window_view(good, 3, axis=0), axis=2)
    k = int(smooth[:, 1].argmin())
    return float(smooth[k, 1]), max(pixel, float(smooth[k, 1] - smooth[k, 0]))


def floor_of_points(
    points: np.ndarray, radius: float, near: float, apart: float
) -> tuple[float, float, float] | None:
    """(height [m], one standard deviation [m], tilt against level [degrees]) of the floor among points (N, 3) [m] of the
    surroundings, the densest level within `apart` of `near`, where the object was lowest; None where there are too few of them."""
    beside = np.hypot(points[:, 0], points[:, 2]) < AROUND * radius
    around = points[beside & (np.abs(points[:, 1] - near) < apart)]
    if len(around) < FEWEST:
        return None
    thick = LAYER * radius
    inside = max((np.flatnonzero(np.abs(around[:, 1] - y) < thick) for y in around[:, 1]), key=len)
    layer = around[inside]
    if len(layer) < FEWEST:
        return None
    height = float(np.median(layer[:, 1]))
    spread = 1.4826 * float(np.median(np.abs(layer[:, 1] - height)))
    plane = np.concatenate([layer[:, [0, 2]], np.ones((len(layer), 1))], 1)
    slope = np.linalg.lstsq(plane, layer[:, 1], rcond=None)[0]
    tilt = float(np.degrees(np.arctan(np.hypot(slope[0], slope[1]))))
    return height, max(1e-4, 1.25 * spread / len(layer) ** 0.5), tilt


def box_of(centres: np.ndarray, radius: float) -> list[list[float]]:
    """Where the object may be [m], two corners, from its centres (T, 3)."""
    across = np.abs(centres[:, [0, 2]]).max() + 4.5 * radius
    top, side = round(float(centres[:, 1].max()) + 3.5 * radius, 2), round(across, 2)
    return [[-side, -round(0.8 * radius, 2), -side], [side, top, side]]


def floor_gains(
    phones: list[Phone], plates: list[np.ndarray], world: World, radius: float
) -> np.ndarray | None:
    """(V, 3) factors that give the phones one colour of the floor where the object lands, seen empty in all plates (H, W, 3) in
    [0, 1]; None where some phone does not see it, or where they differ by more than exposure and white balance do."""
    steps = np.arange(-FLOOR, FLOOR, 0.1) * radius
    spots = np.stack(np.meshgrid(steps, [0.0], steps), -1).reshape(-1, 3)
    spots = spots @ world.R / world.scale + world.origin
    colors, every = [], np.ones(len(spots), bool)
    for phone, plate in zip(phones, plates):
        x, y = np.floor(phone.camera.project(spots)).T.astype(int)
        width, height = phone.camera.size
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        every &= inside
        colors.append(plate[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)])
    if every.sum() < 50:
        return None
    means = np.stack([np.median(color[every], 0) for color in colors])
    if means.min() < 0.02:
        return None
    gains = np.exp(np.log(means).mean(0)) / means
    return None if gains.max() > GAIN or gains.min() < 1 / GAIN else gains

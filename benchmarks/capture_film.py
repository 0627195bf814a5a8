"""Six phones film a built-in body with all their faults, and six perfect cameras film the same: footage for benchmarks/capture.py.

Faults: clocks that differ by fractions of a second, sensors read row by row, noise, H.264, exposure and white balance of each
phone's own and other ones in its plate, poses that are a little wrong, in a world of any scale and orientation. Mattes are left to
the program.
"""

from __future__ import annotations

import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

import cv2
import imageio.v2 as iio
import numpy as np
import warp as wp
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

from mosa.data.formats.footage import OPENGL_TO_OPENCV
from mosa.data.synthetic.bodies.objects import drop_named, object_named
from mosa.data.synthetic.drop import GRAVITY, simulate
from mosa.data.synthetic.films import built
from mosa.data.synthetic.raycast_kernels import cast
from mosa.data.synthetic.renderer import AMBIENT, LIGHT, SAMPLES, window
from mosa.data.synthetic.surface import vertex_normals

FINE = 400.0
"""Frames per second in which the truth is kept: between two of them a body moves on a straight line to 0.4 mm."""
BAND = 0.25e-3
"""[s] of readout that is rendered as one moment."""
REST = 0.12
"""[s] that the object hangs still in the films before it falls."""


@dataclass(frozen=True)
class Faults:
    """Of all phones; sizes of what is drawn for each. offset, readout [s]; noise: of 8-bit values over 255; exposure [stops];
    balance: of a colour channel; pose [degrees], place [m], focal: relative; quality: H.264's crf."""

    offset: float = 0.4
    readout: tuple[float, float] = (0.008, 0.022)
    noise: float = 0.015
    exposure: float = 0.3
    balance: float = 0.06
    plate: float = 0.08
    pose: float = 0.05
    place: float = 0.0015
    focal: float = 0.001
    quality: int = 20


class Fall:
    """A drop of a built-in body, from rest to some time after contact; time 0 is the built-in scene's frame 0."""

    def __init__(self, name: str, sequence: str, material: str, seconds: float, seed: int = 0):
        body, drop = object_named(name), drop_named(name, sequence)
        self.hidden = body.material.variant(material)
        self.surface, self.particles, self.skin = built(body.shape, body.pitch, body.spacing, seed)
        finer = replace(
            body, footage=replace(body.footage, fps=FINE, frames=int(seconds * FINE) + 2)
        )
        found = simulate(
            finer, self.hidden, self.particles, self.surface.vertices, drop, body.drops["train"]
        )
        self.positions, self.velocity, self.g = found.positions, found.velocity, np.array(GRAVITY)
        self.released = float(
            self.velocity[1] / -self.g[1]
        )  # before 0: it hangs, then falls from rest

    def shift(self, t: float) -> np.ndarray | None:
        """(3,) [m] by which the body of time 0 is displaced while it is rigid; None later."""
        if t > 0:
            return None
        t = max(t, self.released)
        return self.velocity * t + 0.5 * self.g * t * t

    def at(self, t: float) -> np.ndarray:
        """Particles (N, 3) [m] at a time [s]."""
        if (shift := self.shift(t)) is not None:
            return self.positions[0] + shift
        k = min(int(t * FINE), len(self.positions) - 2)
        share = t * FINE - k
        return (1 - share) * self.positions[k] + share * self.positions[k + 1]


class Shown:
    """The surface of a fall as a mesh that rays are cast at."""

    def __init__(self, fall: Fall):
        self.fall = fall
        self.colors = wp.array(
            np.clip(fall.surface.colors, 0, 1).astype(np.float32), dtype=wp.vec3, device="cpu"
        )
        self.when: float | None = None
        self.move_to(0.0)

    def move_to(self, t: float) -> np.ndarray:
        """Bring the mesh to a time; returns the shift (3,) that is left to the camera: as long as the body is rigid it stays."""
        shift = self.fall.shift(t)
        key = 0.0 if shift is not None else t
        if self.when != key:
            self.vertices = self.fall.skin.follow(self.fall.at(key)).astype(np.float32)
            triangles = self.fall.surface.triangles
            self.mesh = wp.Mesh(
                wp.array(self.vertices, dtype=wp.vec3, device="cpu"),
                wp.array(triangles.ravel(), dtype=wp.int32, device="cpu"),
            )
            self.normals = wp.array(
                vertex_normals(self.vertices, triangles).astype(np.float32),
                dtype=wp.vec3,
                device="cpu",
            )
            self.when = key
        return np.zeros(3) if shift is None else shift

    def rows(
        self, t: float, K: np.ndarray, w2c: np.ndarray, size: tuple[int, int], rows: tuple[int, int]
    ) -> tuple[int, np.ndarray]:
        """(first column, RGBA (h, w, 4) in [0, 1], straight) of the given rows at one time; w = 0 where nothing is seen."""
        shift = self.move_to(t)
        pose = w2c.copy()
        pose[:3, 3] += pose[:3, :3] @ shift  # the camera moves against the body
        x0, y0, x1, y1 = window(self.vertices, K, pose, *size)
        y0, y1 = max(y0, rows[0]), min(y1, rows[1])
        if x1 <= x0 or y1 <= y0:
            return 0, np.zeros((rows[1] - rows[0], 0, 4), np.float32)
        part = wp.zeros((y1 - y0, x1 - x0), dtype=wp.vec4, device="cpu")
        wp.launch(cast, (y1 - y0, x1 - x0), device="cpu", inputs=[
            self.mesh.id, self.colors, self.normals, wp.mat44(*np.linalg.inv(pose).ravel().tolist()), wp.vec2(K[0, 0], K[1, 1]),
            wp.vec2(K[0, 2], K[1, 2]), x0, y0, x1 - x0, SAMPLES, wp.vec3(*LIGHT.tolist()), AMBIENT, part,
        ])  # fmt: skip
        found = np.zeros((rows[1] - rows[0], x1 - x0, 4), np.float32)
        found[y0 - rows[0] : y1 - rows[0]] = part.numpy()
        return x0, np.clip(found, 0, 1)

    def picture(
        self, t: float, K: np.ndarray, w2c: np.ndarray, size: tuple[int, int], readout: float = 0.0
    ) -> np.ndarray:
        """RGBA (H, W, 4) in [0, 1]; t [s]: of the middle row; readout [s] from the first row to the last."""
        width, height = size
        picture = np.zeros((height, width, 4), np.float32)
        shift = self.move_to(t)
        low, high = (self.vertices + shift).min(0), (self.vertices + shift).max(0)
        spare = (
            4.0 * readout
        )  # [m] on both sides: what falls no faster stays in there while the sensor is read
        corners = np.array(np.meshgrid(*zip(low - spare, high + spare))).reshape(3, -1).T
        _, top, _, bottom = window(corners, K, w2c, width, height)
        bands = max(
            1,
            int(
                np.ceil(
                    readout / (BAND if self.fall.shift(t + 0.5 * readout) is not None else 2 * BAND)
                )
            ),
        )
        edges = np.linspace(0, height, bands + 1).round().astype(int)
        for r0, r1 in pairwise(edges):
            if r1 > top and r0 < bottom:
                x0, part = self.rows(
                    t + readout * (0.5 * (r0 + r1) / height - 0.5), K, w2c, size, (r0, r1)
                )
                picture[r0:r1, x0 : x0 + part.shape[1]] = part
        return picture


def phones(
    count: int, size: tuple[int, int], target: float, field: float, rng: np.random.Generator
) -> list[tuple[np.ndarray, np.ndarray]]:
    """(K, w2c) of phones on tripods around; field: half the height they see at the target [m]."""
    found = []
    for i in range(count):
        azimuth, elevation = (
            2 * np.pi * (i + rng.uniform(-0.15, 0.15)) / count,
            (0.12, 0.5)[i % 2] + rng.uniform(-0.05, 0.05),
        )
        distance = 1.8 * rng.uniform(0.95, 1.1)
        back = np.array(
            [
                np.cos(azimuth) * np.cos(elevation),
                np.sin(elevation),
                np.sin(azimuth) * np.cos(elevation),
            ]
        )
        right = np.cross(-back, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        roll = Rotation.from_rotvec([0, 0, np.radians(rng.uniform(-2, 2))]).as_matrix()
        w2c = np.eye(4)
        w2c[:3, :3] = roll @ np.stack([right, np.cross(-back, right), -back])
        w2c[:3, 3] = -w2c[:3, :3] @ (np.array([0.0, target, 0.0]) + distance * back)
        focal = 0.5 * size[1] * distance / field
        found.append((np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]]), w2c))
    return found


def smooth_noise(u: np.ndarray, v: np.ndarray, seed: int) -> np.ndarray:
    """(...) in about [-1, 1]: sums of waves."""
    rng = np.random.default_rng(seed)
    total = np.zeros_like(u)
    for _ in range(12):
        a, b, c = *rng.normal(0, 6, 2).tolist(), rng.uniform(0, 2 * np.pi)
        total += np.sin(a * u + b * v + c)
    return total / 5


class Room:
    """What is behind the object for one camera: floor and wall of a dull blue, and the floor's points for the shadow."""

    def __init__(self, K: np.ndarray, w2c: np.ndarray, size: tuple[int, int]):
        x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
        rays = (
            np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1)
            @ w2c[:3, :3]
        )
        eye = -w2c[:3, :3].T @ w2c[:3, 3]
        way = np.where(rays[..., 1] < -1e-6, -eye[1] / np.minimum(rays[..., 1], -1e-6), np.inf)
        self.floor_points = eye + np.where(np.isfinite(way), way, 0)[..., None] * rays
        self.is_floor = np.isfinite(way) & (
            np.linalg.norm(self.floor_points[..., [0, 2]], axis=-1) < 2.5
        )
        angle, height = (
            np.arctan2(rays[..., 2], rays[..., 0]),
            rays[..., 1] / np.linalg.norm(rays, axis=-1),
        )
        floor = 0.05 * smooth_noise(3 * self.floor_points[..., 0], 3 * self.floor_points[..., 2], 1)
        wall = 0.05 * smooth_noise(2 * angle, 2 * height, 2)
        tone = np.where(self.is_floor, floor, wall)[..., None]
        base = np.where(self.is_floor[..., None], [0.24, 0.34, 0.50], [0.20, 0.30, 0.46])
        self.picture = np.clip(base * (1 + tone), 0, 1).astype(np.float32)

    def with_shadow(self, place: np.ndarray) -> np.ndarray:
        """The room below an object whose centre is at `place`: the lower, the darker."""
        away = np.square(self.floor_points[..., [0, 2]] - place[[0, 2]]).sum(-1)
        dark = 0.35 * np.clip(1 - place[1] / 0.6, 0, 1) * np.exp(-away / (2 * 0.08**2))
        return self.picture * np.where(self.is_floor, 1 - dark, 1)[..., None].astype(np.float32)


def floor_points(
    rng: np.random.Generator, turn: Rotation, scale: float, move: np.ndarray
) -> list[str]:
    """Lines of points3D.txt: what COLMAP finds on a textured floor, to 2 mm, on the wall, and some mistakes."""
    floor = np.stack(
        [rng.uniform(-1.2, 1.2, 300), np.zeros(300), rng.uniform(-1.2, 1.2, 300)], 1
    ) + rng.normal(0, 0.002, (300, 3))
    angle = rng.uniform(0, 2 * np.pi, 200)
    wall = np.stack([2.5 * np.cos(angle), rng.uniform(0, 2, 200), 2.5 * np.sin(angle)], 1)
    points = turn.apply(np.concatenate([floor, wall, rng.uniform(-1, 1, (40, 3))])) / scale + move
    return [
        f"{i + 1} {x:.9g} {y:.9g} {z:.9g} 90 110 130 0.6 1 1 2 1"
        for i, (x, y, z) in enumerate(points)
    ]


@dataclass(frozen=True)
class Take:
    """What the processes that film one fall have in common."""

    folder: Path
    name: str
    material: str
    size: tuple[int, int]
    fps: float
    seconds: float
    faults: Faults
    seed: int
    top: float
    phone_count: int

    def camera(self, phone: int) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng([self.seed, 11])
        return phones(
            self.phone_count, self.size, target=0.5 * self.top, field=0.56 * self.top, rng=rng
        )[phone]


def film_phone(take: Take, v: int) -> dict:
    """Write the video and the plate of one phone, whose faults are drawn for it alone; what truth.json says of it, and its pose and
    focal length as COLMAP would have them in the true world."""
    faults, size, rng = take.faults, take.size, np.random.default_rng([take.seed, 12, v])
    fall = Fall(take.name, "train", take.material, take.seconds + 0.06)
    shown = Shown(fall)
    K, w2c = take.camera(v)
    phone = f"phone{v}"
    begin = fall.released - REST - rng.uniform(0, faults.offset)
    readout = rng.uniform(*faults.readout)
    gain = 2 ** rng.uniform(-faults.exposure, faults.exposure) * (
        1 + rng.normal(0, faults.balance, 3)
    )
    # a pose that is a little wrong
    wrong = (
        Rotation.from_rotvec(np.radians(rng.normal(0, faults.pose, 3))).as_matrix() @ w2c[:3, :3]
    )
    centre = -w2c[:3, :3].T @ w2c[:3, 3] + rng.normal(0, faults.place, 3)
    focal = K[0, 0] * (1 + rng.normal(0, faults.focal))
    room = Room(K, w2c, size)

    def developed(picture: np.ndarray, gain=gain) -> np.ndarray:
        seen = np.clip(picture * gain + rng.normal(0, faults.noise, picture.shape), 0, 1)
        return np.round(255 * seen).astype(np.uint8)

    iio.imwrite(
        take.folder / "plates" / f"{phone}.png",
        developed(room.picture, gain * (1 + rng.normal(0, faults.plate))),
    )
    count = int((take.seconds - begin) * take.fps)
    with iio.get_writer(
        take.folder / "videos" / f"{phone}.mp4",
        fps=take.fps,
        codec="libx264",
        quality=None,
        pixelformat="yuv420p",
        macro_block_size=2,
        output_params=["-crf", str(faults.quality)],
    ) as writer:
        for k in range(count):
            t = begin + k / take.fps
            seen = shown.picture(t, K, w2c, size, readout)
            behind = room.with_shadow(fall.at(t).mean(0))
            writer.append_data(
                developed(seen[..., :3] * seen[..., 3:] + (1 - seen[..., 3:]) * behind)
            )
    said = {"phone": phone, "begin": begin, "readout": readout, "K": K.tolist(), "w2c": w2c.tolist(), "gain": gain.tolist(),
            "frames": count}  # fmt: skip
    return {"said": said, "rotation": wrong, "centre": centre, "focal": focal}


def film(
    folder: Path,
    *,
    name: str,
    material: str,
    phone_count: int = 6,
    size: tuple[int, int] = (960, 720),
    fps: float = 60.0,
    seconds: float = 0.30,
    faults: Faults | None = None,
    seed: int = 0,
    jobs: int = 1,
) -> dict:
    """Write videos/, plates/, sparse/ (a COLMAP model in text, floor points included) and truth.json into a folder; returns
    what truth.json says. jobs: phones that film at a time, each in a process."""
    rng = np.random.default_rng([seed, 13])
    fall = Fall(name, "train", material, seconds + 0.06)
    top = float((fall.skin.follow(fall.at(0.0))[:, 1] + fall.shift(-10.0)[1]).max())
    for sub in ("videos", "plates", "sparse"):
        (folder / sub).mkdir(parents=True, exist_ok=True)
    take = Take(
        folder, name, material, size, fps, seconds, faults or Faults(), seed, top, phone_count
    )
    if jobs == 1:
        filmed = [film_phone(take, v) for v in range(phone_count)]
    else:
        with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
            filmed = list(pool.map(film_phone, [take] * phone_count, range(phone_count)))
    # what COLMAP says: a world of its own
    scale, turn, move = (
        rng.uniform(0.4, 2.5),
        Rotation.random(random_state=int(rng.integers(1 << 30))),
        rng.normal(0, 3, 3),
    )
    cameras_text, images_text = ["# Camera list"], ["# Image list"]
    for v, found in enumerate(filmed):
        rotation = found["rotation"] @ turn.as_matrix().T
        quaternion = np.roll(Rotation.from_matrix(rotation).as_quat(), 1)
        shift = -rotation @ (turn.apply(found["centre"]) / scale + move)
        K = found["said"]["K"]
        cameras_text.append(
            f"{v + 1} SIMPLE_PINHOLE {size[0]} {size[1]} {found['focal']:.6f} {K[0][2]} {K[1][2]}"
        )
        images_text += [
            f"{v + 1} "
            + " ".join(f"{x:.12g}" for x in [*quaternion, *shift])
            + f" {v + 1} phone{v}.jpg",
            "",
        ]
    (folder / "sparse" / "points3D.txt").write_text(
        "\n".join(["# 3D point list", *floor_points(rng, turn, scale, move)]) + "\n"
    )
    (folder / "sparse" / "cameras.txt").write_text("\n".join(cameras_text) + "\n")
    (folder / "sparse" / "images.txt").write_text("\n".join(images_text) + "\n")
    truth = {"name": name, "material": material, "size": list(size), "fps": fps, "scale": scale, "turn": turn.as_matrix().tolist(),
             "move": move.tolist(), "gravity": -GRAVITY[1], "phones": [found["said"] for found in filmed],
             "parameters": fall.hidden.summary()}  # fmt: skip
    (folder / "truth.json").write_text(json.dumps(truth, indent=1))
    return truth


def perfect(
    folder: Path,
    truth: dict,
    *,
    sequence: str,
    times: np.ndarray,
    world: np.ndarray,
    particles: bool = False,
) -> Path:
    """The same phones without any fault, at common times [s]: transforms.json with RGBA images, in the world that `world` (4, 4)
    takes the true one to; particles: with the true positions as PLY files."""
    fall = Fall(truth["name"], sequence, truth["material"], float(times[-1]) + 0.02)
    shown = Shown(fall)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    entries = []
    for record in truth["phones"]:
        K, w2c = np.array(record["K"]), np.array(record["w2c"])
        pose = world @ np.linalg.inv(w2c)
        for k, t in enumerate(times):
            file = f"images/{record['phone']}_{k:03d}.png"
            seen = np.round(255 * shown.picture(float(t), K, w2c, tuple(truth["size"]))).astype(
                np.uint8
            )
            cv2.imwrite(str(folder / file), cv2.cvtColor(seen, cv2.COLOR_RGBA2BGRA))
            entries.append({"file_path": file, "time": float(t - times[0]), "camera": record["phone"],
                            "transform_matrix": (pose @ OPENGL_TO_OPENCV).tolist(),
                            "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]})  # fmt: skip
    width, height = truth["size"]
    (folder / "transforms.json").write_text(
        json.dumps({"w": width, "h": height, "frames": entries})
    )
    if particles:
        positions = np.stack([fall.at(float(t)) for t in times])[
            :, :: max(1, len(fall.particles) // 8000)
        ]
        (folder / "truth").mkdir(exist_ok=True)
        for t, points in enumerate((positions @ world[:3, :3].T + world[:3, 3]).astype("f4")):
            vertices = np.rec.fromarrays(points.T, names="x,y,z")
            PlyData([PlyElement.describe(vertices, "vertex")]).write(
                folder / "truth" / f"{t:03d}.ply"
            )
    return folder

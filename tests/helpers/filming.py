"""A rigid cone that falls and bounces, seen by cameras with clocks and rolling readouts of their own: outlines by projection."""

import math
from dataclasses import dataclass

import cv2
import imageio.v2 as iio
import numpy as np
from scipy.spatial.transform import Rotation

from mosa.capture.mattes import Track, centre_of
from mosa.capture.phones import Camera, Phone
from mosa.capture.videos import Clip

G, HEIGHT, RELEASE = 9.81, 0.45, 0.10
"""[m/s^2]; [m] of the underside above the floor; [s] at which it is let go."""
CONTACT = RELEASE + math.sqrt(2 * HEIGHT / G)
AROUND = np.linspace(0, 2 * np.pi, 24, endpoint=False)
BODY = np.array([*([0.08 * np.cos(a), 0.0, 0.08 * np.sin(a)] for a in AROUND), [0.0, 0.2, 0.0]])
"""Corners (M, 3) [m] of a cone that stands on its base."""
COLOR, BEHIND = (0.85, 0.5, 0.2), (0.2, 0.3, 0.45)


def lifted(t: float) -> np.ndarray:
    """(3,) by which the cone is displaced at a time [s]."""
    if t <= RELEASE:
        return np.array([0, HEIGHT, 0])
    if t <= CONTACT:
        return np.array([0, HEIGHT - 0.5 * G * (t - RELEASE) ** 2, 0])
    back = 0.4 * G * (CONTACT - RELEASE)
    return np.array([0, max(0.0, back * (t - CONTACT) - 0.5 * G * (t - CONTACT) ** 2), 0])


@dataclass(frozen=True)
class Filmed:
    """camera: true, in metres, y up; begin [s] of its first frame's middle row; readout [s]; fps; count of frames."""

    camera: Camera
    begin: float
    readout: float
    fps: float
    count: int

    def corners(self, k: int) -> np.ndarray:
        """(M, 2) [px] of the cone's corners in frame k, each when its row is read."""
        height = self.camera.size[1]
        found = []
        for corner in BODY:
            row = 0.5 * height
            for _ in range(6):
                t = self.begin + k / self.fps + self.readout * (row / height - 0.5)
                pixel = self.camera.project((corner + lifted(t))[None])[0]
                row = pixel[1]
            found.append(pixel)
        return np.array(found)

    def mask(self, k: int) -> np.ndarray:
        """(H, W) coverage in [0, 1]."""
        width, height = self.camera.size
        hull = cv2.convexHull(self.corners(k).astype(np.float32))[:, 0]
        big = np.zeros((4 * height, 4 * width), np.uint8)
        cv2.fillConvexPoly(big, np.round((4 * hull - 0.5) * 16).astype(np.int32), 255, shift=4)
        return (
            cv2.resize(big, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        )


def cameras(count: int = 6, size: tuple[int, int] = (160, 120)) -> list[Camera]:
    found = []
    for i in range(count):
        azimuth, elevation = 2 * np.pi * (i + 0.1) / count, (0.1, 0.45)[i % 2]
        back = np.array(
            [
                np.cos(azimuth) * np.cos(elevation),
                np.sin(elevation),
                np.sin(azimuth) * np.cos(elevation),
            ]
        )
        right = np.cross(-back, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        w2c = np.eye(4)
        w2c[:3, :3] = np.stack([right, np.cross(-back, right), -back])
        w2c[:3, 3] = -w2c[:3, :3] @ (np.array([0.0, 0.33, 0.0]) + 1.6 * back)
        focal = 0.5 * size[1] * 1.6 / 0.42
        K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]])
        found.append(Camera(K, w2c, size, f"camera {i}"))
    return found


def filmed(seed: int = 0, **how) -> list[Filmed]:
    """Six of them, begun at any time within a third of a second."""
    rng = np.random.default_rng(seed)
    found = []
    for camera in cameras(**how):
        begin = -0.3 * rng.uniform()
        found.append(
            Filmed(camera, begin, rng.uniform(0.008, 0.02), 60.0, int((0.72 - begin) * 60))
        )
    return found


WORLD = 0.37, Rotation.from_euler("xyz", [0.4, -1.0, 0.7]).as_matrix(), np.array([1.0, -2.0, 0.5])
"""Metres per unit, rotation and shift of the poses' world: x = R X / scale + shift."""


def in_world(camera: Camera) -> Camera:
    """The camera as a program of unknown scale and axes says it."""
    scale, R, shift = WORLD
    w2c = np.eye(4)
    w2c[:3, :3] = camera.w2c[:3, :3] @ R.T
    w2c[:3, 3] = -w2c[:3, :3] @ (R @ camera.centre / scale + shift)
    return Camera(camera.K, w2c, camera.size, camera.where)


def phones_and_tracks(films: list[Filmed], tmp_path) -> tuple[list[Phone], list[Track]]:
    """What mattes of them would say, without any pictures."""
    phones, tracks = [], []
    for i, film in enumerate(films):
        path = tmp_path / f"phone{i}.mp4"
        times = np.arange(film.count) / film.fps
        clip = Clip(path, times, film.camera.size, 0, 0.0)
        centres, radii, masks = np.full((film.count, 2), np.nan), np.zeros(film.count), []
        for k in range(film.count):
            mask = film.mask(k)
            centres[k], radii[k] = centre_of(mask)
            masks.append((0, 0, mask > 0.5))
        phones.append(Phone(f"phone{i}", in_world(film.camera), path))
        tracks.append(Track(clip, times, centres, radii, tuple(masks)))
    return phones, tracks


def write_films(films: list[Filmed], folder, noise: float = 0.01) -> None:
    """videos/, plates/ and sparse/ as phones and COLMAP write them."""
    rng = np.random.default_rng(1)
    for name in ("videos", "plates", "sparse"):
        (folder / name).mkdir(parents=True)
    cams, images = [], []
    for i, film in enumerate(films):
        width, height = film.camera.size
        gain = 1 + 0.1 * rng.normal(size=3)

        def developed(picture, gain=gain):
            return np.round(
                255 * np.clip(picture * gain + rng.normal(0, noise, picture.shape), 0, 1)
            ).astype(np.uint8)

        plate = np.broadcast_to(np.array(BEHIND), (height, width, 3))
        iio.imwrite(folder / "plates" / f"phone{i}.png", developed(plate, 0.95 * gain))
        with iio.get_writer(
            folder / "videos" / f"phone{i}.mp4",
            fps=film.fps,
            codec="libx264",
            quality=None,
            pixelformat="yuv420p",
            macro_block_size=2,
            output_params=["-crf", "16", "-preset", "ultrafast"],
        ) as writer:
            for k in range(film.count):
                mask = film.mask(k)[..., None]
                writer.append_data(developed(mask * COLOR + (1 - mask) * BEHIND))
        camera = in_world(film.camera)
        q = np.roll(Rotation.from_matrix(camera.w2c[:3, :3]).as_quat(), 1)
        cams.append(
            f"{i + 1} PINHOLE {width} {height} {camera.K[0, 0]} {camera.K[1, 1]} {camera.K[0, 2]} {camera.K[1, 2]}"
        )
        images += [
            f"{i + 1} " + " ".join(map(str, [*q, *camera.w2c[:3, 3]])) + f" {i + 1} phone{i}.jpg",
            "",
        ]
    (folder / "sparse" / "cameras.txt").write_text("# cameras\n" + "\n".join(cams) + "\n")
    (folder / "sparse" / "images.txt").write_text("# images\n" + "\n".join(images) + "\n")

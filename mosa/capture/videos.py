"""Frames of a video and the times they were taken, by OpenCV."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from warnings import warn

import cv2
import numpy as np

from mosa.capture.poses import VIDEOS
from mosa.data.images.reading import read_image
from mosa.errors import ConfigError, DataError
from mosa.system.ply import named

PICTURES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class Clip:
    """times: (T,) [s] of the frames on the video's own clock; size: (width, height) [px]; turned: degrees by which the file says
    the picture is turned, in {0, 90, 180, 270}; jitter: largest departure from an even rate, in frames."""

    path: Path
    times: np.ndarray
    size: tuple[int, int]
    turned: int
    jitter: float

    @property
    def interval(self) -> float:
        """[s] between frames."""
        return float(np.median(np.diff(self.times)))


def find_videos(folder: str | Path) -> list[Path]:
    """The videos of a folder by name. Errors: DataError."""
    place = Path(folder)
    if not place.is_dir():
        raise DataError(f"{place}: folder not found; expected one video of each phone in it")
    found = sorted(f for f in place.iterdir() if f.suffix.lower() in VIDEOS and f.name[0] != ".")
    if not found:
        raise DataError(
            f"{place}: expected videos ({', '.join(VIDEOS)}), one of each phone, found none"
        )
    if len({file.stem for file in found}) < len(found):
        names = ", ".join(f.name for f in found)
        raise DataError(
            f"{place}: expected one video of each phone, found two of one name: {names}"
        )
    return found


def open_clip(path: Path, fps: float | None = None) -> Clip:
    """What a video says of itself; fps: frames per second in the world, where that is not what it is played at.

    Every frame is counted: a container's own count is often wrong, and phones vary their rate. Errors: DataError.
    """
    video = cv2.VideoCapture(str(path))
    if not video.isOpened():
        raise DataError(
            f"{path}: expected a video that OpenCV can read (H.264), found {named(path)}"
        )
    times, nominal = [], float(video.get(cv2.CAP_PROP_FPS))
    while video.grab():
        times.append(1e-3 * float(video.get(cv2.CAP_PROP_POS_MSEC)))
    size = int(video.get(cv2.CAP_PROP_FRAME_WIDTH)), int(video.get(cv2.CAP_PROP_FRAME_HEIGHT))
    turned = int(video.get(cv2.CAP_PROP_ORIENTATION_META)) % 360
    video.release()
    if len(times) < 5:
        raise DataError(f"{path}: expected at least 5 frames, found {len(times)}")
    stamps = np.array(times)
    if fps is not None:
        stamps = np.arange(len(stamps)) / fps
    elif not (np.diff(stamps) > 0).all():
        if not 1 < nominal < 2000:
            raise DataError(f"{path}: expected increasing times of frames, found none; set fps=60")
        stamps = np.arange(len(stamps)) / nominal
    even = np.polyval(np.polyfit(np.arange(len(stamps)), stamps, 1), np.arange(len(stamps)))
    jitter = float(np.abs(stamps - even).max() / np.median(np.diff(stamps)))
    return Clip(path, stamps, size, turned, jitter)


def frames_of(
    clip: Clip, first: int = 0, last: int | None = None
) -> Iterator[tuple[int, np.ndarray]]:
    """(number, RGB picture (H, W, 3) uint8) of the frames first to last, both included. Read one after the other: seeking in a
    compressed video is not exact. Errors: DataError where one cannot be decoded."""
    last = len(clip.times) - 1 if last is None else last
    video = cv2.VideoCapture(str(clip.path))
    try:
        for i in range(last + 1):
            if i < first:
                video.grab()
                continue
            good, picture = video.read()
            if not good or picture.shape[1::-1] != clip.size:
                raise DataError(f"{clip.path}: frame {i} of {len(clip.times)} cannot be decoded")
            yield i, cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
    finally:
        video.release()


def plate_of(folder: Path | None, clip: Clip, seconds: tuple[float, float] | None) -> np.ndarray:
    """Empty background (H, W, 3) in [0, 1]: a picture or the median of a video in `folder` named as the phone, or else the median
    of the clip's own frames in `seconds` of its clock, which a file in the folder replaces with a warning. Errors: DataError naming
    what is expected where."""
    stem = clip.path.stem
    if folder is not None and folder.is_dir():
        for file in sorted(folder.iterdir()):
            kind = file.suffix.lower()
            if file.stem != stem or kind not in (*VIDEOS, *PICTURES):
                continue
            if seconds is not None:
                warn(
                    f"plate_seconds: has no effect on {clip.path.name}, whose background plate is {file}: "
                    "move that file away to use the seconds",
                    stacklevel=1,
                )
            if kind in VIDEOS:
                other = open_clip(file)
                return median_of(other, 0, len(other.times) - 1, clip)
            # refused where it is damaged, or larger than pictures are; OpenCV would ask for memory first
            read_image(file)
            picture = cv2.imread(str(file), cv2.IMREAD_COLOR)
            if picture is None:
                raise DataError(f"{file}: expected a readable picture, found a damaged one")
            picture = fitting(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), clip, file)
            return picture.astype(np.float32) / 255
    if seconds is None:
        raise DataError(
            f"{clip.path}: no background plate: expected {stem}.png (or .jpg, .mp4) in "
            f"{folder or 'the folder plates='}, or plate_seconds=[0, 0.5] where the video begins "
            "without the object, or another mattes="
        )
    inside = np.flatnonzero((clip.times >= seconds[0]) & (clip.times <= seconds[1]))
    if len(inside) == 0:
        raise ConfigError(
            f"plate_seconds: expected times within {clip.times[0]:.3g} to {clip.times[-1]:.3g} s of {clip.path}, "
            f"found {list(seconds)}"
        )
    return median_of(clip, int(inside[0]), int(inside[-1]), clip)


def median_of(clip: Clip, first: int, last: int, like: Clip) -> np.ndarray:
    """Median picture in [0, 1] of at most 25 frames, evenly taken."""
    wanted = set(np.unique(np.linspace(first, last, 25).round().astype(int)).tolist())
    pictures = [picture for i, picture in frames_of(clip, first, last) if i in wanted]
    return fitting(np.median(np.stack(pictures), 0).astype(np.float32) / 255, like, clip.path)


def fitting(picture: np.ndarray, clip: Clip, file: Path) -> np.ndarray:
    if picture.shape[1::-1] != clip.size:
        raise DataError(
            f"{file}: expected {clip.size[0]}x{clip.size[1]} px as {clip.path}, found "
            f"{picture.shape[1]}x{picture.shape[0]}: film the plate with the same settings"
        )
    return picture

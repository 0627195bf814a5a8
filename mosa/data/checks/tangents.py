"""Does each picture show what the other cameras see at that moment? Frozen, exchanged, mirrored and shifted ones do not.

Of all planes through two cameras the first and the last that meet the object touch both of its outlines, whatever its shape: each
pair of cameras compares two angles a frame, to a fraction of a pixel. Outlines of a camera that disagrees with most others are
tried mirrored, in other cameras' places and at other frames."""

from __future__ import annotations

import warnings

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from mosa.data.checks.cameras import lines_of_sight, misses
from mosa.errors import DataError
from mosa.types import Scene

TRIED, SUSPECT, USUAL = 0.04, 0.08, 4.0
"""Radii by which an outline may miss what most others see: beyond them another place is tried for it, and data are warned of; and
times the film's median that it may in any case. In films as they are: at most 0.04, and three times the median (docs/data.md)."""
EXPLAINED = 3.0
"""Factor by which outlines fit better elsewhere from which on that is where they belong."""
COPY = 0.1
"""Difference of colours of 0 to 1 below which a picture is another's copy, written anew."""
FOCAL = [percent for percent in range(-12, 13) if percent]
"""By which a focal length may be too large [%]: it moves outlines as another moment does where an object falls through the view."""
NEAR, WIDE = 2.0, 2.0
"""Radii from the line through two cameras below which, and angle [rad] of the object about it above which, they do not compare."""


class Tangents:
    """outlines: [V][T] corners (n, 2) [px] of the mattes' convex hulls; angles: (V, V, T, 2) [rad] of the planes that touch the
    first camera's and contain the second; reach: (V, V, T) radii of the object in a radian. NaN where two do not compare."""

    def __init__(self, scene: Scene) -> None:
        V, T, self.width = len(scene.cameras), scene.frames, scene.cameras.width
        self.K, self.rotation = scene.cameras.K.double(), scene.cameras.w2c[:, :3, :3].double()
        place = -(self.rotation.transpose(1, 2) @ scene.cameras.w2c[:, :3, 3:].double())[..., 0]
        axis = normalize(place - place[:, None], dim=2)
        # one direction for both cameras of a pair
        axis = torch.where(torch.ones(V, V).triu()[..., None] > 0, axis, -axis)
        self.outlines = [[outline_of(matte) for matte in mattes] for mattes in scene.mattes]
        self.angles = torch.full((V, V, T, 2), torch.nan).double()
        self.reach = torch.full((V, V, T), torch.nan).double()
        self.ahead = None
        for t in range(T):
            chosen, origins, directions, radii = lines_of_sight(scene, t)
            if len(chosen) < 3:
                continue
            point, _ = misses(origins, directions, radii)
            arm = point - place[:, None]
            arm = arm - (arm * axis).sum(2, keepdim=True) * axis
            if self.ahead is None:
                self.ahead = normalize(arm, dim=2)
                self.aside = torch.linalg.cross(axis, self.ahead)
            reach = arm.norm(dim=2) / (radii * (point - origins).norm(dim=1)).median()
            apart = (reach > NEAR) & ~torch.eye(V, dtype=torch.bool)
            self.reach[..., t] = torch.where(apart, reach, torch.nan)
            for v in chosen:
                self.angles[v, :, t] = self.touching(self.outlines[v][t], v)

    def touching(self, outline: Tensor, camera: int) -> Tensor:
        """Angles (V, 2) of an outline (n, 2), were it that camera's."""
        rays = pad(outline, (0, 1), value=1.0) @ torch.linalg.inv(self.K[camera]).T
        rays = rays @ self.rotation[camera]
        angle = torch.atan2(rays @ self.aside[camera].T, rays @ self.ahead[camera].T)
        span = torch.stack([angle.amin(0), angle.amax(0)], 1)
        return torch.where(span.diff(dim=1) < WIDE, span, torch.nan)

    def misfits(self) -> Tensor:
        """Radii (V, T) by which an outline misses what most other cameras see; NaN where fewer than two compare."""
        off = (self.angles - self.angles.transpose(0, 1)).abs().amax(3) * self.reach
        return torch.where(off.isfinite().sum(1) > 1, off.nanmedian(1).values, torch.nan)

    def misfit(self, outline: Tensor, camera: int, frame: int) -> float:
        """The same of an outline (n, 2), were it that camera's in that frame; infinite where nothing compares."""
        away = (self.touching(outline, camera) - self.angles[:, camera, frame]).abs()
        off = away.amax(1) * self.reach[camera, :, frame]
        known = sorted(off[off.isfinite()].tolist())
        # of two the larger: either may fit by chance
        return known[len(known) // 2] if known else torch.inf

    def explanation(
        self, camera: int, frames: list[int], others: list[int], names: tuple[str, ...]
    ) -> tuple[float, str]:
        """By how many radii the outlines of a camera's frames miss where they fit best, and where that is: there mirrored, at other
        frames or in the places of some others."""
        own = [self.outlines[camera][t] for t in frames]
        mirrored = [torch.stack([self.width - outline[:, 0], outline[:, 1]], 1) for outline in own]
        tried = [([self.misfit(each, camera, t) for each, t in zip(mirrored, frames)], "mirrored")]
        for other in others:
            off = [self.misfit(each, other, t) for each, t in zip(own, frames)]
            tried.append((off, f"as pictures of camera {names[other]}"))
        every = range(self.angles.shape[2])
        best = [min((self.misfit(each, camera, s), s) for s in every) for each in own]
        tried.append(([off for off, _ in best], f"as pictures of {listed([s for _, s in best])}"))
        return min((float(np.median(off)), said) for off, said in tried)

    def focal(self, camera: int, frames: list[int]) -> tuple[float, str]:
        """As `explanation`, of a focal length that is off in all frames."""
        middle, tried = self.K[camera, :2, 2], []
        for percent in FOCAL:
            off = [torch.inf if outline is None else self.misfit(middle + (1 + percent / 100) * (outline - middle), camera, t)
                   for t, outline in enumerate(self.outlines[camera])]  # fmt: skip
            every = np.median([miss for miss in off if miss < torch.inf])
            tried.append((max(np.median(np.array(off)[frames]), every), percent))
        best, percent = min(tried)
        other = f"{abs(percent)} % {('larger', 'smaller')[percent > 0]}"
        return float(best), f"a focal length that is {other} they fit to {best:.2g}"


def outline_of(matte: Tensor) -> Tensor | None:
    """Corners (n, 2) [px] of the convex hull of a matte (H, W); None where it is empty."""
    row, column = np.nonzero((matte > 0.5).numpy())
    if not len(row):
        return None
    corners = cv2.convexHull(np.stack([column, row], 1).astype(np.int32))[:, 0]
    return torch.from_numpy(corners).double() + 0.5


def listed(frames: list[int]) -> str:
    """frame 4; frames 4 to 9; frames 4, 3, 3."""
    if len(frames) > 1 and frames == list(range(frames[0], frames[-1] + 1)):
        return f"frames {frames[0]} to {frames[-1]}"
    return f"frame{'s' * (len(frames) > 1)} {', '.join(map(str, frames[:8]))}{', ...' * (len(frames) > 8)}"


def check_pictures(scene: Scene, label: str) -> None:
    """Every outline ends where the other cameras' at that moment say. Errors: DataError naming camera and frames where its pictures
    fit elsewhere; a warning where they fit nowhere. Silent where fewer than three mattes of a frame are whole."""
    tangents, names, worst = Tangents(scene), scene.cameras.names, (0.0, "")
    off = tangents.misfits().nan_to_num(0.0)
    limit = max(TRIED, USUAL * float(off[off > 0].median())) if bool((off > 0).any()) else TRIED
    for v, row in enumerate(off):
        if not (frames := (row > limit).nonzero()[:, 0].tolist()):
            continue
        # of a round body all pictures fit all cameras: another camera's are those that are its own too, or are missed there
        others = [w for w in range(len(names)) if w != v and (bool((off[w, frames] > limit).any())
                  or float((scene.images[v, frames] - scene.images[w, frames]).abs().max()) < COPY)]  # fmt: skip
        better, place = tangents.explanation(v, frames, others, names)
        most = min(limit, float(row[frames].median()) / EXPLAINED)
        focal, length = tangents.focal(v, frames)
        sure = better < most < focal
        said = (f"{label}: camera {names[v]}, {listed(frames)}: expected outlines that end where most other cameras' say, found "
                f"them up to {float(row.max()):.2g} of the object's radius beside"
                + (f"; {place} they fit to {better:.2g}: put the right pictures there" if sure else ": another moment or camera, "
                   "mirrored or shifted pictures, a matte with a part too many or too few, or a pose or focal length that is "
                   "off?" + f" At {length}" * (focal <= most))
                + f"; or leave out the camera (scene.holdout_cameras=[{names[v]}]) or the frames (scene.frames)")  # fmt: skip
        if sure and float(row.max()) > SUSPECT:
            raise DataError(said)
        # one that is explained is said first, however small
        worst = max(worst, (float(row.max()) + sure, said))
    if worst[0] > SUSPECT:
        many = int((off.amax(1) > limit).sum())
        warnings.warn(worst[1] + f" ({many} cameras have such frames)" * (many > 1), stacklevel=4)


def check_copies(scene: Scene, label: str) -> None:
    """Warns where two cameras have the same picture of the object at the same moment."""
    seen: dict[tuple[int, bytes], str] = {}
    for name, images, mattes in zip(scene.cameras.names, scene.images.numpy(), scene.mattes):
        for t, (image, matte) in enumerate(zip(images, mattes)):
            x, y, w, h = cv2.boundingRect((matte.numpy() > 0.5).astype(np.uint8))  # all 0 of none
            part = image[y : y + h, x : x + w]
            if part.size and (other := seen.setdefault((t, part.tobytes()), name)) != name:
                warnings.warn(
                    f"{label}: cameras {other} and {name} have the same picture in frame {t}: expected views of their own",
                    stacklevel=4,
                )

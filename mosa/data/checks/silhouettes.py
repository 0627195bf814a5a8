"""Do outlines and ground fit the cameras? What is inside of all mattes at once has to fill each of them, and to meet the ground.

Centroids' lines of sight meet as well where focal lengths, aspect ratios or mirrored poses are wrong; a visual hull does not then
fill the mattes that it was carved with. A wrong ground, or an up that is another axis, leaves it below the ground or above it.
"""

from __future__ import annotations

import math
import warnings

import cv2
import numpy as np
import torch
from torch import Tensor

from mosa.data.checks.free_fall import track_of
from mosa.data.hull import at_border, visual_hull
from mosa.errors import DataError
from mosa.rendering.cameras import project
from mosa.types import Cameras, Scene

RESOLUTION = 40  # voxels along the hull's longest side
OPEN, SUSPECT = 0.2, 0.04
"""Share of a matte that the hull leaves open from which on data are refused, and warned of. With a right calibration it is at most
0.001 (built-in films of 64 to 400 px, PAC-NeRF's bird)."""
ISLAND = 4  # pixels of a matte apart from the hull that are warned of, above noise
SUNK = 0.25  # share of the hull below ground in frame 0 that means a wrong height
MAX_GROUND_GAP = 0.35
"""Distance between the ground and the lowest point of the hull at the turning point, in radii, above which a warning is given if
the outlines and what happens between frames leave no other place. In correct films of many cameras and frames it is below 0.15."""
STRAY, LOST = 0.3, 0.6
"""Radii from the middle of the true particles to where the cameras see the object, from which on they are warned of, and refused.
Of the built-in films it is at most 0.1."""

SHARED, DARK = 20, 0.02
"""Points of the hull that a camera and others show at least where their brightness is compared; brightness, of 0 to 1, below which
pixels are alike."""


def check_particles(scene: Scene, label: str) -> None:
    """True particles lie where the cameras see the object, in every frame. Errors: DataError naming scene.particles and frame."""
    track = None if scene.particles is None else track_of(scene)
    if track is None:
        return
    middles = torch.stack([cloud.double().mean(0) for cloud in scene.particles])
    far = (middles - track.points).norm(dim=1)
    frame = int(far.argmax())
    extent = float((scene.particles[0].amax(0) - scene.particles[0].amin(0)).max())
    said = (
        f"{label}: scene.particles: expected the particles of frame {frame} where the cameras see the object, at "
        f"{[round(x, 3) for x in track.points[frame].tolist()]} m, found their middle "
        f"{float(far[frame]):.3g} m beside it: check their unit and axes, and which file is which frame"
    )
    if float(far[frame]) > LOST * track.radius:
        raise DataError(said)
    if not 0.5 * track.radius < extent < 8 * track.radius:
        raise DataError(
            f"{label}: scene.particles: expected a cloud of the object's size, whose radius is {track.radius:.3g} m, "
            f"found one of {len(scene.particles[0])} particles over {extent:.3g} m"
        )
    if float(far[frame]) > STRAY * track.radius:
        warnings.warn(said, stacklevel=3)


def hull_points(mattes: Tensor, cameras: Cameras, box: Tensor) -> tuple[Tensor, float]:
    """Points (M, 3) [m] of the visual hull of mattes (V, H, W), and their distance [m]. Errors: DataError where there are none."""
    hull = visual_hull(mattes, cameras, box, resolution=RESOLUTION)
    return hull.points()[hull.values > 0.5], hull.pitch


def uncovered_and_islands(
    points: Tensor, pitch: float, mattes: Tensor, cameras: Cameras
) -> tuple[Tensor, list[int]]:
    """Share (V,) of each matte (V, H, W) that is farther than a voxel from the projections of points (M, 3), and the pixels of each
    matte that are in wholly uncovered pieces."""
    shares, islands = [], []
    size = torch.tensor([cameras.width, cameras.height])
    for matte, K, pixels, depth in zip(mattes, cameras.K, *project(points, cameras)):
        pixels = pixels.floor().long()
        shown = (depth > 0) & ((pixels >= 0) & (pixels < size)).all(1)
        column, row = pixels.T
        covered = np.zeros(tuple(matte.shape), np.uint8)
        covered[row[shown].numpy(), column[shown].numpy()] = 1
        focal = float(K[[0, 1], [0, 1]].max())
        reach = math.ceil(pitch * focal / float(depth.mean().clamp(min=1e-6)))
        reach = min(max(reach, 1), max(tuple(matte.shape)))
        box = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
        covered = cv2.dilate(covered, box).astype(bool)
        inside = (matte > 0.5).numpy()
        shares.append(float((inside & ~covered).sum() / max(inside.sum(), 1)))
        _, pieces = cv2.connectedComponents(inside.astype(np.uint8), connectivity=8)
        islands.append(int((inside & ~np.isin(pieces, np.unique(pieces[covered & inside]))).sum()))
    return torch.tensor(shares), islands


def whole_views(scene: Scene, frame: int) -> list[int]:
    """Cameras whose matte shows something and does not touch the border."""
    shown = scene.mattes[:, frame] > 0.5
    whole = shown.flatten(1).any(1) & ~(at_border(scene.mattes[:, frame]) > 0.5)
    return whole.nonzero()[:, 0].tolist()


def check_outlines(scene: Scene, label: str) -> None:
    """The mattes of a frame are those of one solid, and it meets the ground where the ground is said to be.

    Looks at frame 0, at the one where the object is lowest, and, if that is the last, at the lowest in which it turns round.
    Errors: DataError naming cameras and frame, or scene.ground.height and scene.up. Silent where fewer than three mattes are
    whole."""
    track = track_of(scene)
    low = turn = 0 if track is None else int((track.points @ scene.up.double()).argmin())
    if track is not None and low == scene.frames - 1:
        turn = lowest_turn(track.points @ scene.up.double(), track.noise)
    worst = (0.0, "")
    for frame in sorted({0, low, turn}):
        views = whole_views(scene, frame)
        if len(views) < 3:
            continue
        mattes, cameras = scene.mattes[views, frame], scene.cameras.select(views)
        try:
            points, pitch = hull_points(mattes, cameras, scene.box)
        except DataError as error:
            raise DataError(f"{label}, frame {frame}: {error}") from error
        if not len(points):
            continue  # thinner than a voxel
        shares, islands = uncovered_and_islands(points, pitch, mattes, cameras)
        worst = max(worst, worst_uncovered(shares, cameras.names, frame, label))
        # later it may splash, and drops are thinner than a voxel
        if frame == 0 and max(islands) >= ISLAND:
            v = islands.index(max(islands))
            many = sum(pixels >= ISLAND for pixels in islands)
            warnings.warn(f"{label}: the matte of camera {cameras.names[v]}, frame 0, has {islands[v]} pixels apart from the "
                          f"object, where the other cameras see nothing ({many} cameras have such): expected one object; clear "
                          "them", stacklevel=3)  # fmt: skip
        if scene.ground is None:
            continue
        heights = points @ scene.up - scene.ground.height
        below = float((heights < 0).float().mean())
        if frame == 0 and below > SUNK:
            raise DataError(
                f"{label}: scene.ground.height: expected the object above the ground of {scene.ground.height:g} m in frame 0, "
                f"found {below:.0%} of it below, its lowest point at {float(heights.min()) + scene.ground.height:.3g} m; correct "
                f"it, or scene.up (now {[round(float(x), 3) for x in scene.up]}), or the axes of the poses"
            )
        if track is not None and 0 < frame == turn:
            most = lowest_at_most(points, heights, pitch, cameras)
            step = float((track.points @ scene.up.double()).diff().abs().max())
            check_landing(float(heights.min()), most, step, track.radius, frame, label)
    if worst[0] > OPEN:
        raise DataError(worst[1])
    if worst[0] > SUSPECT:
        warnings.warn(worst[1], stacklevel=3)


def shared_brightness(scene: Scene, frame: int) -> Tensor:
    """Logarithm (V,) of how bright each camera shows the object, over how bright others show the same points of its hull at the
    same moment; NaN where none does. A body that turns another side to a camera leaves it, an exposure of one camera does not."""
    found = torch.full((len(scene.cameras),), torch.nan)
    views = whole_views(scene, frame)
    if len(views) < 3:
        return found
    cameras, mattes = scene.cameras.select(views), scene.mattes[views, frame]
    try:
        points, pitch = hull_points(mattes, cameras, scene.box)
    except DataError:
        return found
    if not len(points):
        return found
    shown = []
    for v, K, pixels, depth in zip(views, cameras.K, *project(points, cameras)):
        place = (pixels / (1.5 * pitch * K[0, 0] / depth.mean())).floor().long()
        place -= place.amin(0)
        cells = place[:, 0] * (place[:, 1].max() + 1) + place[:, 1]
        first = torch.full((int(cells.max()) + 1,), torch.inf)
        first = first.scatter_reduce(0, cells, depth, "amin")
        column, row = pixels.floor().long().T
        at = row.clamp(0, cameras.height - 1), column.clamp(0, cameras.width - 1)
        front = (depth < first[cells] + pitch) & (scene.mattes[v, frame][at] > 0.9)
        light = scene.images[v, frame][at].mean(1).clamp(min=DARK).log()
        shown.append(torch.where(front, light, torch.nan))
    light = torch.stack(shown)
    seen = (~light.isnan()).sum(0)
    beside = (light - (light.nansum(0) - light) / (seen - 1)).where(seen > 1, torch.nan)
    enough = (~beside.isnan()).sum(1) >= SHARED
    found[views] = beside.nanmean(1).where(enough, torch.nan)
    return found


def lowest_turn(heights: Tensor, noise: float) -> int:
    """The lowest frame before and after which the object's middle is higher, by more than its noise [m]; 0 where there is none.
    heights: (T,) [m]. A film may end in a fall that is deeper than the place where it turned round."""
    turns = [
        t
        for t in range(1, len(heights) - 1)
        if heights[t] == heights[t - 1 : t + 2].min()
        and min(heights[:t].max(), heights[t + 1 :].max()) > heights[t] + 3 * noise
    ]
    return min(turns, key=lambda t: float(heights[t]), default=0)


def worst_uncovered(
    shares: Tensor, names: tuple[str, ...], frame: int, label: str
) -> tuple[float, str]:
    """Largest uncovered share of a matte, and a message that names cameras and causes."""
    large = [v for v in shares.argsort(descending=True)[:4].tolist()
             if float(shares[v]) > 0.25 * float(shares.max())]  # fmt: skip
    listed = ", ".join(f"{names[v]} ({float(shares[v]):.0%})" for v in large)
    return float(shares.max()), (
        f"{label}: the outlines of frame {frame} are not those of one solid: what all cameras see together should fill every "
        f"matte, and leaves open of the cameras {listed}: check focal lengths (fl_x, fl_y), principal points, lens distortion, "
        "mirrored or exchanged poses, a scene.box that cuts the object, and mattes that belong to another moment"
    )


def lowest_at_most(points: Tensor, heights: Tensor, pitch: float, cameras: Cameras) -> float:
    """Height [m] that the lowest point of an object of these outlines has at most. Each line of sight through a matte meets the
    object, somewhere within the hull, whose points (M, 3) [m] have these heights (M,) [m]."""
    found = math.inf
    for K, pixels, depth in zip(cameras.K, *project(points, cameras)):
        focal = float(K[[0, 1], [0, 1]].max())
        place = (pixels / (0.75 * pitch * focal / depth.mean())).floor().long()  # as `shave_ridges`
        cells = tuple((place - place.amin(0)).T.numpy())
        top = np.full([int(c.max()) + 1 for c in cells], -np.inf, np.float32)
        np.maximum.at(top, cells, heights.numpy())
        # of neighbours as well: at a matte's rim the hull is thinner than a voxel, and has no point where the object is
        found = min(found, float(cv2.dilate(top, np.ones((3, 3)))[cells].min()))
    return found


def check_landing(
    least: float, most: float, step: float, radius: float, frame: int, label: str
) -> None:
    """A warning where the object turns round far from the ground. least, most: heights [m] between which its lowest point is: the
    hull of a few cameras, or of steep ones, reaches far below an object that touches the ground. step: by which it rises or falls
    [m] from frame to frame at most, so that it may turn by half of it below this frame."""
    far = MAX_GROUND_GAP * radius
    if least > far + 0.5 * step or (least < -far and most < 0):
        where = "above" if least > 0 else "below"
        warnings.warn(f"{label}: the object turns round in frame {frame} with its lowest point at least {max(least, -most):.3g} m "
                      f"{where} the ground: expected it there; check scene.ground.height and scene.up (what else it lands on "
                      "is one of world.colliders)", stacklevel=4)  # fmt: skip

"""Do the cameras of a scene see one object? A wrong pose, a swapped name or a wrong unit shows before anything is learned."""

from __future__ import annotations

import warnings

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from mosa.data.images.reading import enclosed_holes
from mosa.errors import DataError
from mosa.types import Scene, metres

AGREEMENT = 0.4
"""Distance between a line of sight and the object's centre, over the object's radius (of a slender one half its length), above
which a camera does not fit. Largest of all frames with a right calibration: 0.15 (PAC-NeRF bird), 0.10 (rabbit), 0.23 (a banana;
0.45 by the radius of its area)."""
HUES, SHARED, ALONE = 24, 0.6, 0.33
"""Bins of a share of red or blue; and the share of a camera's hues that the others show: one camera below ALONE is said where all
others are above SHARED. Of 20 films as they are all cameras are above 0.67, those of a ball of all colours above 0.45."""
HOLE = 0.01  # share of a matte's area up to which an enclosed hole is suspected


def lines_of_sight(scene: Scene, frame: int) -> tuple[list[int], Tensor, Tensor, Tensor]:
    """Cameras whose matte is whole, and per camera the line through the matte's centroid and the matte's radius.

    Returns indices (C), origins (C, 3) [m], unit directions (C, 3), tangents of the angular radius (C,), float64. A matte
    that is empty or touches the image's border has no known centroid and is left out."""
    chosen, origins, directions, radii = [], [], [], []
    for v in range(len(scene.cameras)):
        mask = scene.mattes[v, frame] > 0.5
        if not bool(mask.any()) or bool(mask[[0, -1]].any()) or bool(mask[:, [0, -1]].any()):
            continue
        K, w2c = scene.cameras.K[v].double(), scene.cameras.w2c[v].double()
        pixel = mask.nonzero().double().mean(0).flip(0) + 0.5
        ray = w2c[:3, :3].T @ torch.linalg.solve(K, torch.cat((pixel, pixel.new_ones(1))))
        chosen.append(v)
        origins.append(-w2c[:3, :3].T @ w2c[:3, 3])
        directions.append(ray / ray.norm())
        radii.append((mask.sum() / torch.pi).sqrt().double() / K[0, 0])
    if not chosen:
        return [], *(torch.zeros(0, 3).double(),) * 2, torch.zeros(0).double()
    return chosen, torch.stack(origins), torch.stack(directions), torch.stack(radii)


def misses(origins: Tensor, directions: Tensor, radii: Tensor) -> tuple[Tensor, Tensor]:
    """The point nearest to all lines (3,), and by how many object radii each line misses it (C,); infinite behind a camera."""
    across = torch.eye(3).double() - directions[:, :, None] * directions[:, None]
    point = torch.linalg.lstsq(across.sum(0), (across @ origins[..., None]).sum(0)).solution[:, 0]
    arm = point - origins
    depth = (arm * directions).sum(1)
    distance = (across @ arm[..., None])[..., 0].norm(dim=1)
    return point, torch.where(depth > 0, distance / (radii * depth.clamp(min=1e-9)), torch.inf)


def slenderness(matte: Tensor) -> Tensor:
    """Half the length of a matte (H, W) over the radius of a disc of its area, at least 1: the farther a body bends, the farther
    the centroid of one view lies beside another's."""
    pixels = (matte > 0.5).nonzero().double()
    longest = torch.linalg.eigvalsh(torch.cov(pixels.T, correction=0))[-1].clamp(min=0)
    return (2 * (torch.pi * longest / len(pixels)).sqrt()).clamp(min=1)


def check_agreement(scene: Scene, label: str, frame: int = 0) -> None:
    """The lines of sight through the mattes' centroids meet, inside the scene's box.

    Errors: DataError naming the one camera without which the others agree, or all that disagree; and where they meet outside
    of the box (wrong box, unit or axis). Silent where fewer than three mattes are whole."""
    chosen, origins, directions, radii = lines_of_sight(scene, frame)
    if len(chosen) < 3:
        return
    names = [scene.cameras.names[v] for v in chosen]
    point, off = misses(origins, directions, radii)
    if float(off.max()) > AGREEMENT:  # seldom
        radii = radii * torch.stack([slenderness(scene.mattes[v, frame]) for v in chosen])
        off = misses(origins, directions, radii)[1]
    if float(off.max()) > AGREEMENT:
        keep = torch.ones(len(chosen), dtype=torch.bool)
        suspects = []
        for v in range(len(chosen)):
            keep[v] = False
            off_others = misses(origins[keep], directions[keep], radii[keep])[1]
            if len(chosen) > 3 and float(off_others.max()) <= AGREEMENT:
                suspects.append(v)
            keep[v] = True
        if len(suspects) == 1:
            v = suspects[0]
            keep[v] = False
            center, _ = misses(origins[keep], directions[keep], radii[keep])
            arm = center - origins[v]
            depth = float(arm @ directions[v])
            distance = float((arm - depth * directions[v]).norm())
            where = f"passes {distance:.3g} m beside it" if depth > 0 else "looks away from it"
            raise DataError(
                f"{label}: camera {names[v]} does not fit the others: they see the object at "
                f"{[round(x, 3) for x in center.tolist()]} m in frame {frame}, its line of sight {where}: expected a calibration "
                "and images that belong together, look for a wrong pose, a swapped name or an image of another frame"
            )
        if not bool(torch.isfinite(off).any()):
            raise DataError(
                f"{label}: expected cameras that look at the object, found that all look away from it in frame {frame}: are "
                "the poses in other axes than the format's (OpenCV's z points forward, OpenGL's backward)?"
            )
        listed = ", ".join(f"{n} by {o:.2g}" for n, o in zip(names, off.tolist()) if o > AGREEMENT)
        raise DataError(
            f"{label}: the cameras do not see one object in frame {frame}: expected the lines of sight through the mattes' "
            f"centroids to meet, found that they miss it, in radii of the object: {listed}; check poses, intrinsics, axes and names"
        )
    low, high = scene.box.double()
    if not bool(((point > low) & (point < high)).all()):
        raise DataError(
            f"{label}: scene.box: expected the object inside of {metres(scene.box)} m, found it at "
            f"{metres(point)} m in frame {frame}, where the lines of sight meet; correct the box, "
            "or the unit or axes of the poses"
        )


def check_hues(scene: Scene, label: str) -> None:
    """Warns of one camera of four or more that shows the object in colours, apart from their brightness, of no other."""
    found = []
    for images, mattes in zip(scene.images, scene.mattes):
        colors = images[mattes > 0.9]
        if not len(colors):
            return
        shares = colors[:, [0, 2]] / colors.sum(1, keepdim=True).clamp(min=0.05)
        row, column = (HUES * shares).long().clamp(0, HUES - 1).T
        hues = torch.bincount(HUES * row + column, minlength=HUES**2).float()
        found.append(avg_pool2d(hues.view(1, HUES, HUES) / len(row), 3, 1, 1).flatten())
    hues = torch.stack(found)
    others = (hues.sum(0) - hues) / max(len(hues) - 1, 1)
    shared, order = torch.minimum(hues, others).sum(1).sort()
    if len(hues) > 3 and float(shared[0]) < ALONE and float(shared[1]) > SHARED:
        warnings.warn(
            f"{label}: camera {scene.cameras.names[order[0]]}: expected the object in the colours that the other cameras "
            f"see, found {float(shared[0]):.0%} of them there, where the others share {float(shared[1]):.0%} or more: a film in "
            "grey, red and blue exchanged, or another white balance?",
            stacklevel=4,
        )


def small_holes(matte: np.ndarray) -> list[int]:
    """Areas [px] of suspiciously small holes in a matte (H, W): enclosed, below half coverage, at most HOLE of its area."""
    limit = HOLE * float((matte >= 0.5).sum())
    return [area for area in enclosed_holes(matte)[1].tolist() if 0 < area <= limit]


def holes_report(scene: Scene) -> str | None:
    """One sentence on suspicious holes in the mattes of a scene; None without any."""
    found = {}
    for v, name in enumerate(scene.cameras.names):
        for t in range(scene.frames):
            areas = small_holes(scene.mattes[v, t].numpy())
            if areas:
                found[name, t] = areas
    if not found:
        return None
    name, t = max(found, key=lambda key: max(found[key]))
    return (
        f"{sum(map(len, found.values()))} small enclosed holes in {len(found)} of {len(scene.cameras) * scene.frames} mattes, the "
        f"largest of {max(found[name, t])} px in camera {name}, frame {t}: each carves a tunnel through the body; "
        "if they are mistakes of matting and no openings, correct the mattes or set scene.fill_holes to that many pixels"
    )

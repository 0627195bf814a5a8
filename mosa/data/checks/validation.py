"""Checks that a scene makes sense before anything is learned from it, and the key under which results are cached."""

from __future__ import annotations

import hashlib
import math
import warnings
from dataclasses import replace
from typing import Annotated, Any, Literal

import torch
from pydantic import InstanceOf
from torch import Tensor

from mosa.data.checks.cameras import check_agreement, check_hues, holes_report
from mosa.data.checks.free_fall import check_fall
from mosa.data.checks.silhouettes import (
    DARK,
    check_outlines,
    check_particles,
    shared_brightness,
)
from mosa.data.checks.tangents import check_copies, check_pictures
from mosa.data.formats.footage import Footage, even_times
from mosa.data.hull import at_border
from mosa.errors import ConfigError, DataError
from mosa.rendering.cameras import centers
from mosa.settings import Expected, Positive, Text, Whole, check_values, fits, such
from mosa.types import FALLING, REST, Cameras, Ground, KnownBody, Markers, Scene, Truth, dense

FULL = 0.99  # share of an image from which on a matte says nothing
CLEAR = 0.9  # coverage that a camera's matte has somewhere in a film
GROWN = 1.25  # area of a matte at the border, over the largest of its camera that is not
FLASH = 0.2  # jump of the mean colour (0 to 1) in one frame; built-in films stay below 0.04
TURNS, FADES = 0.1, 0.18
"""Change of the logarithm of a camera's mean brightness, over that of all, from which on it is compared point by point, and the
change of that comparison (`shared_brightness`) that is warned of. In 15 films as they are the first is up to 0.48, where a textured
body tumbles, the second up to 0.12; an exposure that falls by 20 % makes it 0.22."""
DRIFT = 0.15
"""By which it may change over a film, averaged over all learning cameras, so that what turns into one's view leaves another's: a
body in one light that is exposed the same stays below 0.075 in the built-in films, at 0.13 in one of a cone that tumbles."""
OUTSIDE = 1e-3  # by which images and mattes may leave [0, 1]: rounding
COMPOSITED = 0.05
"""Mean distance of colours, of 0 to 1, from the background outside of a matte: compression leaves less, another background more."""
CORNER = 0.1  # share of an image: a principal point in it was measured from the centre
FARTHEST = 100.0  # [m] of a camera from the origin: float32 rounds to 0.008 mm there
MAX_ORIGIN_RATIO = 3.0
"""Distance from the origin, over the cameras' spread, above which the capture is off the origin rather than in another unit."""
MAX_FOCAL_RATIO, USUAL_FOCAL_RATIO = 2.0, 1.05
"""Ratios of a camera's two focal lengths that are an error, and above which a warning is given: sensors have square pixels."""


Dense = Annotated[
    Any, Expected("a dense tensor of torch.float32 without gradients"),
    such(lambda t: dense(t) and t.dtype == torch.float32 and not t.requires_grad),
]  # fmt: skip
Indices = Annotated[tuple[int, ...], Expected("a tuple of numbers")]
PARTS: dict[str, Any] = {
    **dict.fromkeys(("images", "mattes", "times", "background", "gravity", "up", "box"), Dense),
    "cameras": Annotated[
        Any, Expected("Cameras of dense tensors of torch.float32, with texts as names"),
        such(lambda c: isinstance(c, Cameras) and fits(tuple[str, ...], c.names)
             and fits(Dense, c.K) and fits(Dense, c.w2c)),
    ],
    "name": Text, "sequence": Text, "density": Positive, "synthetic": bool,
    "start": Literal[FALLING, REST], "last_free_frame": Whole | None,
    "holdout_cameras": Indices, "holdout_frames": Indices,
    "particles": Annotated[Any, Expected("None or a tuple of dense tensors"),
                           such(lambda p: p is None or all(map(dense, p)))],
    "ground": Annotated[InstanceOf[Ground] | None, Expected("a Ground or None")],
    "truth": Annotated[InstanceOf[Truth] | None, Expected("a Truth or None")],
    "markers": Annotated[InstanceOf[Markers] | None, Expected("Markers or None")],
    "body": Annotated[InstanceOf[KnownBody] | None, Expected("a KnownBody or None")],
}  # fmt: skip
"""Types of the parts of a `Scene` and of `Footage`."""


def validate(scene: Scene) -> Scene:
    """The scene itself. Errors: DataError naming camera and frame, what was expected and what was found.

    Suspicious holes in the mattes of real footage are a warning: only who took it knows whether they are openings.
    """
    if isinstance(scene.markers, Markers):  # which its reader has checked
        return scene
    label = f"scene {scene.name} ({scene.sequence})"
    check_types(scene, label)
    for name in ("images", "mattes"):
        value = getattr(scene, name)
        low, high = map(float, value.aminmax()) if value.numel() else (0.0, 0.0)
        if not math.isfinite(low) or not math.isfinite(high):  # NaN is the least and the largest
            v, t = (~value.isfinite()).flatten(2).any(2).nonzero()[0].tolist()
            where = f"camera {scene.cameras.names[v]}, frame {t}"
            raise DataError(f"{label}: {name}: NaN or infinite pixels in {where}")
        if low < -OUTSIDE or high > 1 + OUTSIDE:
            raise DataError(
                f"{label}: {name}: expected numbers in [0, 1], found {low:.4g} to {high:.4g}; divide bytes by 255"
            )
    check_cameras(scene, label)
    times = scene.times.double()
    even_times(times.tolist(), list(range(scene.frames)), label, 2e-7 * float(times.abs().max()))
    check_mattes(scene, label)
    check_background(scene, label)
    check_borders(scene, label)
    learned = scene.training_cameras
    check_film(replace(scene, images=scene.images[learned], mattes=scene.mattes[learned], cameras=scene.cameras.select(learned),
                       holdout_cameras=()) if scene.holdout_cameras else scene, label)  # fmt: skip
    if scene.holdout_cameras:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # they are said
                check_film(scene, label)
        except DataError as error:
            warnings.warn(
                f"{error} (nothing is learned from cameras that are held out; figures of their images depend on them)",
                stacklevel=2,
            )
    if not scene.synthetic:
        check_colors(scene, label)
        check_hues(scene, label)
        if holes := holes_report(scene):
            warnings.warn(f"{label}: {holes}", stacklevel=2)
    return scene


def check_types(film: Scene | Footage, label: str) -> None:
    """Every part is of its type, every array of its shape, and what is held out is there.
    Errors: DataError."""
    try:
        check_values(vars(film), PARTS, label)
    except ConfigError as error:
        raise DataError(str(error)) from None
    cameras = film.cameras
    V, H, W = len(cameras.names), cameras.height, cameras.width
    T = len(film.frames) if isinstance(film, Footage) else film.times.numel()
    shapes = {"times": (T,), "images": (V, T, H, W, 3), "mattes": (V, T, H, W), "background": (3,),
              "gravity": (3,), "up": (3,), "box": (2, 3), "cameras.K": (V, 3, 3),
              "cameras.w2c": (V, 4, 4)}  # fmt: skip
    own = vars(film) | {"cameras.K": cameras.K, "cameras.w2c": cameras.w2c}
    for name, shape in shapes.items():
        if name in own and (found := tuple(own[name].shape)) != shape:
            raise DataError(f"{label}: {name}: expected shape {shape}, found {found}")
    if isinstance(film, Footage):
        return
    last = range(T - len(film.holdout_frames), T)
    known = set(film.holdout_cameras) <= set(range(V)) and (film.last_free_frame or 0) < T
    if not known or sorted(film.holdout_frames) != list(last):
        raise DataError(
            f"{label}: expected holdout_cameras below {V}, last_free_frame below {T} and "
            f"holdout_frames that are the last ones, found {film.holdout_cameras}, "
            f"{film.last_free_frame} and {film.holdout_frames}"
        )


def check_background(scene: Scene, label: str) -> None:
    """What the first mattes leave out is background. Errors: DataError."""
    outside = scene.mattes[:, 0] == 0
    away = (scene.images[:, 0] - scene.background).abs().mean(-1)
    for v, name in enumerate(scene.cameras.names):
        if bool(outside[v].any()) and (found := float(away[v][outside[v]].mean())) > COMPOSITED:
            raise DataError(
                f"{label}: images: camera {name}: expected the background {scene.background.tolist()} where the matte is 0, "
                f"found colours that are {found:.2f} away from it on average: images * mattes[..., None] + background * "
                "(1 - mattes[..., None]), or state another background (or is the matte inverted?)"
            )


def check_film(scene: Scene, label: str) -> None:
    """All cameras see one object, at every moment, and it moves as one that falls. Errors: DataError."""
    check_agreement(scene, label)
    check_pictures(scene, label)
    for frame in range(1, scene.frames):
        check_agreement(scene, label, frame)
    check_fall(scene, label)
    if not scene.synthetic:
        check_copies(scene, label)
        check_outlines(scene, label)
        check_particles(scene, label)


def check_cameras(scene: Scene, label: str) -> None:
    """Proper poses, near the origin, and positive focal lengths."""
    cameras = scene.cameras
    places = centers(cameras).double()
    spread = float((places - places.mean(0)).norm(dim=1).max())
    for v, name in enumerate(cameras.names):
        if not bool(torch.isfinite(cameras.K[v]).all() and torch.isfinite(cameras.w2c[v]).all()):
            raise DataError(f"{label}: camera {name}: NaN or infinite numbers in its calibration")
        # else the unit is wrong, which is said below
        if (far := float(places[v].norm())) > FARTHEST and far > MAX_ORIGIN_RATIO * spread:
            raise DataError(
                f"{label}: camera {name}: expected within {FARTHEST:g} m of the origin, where float32 has digits for "
                f"an image, found {far:.5g} m: subtract one offset from all cameras, the box, ground and solids"
            )
        if not bool((cameras.K[v].diagonal()[:2] > 0).all()):
            found = cameras.K[v].diagonal()[:2].tolist()
            raise DataError(
                f"{label}: camera {name}: expected positive focal lengths, found {found}"
            )
        check_pixels(cameras.K[v], f"{label}: camera {name}")
        R = cameras.w2c[v, :3, :3].double()
        bent = float((R @ R.T - torch.eye(3).double()).abs().max())
        if bent > 2e-3 or float(torch.linalg.det(R)) < 0:
            found = R.tolist()
            raise DataError(
                f"{label}: camera {name}: expected a rotation in its pose, found {found}"
            )
        cx, cy = cameras.K[v, 0, 2].item(), cameras.K[v, 1, 2].item()
        inside = 0 < cx < cameras.width and 0 < cy < cameras.height
        centred = max(abs(cx) / cameras.width, abs(cy) / cameras.height) < CORNER
        said = (
            f"{label}: camera {name}: the principal point cx, cy = ({cx:.1f}, {cy:.1f}) px lies "
            f"{'in the corner' if inside else 'outside'} of its {cameras.width}x{cameras.height} px images: "
        )
        corner = "Expected from the upper left corner: add half of their size"
        other = "intrinsics of another resolution?"
        said += f"measured from their centre? {corner}" if centred else other
        if not inside:
            raise DataError(said)
        if centred:
            warnings.warn(said, stacklevel=3)


def check_pixels(K: torch.Tensor, label: str) -> None:
    """A pinhole camera's matrix, and both focal lengths nearly one. Errors: DataError where one is twice the other; a warning where
    they differ visibly."""
    fixed = K[[1, 2, 2, 2], [0, 0, 1, 2]] - torch.tensor([0.0, 0.0, 0.0, 1.0])
    if float(fixed.abs().max()) > 1e-6:
        wanted = "[[fx, s, cx], [0, fy, cy], [0, 0, 1]]"
        raise DataError(f"{label}: intrinsics: expected {wanted}, found {K.tolist()}")
    across, down = K[0, 0].item(), K[1, 1].item()
    ratio = max(across / down, down / across)
    said = (
        f"{label}: expected focal lengths of square pixels, found fl_x = {across:.5g} and fl_y = {down:.5g} px: were the "
        "images stretched, or one of them taken for another size?"
    )
    if ratio >= MAX_FOCAL_RATIO:
        raise DataError(said)
    if ratio > USUAL_FOCAL_RATIO:
        warnings.warn(said, stacklevel=4)


def check_mattes(scene: Scene, label: str) -> None:
    """The object is seen by every camera at frame 0, and is not everything a camera sees."""
    covered = scene.mattes.mean((2, 3))
    for v, name in enumerate(scene.cameras.names):
        if float(covered[v, 0]) == 0:
            raise DataError(
                f"{label}: camera {name}: the matte of the first frame is empty; expected the object in view of every "
                "camera there: matte it, remove the camera, or start later with scene.frames"
            )
        if float(covered[v].max()) > FULL:
            t = int(covered[v].argmax())
            every = "; the footage has no matte (an alpha channel that is opaque everywhere?)"
            one = ": an opaque alpha channel, or an object too near; matte it, or restrict scene.frames"
            raise DataError(
                f"{label}: camera {name}, frame {t}: the matte covers {float(covered[v, t]):.0%} of the image"
                f"{every if float(covered[v].min()) > FULL else one}"
            )
    check_gaps(scene, covered > 0, label)
    cut = at_border(scene.mattes) > 0.5
    whole = (covered * ~cut).amax(1, keepdim=True)
    grown = torch.where(cut & (whole > 0), covered / whole, 0.0)
    v, t = divmod(int(grown.argmax()), scene.frames)
    if float(grown[v, t]) > GROWN:
        warnings.warn(
            f"{label}: camera {scene.cameras.names[v]}, frame {t}: the matte reaches the image's border and is "
            f"{float(grown[v, t]):.2g} times the largest that does not: expected the object alone, found a hand, or what "
            "holds it?",
            stacklevel=3,
        )
    most = scene.mattes.amax((1, 2, 3))
    if float(most.min()) < CLEAR:
        v = int(most.argmin())
        warnings.warn(
            f"{label}: camera {scene.cameras.names[v]}: the matte is nowhere more than {float(most[v]):.2f} in any "
            "frame: expected 1 inside of the object; what is missing mixes the background into its colours",
            stacklevel=3,
        )


def check_gaps(scene: Scene, seen: torch.Tensor, label: str) -> None:
    """No frame loses the object that frames after it show: in all cameras that is refused, in one a warning. seen: (V, T)."""
    later = seen.flip(1).cummax(1).values.flip(1)
    gap = later & ~seen
    views = seen.sum(0)
    if bool((lost := (views < 2) & (later.sum(0) >= 2)).any()):
        t = int(lost.int().argmax())
        raise DataError(
            f"{label}: {int(views[t])} of {len(seen)} cameras have a matte of the object in frame {t}, and more of "
            "them in a later one: expected two at least in every frame between; matte it, or restrict scene.frames"
        )
    if bool(gap.any()):
        v, t = (int(i) for i in gap.nonzero()[0])
        warnings.warn(f"{label}: camera {scene.cameras.names[v]}, frame {t}: the matte is empty, where it shows the object in a "
                      f"later frame ({int(gap.sum())} such mattes): expected the object; what the camera shows there counts as "
                      "nothing being there", stacklevel=4)  # fmt: skip


def spread(values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of each row of values (V, T) the highest less the lowest, and where they are, (V,) each. NaN is left out."""
    high, low = values.nan_to_num(-math.inf).max(1), values.nan_to_num(math.inf).min(1)
    return high.values - low.values, high.indices, low.indices


def check_colors(scene: Scene, label: str) -> None:
    """A warning where the object's mean colour jumps in one frame of a camera and comes back: a frame that was not exposed, or
    dropped and filled with black. And one where a camera's or all cameras' changes over the film: another exposure or light."""
    inside = (scene.mattes > CLEAR).float()
    count = inside.sum((2, 3))
    sums, seen = (scene.images * inside[..., None]).sum((2, 3)), count > 0
    means = sums / count[..., None].clamp(min=1)
    jump = (means[:, 1:-1] - (means[:, :-2] + means[:, 2:]) / 2).abs().amax(2)
    jump = jump * (seen[:, 1:-1] & seen[:, :-2] & seen[:, 2:])
    if jump.numel() and float(jump.max()) > FLASH:
        v, t = divmod(int(jump.argmax()), jump.shape[1])
        warnings.warn(
            f"{label}: camera {scene.cameras.names[v]}, frame {t + 1}: the object's mean colour is "
            f"{float(jump[v, t]):.2f} beside that of the frames before and after: a dropped or flashed frame? expected "
            "one light",
            stacklevel=3,
        )
        return
    whole = seen & ~(at_border(scene.mattes) > 0.5)
    light = torch.where(whole & (whole.sum(0) > 2), means.mean(2).clamp(min=DARK).log(), torch.nan)
    change, *ends = spread(light - light.nanmean(0))
    if bool((turns := change > TURNS).any()):
        frames = sorted({0, scene.frames - 1}.union(*(each[turns].tolist() for each in ends)))
        shared = torch.stack([shared_brightness(scene, frame) for frame in frames], 1)
        change, *ends = spread(shared)
        v = int(change.argmax())
        if float(change[v]) > FADES:
            first, last = sorted(frames[int(each[v])] for each in ends)
            warnings.warn(
                f"{label}: camera {scene.cameras.names[v]}: the object's brightness, over that in which other cameras show the "
                f"same points, changes by a factor of {math.exp(float(change[v])):.3g} between frames {first} and {last}: an "
                "automatic exposure? expected one; colours are compared from frame to frame",
                stacklevel=3,
            )
            return
    chosen = scene.training_cameras
    every = count[chosen].sum(0)
    together, shown = sums[chosen].sum(0) / every[:, None].clamp(min=1), every > 0
    if int(shown.sum()) < 2:
        return
    change = together[shown].amax(0) - together[shown].amin(0)
    if float(change.max()) > DRIFT:
        channel = int(change.argmax())
        values = torch.where(shown, together[:, channel], torch.nan)
        first = int(values.nan_to_num(2.0).argmin())
        last = int(values.nan_to_num(-1.0).argmax())
        name = ("red", "green", "blue")[channel]
        warnings.warn(
            f"{label}: the object's mean {name} over all cameras is {float(values[first]):.2f} in frame {first} and "
            f"{float(values[last]):.2f} in frame {last}: does the exposure, the white balance or the light change, "
            "or does the body turn another side to the cameras? expected one light; colours are compared from frame to frame",
            stacklevel=3,
        )


def check_borders(scene: Scene, label: str) -> None:
    """The first frame, which says where the object is, shows all of it to two learning cameras at least, to one of a body of known
    shape."""
    cut = at_border(scene.mattes[:, 0]) > 0.5
    names = [scene.cameras.names[v] for v in scene.training_cameras if bool(cut[v])]
    fewest = 2 if scene.body is None else 1
    if len(scene.training_cameras) - len(names) < fewest:
        way = "film from farther away, or start with another frame (scene.frames)"
        # of most of them the corners show the object
        if float(scene.mattes[cut, 0][:, [0, 0, -1, -1], [0, -1, 0, -1]].median()) > 0.5:
            way = "a matte is 1 (white, opaque) where the object is: are these inverted?"
        raise DataError(
            f"{label}: the image's border cuts the object in frame 0 of the cameras {', '.join(names)}: expected {fewest} "
            f"that see all of it; {way}"
        )
    if names:
        warnings.warn(
            f"{label}: the image's border cuts the object in frame 0 of the cameras {', '.join(names)}; what is outside "
            "is known to the others alone",
            stacklevel=3,
        )


def fingerprint(scene: Scene) -> str:
    """Hash of everything that learning can depend on: images, mattes, cameras, times, world, and what is held out."""
    digest = hashlib.sha256()
    own = scene.times, scene.gravity, scene.up, scene.box, scene.background
    for tensor in (scene.images, scene.mattes, scene.cameras.K, scene.cameras.w2c, *own):
        digest.update(str(tuple(tensor.shape)).encode())
        digest.update(tensor.detach().cpu().contiguous().numpy())
    facts = (
        scene.cameras.width, scene.cameras.height, scene.ground, scene.density,
        scene.last_free_frame, scene.holdout_cameras, scene.holdout_frames,
    )  # fmt: skip
    digest.update(repr((*facts, scene.driven) if scene.driven else facts).encode())
    return digest.hexdigest()[:16]

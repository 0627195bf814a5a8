"""Real, prior and adapted beside each other, on the ground they fall on, with the frame's time and what the models miss."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import torch
from torch import Tensor

from mosa.evaluation.analysis.figures import (
    FONT,
    fitted,
    side_by_side,
    text_width,
    to_uint8,
    write_strip,
    write_video,
)
from mosa.evaluation.evaluate import Sequence, true_motion
from mosa.modules.body.body import Body
from mosa.physics.world import World
from mosa.rendering.appearance.carried_splats import Seen, seen
from mosa.rendering.cameras import crop_boxes, crop_cameras, crop_images
from mosa.rendering.observer import deformed_covariances, observe
from mosa.types import Cameras, Rollout, Scene

TITLES = {"prior": "prior", "adapted": "adapted (learned law)"}
DIFFERENCE = 0.5  # largest image difference that has a colour of its own
NEAR_BACKGROUND = 12
"""8-bit levels: ground lines are drawn where a pixel is as close to the background as that, so that they lie behind the object."""

WIDEST = 512.0  # px of a body whose outline and shadow are drawn as finely as the picture
DARK = 0.45  # of the light that a shadow takes where it is deepest


@dataclass(frozen=True)
class View:
    """The first camera of a scene, cut to where the object goes. real: (T, H, W, 3) what it sees; enlarged: how many times pictures
    are; lines: of the ground."""

    scene: Scene
    cameras: Cameras
    real: Tensor
    enlarged: int
    lines: list[np.ndarray]

    @classmethod
    def of(cls, scene: Scene, size: float, width: int = 320) -> View:
        """size: of the object [m]; width: of pictures, about [px]."""
        camera = (scene.training_cameras or [0])[0]
        x0, y0, w, h = crop_boxes(scene.mattes[[camera]], margin=16)
        cameras = crop_cameras(scene.cameras.select([camera]), x0, y0, w, h)
        real = crop_images(scene.images[[camera]], x0, y0, w, h, axis=2)[0]
        times = max(1, round(width / max(w, h)))
        return cls(scene, cameras, real, times, ground_lines(scene, cameras, size))

    @property
    def moments(self) -> list[str]:
        """The caption of each frame."""
        times = self.scene.times.tolist()
        return [f"frame {t}, {time - times[0]:.3f} s" for t, time in enumerate(times)]

    def drawn(self, shown: Seen) -> Tensor:
        """(T, H, W, 3) on the CPU."""
        device = shown.means.device
        given = self.cameras.to(device), self.scene.background.to(device)
        return shown.images(*given)[0].clamp(0, 1).cpu()

    def finished(self, images: Tensor) -> np.ndarray:
        """(T, H', W', 3) uint8: images (T, H, W, 3), enlarged, on the ground."""
        pictures = (enlarge(to_uint8(image), self.enlarged) for image in images)
        given = self.lines, self.enlarged, self.scene.background
        return np.stack([on_ground(picture, *given) for picture in pictures])


@dataclass(frozen=True)
class Comparison:
    """One camera's view of a sequence, cut to where the object goes and enlarged. images: by title, (T, H, W, 3) uint8: `real` and
    the models; errors: of the models, as colours; label: what of, from 0 to `high`; colors: of matplotlib; times: (T,) [s]."""

    images: dict[str, np.ndarray]
    errors: dict[str, np.ndarray]
    label: str
    high: str
    colors: str
    moments: list[str]


@torch.no_grad()
def compare(
    body: Body,
    shown: Sequence,
    variants: Mapping[str, Rollout],
    *,
    width: int = 320,
    limit: float | None = None,
) -> Comparison:
    """What the first camera sees of a sequence and of the models' rollouts (those that there are), about `width` px wide.

    The error is each particle's distance to the true motion where that is known, else the difference of the images. limit [m]: the
    distance that has the last colour (`error_limit` of this sequence)."""
    scene, view = shown.scene, View.of(shown.scene, body.size, width)
    seen_of = {
        v: view.drawn(seen(body, variants[v].x, variants[v].F_tot)) for v in TITLES if v in variants
    }
    far = distances(body, scene, variants)
    if not far:
        label, high, colors = "difference of the images", f"{DIFFERENCE:g}", "Reds"
        errors = {
            v: paint((images - view.real).abs().mean(-1) / DIFFERENCE, colors)
            for v, images in seen_of.items()
        }
    else:
        limit = limit or error_limit(far.values())
        label, high, colors = "distance to the true motion", f"{1e3 * limit:g} mm", "viridis"
        errors = {
            v: painted(body, variants[v], view, paint(d / limit, colors)) for v, d in far.items()
        }
    return Comparison(
        {"real": view.finished(view.real)}
        | {TITLES[v]: view.finished(images) for v, images in seen_of.items()},
        {TITLES[v]: view.finished(images) for v, images in errors.items()},
        label,
        high,
        colors,
        view.moments,
    )


def distances(body: Body, scene: Scene, variants: Mapping[str, Rollout]) -> dict[str, Tensor]:
    """(T, N) [m] of each model's particles to the true motion; none where that is not known."""
    if (target := true_motion(body, scene)) is None:
        return {}
    return {v: (variants[v].x.cpu() - target).norm(dim=-1) for v in TITLES if v in variants}


def error_limit(far: Iterable[Tensor]) -> float:
    """End [m] of a scale that 99 % of each of these distances are within."""
    most = (float(torch.quantile(d.flatten()[: 2**24], 0.99)) for d in far)
    return round_up(max(most, default=0.0))


def painted(body: Body, rollout: Rollout, view: View, colors: Tensor) -> Tensor:
    """(T, H, W, 3) images of a rollout's particles with colours (T, N, 3), on the CPU."""
    device = body.rest.device
    cameras, background = view.cameras.to(device), view.scene.background.to(device)
    covariances = deformed_covariances(rollout.F_tot, body.covariances)
    parts = []
    for t in range(len(rollout.x)):
        own = rollout.x[[t]], covariances[[t]], body.opacities, colors[t].to(body.colors)
        parts.append(observe(*own, cameras, background).images[0])
    return torch.cat(parts).clamp(0, 1).cpu()


def paint(share: Tensor, colors: str) -> Tensor:
    """(..., 3) colours of values (...), of which 1 has the last colour and what is above too."""
    painted = matplotlib.colormaps[colors](share.clamp(0, 1).numpy())
    return torch.from_numpy(painted[..., :3]).float()


def round_up(value: float) -> float:
    """The next of 1, 2, 5, 10, 20, 50 ... times 1e-3 (at least that)."""
    scale = 10.0 ** np.floor(np.log10(max(value, 1e-3)))
    return float(next(step * scale for step in (1, 2, 5, 10) if step * scale >= value * (1 - 1e-9)))


def ground_lines(
    scene: Scene | World, cameras: Cameras, size: float, middle: Tensor | None = None
) -> list[np.ndarray]:
    """Lines of a grid on the ground, half the object's size apart, as (n, 2) [px] in the images of one camera; none without
    a ground. The grid lies under `middle` (3,) [m], None: under the middle of the image."""
    if scene.ground is None:
        return []
    up, w2c, K = scene.up.double(), cameras.w2c[0].double(), cameras.K[0].double()
    eye = -w2c[:3, :3].T @ w2c[:3, 3]
    lowest = K.new_tensor([cameras.width / 2, cameras.height, 1.0])
    ray = w2c[:3, :3].T @ torch.linalg.solve(K, lowest)
    fall = float(ray @ up)
    # a camera below the ground, or looking up
    if fall >= -1e-3 * float(ray.norm()) or float(eye @ up) <= scene.ground.height:
        return []
    if middle is None:
        middle = eye + (scene.ground.height - float(eye @ up)) / fall * ray
    middle = middle.to(up) + (scene.ground.height - float(middle.to(up) @ up)) * up
    across = torch.linalg.cross(up, torch.eye(3, dtype=torch.float64)[int(up.abs().argmin())])
    across = across / across.norm()
    along = torch.linalg.cross(up, across)
    cell, count = 0.5 * size, 12
    steps = torch.linspace(-count, count, 8 * count + 1).double() * cell
    places = torch.arange(-count, count + 1) * cell
    lines = []
    for one, other in ((across, along), (along, across)):
        for place in places.tolist():
            points = middle + place * one + steps[:, None] * other
            seen = points @ w2c[:3, :3].T + w2c[:3, 3]
            pixel = (seen @ K.T)[seen[:, 2] > 0.1 * float((middle - eye).norm())]
            if len(pixel) > 1:
                lines.append((pixel[:, :2] / pixel[:, 2:]).numpy())
    return lines


def enlarge(image: np.ndarray, times: int) -> np.ndarray:
    if times == 1:
        return image
    return cv2.resize(image, None, fx=times, fy=times, interpolation=cv2.INTER_CUBIC)


def ground_shadow(
    points: Tensor, world: World, cameras: Cameras, size: float, convex: bool = False
) -> np.ndarray:
    """(H, W) in [0, 1]: the shadow of a solid with points (N, 3) [m] on the ground, under light from above, in the images of one
    camera. It is the sharper the nearer the solid is to the ground. size: of the object [m];
    convex: the solid fills the space between its points."""
    assert world.ground is not None
    up, points = world.up.double().cpu(), points.double().cpu()
    high = points @ up - world.ground.height
    below, high = (points - high[:, None] * up)[high > -0.1 * size], high[high > -0.1 * size]
    dots, wide = _dots(below, cameras, size, convex)
    if not wide:
        return dots
    soft = 0.03 + 0.1 * float((high.min() / size).clamp(0, 1))
    whole = cv2.dilate(dots, _disc(0.03 * wide))  # no gaps between points
    shade = cv2.GaussianBlur(whole, (0, 0), max(soft * wide, 0.5))
    return cv2.resize(shade, (cameras.width, cameras.height))


def outline(points: Tensor, cameras: Cameras, size: float) -> np.ndarray:
    """(H, W), 1 where one camera sees a body with points (N, 3) [m], gaps between them closed, and
    0 elsewhere. size: of the body [m]."""
    dots, wide = _dots(points.double().cpu(), cameras, size)
    whole = cv2.morphologyEx(dots, cv2.MORPH_CLOSE, _disc(0.05 * wide))
    return cv2.resize(whole, (cameras.width, cameras.height))


def _dots(points: Tensor, cameras: Cameras, size: float, convex: bool = False) -> tuple[np.ndarray, float]:  # fmt: skip
    """((h, w) 1 at the pixels of points (N, 3), or inside of their hull, px of `size` or 0 where none is in front). Of a picture in
    which `size` is wider than `WIDEST`, a smaller one: discs that grow with the body would take minutes."""
    w2c, K = cameras.w2c[0].double().cpu(), cameras.K[0].double().cpu()
    seen = points @ w2c[:3, :3].T + w2c[:3, 3]
    seen = seen[seen[:, 2] > 0]
    shape = (cameras.height, cameras.width)
    if not len(seen):
        return np.zeros(shape), 0.0
    pixel = ((seen @ K.T)[:, :2] / seen[:, 2:]).numpy()
    wide = size * float(K[0, 0] / seen[:, 2].mean())
    if wide > WIDEST:
        wide, share = WIDEST, WIDEST / wide
        shape = (math.ceil(share * shape[0]), math.ceil(share * shape[1]))
        pixel *= share
    if convex:
        hull = cv2.convexHull(pixel.clip(-1e4, 1e4).astype(np.int32))
        return cv2.fillConvexPoly(np.zeros(shape), hull, 1.0), wide
    edges = ((0, shape[0]), (0, shape[1]))
    return np.histogram2d(pixel[:, 1], pixel[:, 0], shape, edges)[0].clip(max=1), wide


def _disc(radius: float) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(radius) + 1,) * 2)


def on_ground(
    image: np.ndarray, lines: list[np.ndarray], times: int, background: Tensor
) -> np.ndarray:
    """An image (H, W, 3) uint8, enlarged `times`, with ground lines [px before that] where it shows the background."""
    if not lines:
        return image
    ink = np.zeros(image.shape[:2], np.uint8)
    # of 1/16 px
    fixed = [np.round(line.clip(-1e4, 1e4) * times * 16).astype(np.int32) for line in lines]
    cv2.polylines(ink, fixed, False, 255, 1, cv2.LINE_AA, shift=4)
    found, drawn = image.copy(), ink > 0
    under = image[drawn]
    behind = np.abs(under - 255.0 * background.numpy()).max(-1) <= NEAR_BACKGROUND
    share = 0.5 * (ink[drawn] / 255 * behind)[..., None]
    found[drawn] = (under * (1 - share) + 120 * share + 0.5).astype(np.uint8)
    return found


def legend(shown: Comparison) -> np.ndarray:
    """(H, W, 3) uint8: the colours of the errors, as large as an image."""
    height, width = shown.images["real"].shape[1:3]
    picture = np.full((height, width, 3), 255, np.uint8)
    colors = paint(torch.linspace(0, 1, int(0.8 * width)), shown.colors)
    bar = to_uint8(colors[None].expand(max(8, height // 20), -1, -1))
    top, left = height // 2, int(0.1 * width)
    picture[top : top + bar.shape[0], left : left + bar.shape[1]] = bar
    text, scale = fitted(shown.label, width - left, 0.42)

    def write(text, x, y):
        return cv2.putText(picture, text, (x, y), FONT, scale, (30, 30, 30), 1, cv2.LINE_AA)

    write(text, left, top - 10)
    write("0", left, top + bar.shape[0] + 18)
    write(shown.high, left + bar.shape[1] - text_width(shown.high, scale), top + bar.shape[0] + 18)
    return picture


def write_comparisons(folder: Path, shown: Mapping[str, Comparison], *, video: bool = True) -> None:
    """strip.png of all sequences; video: also video.mp4 of the last. shown: by the prefix of the sequence."""
    prefix, last = list(shown.items())[-1]
    below = {last.label: np.repeat(legend(last)[None], len(last.moments), 0)}
    below |= {f"{title}: {last.label}": images for title, images in last.errors.items()}
    footer = [f"{prefix}   {moment}" for moment in last.moments]
    if video:
        film = side_by_side(last.images, below=below, footer=footer)
        write_video(folder / "video.mp4", film, fps=6)
    rows, notes = {}, {}
    for prefix, each in shown.items():
        notes[f"{prefix}: real"] = each.moments
        rows |= {f"{prefix}: {title}": images for title, images in each.images.items()}
        until = f"{each.label}, 0 to {each.high}"
        rows |= {f"{prefix}: {title}, {until}": images for title, images in each.errors.items()}
    for each in shown.values():  # the scale once, under the first frame
        scale = np.full_like(each.images["real"], 255)
        scale[0] = legend(each)
        rows[each.label] = scale
    write_strip(folder / "strip.png", rows, notes=notes)

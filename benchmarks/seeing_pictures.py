"""The pictures of seeing.py: real and rendered frames, flow, cues as ellipsoids."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import torch
from cues_pictures import outlines, save
from PIL import Image
from seeing_figures import HELD, Seen, real_flow
from torch import Tensor

from mosa.evaluation.analysis.figures import label, to_uint8
from mosa.evaluation.analysis.flow_colors import color_wheel, flow_colors
from mosa.reconstruction.motion.cues import neighbourhood, polar
from mosa.rendering.cameras import crop_boxes, crop_images

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.collections import PolyCollection


def write(
    rows: dict[str, Tensor], file: Path, enlarge: int, legend: np.ndarray | None = None
) -> Path:
    """One captioned row per entry (T, h, w, 3), as a PNG; `legend` is put in the upper right, beside them."""
    parts = []
    for name, images in rows.items():
        row = np.concatenate([to_uint8(image) for image in images], 1)
        row = (
            cv2.resize(row, None, fx=enlarge, fy=enlarge, interpolation=cv2.INTER_CUBIC)
            if enlarge > 1
            else row
        )
        parts.append(label(row, name))
    picture = np.concatenate(parts)
    if legend is not None:
        column = np.full((len(picture), legend.shape[1], 3), 255, np.uint8)
        column[: len(legend)] = legend
        picture = np.concatenate([picture, column], 1)
    # a colour wheel needs all its colours; photographs do with 256, at a third of the size
    image = Image.fromarray(picture)
    (image if legend is not None else image.quantize(256, dither=Image.Dither.NONE)).save(
        file, optimize=True
    )
    return file


def silhouette_errors(alpha: Tensor, mattes: Tensor) -> Tensor:
    """(T, H, W, 3): grey where both are, red where the matte is not covered, blue where the render stands over."""
    a, b = alpha > 0.5, mattes > 0.5
    picture = torch.ones(*a.shape, 3)
    for where, color in (
        (a & b, (0.8, 0.8, 0.8)),
        (b & ~a, (0.85, 0.1, 0.1)),
        (a & ~b, (0.1, 0.2, 0.9)),
    ):
        picture[where] = torch.tensor(color)
    return picture


def pictures(seen: Seen, to: Path) -> list[Path]:
    """Pictures named seeing_<scene>_*.png in the folder `to`."""
    scene, camera = seen.scene, seen.camera
    to.mkdir(parents=True, exist_ok=True)
    # a window per frame: frames take the place of views
    x0, y0, width, height = crop_boxes(scene.mattes[camera][:, None], margin=6)

    def cut(images: Tensor, frames: list[int]) -> Tensor:
        return crop_images(images[frames], x0[frames], y0[frames], width, height)

    real, rendered = scene.images[camera], seen.views.images[0].clamp(0, 1)
    shown = np.unique(np.linspace(0, scene.frames - 1, 7).round().astype(int)).tolist()
    enlarge = max(1, math.ceil(1000 / (width * len(shown))))
    difference = (1 - 3 * (rendered - real).abs()).clamp(0, 1)
    errors = silhouette_errors(seen.views.mattes[0], scene.mattes[camera])
    numbers = ", ".join(map(str, shown))
    strip = {
        f"real, camera {HELD} (held out), frames {numbers}": cut(real, shown),
        "rendered particles": cut(rendered, shown),
        "difference, three times": cut(difference, shown),
        "red: matte not covered; blue: rendered outside of it": cut(errors, shown),
    }
    files = [write(strip, to / f"seeing_{scene.name}_strip.png", enlarge)]
    steps = [t for t in shown if t < scene.frames - 1]
    found, optical = seen.views.flow[0], real_flow(seen)
    optical = torch.where((scene.mattes[camera, :-1] > 0.5)[..., None], optical, 0.0)
    largest = float(found.norm(dim=-1)[scene.mattes[camera, :-1] > 0.5].quantile(0.99))
    rows = {
        f"Gaussian flow to the next frame, camera {HELD} (held out), frames {', '.join(map(str, steps))}; "
        f"full colour: {largest:.0f} px or more": cut(flow_colors(found, largest), steps),
        "optical flow of the real images (DIS), inside the matte": cut(
            flow_colors(optical, largest), steps
        ),
    }
    files.append(
        write(rows, to / f"seeing_{scene.name}_flow.png", enlarge, to_uint8(color_wheel(96)))
    )
    return [*files, ellipsoids(seen, to / f"seeing_{scene.name}_ellipsoids.png")]


def ellipsoids(seen: Seen, file: Path, exaggeration: float = 2.0) -> Path:
    """Rest balls of a layer of particles, deformed by the cue: frame of the largest stretches and the last, from two sides."""
    result = seen.result
    rest, positions = result.splats.means, result.cues.positions
    F = neighbourhood(rest, neighbours=seen.settings.neighbours).deformation(positions)
    squashed = int((result.cues.stretch - 1).abs().amax(-1).median(dim=1).values.argmax())
    figure, plots = plt.subplots(2, 2, figsize=(10, 6.4), layout="constrained")
    for row, t in zip(plots, (squashed, len(positions) - 1)):
        for plot, (axis, seen_axes, title) in zip(
            row, ((2, (0, 1), "along z"), (1, (0, 2), "along y, from above"))
        ):
            layer = (rest[:, axis] - rest[:, axis].median()).abs() < 0.6 * result.spacing
            # stretches exaggerated about 1; the rotation is kept
            U, S, Vh = torch.linalg.svd(F[t, layer].double())
            R, _ = polar(F[t, layer].double())
            drawn = (U * (1 + exaggeration * (S - 1)).clamp(0.2, 2.5)[:, None]) @ Vh
            axes = np.eye(3)[list(seen_axes)]
            strain, radius = (S - 1).abs().amax(1), 0.42 * result.spacing
            shapes = outlines(drawn, positions[t, layer], axes, radius)
            balls_drawn = PolyCollection(
                shapes, array=strain.numpy(), cmap="viridis", clim=(0, 0.2), ec="#333333", lw=0.3
            )
            mapped = plot.add_collection(balls_drawn)
            # where the rest x axis points to: shows the rotation
            line, centre = (
                radius * R[:, :, 0].numpy() @ axes.T,
                positions[t, layer].numpy() @ axes.T,
            )
            plot.plot(
                *np.stack([centre - line, centre + line]).transpose(2, 0, 1), color="white", lw=0.7
            )
            plot.set_title(
                f"frame {t}, seen {title}; largest |stretch - 1|: median {float(strain.median()):.3f}",
                fontsize=7,
            )
            plot.set_xlabel("xyz"[seen_axes[0]] + " [m]", fontsize=7)
            plot.set_ylabel("xyz"[seen_axes[1]] + " [m]", fontsize=7)
            plot.set_aspect("equal")
            plot.tick_params(labelsize=7)
            plot.autoscale_view()
    figure.colorbar(mapped, ax=plots, shrink=0.6).set_label(
        "largest |stretch - 1| (not exaggerated)", fontsize=8
    )
    what = "synthetic" if seen.scene.synthetic else "real footage"
    title = f"{seen.scene.name} ({what}), a layer through the middle; stretches drawn {exaggeration:g} times as large"
    figure.suptitle(title, fontsize=9)
    save(figure, file)
    return file

"""Tracked points beside where a fitted body says they are: markers.npz, markers.png, and a film."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import torch

from mosa.evaluation.analysis.figures import side_by_side, to_uint8, write_strip, write_video
from mosa.modules.body.body import Body
from mosa.reconstruction.marker_body import cues_of_markers
from mosa.rendering.appearance.carried_splats import seen
from mosa.rendering.cameras import look_at, project
from mosa.system.npz import write_npz
from mosa.types import Cameras, Rollout

SHOWN = 3  # points of a sequence that are drawn: those that move most
SIZE = (320, 220)  # width and height [px] of the film
MEASURED, PREDICTED = (200, 30, 30), (20, 60, 200)


def write_markers(
    folder: Path,
    body: Body,
    sequences: Sequence,
    kept: Mapping[str, Mapping[str, Rollout]],
    *,
    video: bool = False,
) -> None:
    """markers.npz with `<name>/measured`, `<name>/predicted` [T, M, 3] (m), `<name>/times` [T] (s), points in the order of
    `scene.tracked`; markers.png: displacements [mm] of the points that move most, along the axis in which they do, measured (dots)
    and predicted (lines); strip.png: the first swing of all (`film`). video: also video.mp4 of the last sequence."""
    matplotlib.use("Agg")
    from matplotlib import pyplot

    arrays: dict[str, np.ndarray] = {}
    films: dict[str, np.ndarray] = {}
    swings: dict[str, int] = {}
    figure, axes = pyplot.subplots(
        len(sequences), 1, figsize=(9, 2.6 * len(sequences)), squeeze=False, constrained_layout=True
    )
    for axis, s in zip(axes[:, 0], sequences):
        if "adapted" not in kept[s.prefix]:  # it cannot be simulated, which has been said
            continue
        cues = cues_of_markers(s.scene, body.rest.cpu())
        predicted = cues.seen(kept[s.prefix]["adapted"].x.cpu()).numpy()
        measured, names = cues.positions.numpy(), s.scene.markers.names
        times = s.scene.times.numpy()
        own = {"measured": measured, "predicted": predicted, "times": times}
        arrays |= {f"{s.prefix}/{name}": values for name, values in own.items()}
        moved = measured - s.scene.markers.rest.numpy()
        films[s.prefix] = film(body, s.scene, kept[s.prefix]["adapted"], measured, predicted)
        far = np.linalg.norm(predicted - predicted[0], axis=-1).mean(1)
        swings[s.prefix] = min(2 * int(far.argmax()), len(times) - 1)
        spread = np.nanstd(moved, 0)
        along = int(spread.sum(0).argmax())
        for k, m in enumerate(np.argsort(-spread[:, along])[:SHOWN]):
            rest = float(s.scene.markers.rest[m, along])
            axis.plot(times, 1e3 * (measured[:, m, along] - rest), ".", ms=3, color=f"C{k}")
            axis.plot(
                times, 1e3 * (predicted[:, m, along] - rest), lw=1, color=f"C{k}", label=names[m]
            )
        axis.set(title=s.prefix, ylabel=f"{'xyz'[along]} displacement [mm]")
        look = {"loc": "center left", "bbox_to_anchor": (1, 0.5), "fontsize": 8}
        axis.legend(title="dots measured,\nlines predicted", **look)
    axes[-1, 0].set_xlabel("time [s]")
    figure.savefig(folder / "markers.png", dpi=110)
    pyplot.close(figure)
    write_npz(folder / "markers.npz", arrays)
    if films:
        moments = {s.prefix: [f"{t:.2f} s" for t in s.scene.times.tolist()] for s in sequences}
        said = "red measured, blue predicted"
        prefix = list(films)[-1]
        footer = [f"{prefix}   {moment}" for moment in moments[prefix]]
        if video:
            shown = side_by_side({said: films[prefix]}, footer=footer)
            write_video(folder / "video.mp4", shown, fps=20)
        most = max(swings.values()) + 1
        write_strip(
            folder / "strip.png",
            {f"{name}: {said}": images[:most] for name, images in films.items()},
            notes={f"{name}: {said}": moments[name][:most] for name in films},
        )


@torch.no_grad()
def film(body: Body, scene, rollout: Rollout, measured: np.ndarray, predicted: np.ndarray):
    """(T, H, W, 3) uint8: the predicted body from the side on which it is longest, with measured
    (discs) and predicted (rings) points [T, M, 3] (m)."""
    x, up = rollout.x.cpu().double(), (scene.up / scene.up.norm()).double()
    level = torch.eye(3).double() - up[:, None] * up
    flat = level @ torch.cov(x[0].T) @ level / torch.cov(x[0].T).trace()
    side = torch.linalg.eigh(flat + 2 * up[:, None] * up)[1][:, 0]  # the shortest level axis
    side = side * torch.sign(side[side.abs().argmax()])
    across = torch.linalg.cross(up, side)
    shown = torch.cat([x.flatten(0, 1), torch.from_numpy(predicted).double().flatten(0, 1)])
    middle = 0.5 * (shown.amin(0) + shown.amax(0))
    wide, high = (float((shown - middle).mul(axis).sum(-1).abs().max()) for axis in (across, up))
    far = 20 * max(wide, high)  # nearly without perspective
    focal = 0.42 * far * min(SIZE[0] / wide, SIZE[1] / high)
    K = torch.tensor([[focal, 0, SIZE[0] / 2], [0, focal, SIZE[1] / 2], [0, 0, 1.0]])
    w2c = look_at((middle + far * side).float(), middle.float(), up.float())
    camera = Cameras(K[None], w2c[None], *SIZE, ("side",))
    of_body, device = seen(body, rollout.x, rollout.F_tot), body.rest.device
    pictures = of_body.images(camera.to(device), scene.background.to(device))[0].cpu()
    images = [to_uint8(image).copy() for image in pictures]
    kinds = ((measured, MEASURED, 3, -1), (predicted, PREDICTED, 6, 2))
    for points, color, radius, thickness in kinds:
        for image, places in zip(images, torch.from_numpy(points).float()):
            for pixel in project(places, camera)[0][0][torch.isfinite(places).all(-1)].tolist():
                at = [round(16 * value) for value in pixel]  # of 1/16 px
                cv2.circle(image, at, 16 * radius, color, thickness, cv2.LINE_AA, 4)
    return np.stack(images)

"""Pictures of what benchmarks/cues.py measured: cues as ellipsoids, true beside estimated, and bars of the errors by condition.

    OMP_NUM_THREADS=1 python benchmarks/cues_pictures.py --shape chick1 --out outputs/cues --to docs/images

Reads the results and the cached reconstructions of the benchmark (run that first); what is not there is left out of the bars.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import matplotlib
import numpy as np
import torch
from cue_error import rotation_error, true_motion
from cues import CONDITIONS, reconstructed
from PIL import Image
from torch import Tensor

from mosa.reconstruction.motion.cues import neighbourhood, polar
from mosa.types import MotionCues, Splats

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.collections import PolyCollection

FORMS = {("carried", "neighbourhood"): "neighbourhood (default)", ("free", "neighbourhood"): "neighbourhood, free shapes",
         ("free", "gaussian"): "the paper's: Gaussians' own"}  # fmt: skip
COLORS = ("#0072b2", "#56b4e9", "#d55e00")


def deformation_of(cues: MotionCues, splats: Splats, frame: int) -> Tensor:
    """F = V R (N, 3, 3) of the paper's cue: V = sqrt(A_t)/s_0 from the Gaussian's covariance (A_0 is isotropic), R its rotation."""
    variance, axes = torch.linalg.eigh(cues.covariances[frame].double())
    left = (
        (axes * variance.clamp(min=0).sqrt()[:, None])
        @ axes.mT
        / splats.scales[:, :1, None].double()
    )
    return left @ cues.rotation[frame].double()


def outlines(F: Tensor, centres: Tensor, axes: np.ndarray, radius: float) -> np.ndarray:
    """Projected outlines (N, 40, 2) [m] of the images under F (N, 3, 3) of balls of `radius` [m]; axes (2, 3) of the picture."""
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    direction = np.stack([np.cos(angle), np.sin(angle)], -1)
    seen = np.einsum("pi,nij->npj", axes, F.numpy())
    flat = np.einsum("npj,nqj->npq", seen, seen)
    # support point of an ellipse M in direction d: M d / sqrt(d M d)
    length = np.sqrt(np.einsum("ap,npq,aq->na", direction, flat, direction))
    return (
        radius * np.einsum("npq,aq->nap", flat, direction) / length[..., None]
        + (centres.double().numpy() @ axes.T)[:, None]
    )


def save(figure: plt.Figure, file: Path) -> None:
    """As a PNG of 128 colours, a third of the size."""
    figure.savefig(file, dpi=105)
    plt.close(figure)
    Image.open(file).convert("RGB").quantize(128, dither=Image.Dither.NONE).save(
        file, optimize=True
    )


def ellipsoids(shape: str, args: argparse.Namespace) -> Path:
    """A layer of particles through the middle: the truth, and both forms at 12 cameras; a row per frame."""
    rows: dict[int, list] = {}
    for fit in ("carried", "free"):
        scene, result, neighbours = reconstructed(
            shape, "cameras_12", fit, args.out, args.particles, args.seed
        )
        rest, positions = result.splats.means, result.cues.positions
        true = true_motion(scene.truth, rest)
        squashed = int((true.stretch - 1).abs().amax(-1).median(dim=1).values.argmax())
        layer = (rest[:, 2] - rest[:, 2].median()).abs() < 0.6 * result.spacing
        for t in args.frames or (squashed, scene.frames - 1):
            if fit == "carried":
                F = neighbourhood(rest, neighbours=neighbours).deformation(positions[t])
                drawn = [
                    ("true", true.positions[t], true.deformation[t]),
                    (FORMS[fit, "neighbourhood"], positions[t], F),
                ]
            else:
                drawn = [
                    (
                        FORMS[fit, "gaussian"],
                        positions[t],
                        deformation_of(result.cues, result.splats, t),
                    )
                ]
            rows.setdefault(t, []).extend(
                (title, x[layer], F[layer].double(), true.rotation[t][layer])
                for title, x, F in drawn
            )
    figure, plots = plt.subplots(
        len(rows),
        3,
        figsize=(10, 3.3 * len(rows)),
        sharey="row",
        squeeze=False,
        layout="constrained",
    )
    for plot, (t, panel) in zip(
        plots.flat, ((t, panel) for t, panels in rows.items() for panel in panels)
    ):
        drawn = draw_layer(
            plot, t, *panel, radius=0.42 * result.spacing, exaggeration=args.exaggeration
        )
    figure.colorbar(drawn, ax=plots, shrink=0.6).set_label("rotation error [degrees]", fontsize=8)
    figure.suptitle(
        f"{shape} (synthetic), middle layer; heights in m, stretches drawn {args.exaggeration:g} times as large",
        fontsize=9,
    )
    file = args.to / f"cues_ellipsoids_{shape}.png"
    save(figure, file)
    return file


def draw_layer(
    plot,
    t: int,
    title: str,
    where: Tensor,
    F: Tensor,
    true: Tensor,
    *,
    radius: float,
    exaggeration: float,
):
    """Ellipsoids with F (N, 3, 3) at `where` (N, 3) [m], seen along z, coloured by the angle [degrees] from the true rotation."""
    R, _ = polar(F)
    U, S, Vh = torch.linalg.svd(F)
    shown = (U * (1 + exaggeration * (S - 1)).clamp(0.2, 2.5)[:, None]) @ Vh
    error = rotation_error(R, true).numpy()
    shapes = outlines(shown, where, np.eye(3)[:2], radius)
    drawn = plot.add_collection(
        PolyCollection(shapes, array=error, cmap="viridis", clim=(0, 10), ec="#333333", lw=0.3)
    )
    # where the rest x axis points to: shows the rotation
    line, centre = radius * R[:, :2, 0].numpy(), where[:, :2].numpy()
    plot.plot(*np.stack([centre - line, centre + line]).transpose(2, 0, 1), color="white", lw=0.7)
    strain = float((S - 1).abs().amax(1).median())
    medians = f"rotation error {np.median(error):.1f} deg, largest |stretch - 1| {strain:.3f}"
    plot.set_title(f"{title}, frame {t}\nmedians: {medians}", fontsize=7)
    plot.set_aspect("equal")
    plot.tick_params(labelsize=7)
    plot.autoscale_view()
    return drawn


def bars(shapes: list[str], out: Path, to: Path, particles: int, seed: int) -> Path:
    """Median (bar) and 90th percentile (line) of rotation and stretch, by condition."""
    figure, plots = plt.subplots(
        len(shapes),
        2,
        figsize=(10, 2.7 * len(shapes)),
        squeeze=False,
        layout="constrained",
        sharey="col",
    )
    for row, shape in zip(plots, shapes):
        lines = []
        for condition in CONDITIONS:
            for fit in ("carried", "free"):
                file = out / f"{shape}-{condition}-{fit}-{particles}-{seed}.json"
                lines += json.loads(file.read_text()) if file.exists() else []
        for plot, name, title, aim in zip(
            row, ("rotation_deg", "stretch"), ("rotation [degrees]", "stretch"), (3.0, 0.02)
        ):
            for k, (key, label) in enumerate(FORMS.items()):
                found = {
                    line["condition"]: line for line in lines if (line["fit"], line["form"]) == key
                }
                x = np.array([i for i, c in enumerate(CONDITIONS) if c in found]) + 0.27 * (k - 1)
                median, high = (
                    [found[c][f"{name}_{part}"] for c in CONDITIONS if c in found]
                    for part in ("median", "p90")
                )
                plot.bar(x, median, 0.25, color=COLORS[k], label=label)
                plot.vlines(x, median, high, color="#222222", lw=1.2)
            silence = [line[f"{name}_median"] for line in lines if line["form"] == "motionless"]
            for value in silence:
                plot.axhline(value, color="#888888", ls=":", lw=1, label="no cue (median)")
            plot.axhline(aim, color="#009e73", ls="--", lw=1, label="aim at 12 cameras")
            plot.set_yscale("log")
            plot.set_xticks(
                range(len(CONDITIONS)), [c.replace("_", "\n") for c in CONDITIONS], fontsize=7
            )
            plot.set_title(f"{shape}: {title}", fontsize=9)
            plot.tick_params(axis="y", labelsize=7)
            plot.set_ylim(*((0.3, 60) if name == "rotation_deg" else (0.002, 0.3)))
    handles, labels = plots[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=7, loc="outside lower center", ncols=5)
    file = to / "cues_errors.png"
    save(figure, file)
    return file


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shapes", nargs="+", default=["rabbit", "chick1"])
    parser.add_argument(
        "--frames", type=int, nargs="+", help="default: that of the largest stretches, and the last"
    )
    parser.add_argument("--exaggeration", type=float, default=2.0)
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("outputs/cues"))
    parser.add_argument("--to", type=Path, default=Path("docs/images"))
    args = parser.parse_args()
    args.to.mkdir(parents=True, exist_ok=True)
    print(bars(args.shapes, args.out, args.to, args.particles, args.seed))
    for shape in args.shapes:
        print(ellipsoids(shape, args))


if __name__ == "__main__":
    main()

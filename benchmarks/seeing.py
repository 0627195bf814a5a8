"""What the reconstruction of the real bird is worth: a camera that no stage has seen, volume, free flight; and pictures of it.

    OMP_NUM_THREADS=1 python benchmarks/seeing.py                                  # a line with the defaults of train.py
    OMP_NUM_THREADS=1 python benchmarks/seeing.py scene.scale=0.5                  # a line with other settings
    OMP_NUM_THREADS=1 python benchmarks/seeing.py --table                          # print what has been measured
    OMP_NUM_THREADS=1 python benchmarks/seeing.py scene.scale=0.5 --pictures docs/images
    OMP_NUM_THREADS=1 python benchmarks/seeing.py --scene rabbit --pictures docs/images    # pictures only

The arguments are overrides of conf/train.yaml, as train.py takes them; the line is named by them. The scene is PAC-NeRF's bird
(conf/scene/pacnerf_bird.yaml), camera 5 is held out of every stage. `derived/visual_hull_track.json` of the scene's folder is read
here for comparing, after the reconstruction, which never opens it.

Every finished line lies as JSON under --out and is not measured again; stages of a reconstruction are cached beside it.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import torch
from cues_pictures import outlines, save
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf import DictConfig
from PIL import Image
from torch import Tensor

from mosa.analysis.figures import label, to_uint8
from mosa.analysis.flow_colors import color_wheel, flow_colors
from mosa.assembly import Run, assemble
from mosa.data.footage import read_json
from mosa.data.scene import under
from mosa.errors import MosaError
from mosa.evaluation import image_metrics
from mosa.modules.observer import Views, observe
from mosa.reconstruction.cues import neighbourhood, polar
from mosa.reconstruction.filling import body_volume
from mosa.reconstruction.hull import hull_bounds, visual_hull
from mosa.reconstruction.pipeline import object_geometry
from mosa.reconstruction.settings import ReconstructionSettings
from mosa.reconstruction.starts import first_contact, sequence_start
from mosa.rendering.cameras import crop_boxes, crop_images, project
from mosa.rendering.covariance import covariance_from
from mosa.types import Cameras, Reconstruction, Scene

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.collections import PolyCollection

CONF = Path(__file__).parents[1] / "conf"
BIRD, HELD = "pacnerf_bird", "5"
"""The camera that is held out. val and test of the scene's own split repeat camera 0, which is a training camera there."""
DARK = 0.35
"""Largest channel of a pixel that is no bird: its own pixels are brighter in all cameras and frames before contact."""
ASKED = {"iou": 0.97, "volume": 0.05, "gravity": 0.01, "velocity_m_s": 0.01}


@dataclass(frozen=True)
class Seen:
    """A reconstruction and what the held-out camera sees of it. views: one camera; silhouette: (T, H, W) of the bare particles."""

    run: Run
    scene: Scene
    settings: ReconstructionSettings
    result: Reconstruction
    views: Views
    silhouette: Tensor
    camera: int


def configuration(overrides: list[str], out: Path, scene: str = BIRD) -> DictConfig:
    with initialize_config_dir(str(CONF.resolve()), version_base=None):
        return compose("train", [f"scene={scene}", f"scene.holdout_cameras=[{HELD}]", f"scene.cache={out}/cache", *overrides])


def see(cfg: DictConfig) -> Seen:
    """Reconstruct (or take from the cache) and render from the held-out camera."""
    run = assemble(cfg)
    scene, result = run.scene, run.reconstruction
    camera = scene.cameras.names.index(HELD)
    splats, cues, view = result.splats, result.cues, scene.cameras.select([camera])
    with torch.no_grad():
        views = observe(cues.positions, cues.covariances, splats.opacities, splats.colors, view, scene.background, flow=True)
    return Seen(run, scene, run.reconstruction_settings, result, views, balls(cues.positions, result.volume, view), camera)


def balls(positions: Tensor, volume: Tensor, view: Cameras, finer: int = 8) -> Tensor:
    """Coverage (T, H, W) of the image of one camera by particles (T, N, 3) [m] as balls of their volumes (N,) [m^3]."""
    pixels, depth = project(positions.reshape(-1, 3), view)
    radius = (3 * volume / (4 * np.pi)) ** (1 / 3)
    size = view.K[0, 0, 0] * radius.repeat(len(positions)) / depth[0]
    frame = torch.arange(len(positions)).repeat_interleave(len(volume)).tolist()
    pictures = np.zeros((len(positions), view.height * finer, view.width * finer), np.uint8)
    # OpenCV's pixel centres are at integers; shift: 4 binary digits after the point
    places = ((pixels[0] * finer - 0.5) * 16).round().int().tolist()
    for t, place, r in zip(frame, places, (size * finer * 16).round().int().tolist()):
        cv2.circle(pictures[t], place, r, 1, cv2.FILLED, shift=4)
    return torch.from_numpy(pictures).unflatten(1, (-1, finer)).unflatten(3, (-1, finer)).float().mean((2, 4))


def overlap(alpha: Tensor, mattes: Tensor) -> list[float]:
    """Intersection over union per frame of (T, H, W) and (T, H, W), both cut at 0.5."""
    a, b = alpha > 0.5, mattes > 0.5
    return ((a & b).sum((1, 2)) / (a | b).sum((1, 2))).tolist()


def area_ratio(alpha: Tensor, mattes: Tensor) -> float:
    """Area of (T, H, W) over that of (T, H, W), both cut at 0.5; above 1: too thick."""
    return float((alpha > 0.5).sum() / (mattes > 0.5).sum())


def held_out_figures(seen: Seen) -> dict:
    """Images and silhouettes of the held-out camera."""
    scene, camera, splats = seen.scene, [seen.camera], seen.result.static
    covariances = covariance_from(splats.scales, splats.rotations)[None]
    view = scene.cameras.select(camera)
    with torch.no_grad():
        static = observe(splats.means[None], covariances, splats.opacities, splats.colors, view, scene.background)
    images, frames = seen.views.images.clamp(0, 1), list(range(scene.frames))
    return {
        "static": image_metrics(static.images.clamp(0, 1), scene, camera, [0]),
        "static_iou": overlap(static.mattes[0], scene.mattes[camera[0], :1])[0],
        "particles_frame_0": image_metrics(images, scene, camera, [0]),
        "dynamic": image_metrics(images, scene, camera, frames),
        "per_frame": [image_metrics(images, scene, camera, [t]) for t in frames],
        "training_cameras": training_figures(seen),
        "iou": overlap(seen.views.mattes[0], scene.mattes[camera[0]]),
        "area_ratio": area_ratio(seen.views.mattes[0], scene.mattes[camera[0]]),
        "iou_balls": overlap(seen.silhouette, scene.mattes[camera[0]]),
        "area_ratio_balls": area_ratio(seen.silhouette, scene.mattes[camera[0]]),
    }


def training_figures(seen: Seen) -> dict:
    """The same means over the cameras that were trained on: what is missing there is not a matter of the held-out view."""
    scene, cameras = seen.scene, seen.scene.training_cameras
    views = [view_of(seen, camera) for camera in cameras]
    ious = [overlap(v.mattes[0], scene.mattes[camera]) for v, camera in zip(views, cameras)]
    images = torch.cat([v.images for v in views]).clamp(0, 1)
    return image_metrics(images, scene, cameras, scene.training_frames) | {"iou": float(np.mean(ious))}


def view_of(seen: Seen, camera: int) -> Views:
    cues, splats, view = seen.result.cues, seen.result.splats, seen.scene.cameras.select([camera])
    with torch.no_grad():
        return observe(cues.positions, cues.covariances, splats.opacities, splats.colors, view, seen.scene.background)


def shadow_figures(seen: Seen) -> dict:
    """Per camera and frame: share of the matte that is darker than the object ever is in free flight, and IoU. Mattes of footage
    take in a piece of the shadow under the object where it touches the ground."""
    scene = seen.scene
    dark = (scene.images.amax(-1) < DARK) & (scene.mattes > 0.5)
    share = dark.sum((2, 3)) / (scene.mattes > 0.5).sum((2, 3))
    ious = [overlap(view_of(seen, camera).mattes[0], scene.mattes[camera]) for camera in range(len(scene.cameras))]
    return {"cameras": list(scene.cameras.names), "dark": share.tolist(), "iou": ious}


def volume_figures(seen: Seen, published: dict) -> dict:
    """Volumes [m^3] at frame 0: particles, what they are filled from, visual hulls, and that of the scene's folder."""
    scene, settings = seen.scene, seen.settings
    result = {"published_hull": published["frames"][0]["volume"], "particles": float(seen.result.volume.sum()),
              "filled_hull": body_volume(object_geometry(scene, settings).body)}  # fmt: skip
    for name, cameras in (("hull_training_cameras", scene.training_cameras), ("hull_all_cameras", list(range(len(scene.cameras))))):
        mattes, views = scene.mattes[cameras, 0], scene.cameras.select(cameras)
        bounds = hull_bounds(mattes, views, scene.box)
        pitch = float((bounds[1] - bounds[0]).max()) / settings.resolution
        result[name] = visual_hull(mattes, views, scene.box, pitch=pitch).occupied_volume()
    return result


def flight_figures(seen: Seen, published: dict) -> dict:
    """Parabola through the centre of mass over the free frames, and the velocity that learning starts from."""
    scene, result, body = seen.scene, seen.result, seen.run.body
    start = sequence_start(body, result.splats, scene, register=False)
    free = first_contact(body, start, scene)
    weight = (result.volume / result.volume.sum()).double()
    centre = torch.einsum("n,tna->ta", weight, result.cues.positions[:free].double()).numpy()
    times = (scene.times - scene.times[0])[:free].double().numpy()
    fit, residual, *_ = np.polyfit(times, centre, 2, full=True)
    true = np.array([published[f"{axis}0"] for axis in ("vx", "vy", "vz")])
    up = scene.up.double().numpy()
    fallen = 0.5 * scene.gravity.double().numpy() * times[:, None] ** 2
    return {
        "free_frames": free,
        "gravity_m_s2": float(-2 * fit[0] @ up),
        "true_gravity_m_s2": float(-scene.gravity.double().numpy() @ up),
        "velocity_m_s": fit[1].tolist(),
        "velocity_given_gravity_m_s": np.polyfit(times, centre - fallen, 1)[0].tolist(),
        "start_velocity_m_s": start.velocity.tolist(),
        "published_velocity_m_s": true.tolist(),
        "fit_rms_m": float(np.sqrt(residual.sum() / free)),
    }


def real_flow(seen: Seen) -> Tensor:
    """Optical flow (T - 1, H, W, 2) [px] of the held-out camera's own images (DIS, Kroeger et al. 2016): an estimate, no truth."""
    gray = [cv2.cvtColor(to_uint8(image), cv2.COLOR_RGB2GRAY) for image in seen.scene.images[seen.camera]]
    estimate = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return torch.from_numpy(np.stack([estimate.calc(a, b, None) for a, b in itertools.pairwise(gray)]))


def flow_figures(seen: Seen) -> dict:
    """Difference of Gaussian flow and optical flow [px] where matte and alpha are above 0.5."""
    inside = (seen.scene.mattes[seen.camera, :-1] > 0.5) & (seen.views.mattes[0, :-1] > 0.5)
    found, real = seen.views.flow[0][inside], real_flow(seen)[inside]
    error, length = (found - real).norm(dim=-1).double(), real.norm(dim=-1).double()
    result = {"median_px": error.median(), "p90_px": error.quantile(0.9), "optical_flow_median_px": length.median()}
    return {name: float(value) for name, value in result.items()}


def measure(overrides: list[str], out: Path) -> dict:
    cfg = configuration(overrides, out)
    # before the minutes of the reconstruction: a copy of the scene may have come without it
    published = read_json(under(cfg.scene.root, cfg.scene.path) / "derived" / "visual_hull_track.json")
    seen = see(cfg)
    return {
        "overrides": overrides, "width_px": seen.scene.cameras.width, "particles": len(seen.result.volume),
        "spacing_m": seen.result.spacing, "seed": cfg.seed, "held_out": held_out_figures(seen),
        "volume": volume_figures(seen, published), "flight": flight_figures(seen, published), "flow": flow_figures(seen),
        "shadow": shadow_figures(seen),
    }  # fmt: skip


# --- tables -----------------------------------------------------------------------------------------------------------


def markdown(head: list[str], rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(cells) + " |" for cells in [head, ["---"] * len(head), *rows])


def name_of(line: dict) -> str:
    return f"`{' '.join(line['overrides'])}`" if line["overrides"] else "defaults"


def verdict(met: bool) -> str:
    return "met" if met else "missed"


def image_row(line: dict) -> dict[str, str]:
    held = line["held_out"]
    training = held["training_cameras"]
    pair = "{psnr_full:.2f} / {psnr_crop:.2f}".format_map
    return {
        "width [px]": str(line["width_px"]),
        "particles": str(line["particles"]),
        "static, frame 0: psnr_full / psnr_crop": pair(held["static"]),
        "particles, frame 0: psnr_full / psnr_crop": pair(held["particles_frame_0"]),
        "all frames: psnr_full / psnr_crop": pair(held["dynamic"]),
        "ssim_crop": f"{held['dynamic']['ssim_crop']:.4f}",
        "training cameras: psnr_crop, ssim_crop": f"{training['psnr_crop']:.2f}, {training['ssim_crop']:.4f}",
        "flow - optical flow [px]": f"{line['flow']['median_px']:.2f} / {line['flow']['p90_px']:.2f}",
    }


def silhouette_row(line: dict) -> dict[str, str]:
    held = line["held_out"]
    mean = float(np.mean(held["iou"]))
    below = [str(t) for t, value in enumerate(held["iou"]) if value < ASKED["iou"]]
    return {
        f"IoU, mean; asked {ASKED['iou']:g}": f"{mean:.4f}, {verdict(mean >= ASKED['iou'])}",
        "smallest": f"{min(held['iou']):.4f}",
        "frames below": ", ".join(below) or "none",
        "training cameras, mean": f"{held['training_cameras']['iou']:.4f}",
        "area, rendered / matte": f"{held['area_ratio']:.3f}",
        "bare balls: IoU, area": f"{np.mean(held['iou_balls']):.4f}, {held['area_ratio_balls']:.3f}",
    }


def volume_row(line: dict) -> dict[str, str]:
    volume = {name: 1e3 * value for name, value in line["volume"].items()}
    below = 1 - volume["particles"] / volume["published_hull"]
    return {
        "particles [l]": f"{volume['particles']:.2f}",
        "published hull [l]": f"{volume['published_hull']:.2f}",
        f"below it; asked 0 to {ASKED['volume']:.0%}": f"{below:.1%}, {verdict(0 <= below <= ASKED['volume'])}",
        "own hull before shaving, 10 / 11 cameras [l]": f"{volume['hull_training_cameras']:.2f} / {volume['hull_all_cameras']:.2f}",
    }


def flight_row(line: dict) -> dict[str, str]:
    flight = line["flight"]
    off = flight["gravity_m_s2"] / flight["true_gravity_m_s2"] - 1
    wrong = float(np.linalg.norm(np.subtract(flight["velocity_m_s"], flight["published_velocity_m_s"])))
    right = verdict(abs(off) <= ASKED["gravity"])
    return {
        "free frames": f"0 to {flight['free_frames'] - 1}",
        f"g [m/s^2]; asked {ASKED['gravity']:.0%}": f"{flight['gravity_m_s2']:.3f} ({off:+.2%}), {right}",
        "v0 [m/s]": vector(flight["velocity_m_s"]),
        f"its error [m/s]; asked {ASKED['velocity_m_s']:g}": f"{wrong:.4f}, {verdict(wrong <= ASKED['velocity_m_s'])}",
        "v0, g given [m/s]": vector(flight["velocity_given_gravity_m_s"]),
        "v0 that learning starts from [m/s]": vector(flight["start_velocity_m_s"]),
        "RMS of the fit [mm]": f"{1e3 * flight['fit_rms_m']:.2f}",
    }


def tables(lines: list[dict]) -> str:
    """Markdown: images, silhouettes, volume, flight, and the frames of each line."""
    blocks = []
    for cells in (image_row, silhouette_row, volume_row, flight_row):
        rows = [{"line": name_of(line)} | cells(line) for line in lines]
        blocks.append(markdown(list(rows[0]), [list(row.values()) for row in rows]))
    frames = []
    for line in lines:
        held = line["held_out"]
        for key, pattern in (("psnr_crop", "{:.2f}"), ("ssim_crop", "{:.4f}")):
            frames.append([name_of(line), key, *(pattern.format(f[key]) for f in held["per_frame"])])
        frames.append([name_of(line), "IoU", *(f"{x:.4f}" for x in held["iou"])])
    blocks.append(shadow_table(lines))
    return "\n\n".join([*blocks, markdown(["line", "frame", *map(str, range(len(frames[0]) - 2))], frames)])


def shadow_table(lines: list[dict]) -> str:
    """The frame with the most dark pixels in its mattes: dark share / IoU of every camera."""
    rows = []
    for line in lines:
        dark, iou = np.array(line["shadow"]["dark"]), np.array(line["shadow"]["iou"])
        t = int(dark.mean(0).argmax())
        before = dark[:, : line["flight"]["free_frames"]].max()
        rows.append([name_of(line), str(t), f"{before:.1%}", *(f"{d:.1%} / {i:.3f}" for d, i in zip(dark[:, t], iou[:, t]))])
    return markdown(["line", "frame", "most in free flight", *(f"camera {c}" for c in lines[0]["shadow"]["cameras"])], rows)


def vector(values: list[float]) -> str:
    return "(" + ", ".join(f"{v:.3f}" for v in values) + ")"


# --- pictures ---------------------------------------------------------------------------------------------------------


def write(rows: dict[str, Tensor], file: Path, enlarge: int, legend: np.ndarray | None = None) -> Path:
    """One captioned row per entry (T, h, w, 3), as a PNG; `legend` is put in the upper right, beside them."""
    parts = []
    for name, images in rows.items():
        row = np.concatenate([to_uint8(image) for image in images], 1)
        row = cv2.resize(row, None, fx=enlarge, fy=enlarge, interpolation=cv2.INTER_CUBIC) if enlarge > 1 else row
        parts.append(label(row, name))
    picture = np.concatenate(parts)
    if legend is not None:
        column = np.full((len(picture), legend.shape[1], 3), 255, np.uint8)
        column[: len(legend)] = legend
        picture = np.concatenate([picture, column], 1)
    # a colour wheel needs all its colours; photographs do with 256, at a third of the size
    image = Image.fromarray(picture)
    (image if legend is not None else image.quantize(256, dither=Image.Dither.NONE)).save(file, optimize=True)
    return file


def silhouette_errors(alpha: Tensor, mattes: Tensor) -> Tensor:
    """(T, H, W, 3): grey where both are, red where the matte is not covered, blue where the render stands over."""
    a, b = alpha > 0.5, mattes > 0.5
    picture = torch.ones(*a.shape, 3)
    for where, color in ((a & b, (0.8, 0.8, 0.8)), (b & ~a, (0.85, 0.1, 0.1)), (a & ~b, (0.1, 0.2, 0.9))):
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
        "optical flow of the real images (DIS), inside the matte": cut(flow_colors(optical, largest), steps),
    }
    files.append(write(rows, to / f"seeing_{scene.name}_flow.png", enlarge, to_uint8(color_wheel(96))))
    return [*files, ellipsoids(seen, to / f"seeing_{scene.name}_ellipsoids.png")]


def ellipsoids(seen: Seen, file: Path, exaggeration: float = 2.0) -> Path:
    """Rest balls of a layer of particles, deformed by the cue: frame of the largest stretches and the last, from two sides."""
    result = seen.result
    rest, positions = result.splats.means, result.cues.positions
    F = neighbourhood(rest, neighbours=seen.settings.neighbours).deformation(positions)
    squashed = int((result.cues.stretch - 1).abs().amax(-1).median(dim=1).values.argmax())
    figure, plots = plt.subplots(2, 2, figsize=(10, 6.4), layout="constrained")
    for row, t in zip(plots, (squashed, len(positions) - 1)):
        for plot, (axis, seen_axes, title) in zip(row, ((2, (0, 1), "along z"), (1, (0, 2), "along y, from above"))):
            layer = (rest[:, axis] - rest[:, axis].median()).abs() < 0.6 * result.spacing
            # stretches exaggerated about 1; the rotation is kept
            U, S, Vh = torch.linalg.svd(F[t, layer].double())
            R, _ = polar(F[t, layer].double())
            drawn = (U * (1 + exaggeration * (S - 1)).clamp(0.2, 2.5)[:, None]) @ Vh
            axes = np.eye(3)[list(seen_axes)]
            strain, radius = (S - 1).abs().amax(1), 0.42 * result.spacing
            shapes = outlines(drawn, positions[t, layer], axes, radius)
            balls_drawn = PolyCollection(shapes, array=strain.numpy(), cmap="viridis", clim=(0, 0.2), ec="#333333", lw=0.3)
            mapped = plot.add_collection(balls_drawn)
            # where the rest x axis points to: shows the rotation
            line, centre = radius * R[:, :, 0].numpy() @ axes.T, positions[t, layer].numpy() @ axes.T
            plot.plot(*np.stack([centre - line, centre + line]).transpose(2, 0, 1), color="white", lw=0.7)
            plot.set_title(f"frame {t}, seen {title}; largest |stretch - 1|: median {float(strain.median()):.3f}", fontsize=7)
            plot.set_xlabel("xyz"[seen_axes[0]] + " [m]", fontsize=7)
            plot.set_ylabel("xyz"[seen_axes[1]] + " [m]", fontsize=7)
            plot.set_aspect("equal")
            plot.tick_params(labelsize=7)
            plot.autoscale_view()
    figure.colorbar(mapped, ax=plots, shrink=0.6).set_label("largest |stretch - 1| (not exaggerated)", fontsize=8)
    what = "synthetic" if seen.scene.synthetic else "real footage"
    title = f"{seen.scene.name} ({what}), a layer through the middle; stretches drawn {exaggeration:g} times as large"
    figure.suptitle(title, fontsize=9)
    save(figure, file)
    return file


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("overrides", nargs="*", help="of conf/train.yaml, e.g. scene.scale=0.5 simulation.particles=2000")
    parser.add_argument("--out", type=Path, default=Path("outputs/seeing"), help="results and cached stages")
    parser.add_argument("--scene", default=BIRD, help="pictures only, of another scene")
    parser.add_argument("--table", action="store_true", help="only print what has been measured, all lines")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="also draw the pictures of this line")
    args = parser.parse_args()
    if args.table:
        lines = [json.loads(file.read_text()) for file in args.out.glob("*.json")]
        if not lines:
            parser.error(f"--table: nothing has been measured into {args.out}; run it without --table first")
        print(tables(sorted(lines, key=lambda line: (len(line["overrides"]), line["overrides"]))))
        return
    if args.scene != BIRD:  # no figures to compare with, but pictures
        for picture in pictures(see(configuration(args.overrides, args.out, args.scene)), args.pictures or args.out):
            print(picture)
        return
    # the order of overrides matters to hydra: it is kept
    file = args.out / f"bird-{hashlib.sha256(' '.join(args.overrides).encode()).hexdigest()[:8]}.json"
    if not file.exists():
        print(f"bird, {' '.join(args.overrides) or 'defaults'}", file=sys.stderr)
        args.out.mkdir(parents=True, exist_ok=True)
        measured = measure(args.overrides, args.out)
        partial = file.with_suffix(".tmp")
        partial.write_text(json.dumps(measured, indent=1))
        partial.replace(file)
    print(tables([json.loads(file.read_text())]))
    if args.pictures:
        for picture in pictures(see(configuration(args.overrides, args.out)), args.pictures):
            print(picture)


if __name__ == "__main__":
    try:
        main()
    except (MosaError, HydraException) as error:
        sys.exit(f"{type(error).__name__}: {error}")

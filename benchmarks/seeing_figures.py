"""The figures of seeing.py: images, outlines, volume, free flight and flow, from a camera that no stage has seen."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig
from torch import Tensor

from mosa.data.formats.footage import read_json
from mosa.data.hull import hull_bounds, visual_hull
from mosa.data.scene import under
from mosa.evaluation.analysis.figures import to_uint8
from mosa.evaluation.evaluate import image_metrics
from mosa.reconstruction.geometry.filling import body_volume
from mosa.reconstruction.pipeline import object_geometry
from mosa.reconstruction.pose.starts import appearance_of, first_contact, sequence_start
from mosa.reconstruction.settings import ReconstructionSettings
from mosa.rendering.cameras import project
from mosa.rendering.covariance import covariance_from
from mosa.rendering.observer import Views, observe
from mosa.training.assembly import Run, assemble
from mosa.types import Cameras, Reconstruction, Scene

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
        return compose(
            "train",
            [
                f"scene={scene}",
                f"scene.holdout_cameras=[{HELD}]",
                f"scene.cache={out}/cache",
                *overrides,
            ],
        )


def see(cfg: DictConfig) -> Seen:
    """Reconstruct (or take from the cache) and render from the held-out camera."""
    run = assemble(cfg)
    scene, result = run.scene, run.reconstruction
    camera = scene.cameras.names.index(HELD)
    splats, cues, view = result.splats, result.cues, scene.cameras.select([camera])
    with torch.no_grad():
        views = observe(
            cues.positions,
            cues.covariances,
            splats.opacities,
            splats.colors,
            view,
            scene.background,
            flow=True,
        )
    return Seen(
        run,
        scene,
        run.data.reconstruction_settings,
        result,
        views,
        balls(cues.positions, result.volume, view),
        camera,
    )


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
    return (
        torch.from_numpy(pictures)
        .unflatten(1, (-1, finer))
        .unflatten(3, (-1, finer))
        .float()
        .mean((2, 4))
    )


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
        static = observe(
            splats.means[None], covariances, splats.opacities, splats.colors, view, scene.background
        )
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
    return image_metrics(images, scene, cameras, scene.training_frames) | {
        "iou": float(np.mean(ious))
    }


def view_of(seen: Seen, camera: int) -> Views:
    cues, splats, view = seen.result.cues, seen.result.splats, seen.scene.cameras.select([camera])
    with torch.no_grad():
        return observe(
            cues.positions,
            cues.covariances,
            splats.opacities,
            splats.colors,
            view,
            seen.scene.background,
        )


def shadow_figures(seen: Seen) -> dict:
    """Per camera and frame: share of the matte that is darker than the object ever is in free flight, and IoU. Mattes of footage
    take in a piece of the shadow under the object where it touches the ground."""
    scene = seen.scene
    dark = (scene.images.amax(-1) < DARK) & (scene.mattes > 0.5)
    share = dark.sum((2, 3)) / (scene.mattes > 0.5).sum((2, 3))
    ious = [
        overlap(view_of(seen, camera).mattes[0], scene.mattes[camera])
        for camera in range(len(scene.cameras))
    ]
    return {"cameras": list(scene.cameras.names), "dark": share.tolist(), "iou": ious}


def volume_figures(seen: Seen, published: dict) -> dict:
    """Volumes [m^3] at frame 0: particles, what they are filled from, visual hulls, and that of the scene's folder."""
    scene, settings = seen.scene, seen.settings
    result = {"published_hull": published["frames"][0]["volume"], "particles": float(seen.result.volume.sum()),
              "filled_hull": body_volume(object_geometry(scene, settings).body)}  # fmt: skip
    for name, cameras in (
        ("hull_training_cameras", scene.training_cameras),
        ("hull_all_cameras", list(range(len(scene.cameras)))),
    ):
        mattes, views = scene.mattes[cameras, 0], scene.cameras.select(cameras)
        bounds = hull_bounds(mattes, views, scene.box)
        pitch = float((bounds[1] - bounds[0]).max()) / settings.resolution
        result[name] = visual_hull(mattes, views, scene.box, pitch=pitch).occupied_volume()
    return result


def flight_figures(seen: Seen, published: dict) -> dict:
    """Parabola through the centre of mass over the free frames, and the velocity that learning starts from."""
    scene, result, body = seen.scene, seen.result, seen.run.body
    start = sequence_start(body, appearance_of(body), scene, register=False)
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
    gray = [
        cv2.cvtColor(to_uint8(image), cv2.COLOR_RGB2GRAY)
        for image in seen.scene.images[seen.camera]
    ]
    estimate = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return torch.from_numpy(
        np.stack([estimate.calc(a, b, None) for a, b in itertools.pairwise(gray)])
    )


def flow_figures(seen: Seen) -> dict:
    """Difference of Gaussian flow and optical flow [px] where matte and alpha are above 0.5."""
    inside = (seen.scene.mattes[seen.camera, :-1] > 0.5) & (seen.views.mattes[0, :-1] > 0.5)
    found, real = seen.views.flow[0][inside], real_flow(seen)[inside]
    error, length = (found - real).norm(dim=-1).double(), real.norm(dim=-1).double()
    result = {
        "median_px": error.median(),
        "p90_px": error.quantile(0.9),
        "optical_flow_median_px": length.median(),
    }
    return {name: float(value) for name, value in result.items()}


def measure(overrides: list[str], out: Path) -> dict:
    cfg = configuration(overrides, out)
    # before the minutes of the reconstruction: a copy of the scene may have come without it
    published = read_json(
        under(cfg.scene.root, cfg.scene.path) / "derived" / "visual_hull_track.json"
    )
    seen = see(cfg)
    return {
        "overrides": overrides, "width_px": seen.scene.cameras.width, "particles": len(seen.result.volume),
        "spacing_m": seen.result.spacing, "seed": cfg.seed, "held_out": held_out_figures(seen),
        "volume": volume_figures(seen, published), "flight": flight_figures(seen, published), "flow": flow_figures(seen),
        "shadow": shadow_figures(seen),
    }  # fmt: skip


# --- tables -----------------------------------------------------------------------------------------------------------

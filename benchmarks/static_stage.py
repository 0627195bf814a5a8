"""What start, densification and shape of the static stage are worth: frame 0 of a camera that the fit has not seen, CPU-seconds.

    OMP_NUM_THREADS=1 python benchmarks/static_stage.py                    # the table of docs/seeing.md; five minutes
    OMP_NUM_THREADS=1 python benchmarks/static_stage.py --scenes rabbit --seeds 0 reconstruction.static.iterations=800

Further arguments are overrides of conf/train.yaml for every line. PAC-NeRF's bird without camera 5 (reference data in MOSA_DATA)
and the built-in rabbit without camera 3. The seed is that of the start and of the order of views.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from hydra import compose, initialize_config_dir

from mosa.config.build import plain
from mosa.data.hull import Volume
from mosa.evaluation.evaluate import image_metrics
from mosa.reconstruction.gaussians.static import fit_splats, start_splats
from mosa.reconstruction.motion.observed import object_windows
from mosa.reconstruction.pipeline import object_geometry
from mosa.reconstruction.settings import ReconstructionSettings, build_settings
from mosa.rendering.covariance import covariance_from
from mosa.rendering.observer import observe
from mosa.training.assembly import scenes
from mosa.types import Scene

CONF = Path(__file__).parents[1] / "conf"
HELD = {"pacnerf_bird": 5, "rabbit": 3}
GROWN = ["points=1000", "static.densify=mcmc", "static.max_points=3000"]
FREE = ["static.shape=anisotropic"]
LINES = [
    [],
    ["points=1000"],
    GROWN,
    ["static.densify=mcmc"],
    ["static.start=random"],
    ["static.start=random", "static.densify=mcmc"],
    FREE,
    GROWN + FREE,
    ["static.densify=mcmc", *FREE],
    ["static.start=random", "static.densify=mcmc", *FREE],
]


def settings_of(name: str, overrides: list[str]) -> tuple[Scene, ReconstructionSettings]:
    with initialize_config_dir(str(CONF.resolve()), version_base=None):
        cfg = compose(
            "train", [f"scene={name}", f"scene.holdout_cameras=[{HELD[name]}]", *overrides]
        )
    return scenes(cfg)[0], build_settings(**plain(cfg.reconstruction))


def figures(
    scene: Scene, camera: int, hull: Volume, settings: ReconstructionSettings, seed: int
) -> dict[str, float]:
    """Fit once, render the camera. Seconds are those of the fit, on the CPU."""
    still = object_windows(
        scene, scene.training_cameras, scene.training_frames, margin=settings.margin
    ).of_frame(0)
    start = start_splats(hull, still, settings.static, count=settings.points, seed=seed)
    began = time.process_time()
    splats = fit_splats(start, still, scene.background, settings.static, move=True, seed=seed)
    seconds = time.process_time() - began
    covariances = covariance_from(splats.scales, splats.rotations)[None]
    with torch.no_grad():
        seen = observe(splats.means[None], covariances, splats.opacities, splats.colors, scene.cameras.select([camera]),
                       scene.background)  # fmt: skip
    result = image_metrics(seen.images.clamp(0, 1), scene, [camera], [0])
    return result | {"seconds": seconds, "count": len(splats.means)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=list(HELD), choices=list(HELD))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("overrides", nargs="*")
    args = parser.parse_args()
    torch.set_num_threads(1)
    print(
        "| reconstruction. | scene | psnr_full | psnr_crop | ssim_crop | Gaussians | CPU-seconds |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name in args.scenes:
        scene, settings = settings_of(name, args.overrides)
        hull = object_geometry(scene, settings).body
        for line in LINES:
            _, settings = settings_of(
                name, [f"reconstruction.{key}" for key in line] + args.overrides
            )
            found = [figures(scene, HELD[name], hull, settings, seed) for seed in args.seeds]
            cell = lambda key, digits: " / ".join(f"{f[key]:.{digits}f}" for f in found)  # noqa: B023, E731
            names = " ".join(f"`{key}`" for key in line) or "defaults"
            mean = float(np.mean([f["seconds"] for f in found]))
            print(
                f"| {names} | {name} | {cell('psnr_full', 2)} | {cell('psnr_crop', 2)} | {cell('ssim_crop', 4)} | "
                f"{cell('count', 0)} | {mean:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()

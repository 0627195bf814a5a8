"""Error of the motion cues against the true deformation of built-in scenes, per form, fit and condition.

    OMP_NUM_THREADS=1 python benchmarks/cues.py --shapes rabbit chick1 --conditions cameras_12 cameras_3 --fits carried free
    python benchmarks/cues.py --table            # print what has been measured, reconstruct nothing

A line of the table is a shape, a condition, a fit and a form. Fits: `carried`, the default (Gaussians follow the
deformation); `free`, the same with Gaussians of free scale and rotation, as the paper's cue needs; `network`, the paper's
motion-basis network (600 iterations instead of its 30,000). Forms: `neighbourhood`, `gaussian` (docs/cues.md).
Three forms frame them: `motionless` says nothing, `constant` gives every particle the rabbit's mean stretches, `true motion`
is the neighbourhood form of the true positions.

Every finished line lies as JSON under --out and is not measured again; stages of a reconstruction are cached beside it, so that
a stopped run goes on. Progress on stderr, the table on stdout. --neighbours also lists the neighbourhood form of the carried fit
with other numbers of neighbours.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import torch
import yaml
from cue_error import (
    USUAL_STRETCH,
    TrueMotion,
    cue_errors,
    motionless,
    strain_direction_error,
    true_motion,
)

from mosa.data.synthetic import load_builtin
from mosa.data.synthetic.bodies.objects import drop_named
from mosa.reconstruction.motion.cues import neighbourhood, neighbourhood_cues
from mosa.reconstruction.pipeline import reconstruct, spacing_for
from mosa.reconstruction.settings import ReconstructionSettings, build_settings
from mosa.rendering.covariance import covariance_from
from mosa.rendering.observer import observe
from mosa.types import MotionCues, Reconstruction, Scene

PRESET = Path(__file__).parents[1] / "conf" / "reconstruction" / "fast.yaml"
ITERATIONS = {
    "static": ("iterations",),
    "appearance": ("iterations",),
    "dynamic": ("track_iterations", "iterations"),
}
CONDITIONS = {
    "cameras_12": "12 cameras, 160 px",
    "cameras_6": "6 cameras",
    "cameras_3": "3 cameras",
    "half_resolution": "80 px",
    "eroded": "mattes eroded by 2 px",
    "dilated": "mattes dilated by 2 px",
    "early": "stopped at 25 %",
}
FLOORS = (1e-3, 0.005, 0.01, 0.02, 0.03, 0.05)
FITS = {
    "carried": {},
    "free": {"free_shape": True},
    "network": {"model": "network", "iterations": 600},
}
COLUMNS = {
    "rotation_deg": ("rotation [deg]", "{:.2f}", 1.0),
    "stretch": ("stretch", "{:.4f}", 1.0),
    "velocity_m_s": ("velocity [m/s]", "{:.3f}", 1.0),
    "flow_px": ("flow [px]", "{:.2f}", 1.0),
}


def scene_of(shape: str, condition: str) -> Scene:
    """The training sequence of a shape as the condition lets the reconstruction see it."""
    kept = {"cameras_6": range(0, 12, 2), "cameras_3": range(0, 12, 4)}.get(condition, range(12))
    held = [str(v) for v in range(12) if v not in kept]
    scene = load_builtin(
        name=shape, scale=0.2 if condition == "half_resolution" else 0.4, holdout_cameras=held
    )
    if condition not in ("eroded", "dilated"):
        return scene
    V, T, H, W = scene.mattes.shape
    flat, sign = scene.mattes.reshape(V * T, 1, H, W), -1 if condition == "eroded" else 1
    mattes = sign * torch.nn.functional.max_pool2d(sign * flat, 5, stride=1, padding=2)
    mattes = mattes.reshape(V, T, H, W)
    # what is cut away shows the background, as it would after matting; what is added keeps the pixels that are there
    part = (mattes / scene.mattes.clamp(min=1e-3)).clamp(max=1.0)[..., None]
    images = (
        part * scene.images + (1 - part) * scene.background
        if condition == "eroded"
        else scene.images
    )
    return replace(
        scene, images=images, mattes=mattes, fingerprint=f"{scene.fingerprint}-{condition}-2px"
    )


def settings_of(condition: str, fit: str) -> ReconstructionSettings:
    keys = yaml.safe_load(PRESET.read_text())
    keys["dynamic"] |= FITS[fit]
    keys["cue"] = "neighbourhood" if fit == "carried" else "gaussian"
    if condition == "early":
        for section, names in ITERATIONS.items():
            for name in names:
                keys[section][name] = max(1, keys[section][name] // 4)
    return build_settings(**keys)


def flow_error(
    found: MotionCues, true: TrueMotion, result: Reconstruction, scene: Scene, first: int
) -> dict[str, float]:
    """Median and 90th percentile of the error of Gaussian flow maps [px at a width of 160], over pixels where alpha > 0.5 at the
    frame, of four cameras of the ring; the true maps are those of the same Gaussians in their true motion."""
    rest = covariance_from(result.splats.scales, result.splats.rotations)
    moved = true.deformation @ rest @ true.deformation.transpose(-1, -2)
    views = scene.cameras.select(list(range(0, len(scene.cameras), 3)))
    splats = result.splats
    maps, alpha = [], None
    with torch.no_grad():
        for x, A in ((found.positions, found.covariances), (true.positions, moved)):
            seen = observe(
                x, A, splats.opacities, splats.colors, views, scene.background, flow=True
            )
            maps.append(seen.flow[:, first - 1 :])
            alpha = seen.mattes[:, first - 1 : -1]
    error = (maps[0] - maps[1]).norm(dim=-1)[alpha > 0.5].double() * 160 / scene.cameras.width
    return {"flow_px_median": float(error.quantile(0.5)), "flow_px_p90": float(error.quantile(0.9))}


def reconstructed(
    shape: str, condition: str, fit: str, out: Path, particles: int, seed: int
) -> tuple[Scene, Reconstruction, int]:
    """The scene, its reconstruction (from the cache where it lies there) and the number of neighbours of its cues."""
    scene, settings = scene_of(shape, condition), settings_of(condition, fit)
    spacing = spacing_for(scene, particles, settings)
    result = reconstruct(
        scene, settings=settings, spacing=spacing, cache_dir=out / "cache", seed=seed
    )
    return scene, result, settings.neighbours


def measure(
    shape: str, condition: str, fit: str, out: Path, particles: int, seed: int
) -> list[dict]:
    """Reconstruct and compare. One dictionary per form."""
    started = time.perf_counter()
    scene, result, neighbours = reconstructed(shape, condition, fit, out, particles, seed)
    seconds = time.perf_counter() - started
    true = true_motion(scene.truth, result.splats.means)
    # frames whose time is after first contact, as for rms_m (docs/figures.md)
    first = int((scene.times <= drop_named(shape, "train").contact).sum())
    around = neighbourhood(result.splats.means, neighbours=neighbours)
    positions, covariances = result.cues.positions, result.cues.covariances
    forms = {"neighbourhood": neighbourhood_cues(positions, covariances, around)}
    if fit != "carried":
        forms["gaussian"] = result.cues
    if fit == "carried" and condition == "cameras_12":
        forms["motionless"] = replace(
            motionless(true), covariances=covariances[:1].expand_as(covariances)
        )
        forms["constant"] = replace(
            forms["motionless"], stretch=torch.tensor(USUAL_STRETCH).expand_as(true.stretch)
        )
        rest = covariance_from(result.splats.scales, result.splats.rotations)
        floor = neighbourhood_cues(true.positions, covariances, around)
        F = around.deformation(true.positions)
        forms["true motion"] = replace(floor, covariances=F @ rest @ F.transpose(-1, -2))
    common = {"shape": shape, "condition": condition, "fit": fit, "particles": len(true.inside), "spacing_m": result.spacing,
              "frames": [first, scene.frames - 1], "seed": seed}  # fmt: skip
    lines = []
    for form, cues in forms.items():
        errors = cue_errors(cues, true, scene.times, first=first) | flow_error(
            cues, true, result, scene, first
        )
        floors = [strain_direction_error(cues, true, floor, first=first) for floor in FLOORS]
        lines.append(common | {"form": form, "seconds": seconds, "floors": floors} | errors)
    if fit == "carried":
        for count in (8, 12, 30, 50, 80):
            wider = neighbourhood_cues(
                positions, covariances, neighbourhood(result.splats.means, neighbours=count)
            )
            errors = cue_errors(wider, true, scene.times, first=first)
            lines.append(common | {"form": f"neighbourhood, {count}", "seconds": 0.0} | errors)
    return lines


def table(lines: list[dict], neighbours: bool) -> str:
    """Markdown. Median / 90th percentile per column."""
    head = [
        "shape",
        "condition",
        "fit",
        "form",
        *(title for title, _, _ in COLUMNS.values()),
        "stretch RMS / signal",
        "position RMS [mm]",
        "outside",
    ]
    rows = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for line in lines:
        if ("," in line["form"]) and not neighbours:
            continue
        cells = [line["shape"], CONDITIONS[line["condition"]], line["fit"], line["form"]]
        if line["form"] in ("motionless", "constant", "true motion"):
            cells[1:3] = ["-", "-"]
        for name, (_, pattern, unit) in COLUMNS.items():
            pair = [line.get(f"{name}_{part}") for part in ("median", "p90")]
            cells.append(
                "-" if pair[0] is None else " / ".join(pattern.format(x * unit) for x in pair)
            )
        cells.append(f"{line['stretch_rms'] / line['stretch_signal_rms']:.2f}")
        cells += [f"{1e3 * line['position_rms_m']:.1f}", f"{line['outside']:.1%}"]
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


def floor_table(lines: list[dict]) -> str:
    """Markdown: direction of Lambda - 1 where the cue is above a floor: median / 90th percentile; median of `constant` (share)."""
    head = ["shape", "condition", "fit", "form", *(f"floor {floor:g}" for floor in FLOORS)]
    rows = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for line in lines:
        if line["form"] not in ("neighbourhood", "gaussian"):
            continue
        cells = [line["shape"], CONDITIONS[line["condition"]], line["fit"], line["form"]]
        for x in line["floors"]:
            found = (
                x["share"]
                and f"{x['median_deg']:.0f} / {x['p90_deg']:.0f}; {x['constant_median_deg']:.0f} ({x['share']:.0%})"
            )
            cells.append(found or "-")
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shapes", nargs="+", default=["rabbit", "chick1"])
    parser.add_argument("--conditions", nargs="+", default=list(CONDITIONS), choices=CONDITIONS)
    parser.add_argument("--fits", nargs="+", default=["carried", "free"], choices=FITS)
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--out", type=Path, default=Path("outputs/cues"), help="results and cached stages"
    )
    parser.add_argument("--table", action="store_true", help="only print what has been measured")
    parser.add_argument(
        "--neighbours", action="store_true", help="also other numbers of neighbours"
    )
    parser.add_argument(
        "--floors",
        action="store_true",
        help="also the direction of the strain against the cue's floor",
    )
    args = parser.parse_args()
    lines = []
    for shape in args.shapes:
        for condition in args.conditions:
            for fit in args.fits:
                file = args.out / f"{shape}-{condition}-{fit}-{args.particles}-{args.seed}.json"
                if not file.exists():
                    if args.table:
                        continue
                    print(f"{shape}, {CONDITIONS[condition]}, {fit}", file=sys.stderr)
                    args.out.mkdir(parents=True, exist_ok=True)
                    measured = measure(shape, condition, fit, args.out, args.particles, args.seed)
                    partial = file.with_suffix(".tmp")
                    partial.write_text(json.dumps(measured, indent=1))
                    partial.replace(file)
                lines += json.loads(file.read_text())
    print(table(lines, args.neighbours))
    if args.floors:
        print("\n" + floor_table(lines))


if __name__ == "__main__":
    main()

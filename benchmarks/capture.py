"""Own capture against the truth: six simulated phones with their faults, mosa-capture on what they film, and what it found.

    python benchmarks/capture.py film --folder outputs/capture --name rabbit [--fps 120 --jobs 6]   # videos, plates, COLMAP's poses
    python benchmarks/capture.py compare --folder outputs/capture              # mosa-capture, and its errors
    python benchmarks/capture.py footage --folder outputs/capture              # perfect footage and held-out drops, train commands

`compare` prints errors of clocks, readouts, scale, up and ground, and how well the frames at common times are those of perfect
cameras there. `footage` writes what the fits need that `docs/capture.md` compares. Synthetic scenes.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
from capture_film import Faults, film, perfect

from mosa.capture.making import capture
from mosa.capture.world import World
from mosa.config.leaf_settings import CaptureSettings
from mosa.settings import node_of

STEP = 0.02
"""[s] between frames of held-out drops: as the built-in scenes'."""


def settings(folder: Path, truth: dict, **changes) -> dict:
    """The keys of conf/capture.yaml for a filmed folder."""
    values = node_of(CaptureSettings)
    return values | {"videos": str(folder / "videos"), "poses": str(folder / "sparse"), "output": str(folder / "scene"),
                     "gravity": truth["gravity"]} | changes  # fmt: skip


def found_world(record: dict) -> World:
    world = record["world"]
    return World(world["scale"], np.array(world["rotation"]), np.array(world["origin"]))


def to_found(truth: dict, world: World) -> tuple[np.ndarray, np.ndarray]:
    """(A (3, 3), b (3,)): where the found world has a true point X is A X + b."""
    turn, move = np.array(truth["turn"]), np.array(truth["move"])
    return world.scale / truth["scale"] * world.R @ turn, world.points(move)


def gauge(truth: dict, world: World) -> np.ndarray:
    """(4, 4) the turn about up and the shift along the ground that nothing can tell, from the true world to the found one."""
    A, b = to_found(truth, world)
    yaw = np.arctan2(A[0, 2] - A[2, 0], A[0, 0] + A[2, 2])
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]]
    pose[[0, 2], 3] = b[[0, 2]]
    return pose


def true_times(truth: dict, found: dict) -> np.ndarray:
    """(T,) [s] of the frames that were written, on the truth's clock, as the first phone's clock says them."""
    return truth["phones"][0]["begin"] + found["start"] + np.arange(found["frames"]) / found["rate"]


def errors(truth: dict, found: dict) -> dict[str, float]:
    """What was found minus what is true."""
    begins = np.array([p["begin"] for p in truth["phones"]])
    offsets = 1e3 * (np.array([p["offset"] for p in found["phones"]]) - (begins - begins[0]))
    readouts = 1e3 * (
        np.array([p["readout"] for p in found["phones"]]) - [p["readout"] for p in truth["phones"]]
    )
    A, b = to_found(truth, found_world(found))
    up = A[:, 1] / np.linalg.norm(A[:, 1])
    return {
        "clock_rms_ms": float(np.sqrt(np.square(offsets - offsets.mean()).mean())), "clock_max_ms": float(np.abs(offsets).max()),
        "clock_said_ms": float(1e3 * np.mean([p["offset_sd"] for p in found["phones"][1:]])),
        "readout_rms_ms": float(np.sqrt(np.square(readouts).mean())),
        "readout_said_ms": float(1e3 * np.mean([p["readout_sd"] for p in found["phones"]])),
        "scale_percent": 100 * (found["scale"] / truth["scale"] - 1),
        "scale_said_percent": 100 * found["scale_sd"] / found["scale"],
        "up_degrees": float(np.degrees(np.arccos(np.clip(up[1], -1, 1)))), "up_said_degrees": found["up_sd_degrees"],
        "ground_mm": 1e3 * float(b[1]), "ground_said_mm": 1e3 * found["ground"]["sd"],
    }  # fmt: skip


def pictures_errors(seen: Path, right: Path) -> dict[str, float]:
    """Of mattes: overlap, and distance of centres [px]; of colours inside both: PSNR [dB]."""
    overlap, apart, squares = [], [], []
    for file in sorted((right / "images").glob("*.png")):
        a, b = (
            cv2.imread(str(folder / "images" / file.name), cv2.IMREAD_UNCHANGED).astype(np.float32)
            / 255
            for folder in (seen, right)
        )
        both, either = (a[..., 3] > 0.5) & (b[..., 3] > 0.5), (a[..., 3] > 0.5) | (b[..., 3] > 0.5)
        overlap.append(both.sum() / either.sum())
        centres = [
            np.array([(m.sum(0) @ np.arange(m.shape[1])), (m.sum(1) @ np.arange(m.shape[0]))])
            / m.sum()
            for m in (a[..., 3], b[..., 3])
        ]
        apart.append(np.linalg.norm(centres[0] - centres[1]))
        squares.append(np.square(a[both][:, :3] - b[both][:, :3]).mean())
    return {
        "overlap": float(np.mean(overlap)),
        "overlap_worst": float(np.min(overlap)),
        "apart_px": float(np.mean(apart)),
        "apart_worst_px": float(np.max(apart)),
        "psnr": float(-10 * np.log10(np.mean(squares))),
    }


def compare(folder: Path, rate: float | None = None) -> dict:
    """mosa-capture on what was filmed, its errors, and its frames beside those of perfect cameras."""
    truth = json.loads((folder / "truth.json").read_text())
    found = capture(settings(folder, truth, rate=rate))
    said, world = errors(truth, found), gauge(truth, found_world(found))
    times = true_times(truth, found)
    perfect(folder / "perfect", truth, sequence="train", times=times, world=world, particles=True)
    said["flow"] = p = pictures_errors(folder / "scene", folder / "perfect")
    print("\n| | error | said |\n|---|---|---|")
    for name, unit in (
        ("clock_rms", "ms"),
        ("readout_rms", "ms"),
        ("scale", "percent"),
        ("up", "degrees"),
        ("ground", "mm"),
    ):
        print(
            f"| {name} [{unit}] | {said[f'{name}_{unit}']:.3g} | {said[name.removesuffix('_rms') + f'_said_{unit}']:.3g} |"
        )
    print(
        "\n| frames at common times | overlap of mattes | worst | centres apart [px] | worst | PSNR inside [dB] |\n"
        "|---|---|---|---|---|---|"
    )
    print(
        f"| flow | {p['overlap']:.4f} | {p['overlap_worst']:.4f} | {p['apart_px']:.2f} | {p['apart_worst_px']:.2f} | "
        f"{p['psnr']:.1f} |"
    )
    (folder / "compare.json").write_text(json.dumps(said, indent=1))
    return said


def footage(folder: Path, held: list[str]) -> None:
    """Held-out drops by perfect cameras with true particles, and the commands that learn from the phones and perfectly."""
    truth, found = (
        json.loads((folder / name).read_text()) for name in ("truth.json", "scene/capture.json")
    )
    world = gauge(truth, found_world(found))
    for sequence in held:
        perfect(
            folder / "held_out" / sequence,
            truth,
            sequence=sequence,
            times=np.arange(15) * STEP,
            world=world,
            particles=True,
        )
    tests = ",".join(
        f"{{path: {folder.resolve()}/held_out/{sequence}, particles: truth}}" for sequence in held
    )
    box = json.dumps(found["box"], separators=(",", ":"))
    for name in ("scene", "perfect"):
        print(
            f"python train.py scene=transforms scene.path={folder.resolve()}/{name} scene.up=[0,1,0] "
            f"scene.gravity=[0,-{truth['gravity']:g},0] 'scene.box={box}' 'scene.test=[{tests}]' prior=neo_hookean"
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["film", "compare", "footage"])
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--name", default="rabbit")
    parser.add_argument("--material", default="isotropic", choices=["isotropic", "anisotropic"])
    parser.add_argument("--size", default="960x720")
    parser.add_argument("--fps", type=float, default=60.0)
    parser.add_argument(
        "--rate", type=float, default=None, help="frames per second that mosa-capture writes"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--jobs", type=int, default=1, help="phones filmed at a time, each in a process"
    )
    parser.add_argument("--held", default="test_60,test_40")
    options = parser.parse_args()
    if options.what == "film":
        size = tuple(int(n) for n in options.size.split("x"))
        film(
            options.folder,
            name=options.name,
            material=options.material,
            size=size,
            fps=options.fps,
            faults=Faults(),
            seed=options.seed,
            jobs=options.jobs,
        )
    elif options.what == "compare":
        compare(options.folder, options.rate)
    else:
        footage(options.folder, options.held.split(","))


if __name__ == "__main__":
    main()

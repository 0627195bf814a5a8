"""Sag, frequency and damping ratio of measured and predicted points of a run of scene=markers.

python tests/physics_verification/beam_markers.py <run folder> [recording ...]    prints the tables
of docs/beam.md; of each recording, where its first three points come to rest
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from mosa.data.io.markers import AT_REST, read_markers


def ringing(times: np.ndarray, moved: np.ndarray) -> tuple[float, float, float]:
    """(level that it comes to rest at, frequency [Hz], damping ratio) of a displacement (T,) from
    rest: level + exp(-2 pi ratio f t) (a cos 2 pi f t + b sin 2 pi f t), by least squares."""
    there = np.isfinite(moved)
    t, y = times[there], moved[there]

    def model(p: np.ndarray) -> np.ndarray:
        phase = 2 * np.pi * p[1] * t
        return p[0] + np.exp(-p[2] * phase) * (p[3] * np.cos(phase) + p[4] * np.sin(phase))

    step = float(np.median(np.diff(t)))
    even = np.interp(np.arange(t[0], t[-1], step), t, y - y.mean())
    power = np.abs(np.fft.rfft(even, 16 * len(even)))
    first = np.fft.rfftfreq(16 * len(even), step)[power.argmax()]
    fit = least_squares(lambda p: model(p) - y, [y.mean(), first, 0.03, -y.mean(), 0.0])
    return float(fit.x[0]), float(fit.x[1]), float(fit.x[2])


if __name__ == "__main__":
    with np.load(Path(sys.argv[1]) / "markers.npz") as arrays:
        found = {key: arrays[key] for key in arrays.files}
    print("recording: sag [mm], frequency [Hz], damping ratio [%]; measured, predicted")
    for name in (key.removesuffix("/times") for key in found if key.endswith("/times")):
        start = found[f"{name}/predicted"][0].mean(0)[1]
        rows = [
            ringing(found[f"{name}/times"], found[f"{name}/{kind}"].mean(1)[:, 1] - start)
            for kind in ("measured", "predicted")
        ]
        said = [f"{-1e3 * sag:.2f} {f:.3f} {100 * ratio:.2f}" for sag, f, ratio in rows]
        print(f"{name}: {' ; '.join(said)}")
    for path in map(Path, sys.argv[2:]):
        recording = read_markers(path)
        moved = recording.positions[:, :3].mean(1)
        begin, end = recording.times[0] + AT_REST, recording.times[-1] - 0.5
        moved = moved[recording.times > end].mean(0) - moved[recording.times < begin].mean(0)
        print(f"{path.name}: {1e3 * np.linalg.norm(moved):.2f} mm at rest")

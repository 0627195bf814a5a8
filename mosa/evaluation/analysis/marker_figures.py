"""Tracked points beside where a fitted body says they are: markers.npz, markers.png."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np

from mosa.modules.body.body import Body
from mosa.reconstruction.marker_body import cues_of_markers
from mosa.system.npz import write_npz
from mosa.types import Rollout

SHOWN = 3
"""Points of a sequence that are drawn: those that move most."""


def write_markers(
    folder: Path, body: Body, sequences: Sequence, kept: Mapping[str, Mapping[str, Rollout]]
) -> None:
    """markers.npz with `<name>/measured`, `<name>/predicted` [T, M, 3] (m), `<name>/times` [T] (s),
    `<name>/names`; markers.png: displacements [mm] of the points that move most, along the axis in
    which they do, measured (dots) and predicted (lines)."""
    matplotlib.use("Agg")
    from matplotlib import pyplot

    arrays: dict[str, np.ndarray] = {}
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
        arrays |= {
            f"{s.prefix}/measured": measured,
            f"{s.prefix}/predicted": predicted,
            f"{s.prefix}/times": times,
            f"{s.prefix}/names": np.array(names),
        }
        moved = measured - s.scene.markers.rest.numpy()
        spread = np.nanstd(moved, 0)
        along = int(spread.sum(0).argmax())
        for k, m in enumerate(np.argsort(-spread[:, along])[:SHOWN]):
            rest = float(s.scene.markers.rest[m, along])
            axis.plot(times, 1e3 * (measured[:, m, along] - rest), ".", ms=3, color=f"C{k}")
            axis.plot(
                times, 1e3 * (predicted[:, m, along] - rest), lw=1, color=f"C{k}", label=names[m]
            )
        axis.set(title=s.prefix, ylabel=f"{'xyz'[along]} displacement [mm]")
        axis.legend(loc="upper right", fontsize=8, title="dots measured, lines predicted")
    axes[-1, 0].set_xlabel("time [s]")
    figure.savefig(folder / "markers.png", dpi=110)
    pyplot.close(figure)
    write_npz(folder / "markers.npz", arrays)

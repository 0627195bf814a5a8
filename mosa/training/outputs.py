"""Figures of a run, and the files that it leaves in its folder."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from warnings import warn

from omegaconf import DictConfig
from torch import Tensor

from mosa import __version__
from mosa.config.composition import searching
from mosa.data.io.gaussian_ply import save_ply
from mosa.data.synthetic.true_geometry import geometry_figures
from mosa.errors import ConfigError
from mosa.evaluation.analysis.comparison import (
    TITLES,
    compare,
    distances,
    error_limit,
    write_comparisons,
)
from mosa.evaluation.analysis.marker_figures import write_markers
from mosa.evaluation.analysis.statements import (
    determined_text,
    force_lines,
    geometry_lines,
    unexplained_text,
    worse_text,
)
from mosa.evaluation.analysis.tables import columns_text, parameter_table, results_table
from mosa.evaluation.evaluate import (
    Sequence,
    evaluate,
    floor_figures,
    hidden_figures,
    identification,
    law_figures,
    test_means,
    true_motion,
)
from mosa.evaluation.model_card import FILE, model_card
from mosa.evaluation.settings import EvaluationSettings
from mosa.evaluation.uncertainty import determined, predicted_spread
from mosa.modules.body.body import Body, Start, World
from mosa.modules.fitting.gauss_newton import Posterior
from mosa.system.threads import threaded
from mosa.system.whole_files import written_whole
from mosa.training.run_folder import write_figures
from mosa.twin.rollout_file import save_rollout, save_spread, save_truth
from mosa.twin.start import warn_of_unmet
from mosa.types import Rollout

log = logging.getLogger(__name__)

WRITTEN = [
    "results.md", "video.mp4", "strip.png", "markers.png", "splats.ply", f"checkpoints/{FILE}",
    *(f"{name}.npz" for name in ("rollout", "prior", "observed", "truth", "uncertainty", "markers")),
]  # fmt: skip
"""What a run may write beside metrics.json when its fit has ended; which of them depends on the scene and on the fit."""


def clear(folder: Path) -> None:
    """Removes what an earlier run in this folder wrote: the viewer would show it as this one's. Without a checkpoint no run was
    here, and files of these names are somebody's own."""
    for name in WRITTEN if any((folder / "checkpoints").glob("*.ckpt")) else ():
        (folder / name).unlink(missing_ok=True)


def figures_of(
    settings: EvaluationSettings,
    body: Body,
    evaluated: list[Sequence],
    world: World,
    posterior: Posterior | None,
    folder: Path,
) -> tuple[dict[str, float], dict[str, dict[str, Rollout]]]:
    """All that is measured on a fitted body, and the rollouts by sequence and variant.

    Writes uncertainty.npz into `folder` where there is a posterior."""
    scene = evaluated[0].scene
    figures, kept = evaluate(body, evaluated, world, settings)
    figures |= identification(body, scene, world) | law_figures(body)
    known = {prefix: each["adapted"].x for prefix, each in kept.items() if "adapted" in each}
    figures |= hidden_figures(body, scene, figures) | posterior_figures(
        body, posterior, evaluated, world, folder, known
    )
    if settings.floor:
        figures |= floor_figures(body, evaluated, world, settings)
        if scene.synthetic and scene.truth is not None:
            figures |= geometry_figures(body.rest, body.volume, scene)
    return figures, kept


def posterior_figures(
    body: Body, posterior: Posterior | None, evaluated: list[Sequence], world: World, folder: Path,
    known: Mapping[str, Tensor],
) -> dict:  # fmt: skip
    """What the data determined and how sure predictions are; uncertainty.npz with the latter. Nothing where there is no
    posterior. known: positions that the law predicts, by the sequence's prefix."""
    if posterior is None:
        return {}
    figures, spreads = predicted_spread(body, posterior, evaluated, world, known=known)
    if spreads:
        save_spread(folder / "uncertainty.npz", spreads)
    return figures | test_means(figures) | determined(body, posterior)


def start_figures(start: Start) -> dict[str, float]:
    motions = {"v0": start.velocity, "omega0": start.angular_velocity}
    return {f"id/{k}_{n}": float(v) for k, vector in motions.items() for n, v in zip("xyz", vector)}


def write_outputs(
    folder: Path,
    cfg: DictConfig,
    body: Body,
    evaluated: list[Sequence],
    figures: dict,
    kept: dict,
    world: World,
    note: str = "",
) -> None:
    """rollout.npz and prior.npz, truth.npz where it is known; splats.ply; video.mp4 of the last held-out sequence, strip.png of
    all; tables in results.md, below the note; a model card beside the checkpoint; metrics.json."""

    def save(file: tuple[str, str]) -> None:
        variant, name = file
        motions = {prefix: each[variant] for prefix, each in kept.items() if variant in each}
        save_rollout(folder / name, motions, world.solids)

    list(threaded(save, (("adapted", "rollout.npz"), ("prior", "prior.npz"))))
    moved = [each["adapted"] for each in kept.values() if "adapted" in each]
    warn_of_unmet(moved, world.colliders, body, world)
    told = [s for s in evaluated if s.scene.truth is not None]
    if known := {s.prefix: true_motion(body, s.scene) for s in told}:
        save_truth(folder / "truth.npz", known)
    if body.splats is not None:
        known = body.splats.appearance
        save_ply(folder / "splats.ply", known.splats.to("cpu"), known.harmonics.cpu())
    marked = [s for s in evaluated if s.scene.markers is not None]
    if marked:
        write_markers(folder, body, marked, kept, video=cfg.evaluation.video)
    else:
        simulated = [s for s in evaluated if TITLES.keys() & kept[s.prefix].keys()]
        shown = [s for s in simulated if s.prefix.startswith("test")] or simulated[:1]
        if shown:
            far = (distances(body, s.scene, kept[s.prefix]).values() for s in shown)
            limit = error_limit(d for each in far for d in each)
            compared = {s.prefix: compare(body, s, kept[s.prefix], limit=limit) for s in shown}
            write_comparisons(folder, compared, video=cfg.evaluation.video)
    law, learned = body.material.law, body.material.learned
    # of a direction (fibre_x, _y, _z) two angles are learned, fibre_1 and fibre_2
    fixed = [n for n in body.material.physical() if not {n, f"{n[:-2]}_1"}.intersection(learned)]
    fixed += ["contact_offset_m"] * (world.ground is None)
    if doubt := unexplained_text(figures, world):
        warn(
            "the learned law does not explain the motion: see the first lines of results.md",
            stacklevel=1,
        )
    about = columns_text(figures, evaluated[0].scene.name, bool(marked))
    parts = (note, doubt or worse_text(figures), results_table(figures), about, parameter_table(figures, law, fixed),
             determined_text(figures, law, bool(marked)), force_lines(figures), geometry_lines(figures))  # fmt: skip
    table = "\n\n".join(filter(None, parts))
    with written_whole(folder / "results.md") as partial:
        partial.write_text(table + "\n")
    if (folder / "checkpoints").is_dir():
        with written_whole(folder / "checkpoints" / FILE) as partial:
            partial.write_text(
                model_card(figures, body, evaluated, kept, world, __version__, note, fixed)
            )
    write_figures(folder, figures)  # the last file: the run is complete
    log.info("\n%s\n\nrun folder: %s", table, folder)


def optimized(figures: dict[str, float], wanted: str) -> float | None:
    """The figure that a search minimises. Errors: ConfigError where a search wants one that this run does not have."""
    if wanted not in figures and searching():
        raise ConfigError(f"optimized_metric: expected a figure of metrics.json, found {wanted}")
    return figures.get(wanted)

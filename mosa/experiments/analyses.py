"""What an experiment reads from run folders beside metrics.json: motions frame by frame, and laws from checkpoints.

An analysis gets (experiment, records, stem of its files) and gives (Markdown, pictures)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure as Canvas
from torch import Tensor

from mosa.data.synthetic.bodies.objects import OBJECTS
from mosa.evaluation.analysis.anisotropy import (
    directional_modulus,
    directions_in_plane,
    redistribution_response,
    stress_jacobian,
)
from mosa.evaluation.analysis.stiffness import angle_between, directional_moduli
from mosa.evaluation.analysis.tables import markdown
from mosa.experiments.collecting import Record
from mosa.experiments.parameters import parameters
from mosa.experiments.report import drawing
from mosa.experiments.report.drawing import WIDTH, legend, save, say_cut, style_of
from mosa.experiments.run_folders import label, loaded, prefix
from mosa.experiments.specification import Analysis, Experiment
from mosa.experiments.specimens import compression, parameters_at_origin
from mosa.modules.body.body import Body
from mosa.modules.body.material import material_states
from mosa.system.whole_files import write_table

log = logging.getLogger(__name__)

Analysed = tuple[str, list[Path]]
MOTIONS = {"": "rollout.npz", "prior/": "prior.npz"}  # prefix -> file of motions


# ------------------------------------------------------------------------------------------------ frame by frame
def errors_by_frame(record: Record) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """{held-out sequence: (times (T,) [s], root mean square distance of the particles from the true motion (T,) [m])}."""
    folder, name = record.job.folder, MOTIONS.get(prefix(record))
    files = [folder / (name or ""), folder / "truth.npz"]
    if record.figures is None or not all(file.is_file() for file in files):
        return {}
    found = {}
    with np.load(files[0]) as motions, np.load(files[1]) as truth:
        for key in truth.files:
            sequence = key.removesuffix("/x")
            if sequence.startswith("test/") and f"{sequence}/x" in motions.files:
                distance = motions[f"{sequence}/x"] - truth[key]
                rms = np.sqrt(np.square(distance).sum(-1).mean(-1))
                found[sequence] = motions[f"{sequence}/times"], rms
    return found


def long_term(experiment: Experiment, records: Sequence[Record], stem: Path) -> Analysed:
    """Error of every frame, mean over the held-out drops of an object; a band of one standard deviation over the seeds. All parts
    have one axis, which is logarithmic where a linear one would hide the least of the errors."""
    columns = [option.name for option in experiment.axes[experiment.columns]]
    curves: dict[str, dict[str, list[np.ndarray]]] = {column: {} for column in columns}
    times: dict[str, np.ndarray] = {}
    drops: dict[str, int] = {}
    for record in records:
        if found := errors_by_frame(record):
            column = record.place[experiment.columns].name
            times[column], drops[column] = next(iter(found.values()))[0], len(found)
            mean = np.mean([e for _, e in found.values()], 0)
            curves[column].setdefault(label(experiment, record), []).append(mean)
    shown = [column for column in columns if curves[column]]
    if not shown:
        return "", []
    canvas = Canvas(figsize=(WIDTH, 3.8), layout="constrained")
    places = canvas.subplots(1, len(shown), squeeze=False, sharey=True)[0]
    names, rows, drawn = [option.name for option in experiment.axes[experiment.rows]], [], []
    for place, column in zip(places, shown):
        t = times[column]
        for name in sorted(curves[column], key=names.index):  # whatever the order of the jobs is
            seeds, style = 1e3 * np.array(curves[column][name]), style_of(name, names)
            mean, several = seeds.mean(0), len(seeds) > 1
            sd = seeds.std(0, ddof=1) if several else 0 * mean
            place.plot(t, mean, label=name, **style)
            if several:
                band = {"alpha": 0.2, "color": style["color"], "linewidth": 0}
                place.fill_between(t, mean - sd, mean + sd, **band)
            drawn += mean.tolist()
            rows += [[column, name, *(f"{v:.4f}" for v in row)] for row in zip(t, mean, sd)]
        count = f"{drops[column]} held-out drop{'s' * (drops[column] != 1)}"
        place.set_title(f"{column}, mean of {count}", fontsize=9)
        place.set_xlabel("time [s]")
    places[0].set_ylabel("rms error [mm]", fontsize=9)
    if drawing.wide(drawn):
        for place in places:
            drawing.logarithmic(place, min(drawn))
    else:
        places[0].set_ylim(bottom=0)
    say_cut(places[0])
    legend(canvas, names, without="not drawn, as their runs saved no motion")
    frames = stem.with_name(stem.name + "_frames")
    header = [experiment.columns, experiment.rows, "time_s", "rms_mm", "sd_mm"]
    write_table(frames.with_suffix(".csv"), header, rows)
    return f"Error of every frame on held-out drops: `{frames.name}.csv`.", [save(canvas, frames)]


# ------------------------------------------------------------------------------------------------ laws
def learned_modulus(body: Body, directions: Tensor) -> Tensor:
    """(K,) Young's modulus [Pa] of the learned law along unit vectors (K, 3) at small strain, without the heterogeneity."""
    material, adapter = body.material, body.adapter
    adapter = adapter if adapter is not None and adapter.is_on else None
    if adapter is not None:
        adapter.follow(material.poisson())
        if (stiffness := adapter.stiffness()) is not None:
            mu = material.per_particle()["mu"].detach().double()
            return directional_moduli(2 * mu * stiffness.detach().double(), directions.double())
    states = material_states(material.law, material.per_particle(), body.law_options)
    return directional_modulus(states, adapter, directions)


def true_modulus(name: str, variant: str, directions: Tensor) -> Tensor | None:
    """(K,) of the hidden material of a built-in scene [Pa], without its variation over the body; None for other scenes."""
    if name not in OBJECTS:
        return None
    hidden = OBJECTS[name].material.variant(variant)
    one = parameters_at_origin(hidden)
    factor = float(hidden.factor(torch.zeros(1, 3))[0])
    return directional_modulus(material_states(hidden.law, one), None, directions) / factor


def redistribution(body: Body, directions: Tensor) -> Tensor | None:
    """w(n) (K,) at rest, the paper's directional response without the prior's own; None where nothing of the prior's stress is left
    that would be redistributed."""
    adapter = body.adapter
    if adapter is None or not adapter.is_on:
        return torch.zeros(len(directions)).double()
    if adapter.replaces_law:
        return None
    adapter.follow(body.material.poisson())
    zero = torch.zeros(1, 6).double()
    return redistribution_response(stress_jacobian(adapter, zero, zero)[0], directions.double())


MIN_RANGE = 0.05  # smallest half range of the axis of E over its mean, around 1


def directions(experiment: Experiment, records: Sequence[Record], stem: Path) -> Analysed:
    """w(theta) and E(theta) in the plane of the true fibres (or xy), theta from the fibres; beside the truth where it is known. E
    is drawn over its mean, on axes that show MIN_RANGE at least, so that what is isotropic is a level line, and in kPa from 0."""
    found = []
    for record, twin in loaded(records):
        scene = twin.record.settings["scene"]
        hidden = OBJECTS[scene["name"]].material if scene.get("name") in OBJECTS else None
        fibre = torch.tensor(getattr(hidden, "fibre", (1.0, 0.0, 0.0))).double()
        across = torch.eye(3).double()[int(fibre.abs().argmin())]
        angles, n = directions_in_plane(fibre.tolist(), across.tolist())
        w, E = redistribution(twin.body, n), learned_modulus(twin.body, n)
        truth = true_modulus(scene.get("name"), scene.get("material", "anisotropic"), n)
        found.append((record, torch.rad2deg(angles), n, w, E, truth))
    if not found:
        return "", []
    names = list(dict.fromkeys(record.place[experiment.columns].name for record, *_ in found))
    canvas = Canvas(figsize=(WIDTH, 8.4), layout="constrained")
    grid, rows, lines = canvas.subplots(3, len(names), squeeze=False, sharex=True), [], []
    methods, known = [option.name for option in experiment.axes[experiment.rows]], set()
    for record, angles, n, w, E, truth in found:
        column, name = record.place[experiment.columns].name, label(experiment, record)
        response, ratios, moduli = grid[:, names.index(column)]
        style = style_of(name, methods)
        if w is not None:
            response.plot(angles, w, label=name, **style)
        curves = [(E, name, style)]
        if truth is not None and column not in known:
            known.add(column)
            curves.append((truth, "truth", style_of("truth")))
        for values, said, how in curves:
            ratios.plot(angles, values / values.mean(), label=said, **how)
            moduli.plot(angles, values / 1e3, label=said, **how)
        response.set_title(column, fontsize=10)
        moduli.set_xlabel("angle from the fibres [degrees]")
        for i, angle in enumerate(angles):
            parts = ["" if x is None else f"{float(x[i]):.6g}" for x in (w, E, truth)]
            rows.append([column, name, f"{float(angle):.1f}", *parts])
        axis = f"{float(angle_between(n[int(E.argmax())], n[0])):.0f}"
        # of what is isotropic the stiffest direction is that of rounding, and a body without fibres has no angle from them
        level = any(float(x.max() / x.min()) < 1.001 for x in (E, truth) if x is not None)
        spans = (None if x is None else float((x.max() - x.min()) / x.mean()) for x in (E, truth))
        ranges = ["" if span is None else f"{span:.3f}" for span in spans]
        largest = "" if w is None else f"{float(w.max()):.3f}"
        lines.append([column, name, largest, *ranges, "" if level else axis])
    for response, ratios, moduli in grid.T:
        highest = max([float(line.get_ydata().max()) for line in response.lines], default=0.0)
        top = 1.05 * max(MIN_RANGE, highest)
        response.set_ylim(-0.04 * top, top)  # a w of 0 is a line of its own beside the axis
        low, high = ratios.get_ylim()
        low = np.floor(100 * min(low, 1 - MIN_RANGE) + 1e-6) / 100
        ratios.set_ylim(low, max(high, 1 + MIN_RANGE))
        moduli.set_ylim(0, 1.05 * moduli.get_ylim()[1])
        what = ("w, response without the prior's", "E over its mean", "E [kPa]")
        for each, said in zip((response, ratios, moduli), what):
            each.set_ylabel(said, fontsize=9)
            say_cut(each)
    grid[0, 0].set_xticks(range(0, 181, 30))
    legend(canvas, [*methods, "truth"], without="not known")
    path, axes = stem.with_name(stem.name + "_directions"), [experiment.columns, experiment.rows]
    write_table(path.with_suffix(".csv"), [*axes, "degrees", "w", "E_Pa", "true_E_Pa"], rows)
    measures = ["largest w", "range of E over its mean", "of the truth", "stiffest from the fibres [deg]"]  # fmt: skip
    text = "Directions in a plane with the fibres, first seed:\n\n"
    return text + markdown([*axes, *measures], lines), [save(canvas, path)]


def heterogeneity(experiment: Experiment, records: Sequence[Record], stem: Path) -> Analysed:
    """Learned and true stiffness factor over the body, seen from the side."""
    every = list(loaded(records))
    found = [(record, twin) for record, twin in every if twin.body.heterogeneity is not None]
    if not found:
        return "", []
    canvas = Canvas(figsize=(WIDTH, 6.4), layout="constrained")
    grid, lines, shown = canvas.subplots(2, len(found), squeeze=False), [], []
    several = len(experiment.axes[experiment.rows]) > 1
    for places, (record, twin) in zip(grid.T, found):
        body, scene = twin.body, twin.record.settings["scene"]
        learned, true = body.factor(body.model().heterogeneity).detach(), None
        if scene.get("name") in OBJECTS:
            hidden = OBJECTS[scene["name"]].material.variant(scene.get("material", "anisotropic"))
            true = hidden.factor(body.rest.float())
        title, name = record.place[experiment.columns].name, label(experiment, record)
        places[0].set_title(f"{title}, {name}" if several else title, fontsize=10)
        order = body.rest[:, 2].argsort()
        across, up = body.rest[order, 0], body.rest[order, 1]
        for place, values in zip(places, (learned, true)):
            place.set(xticks=[], yticks=[], aspect="equal")
            place.spines[:].set_visible(False)
            if values is not None:
                dots = {"c": values[order], "s": 7, "cmap": "coolwarm", "linewidths": 0}
                shown.append(place.scatter(across, up, **dots))
        same = ""
        if true is not None and min(float(true.std()), float(learned.std())) > 1e-6:
            same = f"{float(torch.corrcoef(torch.stack([learned.float(), true]))[0, 1]):.2f}"
        lines.append([title, name, f"{float(learned.std()):.3f}", same])
    for place, what in zip(grid[:, 0], ("learned", "truth")):
        place.set_ylabel(what, fontsize=11)
    most = max(float(np.abs(part.get_array() - 1).max()) for part in shown)
    for part in shown:  # one range for all bodies, whose middle colour is 1
        part.set_clim(1 - most, 1 + most)
    bar = canvas.colorbar(shown[0], ax=grid.ravel().tolist(), location="bottom", shrink=0.6, aspect=40)  # fmt: skip
    said = "factor on the stiffness, 1: as the calibrated law (truth: as its law without the variation)"  # fmt: skip
    bar.set_label(said, fontsize=9)
    measures = ["standard deviation of the factor", "correlation with the truth"]
    text = markdown([experiment.columns, experiment.rows, *measures], lines)
    picture = save(canvas, stem.with_name(stem.name + "_factor"))
    return "Stiffness over the body:\n\n" + text, [picture]


ANALYSES: dict[Analysis, Callable[[Experiment, Sequence[Record], Path], Analysed]] = {
    "long_term": long_term, "directions": directions, "heterogeneity": heterogeneity,
    "compression": compression, "parameters": parameters,
}  # fmt: skip

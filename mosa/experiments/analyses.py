"""What an experiment reads from run folders beside metrics.json: motions frame by frame, and laws from checkpoints.

An analysis gets (experiment, records, stem of its files) and gives (Markdown, pictures)."""

from __future__ import annotations

import csv
import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure as Canvas
from torch import Tensor

from mosa.analysis.anisotropy import directional_modulus, directions_in_plane, redistribution_response, stress_jacobian
from mosa.analysis.compression import Pressed, press
from mosa.analysis.stiffness import angle_between, directional_moduli
from mosa.analysis.tables import markdown
from mosa.analysis.vibration import longitudinal_modulus
from mosa.data.builtin.objects import OBJECTS
from mosa.errors import SimulationDiverged
from mosa.experiments.collecting import Record
from mosa.experiments.drawing import save
from mosa.experiments.specification import Experiment
from mosa.modules.body import Body
from mosa.modules.material import material_states
from mosa.twin import Twin
from mosa.whole_files import written_whole

log = logging.getLogger(__name__)

MOTIONS = {"": "rollout.npz", "prior/": "prior.npz"}
"""File of a run's motions, by the prefix of the model's figures."""


def label(experiment: Experiment, record: Record) -> str:
    """What the record is called where the columns are parts of the picture."""
    return record.place[experiment.rows].name


def prefix(record: Record) -> str:
    return "".join(option.prefix for option in record.place.values())


def write_table(path: Path, header: Sequence[str], rows: Sequence[Sequence]) -> None:
    with written_whole(path) as partial, open(partial, "w", newline="") as file:
        csv.writer(file).writerows([header, *rows])


# ------------------------------------------------------------------------------------------------ frame by frame
def errors_by_frame(record: Record) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """{held-out sequence: (times (T,) [s], root mean square distance of the particles from the true motion (T,) [m])}."""
    folder, name = record.job.folder, MOTIONS.get(prefix(record))
    if name is None or not (folder / name).is_file() or not (folder / "truth.npz").is_file():
        return {}
    found = {}
    with np.load(folder / name) as motions, np.load(folder / "truth.npz") as truth:
        for key in truth.files:
            sequence = key.removesuffix("/x")
            if sequence.startswith("test/") and f"{sequence}/x" in motions.files:
                distance = motions[f"{sequence}/x"] - truth[key]
                found[sequence] = (motions[f"{sequence}/times"], np.sqrt(np.square(distance).sum(-1).mean(-1)))
    return found


def long_term(experiment: Experiment, records: Sequence[Record], stem: Path) -> tuple[str, list[Path]]:
    """Error of every frame, mean over the held-out drops of an object; a band of one standard deviation over the seeds."""
    columns = [option.name for option in experiment.axes[experiment.columns]]
    curves: dict[str, dict[str, list[np.ndarray]]] = {column: {} for column in columns}
    times: dict[str, np.ndarray] = {}
    for record in records:
        found = errors_by_frame(record)
        if found:
            column = record.place[experiment.columns].name
            times[column] = next(iter(found.values()))[0]
            curves[column].setdefault(label(experiment, record), []).append(np.mean([e for _, e in found.values()], 0))
    shown = [column for column in columns if curves[column]]
    if not shown:
        return "", []
    canvas = Canvas(figsize=(1.5 + 3.4 * len(shown), 3.2), layout="constrained")
    rows = []
    for place, column in zip(canvas.subplots(1, len(shown), squeeze=False)[0], shown):
        for name, seeds in curves[column].items():
            mean, sd = 1e3 * np.mean(seeds, 0), 1e3 * np.std(seeds, 0, ddof=1) if len(seeds) > 1 else 0 * seeds[0]
            place.plot(times[column], mean, label=name)
            place.fill_between(times[column], mean - sd, mean + sd, alpha=0.2)
            rows += [[column, name, f"{t:.4f}", f"{m:.4f}", f"{s:.4f}"] for t, m, s in zip(times[column], mean, sd)]
        place.set_title(column, fontsize=10)
        place.set_xlabel("time [s]")
    canvas.axes[0].set_ylabel("rms error [mm]")
    canvas.axes[-1].legend(fontsize=8)
    frames = stem.with_name(stem.name + "_frames")
    write_table(frames.with_suffix(".csv"), [experiment.columns, experiment.rows, "time_s", "rms_mm", "sd_mm"], rows)
    return f"Error of every frame on held-out drops: `{frames.name}.csv`.", [save(canvas, frames)]


# ------------------------------------------------------------------------------------------------ laws
def loaded(records: Sequence[Record], prefixes: Sequence[str] = ("",)) -> Iterator[tuple[Record, Twin]]:
    """The records of these models that have a checkpoint, with it (the learned law's, where nothing else is said); of several seeds
    the first."""
    seen = set()
    for record in records:
        key = tuple(option.name for option in record.place.values())
        path = record.job.folder / "checkpoints" / "last.ckpt"
        if prefix(record) not in prefixes or not path.is_file() or key in seen:
            continue
        seen.add(key)
        yield record, Twin.load(path)


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
    one = {key: (value[0] if value.ndim else value) for key, value in hidden.parameters(torch.zeros(1, 3)).items()}
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


NEARLY = 0.05
"""What E over its mean is drawn around 1 at least."""


def directions(experiment: Experiment, records: Sequence[Record], stem: Path) -> tuple[str, list[Path]]:
    """w(theta) and E(theta) in the plane of the true fibres (or xy), theta from the fibres; beside the truth where it is known. The
    parts of a row share their axis, which shows NEARLY at least, so that what is isotropic is a level line."""
    found = []
    for record, twin in loaded(records):
        scene = twin.config["cfg"]["scene"]
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
    canvas = Canvas(figsize=(1.5 + 3.4 * len(names), 5.6), layout="constrained")
    grid, rows, lines = canvas.subplots(2, len(names), squeeze=False, sharey="row"), [], []
    for record, angles, n, w, E, truth in found:
        column = names.index(record.place[experiment.columns].name)
        name = label(experiment, record)
        if w is not None:
            grid[0, column].plot(angles, w, label=name)
        grid[1, column].plot(angles, E / E.mean(), label=name)
        if truth is not None and not any(line.get_label() == "truth" for line in grid[1, column].lines):
            grid[1, column].plot(angles, truth / truth.mean(), "k--", label="truth")
        grid[0, column].set_title(names[column], fontsize=10)
        grid[1, column].set_xlabel("angle from the fibres [degrees]")
        given = ["" if x is None else x for x in (w, truth)]
        for i, angle in enumerate(angles):
            rows.append([names[column], name, f"{float(angle):.1f}", *(x if isinstance(x, str) else f"{float(x[i]):.6g}"
                                                                     for x in (given[0], E, given[1]))])  # fmt: skip
        spread = float((E.max() - E.min()) / E.mean())
        axis = angle_between(n[int(E.argmax())], n[0])
        ratio = "" if truth is None else f"{float((truth.max() - truth.min()) / truth.mean()):.3f}"
        lines.append(
            [names[column], name, "" if w is None else f"{float(w.max()):.3f}", f"{spread:.3f}", ratio, f"{float(axis):.0f}"]
        )
    grid[0, 0].set_ylabel("w")
    for place in grid[0]:
        place.set_ylim(0, max(0.05, *(float(w.max()) for _, _, _, w, _, _ in found if w is not None), 0.05) * 1.05)
    low, high = grid[1, 0].get_ylim()
    grid[1, 0].set_ylim(min(low, 1 - NEARLY), max(high, 1 + NEARLY))
    grid[1, 0].set_ylabel("E over its mean")
    grid[1, -1].legend(fontsize=8)
    path = stem.with_name(stem.name + "_directions")
    write_table(path.with_suffix(".csv"), [experiment.columns, experiment.rows, "degrees", "w", "E_Pa", "true_E_Pa"], rows)
    header = [
        experiment.columns,
        experiment.rows,
        "largest w",
        "range of E over its mean",
        "of the truth",
        "stiffest from the fibres [deg]",
    ]
    return "Directions in a plane with the fibres, first seed:\n\n" + markdown(header, lines), [save(canvas, path)]


def heterogeneity(experiment: Experiment, records: Sequence[Record], stem: Path) -> tuple[str, list[Path]]:
    """Learned and true stiffness factor over the body, seen from the side."""
    found = [(record, twin) for record, twin in loaded(records) if twin.body.heterogeneity is not None]
    if not found:
        return "", []
    canvas = Canvas(figsize=(1.5 + 3.0 * len(found), 6.0), layout="constrained")
    grid, lines = canvas.subplots(2, len(found), squeeze=False), []
    for column, (record, twin) in enumerate(found):
        body, scene = twin.body, twin.config["cfg"]["scene"]
        learned = body.factor(body.model().heterogeneity).detach()
        hidden = (
            OBJECTS[scene["name"]].material.variant(scene.get("material", "anisotropic")) if scene.get("name") in OBJECTS else None
        )
        true = None if hidden is None else hidden.factor(body.rest.float())
        known = learned if true is None else torch.cat([learned, true])
        for row, (title, values) in enumerate((("learned", learned), ("true", true))):
            place = grid[row, column]
            place.set_axis_off()
            if values is None:
                continue
            order = body.rest[:, 2].argsort()
            shown = place.scatter(
                body.rest[order, 0],
                body.rest[order, 1],
                c=values[order],
                s=3,
                cmap="coolwarm",
                vmin=float(known.min()),
                vmax=float(known.max()),
            )
            place.set_aspect("equal")
            place.set_title(f"{record.place[experiment.columns].name}: {title}", fontsize=9)
        canvas.colorbar(shown, ax=grid[:, column].tolist(), location="bottom", shrink=0.8)
        same = (
            ""
            if true is None or float(true.std()) < 1e-6 or float(learned.std()) < 1e-6
            else (f"{float(torch.corrcoef(torch.stack([learned.float(), true]))[0, 1]):.2f}")
        )
        lines.append([record.place[experiment.columns].name, label(experiment, record), f"{float(learned.std()):.3f}", same])
    header = [experiment.columns, experiment.rows, "standard deviation of the factor", "correlation with the truth"]
    return "Stiffness over the body:\n\n" + markdown(header, lines), [save(canvas, stem.with_name(stem.name + "_factor"))]


def pressed_modulus(body: Body, variant: str, directions: Tensor) -> list[Pressed]:
    """A specimen of a model's law between two plates, along unit vectors (K, 3)."""
    model = body.model(variant)
    material, adapter = model.material, model.adapter
    adapter = adapter if adapter is not None and adapter.is_on else None
    poisson = float(material.poisson().detach())
    return [press(material.law, material.per_particle(), n, modulus=longitudinal_modulus(material), poisson=poisson,
                  density=body.density, adapter=adapter, stride=body.settings.stride, law_options=body.law_options,
                  stiffening=1.0 if adapter is None else adapter.stiffening(poisson)) for n in directions]  # fmt: skip


def compression(experiment: Experiment, records: Sequence[Record], stem: Path) -> tuple[str, list[Path]]:
    """E(theta) from the force on two plates, of the true law and of every model, in the plane of the fibres and the vertical; a row
    of the picture for each column of the table."""
    angles, n = directions_in_plane((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), 13)
    variants = {"": "adapted", "prior/": "prior"}
    found: dict[str, dict[str, list[Pressed]]] = {}
    truths: dict[tuple[str, str], list[Pressed]] = {}
    for record, twin in loaded(records, tuple(variants)):
        scene, name = twin.config["cfg"]["scene"], label(experiment, record)
        of_law = (scene.get("name"), scene.get("material", "anisotropic"))
        if of_law[0] not in OBJECTS or (twin.body.adapter is not None and twin.body.adapter.own_dynamics and not prefix(record)):
            continue  # nothing to compare with, or no law that a specimen could be made of
        if of_law not in truths:
            hidden = OBJECTS[of_law[0]].material.variant(of_law[1])
            one = {key: (value[0] if value.ndim else value) for key, value in hidden.parameters(torch.zeros(1, 3)).items()}
            truths[of_law] = [press(hidden.law, one, k, modulus=hidden.wave_modulus(), poisson=hidden.known["nu"],
                                    density=hidden.density, stiffening=1.0) for k in n]  # fmt: skip
        own = found.setdefault(record.place[experiment.columns].name, {"truth": truths[of_law]})
        try:
            own[name] = pressed_modulus(twin.body, variants[prefix(record)], n)
        except SimulationDiverged as error:
            own[name] = []
            log.warning("%s: %s", name, error)
    if not found:
        return "", []
    degrees = torch.rad2deg(angles)
    canvas = Canvas(figsize=(9.0, 3.6 * len(found)), layout="constrained")
    rows, lines = [], []
    for (column, laws), (left, right) in zip(found.items(), canvas.subplots(len(found), 2, squeeze=False)):
        true = laws["truth"]
        reference = torch.tensor([each.modulus for each in true])
        for name, results in laws.items():
            if not results:
                lines.append([column, name, "", "", ""])
                continue
            E = torch.tensor([each.modulus for each in results])
            style = "k--" if name == "truth" else "-"
            left.plot(degrees, E / 1e3, style, label=name)
            right.plot(100 * results[0].strain, results[0].force, style, label=name)
            rows += [[column, name, f"{float(a):.1f}", f"{float(e):.6g}", f"{float(t):.6g}"]
                     for a, e, t in zip(degrees, E, reference)]  # fmt: skip
            if name != "truth":
                off = (E / reference - 1).abs()
                forces = [abs(force_at(a, 0.04) / force_at(b, 0.04) - 1) for a, b in zip(results, true)]
                lines.append([column, name, f"{100 * float(off.mean()):.1f}", f"{100 * float(off.max()):.1f}",
                              f"{100 * max(forces):.1f}"])  # fmt: skip
        left.set_title(column, fontsize=10)
        left.set_ylim(0, 1.05 * left.get_ylim()[1])
        left.set_ylabel("E between plates [kPa]")
        right.set_ylabel("force [N]")
        left.legend(fontsize=8, loc="lower left")
    left.set_xlabel("angle from x towards y [degrees]")
    right.set_xlabel("strain along x [%]")
    path = stem.with_name(stem.name + "_plates")
    write_table(path.with_suffix(".csv"), [experiment.columns, experiment.rows, "degrees", "E_Pa", "true_E_Pa"], rows)
    header = [experiment.columns, experiment.rows, "E off, mean [%]", "E off, largest [%]", "force at 4 % strain off, largest [%]"]
    return "A specimen between plates, first seed, against the true law:\n\n" + markdown(header, lines), [save(canvas, path)]


def force_at(result: Pressed, strain: float) -> float:
    """[N] at a strain, by linear interpolation."""
    order = result.strain.argsort()
    return float(np.interp(strain, result.strain[order].numpy(), result.force[order].numpy()))


ANALYSES: dict[str, Callable[[Experiment, Sequence[Record], Path], tuple[str, list[Path]]]] = {
    "long_term": long_term, "directions": directions, "heterogeneity": heterogeneity,
    "compression": compression,
}  # fmt: skip

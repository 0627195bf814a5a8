"""Specimens of learned laws between two plates (`analysis/compression.py`): E(theta) and the force, against the true law.

What was measured of a run stays in its folder (`pressed.json`): tables and pictures are made again without its checkpoint."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure as Canvas
from torch import Tensor

from mosa.data.synthetic.bodies.objects import OBJECTS
from mosa.errors import DataError, SimulationDiverged
from mosa.evaluation.analysis.anisotropy import directions_in_plane
from mosa.evaluation.analysis.compression import Pressed, press
from mosa.evaluation.analysis.tables import markdown
from mosa.evaluation.analysis.vibration import longitudinal_modulus
from mosa.experiments.collecting import Record
from mosa.experiments.report.drawing import WIDTH, legend, save, style_of
from mosa.experiments.run_folders import checkpoint, first_seeds, label, prefix, pressed_file
from mosa.experiments.specification import Experiment
from mosa.modules.body.body import Body
from mosa.system.whole_files import write_table, write_whole
from mosa.twin.twin import Twin

log = logging.getLogger(__name__)

MODELS = {"": "adapted", "prior/": "prior"}  # of a run, by the prefix of their figures
ANGLES = 12  # directions over half a turn in the plane of x and the vertical
STRAIN = 0.04  # at which the force is compared
ASKED = 5.0  # per cent that E of the default shall be within


def pressed_modulus(body: Body, variant: str, directions: Tensor) -> list[Pressed]:
    """A specimen of a model's law between two plates, along unit vectors (K, 3)."""
    model = body.model(variant)
    material, adapter = model.material, model.adapter
    adapter = adapter if adapter is not None and adapter.is_on else None
    poisson = float(material.poisson().detach())
    return [press(material.law, material.per_particle(), n, modulus=longitudinal_modulus(material), poisson=poisson,
                  density=body.density, adapter=adapter, stride=body.settings.stride, law_options=body.law_options,
                  stiffening=1.0 if adapter is None else adapter.stiffening(poisson)) for n in directions]  # fmt: skip


def force_at(result: Pressed, strain: float) -> float:
    """[N] at a strain, by linear interpolation."""
    order = result.strain.argsort()
    return float(np.interp(strain, result.strain[order].numpy(), result.force[order].numpy()))


def plane(name: str) -> tuple[list[float], Tensor]:
    """(degrees, unit vectors (K, 3)) in the plane of x and the vertical in which a built-in body is pressed: evenly over half a
    turn, and along its fibres where these lie in the plane."""
    angles, n = directions_in_plane((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), ANGLES + 1)
    # the last one is the first, turned over
    degrees, vectors = (torch.rad2deg(angles)[:-1].tolist(), list(n[:-1]))
    fibre = getattr(OBJECTS[name].material, "fibre", None)
    if fibre is not None:
        fibre = torch.tensor(fibre, dtype=n.dtype) / torch.tensor(fibre, dtype=n.dtype).norm()
        if abs(float(fibre[2])) < 1e-6:
            degrees.append(float(torch.rad2deg(torch.atan2(fibre[1], fibre[0]))) % 180)
            vectors.append(fibre)
    order = sorted(range(len(degrees)), key=degrees.__getitem__)
    return [degrees[i] for i in order], torch.stack([vectors[i] for i in order])


def parameters_at_origin(hidden: Any) -> dict[str, Tensor]:
    """Of a hidden material, by name: () each."""
    found = hidden.parameters(torch.zeros(1, 3)).items()
    return {key: value[0] if value.ndim else value for key, value in found}


Truths = dict[tuple[str, str], list[Pressed]]


def measured(record: Record, truths: Truths) -> dict[str, Any] | None:
    """{degrees, truth_Pa, models: {prefix: {modulus_Pa, force_off} or None where it diverged}} of a run: from its folder, or from
    its checkpoint, and then kept there. None where there is nothing to compare with.

    force_off: largest relative error of the force at `STRAIN`. Errors: DataError naming a damaged file."""
    kept = pressed_file(record)
    if kept.is_file():
        try:
            found = json.loads(kept.read_text())
            found["degrees"], found["truth_Pa"], found["models"]
            return found
        except (ValueError, KeyError, TypeError) as error:
            raise DataError(
                f"{kept}: a damaged file ({error}); remove it to measure again"
            ) from error
    twin = Twin.load(checkpoint(record))
    scene = twin.record.settings["scene"]
    name, variant = scene.get("name"), scene.get("material", "anisotropic")
    if name not in OBJECTS:
        return None
    degrees, n = plane(name)
    if (name, variant) not in truths:
        hidden = OBJECTS[name].material.variant(variant)
        one = parameters_at_origin(hidden)
        truths[name, variant] = [press(hidden.law, one, k, modulus=hidden.wave_modulus(), poisson=hidden.nu,
                                       density=hidden.density, stiffening=1.0) for k in n]  # fmt: skip
    true, models = truths[name, variant], {}
    for each, model in MODELS.items():
        if not each and twin.body.adapter is not None and twin.body.adapter.own_dynamics:
            continue  # no law that a specimen could be made of
        try:
            own = pressed_modulus(twin.body, model, n)
        except SimulationDiverged as error:
            log.warning("%s: %s", record.job.folder.name, error)
            models[each] = None
            continue
        off = [abs(force_at(a, STRAIN) / force_at(b, STRAIN) - 1) for a, b in zip(own, true)]
        models[each] = {"modulus_Pa": [p.modulus for p in own], "force_off": max(off)}
    found = {"degrees": degrees, "truth_Pa": [p.modulus for p in true], "models": models}
    write_whole(kept, json.dumps(found, indent=1) + "\n")
    return found


def compression(
    experiment: Experiment, records: Sequence[Record], stem: Path
) -> tuple[str, list[Path]]:
    """E(theta) from the force on two plates, of the true law and of every model, in the plane of the fibres and the vertical; a row
    of the picture for each column of the table: E, and how far it is from the truth's."""
    truths: Truths = {}
    laws: dict[str, dict[str, Law]] = {}
    for record in first_seeds(records, tuple(MODELS), [pressed_file, checkpoint]):
        found = measured(record, truths)
        if found is None or prefix(record) not in found["models"]:
            continue
        model = found["models"][prefix(record)]
        column = laws.setdefault(record.place[experiment.columns].name, {})
        column[label(experiment, record)] = Law(found["degrees"], found["truth_Pa"], model)
    if not laws:
        return "", []
    order = [option.name for option in experiment.axes[experiment.rows]]
    rows, lines = [], []
    for column, of in laws.items():
        for name in sorted(of, key=order.index):
            law = of[name]
            if law.model is None:
                lines.append([column, name, "diverged", "", ""])
                continue
            off = [abs(e) for a, e in zip(law.degrees, law.off) if a < 180]
            force = f"{100 * law.model['force_off']:.1f}"
            lines.append([column, name, f"{sum(off) / len(off):.1f}", f"{max(off):.1f}", force])
            rows += [[column, name, f"{a:.1f}", f"{e:.6g}", f"{t:.6g}"]
                     for a, e, t in zip(law.degrees, law.model["modulus_Pa"], law.truth)]  # fmt: skip
    path = stem.with_name(stem.name + "_plates")
    axes = [experiment.columns, experiment.rows]
    write_table(path.with_suffix(".csv"), [*axes, "degrees", "E_Pa", "true_E_Pa"], rows)
    measures = ["E off, mean [%]", "E off, largest [%]", "force at 4 % strain off, largest [%]"]
    text = "A specimen between plates, first seed, against the true law:\n\n"
    return text + markdown([*axes, *measures], lines), [save(drawn(laws, order), path)]


class Law(NamedTuple):
    """degrees: (K,) of the directions; truth: (K,) [Pa] of the true law; model: of `measured`, None where it diverged."""

    degrees: list[float]
    truth: list[float]
    model: dict[str, Any] | None

    @property
    def off(self) -> list[float]:
        """(K,) [%] by which the model's E is too large."""
        return [100 * (e / t - 1) for e, t in zip(self.model["modulus_Pa"], self.truth)]


def drawn(laws: dict[str, dict[str, Law]], order: Sequence[str]) -> Canvas:
    """laws: {column: {model: its law}}; order: of the models."""
    canvas = Canvas(figsize=(WIDTH, 3.4 * len(laws) + 0.6), layout="constrained")
    grid = canvas.subplots(len(laws), 2, squeeze=False)
    axis = "direction of loading, from x towards y [degrees]; dotted: stiffest of the truth"
    for (column, of), (left, right) in zip(laws.items(), grid):
        degrees, truth, _ = next(iter(of.values()))
        left.plot(degrees, [t / 1e3 for t in truth], label="truth", **style_of("truth"))
        right.axhspan(-ASKED, ASKED, color="0.9", label=f"within {ASKED:g} %")
        for name in sorted(of, key=order.index):
            if (model := of[name].model) is not None:
                style, kilo = style_of(name), [e / 1e3 for e in model["modulus_Pa"]]
                left.plot(of[name].degrees, kilo, label=name, **style)
                right.plot(of[name].degrees, of[name].off, **style)
        stiffest = degrees[int(np.argmax(truth))]
        left.set(title=column, ylabel="E between plates [kPa]", ylim=(0, 1.05 * left.get_ylim()[1]))
        right.set(title=f"{column}: error", ylabel="E off the truth [%]")
        for part in (left, right):
            part.axvline(stiffest, color="0.6", linewidth=0.8, linestyle=":")
            part.set_xlabel(axis, fontsize=8)
    legend(canvas, ["truth", *order])
    return canvas

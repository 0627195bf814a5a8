"""What a fit to stress-strain tests leaves: figures, a table, a plot of every curve, the material as JSON and as a checkpoint."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch

from mosa.config.build import build_body, world_of
from mosa.config.record import BodyRecord
from mosa.evaluation.analysis.law_stress import described
from mosa.material_tests.fitting import Fit, Law
from mosa.material_tests.measurements import UNITS, Measurements, strained
from mosa.modules.adapters.hyperelastic import HyperelasticAdapter
from mosa.modules.body.body import Start
from mosa.modules.body.material import FORMS, NU_MAX, Form, unit_of
from mosa.twin.saved import save_twin
from mosa.twin.twin import Twin

matplotlib.use("Agg")
GOOD, SYSTEMATIC, CLOSE, CLEAR, WIDE = 0.95, 0.5, 0.03, 1.5, 0.4
SAME, SOFTEST, STIFFEST, LONGEST = 1.1, 1e3, 1e10, 15.0
"""R2 below which a fit is warned of, and correlation of neighbouring residuals above which it is, unless they are below that share
of the stresses (rms); ratio of errors above which tests prefer one reading of stress, and logarithm of the stretch above which
they are asked for it; ratio above which exports differ from the fit; E [Pa] below and above which the unit is doubted: most gels
and tissues have more, and what stretches far has less; and the stretch above which strain is suspected: rubber breaks before."""
SIDE, ACROSS = 0.05, 6
"""Of the cube that a checkpoint holds [m], and its particles along an edge."""


def curves(data: Measurements) -> dict[tuple[int, int], np.ndarray]:
    """(m,) bool of every curve, by test and component."""
    parts = itertools.product(range(len(data.names)), (0, 1))
    found = {(k, c): ~data.without(k) & (data.component == c) for k, c in parts}
    return {key: chosen for key, chosen in found.items() if chosen.any()}


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def explained(value: np.ndarray, found: np.ndarray) -> float:
    """R2 about the mean; NaN of a constant."""
    spread = ((value - value.mean()) ** 2).sum()
    return float(1 - ((found - value) ** 2).sum() / spread) if spread > 0 else math.nan


def mean_explained(data: Measurements, found: np.ndarray, test: int | None = None) -> float:
    """Mean of R2 over the curves (of one test) that have one; NaN where none has."""
    own = (c for (k, _), c in curves(data).items() if test in (None, k))
    each = [explained(data.value[c], found[c]) for c in own]
    return float(np.mean([value for value in each if not math.isnan(value)] or [math.nan]))


def figures(
    data: Measurements, fit: Fit, left_out: Mapping[str, np.ndarray]
) -> dict[str, float | str]:
    """Of all stresses [Pa]: `rms`, `rms_curves` (mean over curves), R2 (mean over curves), `left_out` (mean over tests of the rms
    of a test that the fit did not see); `rms_simulated`: without the pressure of an incompressible fit; `rms_of_sd`, `noise_of_sd`:
    in units of the given standard deviations, else `noise` [Pa]; other_reading: as `Fitting.other_reading` finds it."""
    away = fit.predicted - data.value
    parts = curves(data).values()
    found: dict[str, float | str] = {
        "rms": rms(away),
        "rms_curves": float(np.mean([rms(away[c]) for c in parts])),
        "R2": mean_explained(data, fit.predicted),
        "numbers": len(fit.names),
        "numbers_determined": fit.effective,
    }
    found["noise" if np.isnan(data.sd).any() else "noise_of_sd"] = fit.noise
    if fit.simulated is not None:
        found["rms_simulated"] = rms(fit.simulated - data.value)
    if not np.isnan(data.sd).any():
        found["rms_of_sd"] = rms(away / data.sd)
    if fit.other is not None:
        found["other_reading"] = fit.other
    if left_out:
        seen = {name: data.value[~data.without(k)] for k, name in enumerate(data.names)}
        found["left_out"] = float(np.mean([rms(left_out[n] - seen[n]) for n in left_out]))
    return found


def uncertain(law: Law, fit: Fit) -> list[tuple[str, float, float | str, str]]:
    """(name, value, standard deviation or why there is none, unit) of every number that was fitted, physical; where a pressure
    replaces nu, E as mu and 3 mu, which do not depend on the given nu."""
    rows = []
    deviations = np.sqrt(np.diag(fit.covariance))
    for name, value, sd, most in zip(fit.names, fit.theta, deviations, law.unsure):
        form = FORMS.get(name)
        if isinstance(form, Form):
            raw = torch.tensor(float(value), dtype=torch.float64, requires_grad=True)
            physical = form.physical(raw)
            (slope,) = torch.autograd.grad(physical, raw)
            unit, value = unit_of(law.material.law, name), physical.item()
            deviation = abs(slope.item()) * sd
            near = any(abs(value - b) < 0.01 * max(abs(b), 1) for b in (form.low, form.high))
            unknown = f"not determined{' (at its bound)' if near else ''}"
            if name == "E" and fit.simulated is not None and "nu" not in fit.names:
                nu = law.material.physical()["nu"].item()
                for label, factor in (("mu", 1), ("3 mu (E at nu = 1/2)", 3)):
                    part = factor / 2 / (1 + nu)
                    told = part * deviation if sd < most else unknown
                    rows.append((label, part * value, told, unit))
                name = f"E (at the given nu = {nu:.4g})"
            rows.append((name, value, deviation if sd < most else unknown, unit))
        else:
            told = sd if sd < most else "not determined"
            rows.append((name, value, told, "" if name.startswith("stiffness_") else "rad"))
    return rows


READINGS = "nominal (force over the undeformed area)", "cauchy (true: over the area now)"


def reading(fit: Fit) -> str:
    """As what the stresses were read, and how much worse the other reading fits."""
    own, other = READINGS[fit.true], READINGS[not fit.true].split()[0]
    if fit.other is None:
        return f"stress: read as {own}; stress={other} is nearly the same in these tests"
    told = "" if fit.other >= CLEAR else ": look up which of the two the file holds"
    far = f"this law ends {fit.other:.2g} times as far from the tests"
    return f"stress: read as {own}; with stress={other} {far}{told}"


def doubts(law: Law, data: Measurements, fit: Fit, unit: str) -> list[str]:
    """What a user should look at: poor curves, an export that is another law."""
    R2, poor, odd, long = float(figures(data, fit, {})["R2"]), "", "", ""
    if R2 < GOOD:
        poor = (
            f"tests: R2 is {R2:.2f}: the law does not follow these curves. Either it cannot (try another prior), its start is "
            "too far away (prior.parameters, starts), or the file holds strain (expected: stretch, 1 at rest) or another "
            f"stress than {READINGS[fit.true]}"
        )
    elif fit.together > SYSTEMATIC and rms(fit.predicted - data.value) > CLOSE * rms(data.value):
        poor = (
            f"tests: neighbouring residuals are alike (correlation {fit.together:.2f}): these curves have an offset, a preload, "
            "slack or a loop, hold another stress, or the law does not follow them (try another prior). The standard deviations of "
            "the numbers do not contain such an error"
        )
    least = CLEAR if strained(data) > WIDE else 1 / CLEAR
    slip = reading(fit) if (fit.other or CLEAR) < least else ""
    name = "E" if "E" in law.material.names else "kappa"
    if not SOFTEST < (modulus := float(law.material.reference_modulus())) < STIFFEST:
        others = " or ".join(each for each in UNITS if each != unit)
        than = "softer than most gels" if modulus < STIFFEST else "stiffer than plastics"
        odd = f"unit: {name} is {modulus:.3g} Pa, {than}: is the file in {unit}, not in {others}?"
    if (most := float(np.abs(data.given).max())) > LONGEST:
        long = f"tests: a stretch of {most:.4g}, which no rubber reaches: stretch is 1 at rest, strain in per cent is not"
    return [each for each in (poor, slip, odd, long, note(law, data, fit, unit)) if each]


def note(law: Law, data: Measurements, fit: Fit, unit: str) -> str:
    """What material.json and the checkpoint say of a fit with a pressure; empty where its absence does not matter."""
    totals, scale = figures(data, fit, {}), UNITS[unit]
    if fit.simulated is None or float(totals["rms_simulated"]) < SAME * float(totals["rms"]):
        return ""
    nu, free = float(law.material.poisson().detach()), float(totals["rms_simulated"]) / scale
    there = "no equilibrium in one of the tests" if math.isnan(free) else f"an rms in the tests of {free:.4g} {unit}"  # fmt: skip
    higher = f"prior.parameters.nu={NU_MAX:g}, or " if nu < 0.999 * NU_MAX else ""
    return (
        f"fitted as incompressible; the law that simulations and exports get has nu = {nu:.4g} (at most {NU_MAX:g}), and "
        f"{there}; as fitted {float(totals['rms']) / scale:.4g} {unit}. "
        f"Nearer: {higher}incompressible=false, which fits that law; an export, with --nu 0.49999"
    )


def table(
    law: Law, data: Measurements, fit: Fit, left_out: Mapping[str, np.ndarray], unit: str
) -> str:
    """Markdown: figures, the numbers with their standard deviations, a row for each test. Stresses in `unit`."""
    scale, totals = UNITS[unit], figures(data, fit, left_out)
    lines = [
        f"# {law.material.law}{'' if law.adapter is None else ' with a learned stiffness'}",
        "",
    ]
    for name, value in totals.items():
        plain = name in (
            "R2",
            "numbers",
            "numbers_determined",
            "rms_of_sd",
            "noise_of_sd",
            "other_reading",
        )
        said = f"{value:.4g}" if plain else f"{float(value) / scale:.4g} {unit}"
        if name == "R2" and math.isnan(float(value)):
            said = "none: no test has stresses that vary"
        lines.append(f"- {name}: {said}")
    lines += [f"- {reading(fit)}", ""]
    lines += ["| number | value | standard deviation | unit |", "|---|---|---|---|"]
    for n, v, sd, u in uncertain(law, fit):
        lines.append(f"| {n} | {v:.4g} | {sd if isinstance(sd, str) else f'{sd:.2g}'} | {u} |")
    lines += ["", f"| test | stresses | rms [{unit}] | R2 | rms when left out [{unit}] |"]
    lines += ["|---|---|---|---|---|"]
    for k, name in enumerate(data.names):
        chosen = ~data.without(k)
        value, found = data.value[chosen], fit.predicted[chosen]
        out = f"{rms(left_out[name] - value) / scale:.3g}" if name in left_out else ""
        off, share = rms(found - value) / scale, mean_explained(data, fit.predicted, k)
        told = "" if math.isnan(share) else f"{share:.3f}"
        lines.append(f"| {name} | {chosen.sum()} | {off:.3g} | {told} | {out} |")
    return "\n".join(lines) + "\n"


def plot(
    path: Path, data: Measurements, fit: Fit, left_out: Mapping[str, np.ndarray], unit: str
) -> None:
    """A panel for each test: measured (points, with standard deviations), fitted (line), predicted when left out (dashes)."""
    import matplotlib.pyplot as plt
    from matplotlib.lines import Line2D

    scale, across = UNITS[unit], math.ceil(math.sqrt(len(data.names)))
    down = math.ceil(len(data.names) / across)
    size = (3.2 * across, 2.7 * down)
    figure, panels = plt.subplots(down, across, figsize=size, squeeze=False, layout="constrained")
    named: dict[str, Any] = {}
    for panel in panels.flat[len(data.names) :]:
        panel.axis("off")
    for (k, c), chosen in curves(data).items():
        panel, color = panels.flat[k], f"C{c}"
        own = ~data.without(k)
        given = data.given[data.row[chosen]]
        x = given[:, c] if np.ptp(given[:, c]) > 0 else given[:, 1 - c]
        order = np.argsort(x, kind="stable")
        sd = None if np.isnan(data.sd).any() else data.sd[chosen][order] / scale
        look = {"fmt": "o", "ms": 3, "lw": 0.6, "color": color, "label": f"stress_{c + 1}"}
        panel.errorbar(x[order], data.value[chosen][order] / scale, sd, **look)
        panel.plot(x[order], fit.predicted[chosen][order] / scale, color=color)
        if data.names[k] in left_out:
            found = left_out[data.names[k]][chosen[own]]
            panel.plot(x[order], found[order] / scale, "--", color=color, lw=1)
        panel.set_title(data.names[k], fontsize=9)
        kind = data.kind[data.row[chosen][0]]
        panel.set_xlabel("shear" if kind == "shear" else "stretch", fontsize=8)
        panel.set_ylabel(f"{'true' if fit.true else 'nominal'} stress [{unit}]", fontsize=8)
        panel.tick_params(labelsize=7)
        # no panel need have all of them, so that the legend is the figure's
        named |= {text: handle for handle, text in zip(*panel.get_legend_handles_labels())}
    named["fitted"] = Line2D([], [], color="0.3")
    if left_out:
        named["left out"] = Line2D([], [], color="0.3", linestyle="--", lw=1)
    place: dict[str, Any] = {"loc": "outside upper center", "ncols": 2 * across, "fontsize": 8}
    figure.legend(list(named.values()), list(named), **place)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def written(law: Law, fit: Fit, note: str = "") -> dict[str, Any]:
    """The material as plain data, with the posterior of the unconstrained numbers; note: a warning of `mosa-export-law`."""
    numbers = {"theta": fit.theta.tolist(), "covariance": fit.covariance.tolist()}
    # the angles of a direction count from where it began, and not from the one that was found
    begins = {name: law.material.begin_of(name).tolist() for name in law.material.directions}
    posterior = {"names": list(fit.names), "begins": begins} | numbers
    return described(law.material, law.adapter) | {"posterior": posterior, "note": note}


def specimen_twin(law: Law, values: Mapping[str, Any], density: float) -> Twin:
    """A cube of the material at rest on the ground: what `Twin.load` and `mosa-splats ckpt_path=` take the law from.

    values: configuration with seed, prior, simulation, heterogeneity and adapter; density [kg/m^3]."""
    spacing = SIDE / ACROSS
    axis = (torch.arange(ACROSS) + 0.5) * spacing
    rest = torch.cartesian_prod(axis, axis, axis)
    n, eye = len(rest), torch.eye(3)
    tensors = {"rest": rest, "volume": torch.full((n,), spacing**3), "colors": torch.full((n, 3), 0.6),
               "opacities": torch.full((n,), 0.8), "covariances": 0.1 * spacing**2 * eye.expand(n, 3, 3).contiguous()}  # fmt: skip
    sections = ("seed", "prior", "simulation", "heterogeneity", "adapter", "note")
    record = BodyRecord(
        settings={name: values[name] for name in sections if name in values},
        ground={"height": 0.0, "mode": "separate", "friction": 0.5},
        world={"gravity": [0.0, -9.81, 0.0], "up": [0.0, 1.0, 0.0], "box": [[-1.0, -0.2, -1.0], [1.0, 2.0, 1.0]]},
        density=float(density), dx=2 * spacing, frame_dt=1 / 60,
    )  # fmt: skip
    body = build_body(record, tensors)
    with torch.no_grad():
        for name, raw in law.material.raw.items():
            body.material.raw[name].copy_(raw)
        if isinstance(body.adapter, HyperelasticAdapter) and law.adapter is not None:
            body.adapter.numbers.copy_(law.adapter.numbers)
            body.adapter.switch_on(body.material.reference_modulus(), body.material.poisson())
    start = Start(eye, body.center, torch.zeros(3), torch.zeros(3))
    return Twin(body.eval(), world_of(record), record.frame_dt, record, start)


def write(folder: Path, law: Law, data: Measurements, fit: Fit, left_out: Mapping[str, np.ndarray], unit: str,
          values: Mapping[str, Any], density: float) -> None:  # fmt: skip
    """results.md, tests.png, material.json and checkpoints/specimen.ckpt in `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "results.md").write_text(table(law, data, fit, left_out, unit))
    plot(folder / "tests.png", data, fit, left_out, unit)
    told = note(law, data, fit, unit)
    kept = json.dumps(written(law, fit, told), indent=1, allow_nan=False)
    (folder / "material.json").write_text(kept)
    twin = specimen_twin(law, {**values, "note": told}, density)
    save_twin(twin, folder / "checkpoints" / "specimen.ckpt")

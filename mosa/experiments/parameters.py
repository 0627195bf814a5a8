"""Table of identified parameters: truth, what was found, how far it is off, and what the posterior says of it."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from pathlib import Path

from mosa.data.synthetic.bodies.objects import OBJECTS
from mosa.evaluation.analysis.tables import markdown
from mosa.experiments.collecting import Record
from mosa.experiments.specification import Experiment
from mosa.modules.body.material import RELATIVE, unit_of
from mosa.system.whole_files import write_table


def setting(overrides: Sequence[str], key: str) -> str | None:
    """The value of the last override of a key."""
    return {name: value for name, _, value in (each.partition("=") for each in overrides)}.get(key)


def parameters(
    experiment: Experiment, records: Sequence[Record], stem: Path
) -> tuple[str, list[Path]]:
    """A line for each parameter of each built-in body whose law has the form that is identified, with means over the seeds."""
    labels = {f.figure.removeprefix("id/").removesuffix("_relative_error"): f.label
              for f in experiment.figures if f.figure.startswith("id/")}  # fmt: skip
    rows, lines = [], []
    for option in experiment.axes[experiment.rows]:
        runs = [r for r in records if r.place[experiment.rows] == option and r.figures is not None]
        overrides = runs[0].job.overrides if runs else ()
        name = setting(overrides, "scene.name") or setting(overrides, "scene")
        if name not in OBJECTS:
            continue
        variant = setting(overrides, "scene.material") or "anisotropic"
        material = OBJECTS[name].material.variant(variant)
        for parameter, truth in material.known.items():
            relative = parameter in RELATIVE
            deviation = f"posterior/{parameter}_{'relative_' if relative else ''}sd"
            found = [r.figures.get(f"id/{parameter}") for r in runs]
            sds = [r.figures.get(deviation) for r in runs]
            if not all(isinstance(value, (int, float)) for value in [*found, *sds]):
                continue
            mean, sd = statistics.fmean(found), statistics.fmean(sds)
            sd = sd if relative else sd / abs(truth)
            over = statistics.stdev(found) if len(found) > 1 else None
            off = statistics.fmean(abs(value / truth - 1) for value in found)
            step = statistics.fmean(abs(math.log(v / truth)) for v in found) if relative else off
            limits = [claim.limit(option.name) for claim in experiment.claims
                      if claim.figure == labels.get(parameter)]  # fmt: skip
            limit = next((each for each in limits if each is not None), None)
            said = verdict(100 * off, 100 * step, 100 * sd, limit)
            unit = unit_of(material.law, parameter)
            named = f"{parameter} [{unit}]" if unit else parameter
            spread = "" if over is None else f" ± {over:.2g}"
            away, sure = f"{100 * (mean / truth - 1):+.1f}", f"{100 * sd:.1f}"
            lines.append([option.name, named, f"{truth:g}", f"{mean:.3g}{spread}", away, sure, said])  # fmt: skip
            deviations = ["" if over is None else over, len(found), sd]
            rows.append([option.name, parameter, unit, truth, mean, *deviations, said])
    if not lines:
        return "", []
    columns = "parameter unit truth found sd_over_seeds seeds posterior_sd verdict".split()
    file = stem.with_name(stem.name + "_parameters").with_suffix(".csv")
    write_table(file, [experiment.rows, *columns], rows)
    header = [experiment.rows, "parameter", "truth", "found", "off [%]", "posterior sd [%]", ""]
    return (
        "Each scene states a largest error of its parameters. *met*: the error is at most that. *met, by chance*: so it is, "
        "but two standard deviations of the posterior are more than that. *not determined*: the error is larger, and two standard "
        "deviations cover it. *missed*: they do not. ± is the spread over the seeds, not the posterior's standard deviation, "
        "which for a modulus is that of its logarithm.\n\n" + markdown(header, lines)
    ), []


def verdict(off: float, step: float, sd: float, most: float | None) -> str:
    """Of one parameter, all in per cent; step: how far it is off in what sd is the deviation of, a modulus' logarithm for one."""
    if most is None:
        return ""
    if off <= most:
        return "met" if 2 * sd <= most else "met, by chance"
    return "not determined" if 2 * sd >= step else "missed"

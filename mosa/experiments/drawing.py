"""Pictures of experiments by matplotlib, as PNG and PDF."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure as Canvas

from mosa.experiments.collecting import Cell
from mosa.experiments.specification import Experiment, Figure
from mosa.whole_files import written_whole

Tables = Mapping[str, Mapping[str, Mapping[str, Cell | None]]]


def save(canvas: Canvas, stem: Path) -> Path:
    """<stem>.png and .pdf; the path of the first."""
    with matplotlib.rc_context({"pdf.fonttype": 42}):
        with written_whole(stem.with_suffix(".pdf")) as partial:
            canvas.savefig(partial, format="pdf", bbox_inches="tight", metadata={"CreationDate": None})
        with written_whole(stem.with_suffix(".png")) as partial:
            canvas.savefig(partial, format="png", dpi=150, bbox_inches="tight", metadata={"Software": None})
    return stem.with_suffix(".png")


def draw(experiment: Experiment, tables: Tables) -> Canvas | None:
    """The experiment's picture, None where no job is complete."""
    if not any(cell for rows in tables.values() for cells in rows.values() for cell in cells.values()):
        return None
    canvas = Canvas(figsize=(1.5 + 4.2 * len(experiment.figures), 3.6), layout="constrained")
    places = canvas.subplots(1, len(experiment.figures), squeeze=False)[0]
    how = {"bars": bars, "lines": lines, "map": heat_map}[experiment.plot]
    if experiment.plot == "bars":  # a row that nothing was run of would take a place and a colour
        run = {row for rows in tables.values() for row, cells in rows.items() if any(cells.values())}
        tables = {label: {row: cells for row, cells in rows.items() if row in run} for label, rows in tables.items()}
    for place, figure in zip(places, experiment.figures):
        place.set_title(figure.label, fontsize=10)
        how(place, experiment, tables[figure.label], figure)
    if experiment.plot != "map":
        handles, labels = places[0].get_legend_handles_labels()
        if len(labels) > 1:
            canvas.legend(handles, labels, loc="outside right center", fontsize=8, frameon=False)
    return canvas


def bars(place, experiment: Experiment, rows: Mapping[str, Mapping[str, Cell | None]], figure: Figure) -> None:
    """A group of bars for each column, a bar for each row. Of figures with no zero of their own (PSNR, SSIM) the axis begins below
    the least, and says so; that of SSIM ends at its 1."""
    columns = list(next(iter(rows.values())))
    width, least = 0.8 / len(rows), np.inf
    for i, (row, cells) in enumerate(rows.items()):
        found = [(j, cells[c]) for j, c in enumerate(columns) if cells.get(c) is not None and np.isfinite(cells[c].mean)]
        if not found:
            place.bar([], [], label=row, color=f"C{i}")
            continue
        at = [j - 0.4 + width * (i + 0.5) for j, _ in found]
        means, spread = [c.mean for _, c in found], [c.sd or 0.0 for _, c in found]
        place.bar(at, means, width, yerr=spread if any(spread) else None, label=row, color=f"C{i}",
                  error_kw={"linewidth": 0.8})  # fmt: skip
        least = min(least, min(m - s for m, s in zip(means, spread)))
    most = place.get_ylim()[1]
    if "ssim" in figure.figure:
        most = min(most, figure.scale)
        place.set_ylim(top=most)
    if figure.best == "most" and np.isfinite(least) and least > 0.5 * most:
        place.set_ylim(bottom=least - 0.2 * (most - least) - 1e-9)
        place.set_ylabel(f"axis cut at {place.get_ylim()[0]:.4g}", fontsize=8)
    place.set_xticks(range(len(columns)), columns, rotation=30, ha="right", fontsize=8)


def lines(place, experiment: Experiment, rows: Mapping[str, Mapping[str, Cell | None]], figure: Figure) -> None:
    """A line for each column over the rows, at their values where these are numbers."""
    options = experiment.axes[experiment.rows]
    numeric = all(option.value is not None for option in options)
    at = [option.value if numeric else i for i, option in enumerate(options)]
    for column in next(iter(rows.values())):
        found = [(x, rows[o.name][column]) for x, o in zip(at, options) if rows[o.name].get(column) is not None]
        if found:
            place.errorbar(
                [x for x, _ in found],
                [c.mean for _, c in found],
                yerr=[c.sd or 0.0 for _, c in found],
                marker="o",
                capsize=2,
                label=column,
            )
    if numeric:
        place.set_xlabel(experiment.rows, fontsize=9)
    else:
        place.set_xticks(at, [option.name for option in options], rotation=30, ha="right", fontsize=8)


def heat_map(place, experiment: Experiment, rows: Mapping[str, Mapping[str, Cell | None]], figure: Figure) -> None:
    """Rows downwards, columns to the right, each cell with its number; what is missing stays white."""
    columns = [option.name for option in experiment.axes[experiment.columns]]
    values = np.array([[cells[c].mean if cells.get(c) is not None else np.nan for c in columns] for cells in rows.values()])
    values[~np.isfinite(values)] = np.nan
    image = place.imshow(values, aspect="auto", cmap="viridis")
    middle = np.nanmean([np.nanmin(values), np.nanmax(values)])
    for (i, j), value in np.ndenumerate(values):
        if np.isfinite(value):
            color = "white" if value < middle else "black"
            place.text(j, i, f"{value:.{figure.decimals}f}", ha="center", va="center", fontsize=8, color=color)
    place.set_xticks(range(len(columns)), columns, fontsize=8)
    place.set_yticks(range(len(rows)), list(rows), fontsize=8)
    place.set_xlabel(experiment.columns, fontsize=9)
    place.set_ylabel(experiment.rows, fontsize=9)
    place.figure.colorbar(image, ax=place)

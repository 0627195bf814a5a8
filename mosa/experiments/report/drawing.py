"""Pictures of experiments by matplotlib, as PNG and PDF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure as Canvas
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator

from mosa.experiments.collecting import Cell
from mosa.experiments.specification import Experiment, Figure
from mosa.system.whole_files import written_whole

Rows = Mapping[str, Mapping[str, Cell | None]]
Tables = Mapping[str, Rows]
Styles = Mapping[str, Mapping]
WIDTH = 9.0  # [inch] of a picture: a page's; more parts grow downwards

STYLES: Mapping[str, Mapping[str, Any]] = {
    "truth": {"color": "black", "linestyle": "--", "linewidth": 1.6, "zorder": 3.5},
    "floor": {"color": "#9a9a9a", "linestyle": ":"},
    "prior only": {"color": "#5fa3d3", "linestyle": "-."},
    "prior + eta": {"color": "#1f4f99", "linestyle": "-."},
    "pair forces (DEL)": {"color": "#8c6239"},
    "NCLaw": {"color": "#7cc36a"},
    "NeuMA": {"color": "#23803c"},
    "black box": {"color": "#7a5ab5"},
    "four networks (paper)": {"color": "#f2a12e"},
    "full": {"color": "#f2a12e"},  # of the ablations: the same four networks with all their parts
    "ours": {"color": "#d4111f", "linewidth": 2.6, "zorder": 3},
}
"""How a method is drawn in every picture, by its name in specifications/_shared.yaml."""

FURTHER = ("#17becf", "#e377c2", "#a3a21c", "#253494", "#b15928", "#66c2a5", "#c39bd3")
"""Colours of what STYLES does not name: none of them is a method's."""

AXES: Mapping[str, str] = {
    "steps": "steps of Adam of the reconstruction (of its joint refinement)",
    "alpha": "alpha: bound of C_x, C_y, C_z",
    "alpha_normal": "alpha_normal: bound of C_xyz",
    "prior": "prior law that was calibrated",
    "scene": "object",
}
"""What a stranger is told of an axis, where its name does not say it."""

BETTER = {"most": ", more is better", "least": ", less is better", None: ""}
MARKS = {"x": "diverged", "+": "failed"}  # of a cell without a finite mean, on the axis
MANY = 16  # bars from which on a part of the picture has a row for itself
DECADE = 10.0  # errors whose largest is more than so many times their least have a logarithmic axis


def style_of(name: str, names: Sequence[str] = ()) -> dict[str, Any]:
    """Keywords of a line of matplotlib for a method, the same in every picture. names: of all that a picture may have, in their
    order, from which what STYLES does not name takes its colour, whether the others were run or not."""
    unknown = [each for each in names if each not in STYLES]
    further = FURTHER[unknown.index(name) % len(FURTHER) if name in unknown else 0]
    return {"linestyle": "-", "linewidth": 1.4, **STYLES.get(name, {"color": further})}


def say_cut(place) -> None:
    """Adds to the label of the y axis where it begins, unless it shows the 0."""
    low, high = place.get_ylim()
    if not low <= 0 <= high:
        what = "logarithmic axis from" if place.get_yscale() == "log" else "axis cut at"
        known, said = place.get_ylabel(), f"{what} {low:.4g}"
        size = place.yaxis.label.get_size() if known else 8
        place.set_ylabel(f"{known} ({said})" if known else said, fontsize=size)


def wide(values: Sequence[float]) -> bool:
    """Whether a linear axis would hide the least of these errors."""
    found = [value for value in values if np.isfinite(value)]
    return len(found) > 1 and min(found) > 0 and max(found) > DECADE * min(found)


def logarithmic(place, low: float) -> None:
    """A logarithmic y axis from below `low` > 0, whose numbers are written out."""
    place.set_yscale("log", nonpositive="clip")
    step = 10.0 ** np.floor(np.log10(low))
    place.set_ylim(bottom=step * max(each for each in (0.5, 1, 2, 5) if step * each < low))
    place.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    place.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    place.yaxis.set_minor_formatter("")
    place.grid(axis="y", linewidth=0.4, color="0.85")
    place.set_axisbelow(True)


def limit(place, figure: Figure, least: float, values: Sequence[float]) -> None:
    """The y axis of a figure's bars or lines, of which `least` is the lowest point (of a bar of an error too). Errors begin at 0,
    or are logarithmic; figures with no zero of their own (PSNR, SSIM) below the least of them, at a round number. SSIM ends at its
    largest possible value. What does not show the 0 says so."""
    if not np.isfinite(least):
        return
    if figure.best == "least" and wide(values):
        logarithmic(place, min(values))
    elif figure.best == "least":
        place.set_ylim(bottom=min(0.0, least))
    else:
        (low, high), most = place.get_ylim(), float(place.dataLim.y1)
        if figure.best == "most" and least > 0.5 * most:
            span = max(most - least, 0.01 * most)
            step = 10.0 ** (np.floor(np.log10(span)) - 1)
            low = step * np.floor((least - 0.3 * span) / step)
            high = most + 0.08 * (most - low)
        elif figure.best == "most":
            low = min(0.0, least)
        place.set_ylim(low, min(high, figure.scale) if "ssim" in figure.figure else high)
    say_cut(place)


def save(canvas: Canvas, stem: Path) -> Path:
    """<stem>.png and .pdf; the path of the first."""
    with matplotlib.rc_context({"pdf.fonttype": 42}):
        for kind, stamp, dpi in (("pdf", "CreationDate", "figure"), ("png", "Software", 150)):
            with written_whole(stem.with_suffix(f".{kind}")) as partial:
                look = {"dpi": dpi, "bbox_inches": "tight", "metadata": {stamp: None}}
                canvas.savefig(partial, format=kind, **look)
    return stem.with_suffix(".png")


def cells_of(tables: Tables) -> list[Cell | None]:
    """All cells of some tables."""
    return [cell for rows in tables.values() for cells in rows.values() for cell in cells.values()]


def draw(experiment: Experiment, tables: Tables) -> Canvas | None:
    """The experiment's picture, None where no job is complete."""
    if not any(cell is not None and cell.count for cell in cells_of(tables)):
        return None
    names = list(next(iter(tables.values())))
    if experiment.plot == "bars":  # a row that nothing was run of would take a place
        run = {
            row for rows in tables.values() for row, cells in rows.items() if any(cells.values())
        }
        tables = {k: {row: rows[row] for row in rows if row in run} for k, rows in tables.items()}
    elif experiment.plot == "lines":
        names = [option.name for option in experiment.axes[experiment.columns]]
    styles = {name: style_of(name, names) for name in names}
    count = len(experiment.figures)
    shown = next(iter(tables.values()))
    many = experiment.plot == "bars" and len(shown) * max(map(len, shown.values())) > MANY
    across = 1 if many or count == 1 else 2
    down = -(-count // across)
    height = 2.3 if many else 3.4 if down == 1 else 2.8
    canvas = Canvas(figsize=(WIDTH, 0.6 + height * down), layout="constrained")
    places = canvas.subplots(down, across, squeeze=False).ravel()
    for place in places[count:]:
        place.remove()
    how = {"bars": bars, "lines": lines, "map": heat_map}[experiment.plot]
    for place, figure in zip(places, experiment.figures):
        place.set_title(figure.label + BETTER[figure.best], fontsize=10)
        how(place, experiment, tables[figure.label], figure, styles)
    if experiment.plot != "map":
        rows = [row for figure in experiment.figures for row in tables[figure.label].values()]
        legend(canvas, names, rows)
    elif None in cells_of(tables):
        canvas.supxlabel("white: not run", fontsize=9)
    return canvas


def legend(
    canvas: Canvas,
    names: Sequence[str],
    rows: Sequence[Mapping[str, Cell | None]] = (),
    without: str = "not run",
) -> None:
    """One above all parts, in the order of `names`, with the words for the marks and gaps of the cells of rows. without: what is
    said of those of `names` that no part shows."""
    every = (place.get_legend_handles_labels() for place in canvas.axes)
    known = {text: handle for handles, texts in every for handle, text in zip(handles, texts)}
    ordered = [name for name in names if name in known] + [t for t in known if t not in names]
    found = [cell for row in rows for cell in row.values() if cell is not None]
    marks = {mark_of(cell) for cell in found if not np.isfinite(cell.mean)}
    handles, words = [known[name] for name in ordered], []
    handles += [
        Line2D([], [], linestyle="", marker=mark, color="black", label=MARKS[mark])
        for mark in sorted(marks, reverse=True)
    ]
    if any(cell is None for row in rows for column, cell in row.items() if column != "mean"):
        words.append("gap: not run")
    if any("mean" in row and row["mean"] is None for row in rows):
        words.append("no mean: not of all columns")
    if absent := [name for name in names if name not in known]:
        words.append(f"{without}: {', '.join(absent)}")
    if words:
        canvas.supxlabel("; ".join(words), fontsize=9)
    if len(handles) > 1:
        labels = [*ordered, *(handle.get_label() for handle in handles[len(ordered) :])]
        look: dict[str, Any] = {"loc": "outside upper center", "fontsize": 9, "frameon": False}
        canvas.legend(handles, labels, ncols=min(len(handles), 5), **look)


def mark_of(cell: Cell) -> str:
    """Of MARKS."""
    return "+" if np.isnan(cell.mean) else "x"


def marked(place, at: float, cell: Cell, color: str) -> None:
    """The mark of what has no finite mean, on the lower axis."""
    place.plot([at], [0.025], transform=place.get_xaxis_transform(), marker=mark_of(cell), markersize=5.5, markeredgewidth=1.5,
               color=color, linestyle="", zorder=4, clip_on=False)  # fmt: skip


def measured(
    place, cells: Sequence[tuple[float, Cell | None]], color: str
) -> list[tuple[float, Cell]]:
    """Those of cells at x that have a finite mean; of the others that were run a mark is drawn."""
    for x, cell in cells:
        if cell is not None and not np.isfinite(cell.mean):
            marked(place, x, cell, color)
    return [(x, cell) for x, cell in cells if cell is not None and np.isfinite(cell.mean)]


def bars(place, experiment: Experiment, rows: Rows, figure: Figure, styles: Styles) -> None:
    """A group of bars for each column, a bar for each row; one of MARKS where it has no finite mean."""
    columns = list(next(iter(rows.values())))
    width, least, values = 0.84 / len(rows), np.inf, []
    for i, (row, cells) in enumerate(rows.items()):
        color = styles[row]["color"]
        at = [(j - 0.42 + width * (i + 0.5), cells.get(c)) for j, c in enumerate(columns)]
        found = measured(place, at, color)
        means, spread = [c.mean for _, c in found], [c.sd or 0.0 for _, c in found]
        look = {"label": row, "color": color, "error_kw": {"linewidth": 0.8}}
        place.bar([x for x, _ in found], means, width, yerr=spread if any(spread) else None, **look)
        values += means
        least = min([least, *(m - s for m, s in zip(means, spread))])
    limit(place, figure, least, values)
    place.set_xlim(-0.6, len(columns) - 0.4)
    place.set_xticks(range(len(columns)), columns, fontsize=9)
    if experiment.columns in AXES and experiment.columns != "scene":
        place.set_xlabel(AXES[experiment.columns], fontsize=9)


def lines(place, experiment: Experiment, rows: Rows, figure: Figure, styles: Styles) -> None:
    """A line for each column over the rows, at their values where these are numbers; a bar of one standard deviation where there
    are several seeds."""
    options = experiment.axes[experiment.rows]
    numeric = all(option.value is not None for option in options)
    at = [option.value if numeric else i for i, option in enumerate(options)]
    least, values = np.inf, []
    for column, style in styles.items():
        cells = [(x, rows[option.name].get(column)) for x, option in zip(at, options)]
        found = measured(place, cells, style["color"])
        if not found:
            continue
        means = [cell.mean for _, cell in found]
        place.plot([x for x, _ in found], means, marker=".", label=column, **style)
        if spread := [(x, c.mean, c.sd) for x, c in found if c.sd is not None]:
            look = {"fmt": "none", "ecolor": style["color"], "elinewidth": 1.0, "capsize": 2}
            x, mean, sd = zip(*spread)
            place.errorbar(x, mean, yerr=sd, **look)
        values += means
        least = min([least, *(c.mean - (c.sd or 0.0) for _, c in found)])
    limit(place, figure, least, values)
    place.set_xlabel(AXES.get(experiment.rows, experiment.rows), fontsize=9)
    if not numeric:
        place.set_xticks(at, [option.name for option in options], fontsize=9)


def heat_map(place, experiment: Experiment, rows: Rows, figure: Figure, styles: Styles) -> None:
    """Rows downwards, columns to the right, each cell with its number, the better the lighter; what was not run stays white, what
    diverged or failed says so."""
    names = [option.name for option in experiment.axes[experiment.columns]]
    cells = [[of.get(name) for name in names] for of in rows.values()]
    finite = [[c is not None and np.isfinite(c.mean) for c in row] for row in cells]
    values = np.array(
        [[c.mean if f else np.nan for c, f in zip(*both)] for both in zip(cells, finite)]
    )
    less = figure.best == "least"
    image = place.imshow(values, aspect="auto", cmap="viridis_r" if less else "viridis")
    middle = (np.nanmin(values) + np.nanmax(values)) / 2 if np.isfinite(values).any() else 0.0
    for (i, j), value in np.ndenumerate(values):
        if cells[i][j] is None:
            continue
        said, size, color = MARKS[mark_of(cells[i][j])], 8, "0.3"
        if np.isfinite(value):
            said, size = f"{value:.{figure.decimals}f}", 9
            color = "white" if (value < middle) != less else "black"
        place.text(j, i, said, ha="center", va="center", fontsize=size, color=color)
    place.set_xticks(range(len(names)), names, fontsize=9)
    place.set_yticks(range(len(rows)), list(rows), fontsize=9)
    place.set_xlabel(AXES.get(experiment.columns, experiment.columns), fontsize=9)
    place.set_ylabel(AXES.get(experiment.rows, experiment.rows), fontsize=9)
    bar = place.figure.colorbar(image, ax=place)
    if less:
        bar.ax.invert_yaxis()  # so that the better end is above in every part
    if figure.best is not None:
        bar.set_label("better \N{RIGHTWARDS ARROW}", fontsize=9)

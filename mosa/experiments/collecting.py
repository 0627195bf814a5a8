"""Figures of jobs as cells of a table: mean and spread over seeds."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from mosa.experiments.specification import Experiment, Figure, Job, Option, read_job

MEAN = "Mean: over all columns; a row that lacks one of them has none."
INSTEAD = {
    "diverged": "the law cannot be simulated there",
    "failed": "the run ended with an error, which the table's own file names",
}
"""What stands in place of a figure (`Cell.text`)."""


@dataclass(frozen=True)
class Record:
    """A cell's figures from one run. place: option by axis; figures: of metrics.json, under the option's prefix and bare."""

    place: dict[str, Option]
    seed: int
    job: Job
    figures: Mapping[str, float | str] | None

    def value(self, figure: Figure) -> float | None:
        """In the unit shown, None where the run has none (or is not complete)."""
        if self.figures is None:
            return None
        prefix = "".join(option.prefix for option in self.place.values())
        name = prefix + figure.figure
        # what is identified has two names of its own (docs/figures.md)
        found = self.figures.get(
            name.replace("prior/id/", "id_prior/", 1) if name.startswith("prior/id/") else name
        )
        return found * figure.scale if isinstance(found, (int, float)) else None


@dataclass(frozen=True)
class Cell:
    """mean and sample standard deviation (None of fewer than two) over `count` seeds. A mean of infinity: it diverged; NaN, of no
    seed: its runs failed."""

    mean: float
    sd: float | None
    count: int

    def text(self, decimals: int) -> str:
        if not math.isfinite(self.mean):
            return "failed" if math.isnan(self.mean) else "diverged"
        spread = "" if self.sd is None else f" ± {self.sd:.{decimals}f}"
        return f"{self.mean:.{decimals}f}{spread}"


FAILED = Cell(math.nan, None, 0)  # of a place of which no run is complete, and one has failed


def footnotes(tables: Mapping[str, Mapping[str, Mapping[str, Cell | None]]]) -> str:
    """Notes of a table: the meaning of words in place of figures, and of the means; empty if it has neither."""
    every = (found for rows in tables.values() for found in rows.values())
    cells = [(column, cell) for found in every for column, cell in found.items()]
    used = {cell.text(0) for _, cell in cells if cell is not None}
    words = "; ".join(f"*{word}*: {meaning}" for word, meaning in INSTEAD.items() if word in used)
    means = [MEAN] * any(column == "mean" for column, _ in cells)
    return " ".join([*means, f"{words}."] if words else means)


def records_of(jobs: Sequence[Job]) -> list[Record]:
    """One for each job and cell that reads it. Errors: DataError for a damaged metrics.json."""
    found = []
    for job in jobs:
        figures = read_job(job)
        found += [Record(place, job.seed, job, figures) for place in job.places]
    return found


def cell(values: Sequence[float]) -> Cell | None:
    if not values:
        return None
    several = len(values) > 1 and all(map(math.isfinite, values))
    spread = statistics.stdev(values) if several else None
    return Cell(statistics.fmean(values), spread, len(values))


def table(
    experiment: Experiment, records: Sequence[Record], figure: Figure
) -> dict[str, dict[str, Cell | None]]:
    """{row: {column: cell}}, None where nothing was run, with a column `mean` of the rows that have finite figures in all columns
    (spread: over seeds, of these means)."""
    values: dict[str, dict[str, dict[int, float]]] = {}
    failed: set[tuple[str, str]] = set()
    for record in records:
        row, column = record.place[experiment.rows].name, record.place[experiment.columns].name
        seeds = values.setdefault(row, {}).setdefault(column, {})
        found = record.value(figure)
        if found is not None:
            seeds[record.seed] = found
        elif record.job.failed is not None:
            failed.add((row, column))
    columns = [option.name for option in experiment.axes[experiment.columns]]
    rows = {option.name: values.get(option.name, {}) for option in experiment.axes[experiment.rows]}
    result: dict[str, dict[str, Cell | None]] = {}
    for row, found in rows.items():
        result[row] = {
            column: cell(list(found.get(column, {}).values()))
            or (FAILED if (row, column) in failed else None)
            for column in columns
        }
        if experiment.mean and len(columns) > 1 and experiment.rows != experiment.columns:
            seeds = sorted(set.intersection(*(set(found.get(column, {})) for column in columns)))
            means = [statistics.fmean(found[column][seed] for column in columns) for seed in seeds]
            result[row]["mean"] = cell(means) if all(map(math.isfinite, means)) else None
    return result


def best_of(
    rows: Mapping[str, Mapping[str, Cell | None]], column: str, best: str | None
) -> str | None:
    """The row with the best mean in a column."""
    found = {row: cells[column].mean for row, cells in rows.items()
             if cells.get(column) is not None and math.isfinite(cells[column].mean)}  # fmt: skip
    if best is None or len(found) < 2:
        return None
    return (max if best == "most" else min)(found, key=found.get)

"""Figures of jobs as cells of a table: mean and spread over seeds."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from mosa.experiments.specification import Experiment, Figure, Job, Option, read_job

OF_MEANS = "Mean: over the columns that all rows have, but for those rows that are less than half complete."
"""What a mean of unequal rows is (`table`)."""


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
        name = figure.figure
        # what is identified has two names of its own (docs/figures.md)
        found = self.figures.get(f"id_prior/{name[3:]}" if prefix == "prior/" and name.startswith("id/") else prefix + name)
        return found * figure.scale if isinstance(found, (int, float)) else None


@dataclass(frozen=True)
class Cell:
    """mean and sample standard deviation (None of fewer than two) over `count` seeds."""

    mean: float
    sd: float | None
    count: int

    def text(self, decimals: int, plus: str = "±") -> str:
        if not math.isfinite(self.mean):
            return "inf" if self.mean > 0 else "-"
        spread = "" if self.sd is None else f" {plus} {self.sd:.{decimals}f}"
        return f"{self.mean:.{decimals}f}{spread}"


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
    return Cell(statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else None, len(values))


def table(experiment: Experiment, records: Sequence[Record], figure: Figure) -> dict[str, dict[str, Cell | None]]:
    """{row: {column: cell}} with a column `mean` (spread: over seeds, of these means), over the columns that every row has of which
    at least half as many are complete as of the fullest; rows that lack one of them have no mean.

    None where no run has the figure."""
    values: dict[str, dict[str, dict[int, float]]] = {}
    for record in records:
        row, column = record.place[experiment.rows].name, record.place[experiment.columns].name
        seeds = values.setdefault(row, {}).setdefault(column, {})
        found = record.value(figure)
        if found is not None:
            seeds[record.seed] = found
    columns = [option.name for option in experiment.axes[experiment.columns]]
    rows = {option.name: values.get(option.name, {}) for option in experiment.axes[experiment.rows]}
    result = {row: {column: cell(list(found.get(column, {}).values())) for column in columns} for row, found in rows.items()}
    if experiment.mean and len(columns) > 1 and experiment.rows != experiment.columns:
        complete = {row: sum(map(bool, found.values())) for row, found in rows.items()}
        filled = [found for row, found in rows.items() if 0 < complete[row] >= 0.5 * max(complete.values())]
        shared = [column for column in columns if filled and all(found.get(column) for found in filled)]
        for row, found in rows.items():
            seeds = sorted(set.intersection(*(set(found.get(column, {})) for column in shared))) if shared else []
            result[row]["mean"] = cell([statistics.fmean(found[column][seed] for column in shared) for seed in seeds])
    return result


def best_of(rows: Mapping[str, Mapping[str, Cell | None]], column: str, best: str | None) -> str | None:
    """The row with the best mean in a column."""
    found = {row: cells[column].mean for row, cells in rows.items() if cells.get(column) is not None}
    if best is None or len(found) < 2:
        return None
    return (max if best == "most" else min)(found, key=found.get)

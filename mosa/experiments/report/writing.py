"""Results of an experiment on disk: Markdown and CSV, with the paper's printed figures beside ours, and its picture."""

from __future__ import annotations

import platform
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import mosa
from mosa.evaluation.analysis.tables import markdown
from mosa.experiments.collecting import Record, best_of, footnotes, records_of, table
from mosa.experiments.commits import commit
from mosa.experiments.report.drawing import BETTER, draw, save
from mosa.experiments.report.page import listed, verdict, write_json
from mosa.experiments.report.printed import printed_table
from mosa.experiments.specification import Experiment, Job, commit_of, minutes_taken
from mosa.system.whole_files import write_table, write_whole

SHOWN = 4
"""Jobs that were not run, of which the page shows the names."""


def write_results(experiment: Experiment, jobs: Sequence[Job], folder: Path, command: str) -> Path:
    """Tables and pictures of the jobs that are complete into `folder`; the Markdown page's path."""
    from mosa.experiments.analyses import ANALYSES

    folder.mkdir(parents=True, exist_ok=True)
    records = records_of(jobs)
    tables = {figure.label: table(experiment, records, figure) for figure in experiment.figures}
    name = experiment.name + ("_quick" if experiment.quick else "")
    write_csv(folder / f"{name}.csv", experiment, records)
    pictures = []
    if experiment.plot is not None and (figure := draw(experiment, tables)) is not None:
        pictures.append(save(figure, folder / name))
    extra = ""
    if experiment.analysis is not None:
        extra, more = ANALYSES[experiment.analysis](experiment, records, folder / name)
        pictures += more
    page = folder / f"{name}.md"
    lines = provenance(experiment, jobs, records, command)
    write_json(folder / f"{name}.json", tables, lines)
    write_whole(page, markdown_page(experiment, jobs, tables, pictures, extra, lines))
    return page


def markdown_page(
    experiment: Experiment, jobs: Sequence[Job], tables: Mapping, pictures: Sequence[Path], extra: str, lines: Sequence[str],
) -> str:  # fmt: skip
    parts = [f"# {experiment.title}"]
    if experiment.quick:
        parts.append("Quick variant: small and short. Its figures say nothing about the methods.")
    if experiment.claims and not experiment.quick:
        whole = (listed(c.text, verdict(experiment, c, tables)) for c in experiment.claims)
        parts.append("\n".join(each.partition("\n")[0] for each in whole))
    if experiment.note:
        parts.append(experiment.note.strip())
    bold = "{}" if experiment.plot == "map" else "**{}**"  # of a map no column has a best row
    for figure in experiment.figures:
        rows = tables[figure.label]
        header = [experiment.rows, *next(iter(rows.values()))]
        best = {column: best_of(rows, column, figure.best) for column in header[1:]}
        body = []
        for row, cells in rows.items():
            texts = [(c, cells[c].text(figure.decimals) if cells.get(c) else "") for c in best]
            ahead = {c for c, text in texts if text and best[c] == row}
            body.append([row, *(bold.format(text) if c in ahead else text for c, text in texts)])
        title = f"{figure.label}{BETTER[figure.best]} (`{figure.figure}`)"
        parts.append(f"{title}\n\n{markdown(header, body)}")
    parts += [said] if (said := footnotes(tables)) else []
    if extra:
        parts.append(extra)
    parts += [f"![{experiment.title}]({picture.name})" for picture in pictures]
    if experiment.printed is not None:
        parts.append(printed_table(experiment.printed))
    left = [job for job in jobs if not job.finished]
    bad = [job for job in left if job.failed]
    missing = [f"failed: {j.folder.name} ({' '.join(j.overrides)}): {j.failed}" for j in bad]
    waiting = [job.folder.name for job in left if not job.failed]
    if waiting:
        shown = ", ".join(waiting[:SHOWN]) + (", ..." if len(waiting) > SHOWN else "")
        missing.append(f"not run: {len(waiting)} jobs ({shown})")
    parts.append("\n".join(f"- {line}" for line in (*lines, *missing)))
    return "\n\n".join(parts) + "\n"


def provenance(
    experiment: Experiment, jobs: Sequence[Job], records: Sequence[Record], command: str
) -> list[str]:
    """What the figures come from: commit, seeds, machine, time."""
    complete = [job for job in jobs if job.finished]
    figures = [record.figures for record in records if record.figures]
    devices = sorted({str(each["time/device"]) for each in figures if "time/device" in each})
    minutes = [minutes_taken(job) or 0.0 for job in complete]
    return [
        f"command: `{command}`",
        f"version {mosa.__version__}, {made_by(complete)}",
        f"seeds: {', '.join(map(str, experiment.seeds))}; ± is the standard deviation over them, of one seed there is none",
        f"machine: {', '.join(devices) or 'none'}; collected under Python {platform.python_version()}",
        f"{len(complete)} of {len(jobs)} jobs complete, {sum(minutes):.1f} minutes of jobs, written "
        f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
    ]


def made_by(jobs: Sequence[Job]) -> str:
    """The states of the program that complete jobs were run with, the commonest first; of those that do not say it the present
    one."""
    present = commit()
    counts = Counter(commit_of(job) or present for job in jobs) or Counter([present])
    (first, _), *others = counts.most_common()
    more = ", ".join(f"{count} job{'s' * (count > 1)} of {other}" for other, count in others)
    return f"commit {first}" + (f" ({more})" if more else "")


def write_csv(path: Path, experiment: Experiment, records: Sequence[Record]) -> None:
    """One line for each cell, seed and figure, in the unit of metrics.json times `scale`; empty where it is missing."""
    rows = []
    for record in records:
        places = [record.place[axis].name for axis in experiment.axes]
        for figure in experiment.figures:
            value = "" if (found := record.value(figure)) is None else repr(found)
            own = [figure.label, figure.figure, value, record.job.folder.name]
            rows.append([*places, record.seed, *own])
    write_table(path, [*experiment.axes, "seed", "label", "figure", "value", "run"], rows)

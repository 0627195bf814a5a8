"""The page of results: for every experiment the paper's printed figures beside ours, and which of its claims hold.

It is made from the files `<name>.json` that `write_results` leaves beside the tables; nothing on it is typed by hand."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mosa.analysis.tables import markdown
from mosa.errors import ConfigError, DataError
from mosa.experiments.collecting import OF_MEANS, Cell
from mosa.experiments.commits import commits_since
from mosa.experiments.printed import printed_table
from mosa.experiments.specification import Claim, Experiment, Figure, load_experiment
from mosa.whole_files import write_whole, written_whole

Tables = Mapping[str, Mapping[str, Mapping[str, Cell | None]]]
NOT_RUN = "not run"
EMPTY: dict[str, Any] = {"extra": "", "provenance": [], "pictures": []}
INTRODUCTION = """# The paper's tables, and ours

Made by `mosa-experiment --page` from `docs/results/`; [experiments.md](experiments.md) says how its tables are run. Under each
title: how the data differ from the paper's, which have not been released; our figures; the paper's own; and what of its claims
holds in ours. A claim without a spread rests on one seed. *not run*: no job of that cell is complete."""


def write_json(path: Path, tables: Tables, extra: str, lines: Sequence[str], pictures: Sequence[Path]) -> None:
    """What the page needs of an experiment's results. extra: what its analysis says; lines: where the figures come from."""
    cells = {label: {row: {c: None if cell is None else [cell.mean, cell.sd, cell.count] for c, cell in found.items()}
                     for row, found in rows.items()} for label, rows in tables.items()}  # fmt: skip
    found = {"cells": cells, "extra": extra, "provenance": list(lines), "pictures": [picture.name for picture in pictures]}
    with written_whole(path) as partial:
        partial.write_text(json.dumps(found, indent=1) + "\n")


def read_tables(path: Path) -> tuple[Tables, dict[str, Any]] | None:
    """Of `write_json`; None where there is no file. Errors: DataError naming a damaged one."""
    if not path.is_file():
        return None
    try:
        found = json.loads(path.read_text())
        tables = {label: {row: {c: None if cell is None else Cell(*cell) for c, cell in cells.items()}
                          for row, cells in rows.items()} for label, rows in found["cells"].items()}  # fmt: skip
        return tables, {name: found[name] for name in EMPTY}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{path}: not the results of an experiment ({error}); write them again with --collect") from error


def write_page(folder: Path, names: Sequence[str], results: Path) -> Path:
    """results.md beside the folder of results. folder: of the experiments' files. Errors: ConfigError, DataError."""
    if not results.is_dir():
        raise ConfigError(f"--results: expected a folder with results, found none at {results}")
    parts, lines = [], []
    for name in sorted(names, key=lambda name: not name.startswith("table_")):
        experiment = load_experiment(folder, name)
        parts.append(f"## {experiment.title}\n\n{experiment.note.strip()}")
        found = read_tables(results / f"{name}.json")
        tables, about = found if found is not None else ({}, EMPTY)
        lines.append([experiment.title, *state_of(about["provenance"]), claims_of(experiment, tables)])
        parts += older(about["provenance"])
        if any(cell for rows in tables.values() for cells in rows.values() for cell in cells.values()):
            parts.append(ours(experiment, tables))
        else:
            parts.append(f"Ours: {NOT_RUN}. `mosa-experiment {name}`")
        if about["extra"]:
            parts.append(about["extra"])
        parts += [f"![{experiment.title}]({results.name}/{picture})" for picture in about["pictures"]]
        if experiment.printed is not None:
            parts.append(printed_table(experiment.printed))
        if experiment.claims:
            parts.append("\n".join(f"- {claim.text}: **{verdict(experiment, claim, tables)}**" for claim in experiment.claims))
        if about["provenance"]:
            parts.append(f"All of it: [{name}.md]({results.name}/{name}.md). " + "; ".join(about["provenance"]) + ".")
    beside = [f"[{read_title(page)}]({results.name}/{page.name})" for page in sorted(results.glob("*_from_motion.md"))]
    if beside:
        parts.append(f"## Without images\n\nLaws that were learned from the true motion of a body: {', '.join(beside)}.")
    page = results.parent / "results.md"
    whole = [INTRODUCTION, markdown(["", "jobs complete", "commit (changes of the program since)", "claims"], lines), *parts]
    write_whole(page, "\n\n".join(whole) + "\n")
    return page


def read_title(page: Path) -> str:
    return page.read_text().partition("\n")[0].lstrip("# ")


def state_of(lines: Sequence[str]) -> tuple[str, str]:
    """(jobs complete of all, age) by the lines that say where figures come from."""
    jobs = re.search(r"\b(\d+ of \d+) jobs complete\b", "; ".join(lines))
    if jobs is None:
        return NOT_RUN, ""
    since = commits_since(lines)
    return jobs[1], "" if since is None else f"{since[0]} ({since[1]})"


OUTCOMES = {"holds against": "hold against what was run", "holds": "hold", "within": "within the spread",
            "none is determined": "not determined", "does not": "do not hold", NOT_RUN: NOT_RUN}  # fmt: skip
"""What a verdict begins with, the longer words first, and how such are counted."""


def claims_of(experiment: Experiment, tables: Tables) -> str:
    """How many of the claims hold, and how many not."""
    verdicts = [verdict(experiment, claim, tables) for claim in experiment.claims]
    counts = Counter(next(word for begins, word in OUTCOMES.items() if said.startswith(begins)) for said in verdicts)
    return ", ".join(f"{counts[word]} {word}" for word in OUTCOMES.values() if counts[word])


def older(lines: Sequence[str]) -> list[str]:
    """What is said of figures that an earlier state of the program made, by the lines that say where they come from."""
    found = commits_since(lines)
    if found is None or found[1] == 0:
        return []
    made, count = found
    changed = "1 commit has" if count == 1 else f"{count} commits have"
    return [f"**These figures are of an older commit, {made}:** {changed} changed the program (`mosa/`, `conf/`) since, up to when "
            "this page was made. What it gives now was not run."]  # fmt: skip


def ours(experiment: Experiment, tables: Tables) -> str:
    """A table of all figures: a column for each figure where there is one column, else figures side by side in a cell."""
    figures = [figure for figure in experiment.figures if figure.label in tables]
    rows, columns = list(tables[figures[0].label]), list(next(iter(tables[figures[0].label].values())))

    def text(figure: Figure, row: str, column: str) -> str:
        found = tables[figure.label].get(row, {}).get(column)
        return "" if found is None else found.text(figure.decimals)

    if len(columns) == 1:
        shown = [f for f in figures if any(text(f, row, columns[0]) for row in rows)]
        lines = [[row, *(text(f, row, columns[0]) for f in shown)] for row in rows]
        lines = [[row, *cells] if any(cells) else [row, NOT_RUN, *([""] * (len(shown) - 1))] for row, *cells in lines]
        return f"Ours ({columns[0]}):\n\n" + markdown([experiment.rows, *(f.label for f in shown)], lines)
    lines = []
    for row in rows:
        cells = [[text(f, row, column) for f in figures] for column in columns]
        lines.append([row, *(" / ".join(values) if any(values) else NOT_RUN for values in cells)])
    means = f"\n\n{OF_MEANS}" if "mean" in columns else ""
    return f"Ours ({' / '.join(f.label for f in figures)}):\n\n" + markdown([experiment.rows, *columns], lines) + means


def verdict(experiment: Experiment, claim: Claim, tables: Tables) -> str:
    """What the tables say of a claim, in words and figures."""
    figure = next(f for f in experiment.figures if f.label == claim.figure)
    rows = tables.get(claim.figure, {})
    return within(experiment, claim, rows, tables) if claim.most is not None else ahead(figure, claim, rows)


def place_of(cells: Mapping[str, Cell | None], column: str | None) -> Cell | None:
    """The cell of a column; of none the mean, or the only one."""
    if column is not None:
        return cells.get(column)
    return cells["mean"] if "mean" in cells else next(iter(cells.values())) if len(cells) == 1 else None


def ahead(figure: Figure, claim: Claim, rows: Mapping[str, Mapping[str, Cell | None]]) -> str:
    """Whether a row is better than others, by more than the spread of the two over the seeds."""
    mine = place_of(rows.get(claim.row, {}), claim.column)
    others = {row: place_of(rows.get(row, {}), claim.column) for row in claim.against}
    known = {row: cell for row, cell in others.items() if cell is not None and not math.isnan(cell.mean)}
    if mine is None or not known:
        return NOT_RUN
    sign = -1 if figure.best == "least" else 1
    behind = [row for row, cell in known.items() if not sign * (mine.mean - cell.mean) > 0]
    close = [row for row, cell in known.items() if row not in behind and mine.sd is not None and cell.sd is not None
             and abs(mine.mean - cell.mean) <= math.hypot(mine.sd, cell.sd)]  # fmt: skip
    missing = [row for row in claim.against if row not in known]
    word = "does not hold" if behind else "within the spread" if close else "holds" + bool(missing) * " against those that were run"
    text = f"{word}, {mine.text(figure.decimals)} against " + ", ".join(
        f"{cell.text(figure.decimals)} ({row})" for row, cell in known.items())
    return text + (f"; {NOT_RUN}: {', '.join(missing)}" if missing else "") + ("; one seed" if mine.sd is None else "")


def covered(off: float, sd: float, scale: float | None) -> bool:
    """Whether twice the posterior's deviation covers an error. scale: of what 1 is written as, where the deviation is that of a
    modulus, hence of its logarithm: an error of less than 1 may then be one downwards, which is the larger step."""
    if scale is None:
        return 2 * sd >= off
    off, sd = off / scale, sd / scale
    return 2 * sd >= (math.log1p(off) if off >= 1 else -math.log1p(-off))


def within(experiment: Experiment, claim: Claim, rows: Mapping[str, Mapping[str, Cell | None]], tables: Tables) -> str:
    """Of how many rows a figure is at most what is claimed; of the others, whether twice the posterior's deviation covers it."""
    known = {row: cell for row in rows if (cell := place_of(rows[row], claim.column)) is not None}
    if not known:
        return NOT_RUN
    above = {row: cell for row, cell in known.items() if not cell.mean <= claim.most}
    scales = {f.label: f.scale for f in experiment.figures if f.figure.endswith("_relative_sd")}
    unsure = [] if claim.unless is None else [
        row for row, cell in above.items()
        if (sd := place_of(tables.get(claim.unless, {}).get(row, {}), claim.column)) is not None
        and covered(cell.mean, sd.mean, scales.get(claim.unless))]  # fmt: skip
    wrong = {row: cell for row, cell in above.items() if row not in unsure}
    undetermined = "none is determined" if len(unsure) == len(known) else "holds where it is determined"
    text = f"{'holds' if not above else 'does not hold' if wrong else undetermined}, "
    text += f"{len(known) - len(above)} of {len(known)} within {claim.most:g}"
    if unsure:
        text += "; not determined, and the posterior says so: " + ", ".join(f"{row} ({above[row].text(1)})" for row in unsure)
    if wrong:
        text += "; beyond it: " + ", ".join(f"{row} ({cell.text(1)})" for row, cell in wrong.items())
    return text

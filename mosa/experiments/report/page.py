"""The overview of results: for every experiment its data, which claims hold, and a link to the page with its tables.

It is made from the files `<name>.json` that `write_results` leaves beside the tables; nothing on it is typed by hand."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from mosa.errors import ConfigError, DataError
from mosa.evaluation.analysis.tables import markdown
from mosa.experiments.collecting import Cell
from mosa.experiments.commits import commits_since
from mosa.experiments.specification import Claim, Experiment, Figure, load_experiment
from mosa.system.whole_files import write_whole, written_whole

Cells = Mapping[str, Cell | None]
Rows = Mapping[str, Cells]
Tables = Mapping[str, Rows]
NOT_RUN, OURS = "not run", "ours"
INTRODUCTION = """# Results

This page lists every table and figure of the paper that this program reproduces, and says which
claims hold. Each section links to a page with its tables, the difference between its data and the
paper's, the paper's printed figures, commit, seeds and machine. The table below names the
version and commit of the figures and, in brackets, how many later commits changed the program.
The paper's data were not released: the bodies here are simulated, so their true motion is known.
`mosa-experiment --page` makes this page from `docs/results/` ([how to reproduce the
tables](reproduce.md)).

- **ours** is the default of this program (`adapter=operator`, [fitted](uncertainty.md) by
  Gauss-Newton): the row *adapted* of a run's `results.md`. **prior only** is its row *prior*.
- **four networks (paper)** is the paper's adapter (`adapter=mosa`) with alpha = 0.1, as in its
  text, learned for 40 steps. Its choices and its training [differ from the paper's](paper.md).
  [The other methods](reproduce.md#methods-compared).
- **rms error** is the root mean square distance of particles from their true positions after
  first contact, on held-out drops unless said otherwise. **PSNR** and **SSIM** are those of a
  window around the body ([all metrics](figures.md), [glossary](glossary.md)).
- With several seeds, a claim *holds* if the difference exceeds the spread of both rows over the
  seeds. *not run*: no job is complete. *not determined*: two posterior deviations contain the truth."""


def write_json(path: Path, tables: Tables, lines: Sequence[str]) -> None:
    """The part of an experiment's results that the page needs. lines: where the figures come from."""
    cells = {label: {row: {c: None if cell is None else [cell.mean, cell.sd, cell.count] for c, cell in found.items()}
                     for row, found in rows.items()} for label, rows in tables.items()}  # fmt: skip
    found = {"cells": cells, "provenance": list(lines)}
    with written_whole(path) as partial:
        partial.write_text(json.dumps(found, indent=1) + "\n")


def read_tables(path: Path) -> tuple[Tables, list[str]] | None:
    """Of `write_json`; None where there is no file. Errors: DataError naming a damaged one."""
    if not path.is_file():
        return None
    try:
        found = json.loads(path.read_text())
        tables = {label: {row: {c: None if cell is None else Cell(*cell) for c, cell in cells.items()}
                          for row, cells in rows.items()} for label, rows in found["cells"].items()}  # fmt: skip
        return tables, list(found["provenance"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(
            f"{path}: not the results of an experiment ({error}); write them again with --collect"
        ) from error


def write_page(folder: Path, names: Sequence[str], results: Path) -> Path:
    """results.md beside the folder of results. folder: of the experiments' files. Errors: ConfigError, DataError."""
    if not results.is_dir():
        raise ConfigError(f"--results: expected a folder with results, found none at {results}")
    parts, lines = [], []
    for name in sorted(names, key=lambda name: not name.startswith("table_")):
        experiment = load_experiment(folder, name)
        parts.append(f"## {experiment.title}")
        tables, provenance = read_tables(results / f"{name}.json") or ({}, [])
        # results of before may have other rows
        known = {option.name for option in experiment.axes[experiment.rows]}
        tables = {
            label: {row: cells for row, cells in rows.items() if row in known}
            for label, rows in tables.items()
        }
        lines.append([experiment.title, *state_of(provenance), *claims_of(experiment, tables)])
        if not provenance:
            parts.append(f"Not run. Command: `mosa-experiment {name}`")
        if experiment.claims:
            parts.append(
                "\n".join(
                    listed(claim.text, verdict(experiment, claim, tables))
                    for claim in experiment.claims
                )
            )
        if experiment.plot == "map":
            parts += [said] if (said := ranges(experiment, tables)) else []
        if provenance:
            parts.append(f"[Tables, seeds, machine and command]({results.name}/{name}.md)")
    beside = [
        f"[{page.read_text().splitlines()[0].lstrip('# ')}]({results.name}/{page.name})"
        for page in sorted(results.glob("*_from_motion.md"))
    ]
    if beside:
        parts.append(
            f"## Without images\n\nLaws learned from the true motion of a body: {', '.join(beside)}."
        )
    page = results.parent / "results.md"
    age = "version, commit (changes of the program since)"
    header = ["", "jobs complete", age, "the paper's claims", "claims about ours"]
    whole = [INTRODUCTION, markdown(header, lines), *parts]
    write_whole(page, "\n\n".join(whole) + "\n")
    return page


def ranges(experiment: Experiment, tables: Tables) -> str:
    """A line for each figure of a map: its smallest and largest cell, and where they are."""
    lines = []
    for figure in experiment.figures:
        cells = [
            (cell.mean, f"{cell.text(figure.decimals)} ({row}, {column})")
            for row, columns in tables.get(figure.label, {}).items()
            for column, cell in columns.items()
            if cell is not None and math.isfinite(cell.mean)
        ]
        if cells:
            axes = f"{experiment.rows}, {experiment.columns}"
            lines.append(f"- {figure.label} ({axes}): {min(cells)[1]} to {max(cells)[1]}")
    return "\n".join(lines)


def state_of(lines: Sequence[str]) -> tuple[str, str]:
    """(jobs complete of all, age) by the lines that say where figures come from."""
    jobs = re.search(r"\b(\d+ of \d+) jobs complete\b", "; ".join(lines))
    if jobs is None:
        return NOT_RUN, ""
    since, said = commits_since(lines), "; ".join(lines)
    age = sorted(set(re.findall(r"\bversion (\d[\d.]*\d)", said)))
    changed = ", with changes" if re.search(r"\bcommit [0-9a-f]+, with changes", said) else ""
    age += [] if since is None else [f"{since[0]}{changed} ({since[1]})"]
    return jobs[1], ", ".join(age)


OUTCOMES = {"holds against": ("holds against what was run", "hold against what was run"), "holds": ("holds", "hold"),
            "within": ("within the spread", "within the spread"), "none is determined": ("not determined", "not determined"),
            "does not": ("does not hold", "do not hold"), NOT_RUN: (NOT_RUN, NOT_RUN)}  # fmt: skip
"""What a verdict begins with, the longer words first, and how one and several of them are said."""


def claims_of(experiment: Experiment, tables: Tables) -> tuple[str, str]:
    """How many of the claims hold, and how many not: of the paper's, which are about its own methods, and of those about ours."""
    counts: tuple[Counter, Counter] = Counter(), Counter()
    for claim in experiment.claims:
        said = verdict(experiment, claim, tables)
        counts[claim.most is not None or claim.row == OURS][
            next(begins for begins in OUTCOMES if said.startswith(begins))
        ] += 1
    of_paper, of_ours = (", ".join(f"{found[begins]} {words[found[begins] > 1]}" for begins, words in OUTCOMES.items()
                                   if found[begins]) for found in counts)  # fmt: skip
    return of_paper, of_ours


def listed(claim: str, said: str) -> str:
    """A claim as an item of a list, with its outcome, and one item below it for each comparison."""
    outcome, _, figures = said.partition(", ")
    compared = re.split(r"(?<=\)), (?=[\d.]+(?: ± [\d.]+)? against )", figures) if figures else []
    return "\n    - ".join([f"- {claim}: **{outcome}**", *compared])


def verdict(experiment: Experiment, claim: Claim, tables: Tables) -> str:
    """What the tables say of a claim, in words and figures."""
    figure = next(f for f in experiment.figures if f.label == claim.figure)
    rows = tables.get(claim.figure, {})
    if claim.most is not None:
        return within(experiment, claim, rows, tables)
    return ahead(figure, claim, rows)


def place_of(cells: Cells, column: str | None) -> Cell | None:
    """The cell of a column; of none the mean, or the only one."""
    if column is not None:
        return cells.get(column)
    if "mean" in cells:
        return cells["mean"]
    return next(iter(cells.values())) if len(cells) == 1 else None


class Compared(NamedTuple):
    """Two rows over the columns in which both have finite figures. mine, other: means over them; without: the other columns;
    better: in how many of those that were run of both the first is ahead, or the other one diverged or failed; of: their number."""

    mine: Cell
    other: Cell
    without: list[str]
    better: int
    of: int


def compared(mine: Cells, other: Cells, column: str | None, sign: int) -> Compared | None:
    """None where they share no column. sign: 1 where more is better, -1 where less is."""
    names = [column] if column is not None else [c for c in mine if c != "mean"] or list(mine)
    pairs = {c: (mine.get(c), other.get(c)) for c in names}
    pairs = {c: pair for c, pair in pairs.items() if None not in pair}
    both = {c: p for c, p in pairs.items() if all(math.isfinite(cell.mean) for cell in p)}
    if not both:
        return None
    better = sum(
        math.isfinite(a.mean) and (c not in both or sign * (a.mean - b.mean) > 0)
        for c, (a, b) in pairs.items()
    )
    means = mine.get("mean"), other.get("mean")
    if len(both) < len(names) or column is not None or None in means:
        means = tuple(averaged(cells) for cells in zip(*both.values()))
    return Compared(*means, [c for c in names if c not in both], better, len(pairs))


def averaged(cells: Sequence[Cell]) -> Cell:
    """Mean of means; their seeds differ independently."""
    sds, count = [each.sd for each in cells], len(cells)
    sd = None if None in sds else math.hypot(*sds) / count
    return Cell(sum(each.mean for each in cells) / count, sd, min(each.count for each in cells))


def outcome(found: Compared, sign: int, spread: float) -> str:
    """ahead | close | behind: by more than the spread over the seeds; of one seed, than what is given."""
    gain = sign * (found.mine.mean - found.other.mean)
    if found.mine.sd is not None and found.other.sd is not None:
        spread = math.hypot(found.mine.sd, found.other.sd)
    return "close" if abs(gain) <= spread and gain != 0 else "ahead" if gain > 0 else "behind"


def ahead(figure: Figure, claim: Claim, rows: Rows) -> str:
    """Whether a row is better than others, by more than the spread of the two over the seeds."""
    mine, sign = rows.get(claim.row, {}), -1 if figure.best == "least" else 1
    if claim.each:
        return ahead_in_each(figure, claim, rows, sign)
    found = {row: compared(mine, rows.get(row, {}), claim.column, sign) for row in claim.against}
    known = {row: each for row, each in found.items() if each is not None}
    if not known:
        return NOT_RUN
    said = {outcome(each, sign, claim.spread) for each in known.values()}
    missing = [row for row in claim.against if row not in known]
    word = ("does not hold" if "behind" in said else "within the spread" if "close" in said
            else "holds" + bool(missing) * " against those that were run")  # fmt: skip
    parts = []
    for row, each in known.items():
        notes = [row] + [f"better in {each.better} of {each.of}"] * (each.of > 1)
        notes += [f"without {', '.join(each.without)}"] * bool(each.without)
        pair, usual = (each.mine, each.other), figure.decimals
        # rounding may not hide which of the two is ahead
        apart = (
            n for n in range(usual, usual + 3) if len({f"{cell.mean:.{n}f}" for cell in pair}) > 1
        )
        decimals = next(apart, usual)
        own, other = (cell.text(decimals) for cell in pair)
        parts.append(f"{own} against {other} ({'; '.join(notes)})")
    text = f"{word}, {', '.join(parts)}" + f"; {NOT_RUN}: {', '.join(missing)}" * bool(missing)
    return text + "; one seed" * any(each.mine.sd is None for each in known.values())


def ahead_in_each(figure: Figure, claim: Claim, rows: Rows, sign: int) -> str:
    """Whether a row is better than all others in every column, with those in which it is not."""
    mine, known = rows.get(claim.row, {}), dict[str, str]()
    for column, own in mine.items():
        others = {row: rows.get(row, {}).get(column) for row in claim.against}
        others = {row: cell for row, cell in others.items() if cell is not None}
        if column == "mean" or own is None or not others:
            continue
        if not math.isfinite(own.mean):
            known[column] = f"{column}: {own.text(figure.decimals)}"
            continue
        # None: the other one diverged
        found = {row: compared(mine, rows[row], column, sign) for row in others}
        both = {row: each for row, each in found.items() if each is not None}
        bad = [row for row in both if outcome(both[row], sign, claim.spread) != "ahead"]
        worse = ", ".join(f"{others[row].text(figure.decimals)} ({row})" for row in bad)
        known[column] = f"{column}: {own.text(figure.decimals)} against {worse}" if bad else ""
    if not known:
        return NOT_RUN
    good = [column for column, said in known.items() if not said]
    some = 0 < len(good) < len(known)
    said = "holds" if len(good) == len(known) else "does not hold"
    text = f"{said}, ahead in {len(good)} of {len(known)}"
    text += f" ({', '.join(good)})" * some + "".join(f"; {said}" for said in known.values() if said)
    return text + "; one seed" * all(cell is None or cell.sd is None for cell in mine.values())


def covered(off: float, sd: float, scale: float | None) -> bool:
    """Whether twice the posterior's deviation covers an error. scale: of what 1 is written as, where the deviation is that of a
    modulus, hence of its logarithm: an error of less than 1 may then be one downwards, which is the larger step (of what is off
    upwards `parameters` knows more)."""
    if scale is None:
        return 2 * sd >= off
    off, sd = off / scale, sd / scale
    return 2 * sd >= (math.log1p(off) if off >= 1 else -math.log1p(-off))


def within(experiment: Experiment, claim: Claim, rows: Rows, tables: Tables) -> str:
    """Of how many rows a figure is at most what is claimed; of the others, whether twice the posterior's deviation covers it."""
    limits = {row: most for row in rows if (most := claim.limit(row)) is not None}
    known = {row: cell for row in limits if (cell := place_of(rows[row], claim.column)) is not None}
    if not known:
        return NOT_RUN
    above = {row: cell for row, cell in known.items() if not cell.mean <= limits[row]}
    scales = {f.label: f.scale for f in experiment.figures if f.figure.endswith("_relative_sd")}
    unsure = [] if claim.unless is None else [
        row for row, cell in above.items()
        if (sd := place_of(tables.get(claim.unless, {}).get(row, {}), claim.column)) is not None
        and covered(cell.mean, sd.mean, scales.get(claim.unless))]  # fmt: skip
    wrong = [row for row in above if row not in unsure]
    open_ = "none is determined" if len(unsure) == len(known) else "holds where it is determined"
    unit = match[1] if (match := re.search(r"\[(.+)\]$", claim.figure)) else ""
    text = f"{'holds' if not above else 'does not hold' if wrong else open_}, "
    bounds = [limits[row] for row in known]
    most = " to ".join(dict.fromkeys(f"{end(bounds):g}" for end in (min, max)))
    text += f"{len(known) - len(above)} of {len(known)} within {most} {unit}".rstrip()
    for which, said in ((unsure, "not determined"), (wrong, "beyond it")):
        listed = ", ".join(f"{row} ({above[row].text(1)})" for row in which)
        text += f"; {said}: {listed}" * bool(which)
    return text

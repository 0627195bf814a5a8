"""The figures that the paper prints, from printed.yaml."""

from __future__ import annotations

from pathlib import Path

import yaml

from mosa.evaluation.analysis.tables import markdown

PRINTED = Path(__file__).with_name("printed.yaml")


def printed_table(name: str) -> str:
    """The paper's own figures as Markdown, a table for each label; parameters, whose cells are lists, have a row each. Errors:
    KeyError for an entry that is not there."""
    entry = yaml.safe_load(PRINTED.read_text())[name]
    rows, columns = entry["rows"], entry["columns"]
    parts = [f"The paper prints ({entry['title']}):"]
    if "parameters" in rows:
        values = {row: [str(cell).split(", ") for (cell,) in cells] for row, cells in rows.items()}
        lines = [[column, *each] for k, column in enumerate(columns)
                 for each in zip(*(cells[k] for cells in values.values()))]  # fmt: skip
        return "\n\n".join([*parts, markdown(["", "parameter", *list(rows)[1:]], lines)])
    for k, label in enumerate(entry["labels"]):
        lines = [
            [row, *("" if cell[k] is None else str(cell[k]) for cell in cells)]
            for row, cells in rows.items()
        ]
        parts += [label, markdown(["", *columns], lines)]
    return "\n\n".join(parts)

"""The figures that the paper prints, from printed.yaml."""

from __future__ import annotations

from pathlib import Path

import yaml

from mosa.evaluation.analysis.tables import markdown

PRINTED = Path(__file__).with_name("printed.yaml")


def printed_table(name: str) -> str:
    """The paper's own figures as Markdown. Errors: KeyError for an entry that is not there."""
    entry = yaml.safe_load(PRINTED.read_text())[name]
    lines = [[row, *(" / ".join("" if v is None else str(v) for v in values) for values in cells)]
             for row, cells in entry["rows"].items()]  # fmt: skip
    return f"The paper prints ({entry['title']}; {' / '.join(entry['labels'])}):\n\n" + markdown(
        ["", *entry["columns"]], lines
    )

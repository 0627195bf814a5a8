"""Measurements as a csv file: a header, a row for each sample."""

from __future__ import annotations

import csv
from itertools import dropwhile
from pathlib import Path


def read_table(path: Path) -> tuple[list[str], list[list[str]]]:
    """Names of the columns, and the cells of each row below them, which may be fewer or more. Spaces around cells, rows of empty
    cells and those behind the last column, as spreadsheets leave them, and lines above the names that begin with # are left out:
    below them #1 may be a name. Errors: OSError, csv.Error, UnicodeDecodeError."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        read = [[cell.strip() for cell in row] for row in csv.reader(file, skipinitialspace=True)]
    names, *rows = list(dropwhile(lambda row: row[0][:1] == "#", filter(any, read))) or [[]]
    while names and not names[-1]:
        names.pop()
    end = len(names)
    return names, [row if any(row[end:]) else row[:end] for row in rows]

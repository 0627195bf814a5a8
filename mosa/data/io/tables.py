"""Measurements as a csv file: a header, a row for each sample."""

from __future__ import annotations

import csv
from itertools import dropwhile
from pathlib import Path

from mosa.errors import DataError


def read_table(path: Path) -> tuple[list[str], list[list[str]]]:
    """Names of the columns, and a cell for each of them in each row below: a row may leave out its last ones, which are then empty.
    Spaces around cells, rows of empty cells and those behind the last column, as spreadsheets leave them, and lines above the names
    that begin with # are left out: below them #1 may be a name. Errors: OSError, UnicodeDecodeError, csv.Error for a row with more
    cells than there are names, as decimal commas make them, and for columns that other signs separate."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        read = [[cell.strip() for cell in row] for row in csv.reader(file, skipinitialspace=True)]
    names, *rows = list(dropwhile(lambda row: row[0][:1] == "#", filter(any, read))) or [[]]
    while names and not names[-1]:
        names.pop()
    way = "separate columns by commas, and write numbers with a decimal point"
    if len(names) == 1 and {";", "\t"}.intersection(names[0]):
        raise csv.Error(f"one column {names[0]!r}: {way}")
    end = len(names)
    for number, row in enumerate(rows, 1):
        if any(row[end:]) and row[0][:1] != "#":
            raise csv.Error(f"{len(row)} cells below {end} names in row {number}: {way}")
    return names, [row[:end] + [""] * (end - len(row)) for row in rows]


def number(text: str, where: str) -> float:
    """Of a cell, NaN of an empty one. where: file, row and column. Errors: DataError."""
    try:
        return float(text or "nan")
    except ValueError as error:
        raise DataError(f"{where}: expected a number or an empty cell, found {text!r}") from error

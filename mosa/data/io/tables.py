"""Measurements as a csv file: a header, a row for each sample."""

from __future__ import annotations

import csv
from pathlib import Path


def read_table(path: Path) -> tuple[list[str], list[list[str]]]:
    """Names of the columns, and the cells of each row below them, which may be fewer or more. Spaces around cells, rows of empty
    cells, as spreadsheets leave them, and lines that begin with # are left out. Errors: OSError, csv.Error, UnicodeDecodeError."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        read = [[cell.strip() for cell in row] for row in csv.reader(file, skipinitialspace=True)]
    names, *rows = [row for row in read if any(row) and row[0][:1] != "#"] or [[]]
    return names, rows

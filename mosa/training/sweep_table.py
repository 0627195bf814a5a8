"""One table over all jobs of a sweep: overrides, figures, time, failures. Imports nothing heavy."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import yaml

from mosa.errors import DataError
from mosa.system.whole_files import written_whole

FAILED = "failed"  # folder of a sweep: <number>.txt of each job that failed
SHOWN = ("test/rms_m", "train/rms_m", "val/loss", "id/E", "id/nu", "posterior/E_relative_sd")
"""Figures of the table on the screen, where a job has them; the file has all."""
Row = dict[str, object]


def jobs_of(folder: Path) -> list[Path]:
    """The jobs' folders, `<number>_...`, in the order of their numbers."""
    found = [path for path in folder.glob("*") if path.name.partition("_")[0].isdecimal()]
    return sorted((p for p in found if p.is_dir()), key=lambda p: int(p.name.partition("_")[0]))


def overrides_of(job: Path) -> dict[str, str]:
    """What the job was asked for on the command line, by key."""
    file = job / ".hydra" / "overrides.yaml"
    words = yaml.safe_load(file.read_text()) if file.is_file() else []
    return {key: value for key, _, value in (str(word).partition("=") for word in words or ())}


def sweep_table(folder: str | Path) -> list[Row]:
    """A row for each job: job, state (complete | failed | not complete), message of a failure, its overrides, total time [s], and
    all figures of its metrics.json. Errors: DataError where the folder has no jobs, or for a damaged file."""
    folder = Path(folder)
    rows: list[Row] = []
    for job in jobs_of(folder):
        number = job.name.partition("_")[0]
        reason, metrics = folder / FAILED / f"{number}.txt", job / "metrics.json"
        row: Row = {"job": int(number), "folder": job.name, "state": "not complete", "message": ""}
        figures: Row = {}
        try:
            row |= overrides_of(job)
            if metrics.is_file():
                row["state"], figures = "complete", json.loads(metrics.read_text())
            elif reason.is_file():
                row |= {"state": "failed", "message": " ".join(reason.read_text().split())}
        except (OSError, ValueError, yaml.YAMLError) as error:
            raise DataError(f"{job}: a damaged file ({error}); remove the job's folder") from error
        row["time_s"] = seconds(figures) or ""
        rows.append(row | {k: v for k, v in figures.items() if k not in row})  # seed is both
    if not rows:
        raise DataError(f"{folder}: expected the folder of a sweep with 0_..., 1_..., found no job")
    return rows


def seconds(figures: Mapping[str, object]) -> float:
    """All stages of a run together [s]; 0 where none was measured."""
    keys = (k for k in figures if k.startswith("time/") and k.endswith("_s") and "_per_" not in k)
    return sum(value for key in keys if isinstance(value := figures[key], int | float))


def columns_of(rows: Sequence[Row]) -> list[str]:
    """In the order of their first appearance; a job that failed has no figures."""
    return list(dict.fromkeys(name for row in rows for name in row))


def write_table(folder: str | Path) -> tuple[list[Row], list[Path]]:
    """(rows, files written): sweep.csv, and sweep.parquet where pandas and pyarrow are installed."""
    folder = Path(folder)
    rows = sweep_table(folder)
    with (
        written_whole(folder / "sweep.csv") as partial,
        partial.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.DictWriter(file, columns_of(rows))
        writer.writeheader()
        writer.writerows(rows)
    try:
        import pandas  # type: ignore[import-not-found,import-untyped,unused-ignore]
        import pyarrow  # type: ignore[import-not-found,import-untyped,unused-ignore]  # noqa: F401
    except ImportError:
        return rows, [folder / "sweep.csv"]
    with written_whole(folder / "sweep.parquet") as partial:
        pandas.read_csv(folder / "sweep.csv").to_parquet(partial)
    return rows, [folder / "sweep.csv", folder / "sweep.parquet"]


def text_of(rows: Sequence[Row]) -> str:
    """For a screen: the overrides that differ among the jobs, some figures, time and state."""
    fixed = {"job", "folder", "state", "message", "time_s"}
    varied = []
    for name in columns_of(rows):
        values = {row.get(name) for row in rows}
        numbers = any(isinstance(value, float | int) for value in values)
        if name not in fixed and "/" not in name and len(values) > 1 and not numbers:
            varied.append(name)
    shown = [name for name in SHOWN if any(name in row for row in rows)]
    header = ["job", *varied, *shown, "time_s", "state"]
    cells = [header, *([said(row.get(name, "")) for name in header] for row in rows)]
    widths = [max(len(line[k]) for line in cells) for k in range(len(header))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(line, widths)).rstrip() for line in cells)


def said(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)

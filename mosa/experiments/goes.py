"""How long the jobs of a folder have taken in all, however often their command was stopped and given again."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

from mosa.errors import DataError
from mosa.system.whole_files import write_whole

GOES = "goes.csv"
"""File in the folder of the runs: a row for each time that jobs were run there."""


@dataclass
class Go:
    """One of these times. began: UTC; devices: how many; jobs: to run; expected: minutes until they are complete, as said at the
    start; minutes: so far; complete, failed: jobs so far."""

    began: str
    command: str
    commit: str
    devices: int
    side_by_side: int
    jobs: int
    expected: float
    minutes: float = 0.0
    complete: int = 0
    failed: int = 0


class Clock:
    """Keeps the row of the go that runs now up to date, so that one which is killed has its row too. Rows of other commands that
    run in the same folder meanwhile are kept as they are."""

    def __init__(self, runs: Path, go: Go) -> None:
        self.runs, self.go, self.start = runs, go, time.perf_counter()
        read_goes(runs)  # a damaged file is said before any job runs

    def ended(self, failed: bool) -> None:
        """A job has."""
        self.go.failed += failed
        self.go.complete += not failed
        self.write()

    def write(self) -> list[Go]:
        """All goes, this one last."""
        self.go.minutes = round((time.perf_counter() - self.start) / 60, 3)
        own = self.go.began, self.go.command
        goes = [*(go for go in read_goes(self.runs) if (go.began, go.command) != own), self.go]
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(
            [[f.name for f in fields(Go)], *map(astuple, goes)]
        )
        write_whole(self.runs / GOES, text.getvalue())
        return goes


def now() -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime())


def read_goes(runs: Path) -> list[Go]:
    """Errors: DataError naming the file."""
    file = runs / GOES
    if not file.is_file():
        return []
    types = {
        "devices": int,
        "side_by_side": int,
        "jobs": int,
        "expected": float,
        "minutes": float,
        "complete": int,
        "failed": int,
    }
    try:
        with open(file, newline="") as lines:
            return [
                Go(**{name: types.get(name, str)(value) for name, value in row.items()})
                for row in csv.DictReader(lines)
            ]
    except (TypeError, ValueError, OSError, csv.Error) as error:
        raise DataError(
            f"{file}: expected a row for each time that jobs were run, found what cannot be read ({error}); "
            "remove it, and times are counted from then on"
        ) from error


def said_of(goes: Sequence[Go]) -> str:
    """One line; of GPUs the hours of all of them together."""
    first = min(goes, key=lambda go: go.began)
    hours, jobs = sum(go.minutes * go.devices for go in goes) / 60, sum(go.complete for go in goes)
    times = "one go" if len(goes) == 1 else f"{len(goes)} goes"
    return (
        f"{jobs} jobs in {times}: {hours:.2f} hours of a device; the first go began with {first.jobs} to run and "
        f"expected {first.expected * first.devices / 60:.2f} for them"
    )

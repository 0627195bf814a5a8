"""What the analyses of an experiment share: names of records, tables on disk, laws from the checkpoints of runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from mosa.experiments.collecting import Record
from mosa.experiments.specification import PRESSED, Experiment
from mosa.twin.twin import Twin


def label(experiment: Experiment, record: Record) -> str:
    """What the record is called where the columns are parts of the picture."""
    return record.place[experiment.rows].name


def prefix(record: Record) -> str:
    return "".join(option.prefix for option in record.place.values())


def checkpoint(record: Record) -> Path:
    """Where a record's run keeps its last checkpoint, whether there is one or not."""
    return record.job.folder / "checkpoints" / "last.ckpt"


def pressed_file(record: Record) -> Path:
    """What `specimens` has measured of a record's laws."""
    return record.job.folder / PRESSED


def first_seeds(
    records: Sequence[Record], prefixes: Sequence[str], files: Sequence[Callable[[Record], Path]]
) -> Iterator[Record]:
    """The records of these models, of several seeds the first that is complete and has one of the files: what a run had learned by
    the time that it was stopped is no result."""
    seen = set()
    for record in records:
        key = tuple(option.name for option in record.place.values())
        if record.figures is None or prefix(record) not in prefixes or key in seen:
            continue
        if any(file(record).is_file() for file in files):
            seen.add(key)
            yield record


def loaded(
    records: Sequence[Record], prefixes: Sequence[str] = ("",)
) -> Iterator[tuple[Record, Twin]]:
    """The records of these models (the learned law's, where nothing else is said) that have a checkpoint, with it; of several seeds
    the first."""
    for record in first_seeds(records, prefixes, [checkpoint]):
        yield record, Twin.load(checkpoint(record))

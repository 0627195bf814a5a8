"""Files that appear under their name complete or not at all, and what a killed process left of them."""

from __future__ import annotations

import csv
import os
import platform
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mosa.errors import ConfigError


def made_folder(folder: str | Path, where: str = "export") -> Path:
    """A folder, made with its parents. Errors: ConfigError beginning with `where`, where it cannot be written."""
    try:
        made = Path(folder)
        made.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        found = f"{str(folder)[:100]!r} ({error})"
        raise ConfigError(
            f"{where}: expected a folder that can be written, found {found}"
        ) from error
    return made


@contextmanager
def written_whole(path: str | Path) -> Iterator[Path]:
    """Where to write a file that is renamed to `path` afterwards, if nothing went wrong. Each process writes beside the others, and
    removes what processes of this machine that have ended left of the same file. It is on the disk before it gets its name: a
    machine that loses power would else keep a name without content."""
    path = Path(path)
    own = f"{path.name}.{platform.node().replace('.', '_')}."
    for old in path.parent.glob(f"{own.replace('[', '[[]')}*.partial"):
        if not _runs(old.name.removeprefix(own).removesuffix(".partial")):
            old.unlink(missing_ok=True)
    partial = path.with_name(f"{own}{os.getpid()}.partial")
    try:
        yield partial
        with open(partial, "rb") as written:
            os.fsync(written.fileno())
        os.replace(partial, path)
    except OSError as error:
        # a disk that fills up meanwhile names no file
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise
    finally:
        partial.unlink(missing_ok=True)


def write_whole(path: str | Path, text: str) -> None:
    """A text, as `written_whole` writes; lines end as they are given."""
    with written_whole(path) as partial:
        partial.write_bytes(text.encode())


def write_table(path: str | Path, header: Sequence[object], rows: Iterable[Any]) -> None:
    """A csv file."""
    with written_whole(path) as partial, open(partial, "w", newline="") as file:
        csv.writer(file).writerows([header, *rows])


def _runs(number: str) -> bool:
    """Whether a process of this machine has that number."""
    try:
        os.kill(int(number), 0)
    except (ProcessLookupError, ValueError):
        return False
    except OSError:  # another user's
        return True
    return True

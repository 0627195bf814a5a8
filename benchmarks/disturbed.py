"""A program of this repository that is disturbed when it writes: what a kill, a full disk or a read-only one does to its files.

    python benchmarks/disturbed.py list:0 outputs/a train.py debug=default hydra.run.dir=outputs/a     # number what it writes
    python benchmarks/disturbed.py kill:12 outputs/a train.py ...                                      # SIGKILL at the twelfth

HOW:N FOLDER[:FOLDER] PROGRAM ARGUMENTS. Counted are the files that the program opens for writing, renames or removes below the
folders, and the folders that it makes there. HOW: kill, term, int (a signal before the N-th); full (the N-th fails as on a full
disk); read_only (all from the N-th on fail); list.
"""

from __future__ import annotations

import errno
import os
import runpy
import signal
import sys

SIGNALS = {"kill": signal.SIGKILL, "term": signal.SIGTERM, "int": signal.SIGINT}
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT


def disturb(how: str, number: int, folders: list[str]) -> None:
    """Install what counts, and acts; an audit hook cannot be taken away again."""
    seen, busy = 0, False

    def hook(event: str, arguments: tuple) -> None:
        nonlocal seen, busy
        if busy or event not in ("open", "os.rename", "os.remove", "os.mkdir"):
            return
        place = arguments[0]
        if not isinstance(place, (str, bytes, os.PathLike)):  # of an open file
            return
        if event == "open" and not (isinstance(arguments[2], int) and arguments[2] & WRITING):
            return
        path = os.path.abspath(os.fsdecode(place))
        if not any(path.startswith(folder) for folder in folders):
            return
        seen += 1
        if how == "list" or seen == number:
            busy = True
            print(f"disturbed: {how} {seen} {event} {path}", file=sys.stderr, flush=True)
            busy = False
        if how in SIGNALS and seen == number:
            os.kill(os.getpid(), SIGNALS[how])
        if (how == "full" and seen == number) or (how == "read_only" and seen >= number):
            code = errno.ENOSPC if how == "full" else errno.EROFS
            raise OSError(code, os.strerror(code), path)

    sys.addaudithook(hook)


if __name__ == "__main__":
    kind, _, count = sys.argv[1].partition(":")
    signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # a shell that put this into the background had it ignored
    disturb(kind, int(count), [os.path.abspath(folder) for folder in sys.argv[2].split(":")])
    sys.argv = sys.argv[3:]
    sys.path[0] = os.path.dirname(os.path.abspath(sys.argv[0]))
    runpy.run_path(sys.argv[0], run_name="__main__")

"""Standard output that may lose its reader while the program goes on."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO


class TolerantStream:
    """A text stream whose reader may end before the program (`| head -1`, a closed terminal, a log on a full disk): later output is
    discarded, and the program goes on."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def __getattr__(self, name: str):
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        return self.attempted(lambda: self.stream.write(text), len(text))

    def flush(self) -> None:
        self.attempted(self.stream.flush, None)

    def attempted(self, act: Callable, otherwise):
        try:
            return act()
        except OSError:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            # also for what runs below this process, and for what is still in the buffer
            os.dup2(nowhere, self.stream.fileno())
            os.close(nowhere)
            return otherwise


@contextmanager
def tolerant_output() -> Iterator[None]:
    """Within it standard output and error may lose their readers; missing streams (`>&-`) are replaced by /dev/null."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (
        TolerantStream(open(os.devnull, "w") if stream is None else stream) for stream in before
    )
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        sys.stdout, sys.stderr = before

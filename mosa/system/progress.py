"""Progress: tqdm's bar on a terminal, and whole lines in a file or a pipe, where a bar that is redrawn is one endless line."""

from __future__ import annotations

import sys
from typing import TextIO

from tqdm import tqdm as bar

LINE_SECONDS = 15.0  # between two lines of what is under way


class Lines:
    """A stream in which each state of a bar is a line of its own."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> None:
        if text := text.replace("\r", "").strip():
            self.stream.write(text + "\n")

    def flush(self) -> None:
        self.stream.flush()


class tqdm(bar):
    """tqdm's bar, with its arguments. Where its file is no terminal: a line at the start, every `LINE_SECONDS`, and at the end."""

    def __init__(self, *args, **options) -> None:
        stream = options.get("file") or sys.stderr
        if not stream.isatty():  # ncols=0: figures without the bar
            options |= {"file": Lines(stream), "mininterval": LINE_SECONDS, "maxinterval": LINE_SECONDS,
                        "ncols": 0, "dynamic_ncols": False, "leave": True}  # fmt: skip
        super().__init__(*args, **options)

"""Progress: tqdm's bar on a terminal, and whole lines in a file or a pipe, where a bar that is redrawn is one endless line."""

from __future__ import annotations

import sys

from tqdm import tqdm as bar

LINE_SECONDS = 15.0
"""Between two lines of what is under way."""


class tqdm(bar):
    """tqdm's, with its arguments. Where its file is no terminal: a line at the start, every `LINE_SECONDS`, and at the end."""

    def __init__(self, *args, **options) -> None:
        self.lines, self.said = not (options.get("file") or sys.stderr).isatty(), None
        if self.lines:  # ncols=0: figures without the bar
            options |= {
                "mininterval": LINE_SECONDS,
                "maxinterval": LINE_SECONDS,
                "ncols": 0,
                "dynamic_ncols": False,
            }
        super().__init__(*args, **options)

    def display(self, msg=None, pos=None) -> bool:
        if not self.lines:
            return super().display(msg, pos)
        if msg is None:
            self.fp.write(f"{self}\n")
            self.fp.flush()
            self.said = self.n
        return True

    def close(self) -> None:
        if not self.lines or getattr(self, "disable", True):
            return super().close()
        if self.said != self.n:
            self.display()
        self.leave = False  # the line is there already; tqdm would add one
        fp, self.fp = self.fp, _Silent()
        super().close()
        self.fp = fp


class _Silent:
    """Takes what tqdm writes to clear a bar."""

    def write(self, _text: str) -> None:
        pass

    def flush(self) -> None:
        pass

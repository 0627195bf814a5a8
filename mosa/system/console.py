"""What a command says on the screen and in its log."""

from __future__ import annotations

import importlib
import logging
import sys
import warnings
from collections.abc import Sequence


def say_version(words: Sequence[str] | None = None) -> None:
    """Print mosa's version and end, where the command line (None: of this process) asks for it."""
    if "--version" in (sys.argv[1:] if words is None else words):
        print("mosa", importlib.import_module("mosa").__version__)  # beside all layers
        sys.exit(0)


def begin_log() -> None:
    """Warnings become lines of the log, on the screen and in the run folder; the chatter of libraries does not."""
    for name in ("matplotlib", "imageio", "PIL", "fsspec"):
        logging.getLogger(name).setLevel(logging.WARNING)
    logging.raiseExceptions = False  # a line that cannot be written (a closed screen, a full disk) is no reason for a traceback
    warnings.formatwarning = one_line
    logging.captureWarnings(True)


def one_line(message, category, filename, lineno, line=None) -> str:
    """Our own warnings say themselves what they are about, others where they come from."""
    if category is UserWarning:
        return f"warning: {message}"
    return f"{filename}:{lineno}: {category.__name__}: {message}"


def fail(message: str) -> None:
    """Say on the screen what ended the run, and note it in the run folder's log."""
    print(f"\n{message}", file=sys.stderr)
    record = logging.LogRecord("mosa", logging.ERROR, __file__, 0, message, None, None)
    for handler in logging.getLogger().handlers:
        if isinstance(handler, logging.FileHandler):
            handler.handle(record)

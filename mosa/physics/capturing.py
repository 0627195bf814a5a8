"""Capturing launches as a graph, which anything else that the thread does meanwhile may break."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager

ATTEMPTS = 3
"""Captures in a row that may fail before there are no more: a library that sets itself up when it is first captured spoils one."""


@contextmanager
def uninterrupted() -> Iterator[None]:
    """No garbage collection inside: it may find an earlier simulator's graphs and buffers, and freeing those breaks the capture."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()

"""What a thread may not do while it captures a CUDA graph."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


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

"""Capturing launches as a graph, which anything else that the thread does meanwhile may break."""

import gc
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

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


class Captures:
    """Tries captures until too many failed in a row. failing: what the warning then says, before the last error."""

    def __init__(self, failing: str, attempts: int = ATTEMPTS) -> None:
        self.failing, self.attempts = failing, attempts

    def succeeds(self, capture: AbstractContextManager, body: Callable[[], None]) -> bool:
        """Whether the launches of `body` were captured; a failure says nothing of the launches themselves."""
        if not self.attempts:
            return False
        try:
            with uninterrupted(), capture:
                body()
        except RuntimeError as error:
            self.attempts -= 1
            if not self.attempts:
                warnings.warn(f"{self.failing}: {error}", stacklevel=2)
            return False
        self.attempts = ATTEMPTS
        return True

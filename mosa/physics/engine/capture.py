"""Capturing launches as a graph, which anything else that the thread does meanwhile may break."""

import gc
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

ATTEMPTS = 3
"""Captures in a row that may fail before there are no more: a library that sets itself up when it is first captured spoils one."""


class Turns:
    """Many threads launch at once, or one captures alone: Warp's capture on a CPU records every thread's launches."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._launching, self._capturing = 0, None

    @contextmanager
    def launching(self) -> Iterator[None]:
        """Beside other launches; within this thread's own capture too."""
        if self._capturing == threading.get_ident():
            yield
            return
        with self._changed:
            self._changed.wait_for(lambda: self._capturing is None)
            self._launching += 1
        try:
            yield
        finally:
            with self._changed:
                self._launching -= 1
                self._changed.notify_all()

    @contextmanager
    def capturing(self) -> Iterator[None]:
        """When no other thread launches, and until it ends none begins to."""
        with self._changed:
            self._changed.wait_for(lambda: self._capturing is None and self._launching == 0)
            self._capturing = threading.get_ident()
        try:
            yield
        finally:
            with self._changed:
                self._capturing = None
                self._changed.notify_all()


ON_CPU = Turns()
"""Of this process."""


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

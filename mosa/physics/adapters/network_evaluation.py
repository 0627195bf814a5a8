"""What evaluations of a network may know of those before and after them."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_AT_HAND = ContextVar("at_hand", default=False)


@contextmanager
def at_hand() -> Iterator[None]:
    """The backward pass of what is evaluated inside follows at once, before the next evaluation: recomputing saves no memory."""
    token = _AT_HAND.set(True)
    try:
        yield
    finally:
        _AT_HAND.reset(token)


def backward_at_hand() -> bool:
    return _AT_HAND.get()

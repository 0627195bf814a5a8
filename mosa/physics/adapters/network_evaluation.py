"""What evaluations of a network may know of those before and after them."""

from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

from torch import Tensor

from mosa.physics.launching import same_memory

Made = TypeVar("Made")
_AT_HAND = ContextVar("at_hand", default=False)
_FROM_WEIGHTS: ContextVar[list | None] = ContextVar("from_weights", default=None)


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


@contextmanager
def same_weights() -> Iterator[None]:
    """No weight changes between the evaluations inside. A pass that is captured opens its own: a replay may find others."""
    token = _FROM_WEIGHTS.set([])
    try:
        yield
    finally:
        _FROM_WEIGHTS.reset(token)


def from_weights(make: Callable[[], Made], weights: Sequence[Tensor], *key: Hashable) -> Made:
    """What `make` makes of weights, inside `same_weights` once for all evaluations with the same key."""
    known = _FROM_WEIGHTS.get()
    if known is None:
        return make()
    for own, of_weights, made in known:
        if own == key and same_memory(of_weights, weights):
            return made
    known.append((key, tuple(weights), make()))
    return known[-1][2]

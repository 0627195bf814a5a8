"""Functions of torch that a GPU runs again as a CUDA graph: many small operations that the host launches at once."""

from __future__ import annotations

import gc
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import torch
from torch import Tensor


@contextmanager
def uninterrupted() -> Iterator[None]:
    """No garbage collection inside: it may find earlier graphs and buffers, and freeing those breaks a capture."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def stream_kept() -> AbstractContextManager[None]:
    """Torch's current stream is afterwards what it was: where a capture fails, torch leaves that of the capture the current one."""
    return torch.cuda.stream(torch.cuda.current_stream())


class Graphed:
    """A function of tensors, and its gradient, which a GPU replays once it has had tensors of these shapes and types.

    It may read other tensors that stay where they are, without a gradient; it may not wait for the GPU, read a number on the host
    or copy from there. What it returns is overwritten by its next call. On a CPU, and where nothing needs a gradient, it is
    called as it is."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self._replayed: dict[tuple, Callable[..., Any]] = {}

    def __call__(self, *tensors: Tensor) -> Any:
        needed = [t.requires_grad for t in tensors]
        if not (tensors[0].is_cuda and torch.is_grad_enabled() and any(needed)):
            return self.function(*tensors)
        kind = tuple((t.shape, t.dtype, needs) for t, needs in zip(tensors, needed))
        if kind not in self._replayed:
            samples = tuple(
                t.detach().clone().requires_grad_(needs) for t, needs in zip(tensors, needed)
            )
            self._replayed[kind] = self._captured(samples)
        return self._replayed[kind](*tensors)

    def _captured(self, samples: tuple[Tensor, ...]) -> Callable[..., Any]:
        try:
            with stream_kept(), uninterrupted(), warnings.catch_warnings():
                # torch warms up on one stream and captures on another, and warns of what it does itself
                warnings.filterwarnings("ignore", "The AccumulateGrad node's stream")
                return torch.cuda.make_graphed_callables(self.function, samples)
        except RuntimeError as error:  # as where memory or a driver does not suffice
            said = str(error).partition("\n")[0]
            warnings.warn(f"no CUDA graph, steps on the GPU take longer ({said})", stacklevel=3)
            return self.function

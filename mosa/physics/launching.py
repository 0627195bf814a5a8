"""Launches of Warp kernels on torch's tensors: where they lie in memory, on which stream, beside which other threads."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Sequence
from contextlib import ContextDecorator, contextmanager, nullcontext

import torch
import warp as wp
from torch import Tensor

SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}
BYTES = 16
"""Kernels read a particle's part in pieces of so many: arrays begin at a multiple."""
APART = 32
"""Numbers of which arrays in one buffer begin at multiples."""
BLOCK = 64
"""Threads of a CUDA block: small ones, so that ten thousand particles are spread over all multiprocessors."""


class Turns(ContextDecorator):
    """Many threads launch at once, or one captures alone: Warp's capture on a CPU records every thread's launches.

    Itself the context of launches, which is entered for every one of them, within this thread's own capture too, and a decorator of
    functions that launch. A capture that waits goes first, so that threads that render without a pause cannot keep it out."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._launching = self._waiting = 0
        self._capturing: int | None = None
        self._own = threading.local()

    def __enter__(self) -> None:
        depth = getattr(self._own, "depth", 0)
        if depth == 0 and self._capturing != threading.get_ident():
            with self._changed:
                while self._capturing is not None or self._waiting:
                    self._changed.wait()
                self._launching += 1
        self._own.depth = depth + 1

    def __exit__(self, *_) -> None:
        self._own.depth -= 1
        if self._own.depth == 0 and self._capturing != threading.get_ident():
            with self._changed:
                self._launching -= 1
                self._changed.notify_all()

    @contextmanager
    def capturing(self) -> Iterator[None]:
        """When no other thread launches, and until it ends none begins to."""
        with self._changed:
            self._waiting += 1
            try:
                self._changed.wait_for(lambda: self._capturing is None and self._launching == 0)
                self._capturing = threading.get_ident()
            finally:
                self._waiting -= 1
        try:
            yield
        finally:
            with self._changed:
                self._capturing = None
                self._changed.notify_all()


ON_CPU = Turns()
"""Of this process."""
NOTHING = nullcontext()
_first: dict[wp.Module, threading.Lock] = {}
"""Whose turn it is to compile a module: each thread would, beside the others."""


def turn(device: torch.device):
    """Context of Warp's work outside of `launch` (meshes, sorts, arrays that are filled): where another thread may be capturing."""
    return NOTHING if device.type == "cuda" else ON_CPU


def filled(kind, *values):
    """An object of a Warp struct with these values of its fields, in their order."""
    made = kind()
    for name, value in zip(kind.vars, values, strict=True):
        setattr(made, name, value)
    return made


def launch(kernel, dim: int, inputs: list, device, adj_inputs: list | None = None) -> None:
    """On Warp's current stream. adj_inputs: launch the adjoint."""
    block = BLOCK if device.is_cuda else None
    with NOTHING if device.is_cuda else ON_CPU:
        if not (device.is_cuda or kernel.module.execs):
            with _first.setdefault(kernel.module, threading.Lock()):
                wp.load_module(kernel.module, device)
        wp.launch(
            kernel, dim, inputs=inputs, adj_inputs=adj_inputs or [], adjoint=adj_inputs is not None, device=device,
            block_dim=block,
        )  # fmt: skip


def warp_stream(device: torch.device):
    """Context in which Warp launches on torch's current stream."""
    if device.type != "cuda":
        return wp.ScopedDevice("cpu")
    # without waiting for Warp's own stream: nothing is left on it, and a stream that is being captured could not
    return wp.ScopedStream(
        wp.stream_from_torch(torch.cuda.current_stream(device)), sync_enter=False
    )


def copies(tensors: Sequence[Tensor]) -> list[Tensor]:
    """Contiguous copies, in one launch on CUDA."""
    made = [torch.empty_like(t, memory_format=torch.contiguous_format) for t in tensors]
    if made:
        torch._foreach_copy_(made, list(tensors))
    return made


def same_memory(a: Sequence[Tensor], b: Sequence[Tensor]) -> bool:
    """Whether these are views of the same memory, one by one. Whoever holds `a` knows that it has not become another tensor's."""
    return len(a) == len(b) and all(s.is_set_to(t) for s, t in zip(a, b))


def aligned(t: Tensor) -> Tensor:
    """t, contiguous and where the kernels can read it in pieces; itself, if it is already."""
    t = t.contiguous()
    return t if t.data_ptr() % BYTES == 0 else t.clone()


def zeros_in_one(
    shapes: Sequence[Sequence[int]], dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, list[Tensor]]:
    """(buffer, its parts of these shapes), each part as `aligned` wants it: all are cleared in one launch."""
    sizes = [-(-math.prod(shape) // APART) * APART for shape in shapes]
    buffer = torch.zeros(sum(sizes), dtype=dtype, device=device)
    return buffer, [
        part[: math.prod(shape)].view(*shape) for part, shape in zip(buffer.split(sizes), shapes)
    ]

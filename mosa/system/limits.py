"""What this machine can hold: sizes that a file or a key asks for are compared with it before memory is asked for."""

from __future__ import annotations

import ctypes
import functools
import gc
import math
import os
import sys
import time
from collections.abc import Iterable
from pathlib import Path

import torch

from mosa.errors import ConfigError, MosaError
from mosa.system.machine_errors import short_of_memory

CGROUP = Path("/sys/fs/cgroup/memory.max")


@functools.cache
def machine_memory() -> int:
    """Bytes of memory of this machine, or of its container where that has a limit."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        limit = CGROUP.read_text().strip()
    except OSError:
        return total
    return min(total, int(limit)) if limit.isdigit() else total


SELDOM = 20.0
"""Seconds between two returns of memory: each takes a quarter of one, short runs would pay it in every stage."""
returned = [-math.inf]  # when it was last


def return_memory() -> None:
    """What nothing refers to goes back to the system. glibc keeps it, in pieces that are too small for what comes next."""
    if time.monotonic() < returned[0] + SELDOM:
        return
    gc.collect()
    returned[0] = time.monotonic()
    if sys.platform == "linux" and hasattr(library := ctypes.CDLL(None), "malloc_trim"):
        library.malloc_trim(0)


def counted(where: str, sizes: Iterable[float], remedy: str, *, each: float = 8, most: float = math.inf,
            error: type[MosaError] = ConfigError) -> tuple[int, ...]:  # fmt: skip
    """Sizes (whole numbers) of an array that is about to be allocated. Their product is compared in floating point, before they
    become integers, which would wrap. It may be `most`, and as many of `each` bytes as fill half of the memory. Errors: `error`."""
    sizes = [min(n, 10**300) if isinstance(n, int) else float(n) for n in sizes]
    most = min(most, machine_memory() / (2 * each))
    if not math.prod(map(float, sizes)) <= most:  # as NaN is not
        raise error(
            f"{where}: expected at most {int(most)}, found {' x '.join(f'{n:.6g}' for n in sizes)}: {remedy}"
        )
    return tuple(map(int, sizes))


def named_device(name: str | torch.device) -> str:
    """The name of a device that torch can use here. Errors: ConfigError."""
    wanted = "device: expected cpu, or cuda on a machine with a GPU, found"
    known = str(name) == "cpu" or str(name).split(":")[0] == "cuda"
    if not isinstance(name, (str, torch.device)) or not known:
        raise ConfigError(f"{wanted} {name!r}")
    try:
        torch.empty(0, device=name)
    except (RuntimeError, AssertionError) as error:  # AssertionError: torch without CUDA
        if short_of_memory(error):
            raise
        raise ConfigError(f"{wanted} {str(name)!r} ({str(error).splitlines()[0]})") from error
    return str(name)

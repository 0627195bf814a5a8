"""What this machine can hold: sizes that a file or a key asks for are compared with it before memory is asked for."""

from __future__ import annotations

import os
from pathlib import Path

import torch

from mosa.errors import ConfigError
from mosa.refused import lacks_memory

CGROUP = Path("/sys/fs/cgroup/memory.max")


def machine_memory() -> int:
    """Bytes of memory of this machine, or of its container where that has a limit."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        limit = CGROUP.read_text().strip()
    except OSError:
        return total
    return min(total, int(limit)) if limit.isdigit() else total


def named_device(name: str | torch.device) -> str:
    """The name of a device that torch can use here. Errors: ConfigError."""
    wanted = "device: expected cpu, or cuda on a machine with a GPU, found"
    if not isinstance(name, (str, torch.device)) or (str(name) != "cpu" and str(name).split(":")[0] != "cuda"):
        raise ConfigError(f"{wanted} {name!r}")
    try:
        torch.empty(0, device=name)
    except (RuntimeError, AssertionError) as error:  # AssertionError: torch without CUDA
        if lacks_memory(error):
            raise
        raise ConfigError(f"{wanted} {str(name)!r} ({str(error).splitlines()[0]})") from error
    return str(name)

"""Warp begins without chatter: lines on every module compiled, and a warning where a machine has no CUDA driver."""

from __future__ import annotations

import ctypes
import functools
import os

import warp as wp


@functools.cache
def start_warp() -> None:
    """Initialise Warp. Its library writes to the file of stderr itself that there is no driver."""
    wp.config.log_level = wp.LOG_WARNING
    if has_driver():
        wp.init()
        return
    try:
        kept = os.dup(2)
    except OSError:  # stderr is closed
        wp.init()
        return
    silent = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(silent, 2)
        wp.init()
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(silent)


def has_driver() -> bool:
    """Whether a CUDA driver's library can be loaded; on Windows, Warp is left to say so."""
    if os.name == "nt":
        return True
    for name in ("libcuda.so", "libcuda.so.1"):
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        return True
    return False

"""Warp begins without chatter: lines on every module compiled, and a warning where a machine has no CUDA driver."""

from __future__ import annotations

import ast
import ctypes
import functools
import hashlib
import os
import sys
import threading

import warp as wp
from warp._src.context import Runtime

ONE_PARSER = sys.version_info < (3, 11, 8) or (3, 12) <= sys.version_info < (3, 12, 2)
"""CPython's `ast.parse` keeps its depth for all threads together (gh-106905): it fails where garbage collection lets another in."""


def headers(_: Runtime) -> str:
    """Folder beside the kernels for Warp's headers, precompiled by this installation for this CPU. Warp would precompile them
    (1.6 s) in each thread that compiles. Clang writes a file beside its place and renames it."""
    installed = os.path.join(wp.__path__[0], "native", "builtin.h")
    words = f"{wp.get_cpu_kernel_cache_key()} {installed} {os.stat(installed).st_mtime_ns}"
    name = f"wp_headers_{hashlib.sha256(words.encode()).hexdigest()[:8]}"
    os.makedirs(folder := os.path.join(str(wp.config.kernel_cache_dir), name), exist_ok=True)
    return folder


@functools.cache
def start_warp() -> None:
    """Initialise Warp. Its library writes to the file of stderr itself that there is no driver. It parses each kernel that is made:
    films do so in a thread beside the reconstruction, so `ast.parse` is for one thread at a time where Python needs that."""
    if ONE_PARSER:
        parse, lock = ast.parse, threading.RLock()

        def alone(*args, **kwargs):
            with lock:
                return parse(*args, **kwargs)

        ast.parse = alone
    wp.config.log_level = wp.LOG_WARNING
    Runtime.get_clang_pch_dir = headers  # type: ignore[assignment, method-assign]
    # vectors of straight code: a fifth of the compiler's time, and kernels are as fast without, with the same bits
    flags = wp.config.cpu_compiler_flags or "-march=native"
    wp.config.cpu_compiler_flags = f"{flags} -fno-slp-vectorize"
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

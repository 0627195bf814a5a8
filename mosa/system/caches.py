"""Folders in which libraries keep code that they compile, and load it from: never the current folder, which may be a stranger's."""

from __future__ import annotations

import os
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

FOLDERS = """HOME TMPDIR XDG_CONFIG_HOME XDG_DATA_HOME XDG_CACHE_HOME WARP_CACHE_PATH CUDA_CACHE_PATH TRITON_HOME TRITON_CACHE_DIR
TORCHINDUCTOR_CACHE_DIR TORCH_EXTENSIONS_DIR TORCH_HOME NUMBA_CACHE_DIR MPLCONFIGDIR JOBLIB_TEMP_FOLDER U2NET_HOME""".split()
"""Variables that say where libraries keep such code, or what it is below."""
_temporary: list[tempfile.TemporaryDirectory[str]] = []


def cache_home() -> str:
    """The user's folder of caches: $XDG_CACHE_HOME, where that is absolute, or ~/.cache."""
    found = os.environ.get("XDG_CACHE_HOME", "")
    return found if os.path.isabs(found) else os.path.expanduser("~/.cache")


def default_cache() -> Path:
    """$XDG_CACHE_HOME/mosa or ~/.cache/mosa."""
    return Path(cache_home()) / "mosa"


def settle_caches() -> None:
    """Variables that are empty or relative count as unset. Where no kernels can be kept, a temporary folder is used until this
    process ends, with a word that names the variable to set."""
    for name in FOLDERS:
        if not os.path.isabs(os.environ.get(name, os.sep)):
            del os.environ[name]
    name = "WARP_CACHE_PATH" if "WARP_CACHE_PATH" in os.environ else "XDG_CACHE_HOME"
    place = os.path.join(
        os.environ.get("WARP_CACHE_PATH", os.path.join(cache_home(), "warp")), version("warp-lang")
    )
    try:
        os.makedirs(place, exist_ok=True)
    except OSError as error:
        _temporary.append(tempfile.TemporaryDirectory(prefix="mosa-", ignore_cleanup_errors=True))
        os.environ[name] = _temporary[-1].name
        print(f"{place}: cannot be made ({error.strerror}): kernels are compiled into a temporary folder, again by every command; "
              f"set {name} to a folder that can be written", file=sys.stderr)  # fmt: skip
    for name in (
        "CUDA_CACHE_PATH",
        "TRITON_CACHE_DIR",
        "TORCHINDUCTOR_CACHE_DIR",
    ):  # by themselves not below XDG_CACHE_HOME
        os.environ.setdefault(name, os.path.join(cache_home(), "mosa", name.lower()))

"""`mosa-export-law`: write a law as text for other programs, and check every text."""

from __future__ import annotations

from pathlib import Path

from mosa.export.checking import check_all
from mosa.export.source import as_json, read_source
from mosa.export.texts import ufl_text, umat, warp_text
from mosa.settings import Whole, typed
from mosa.system.whole_files import made_folder

LARGEST = {"stress": 1e-10, "energy": 1e-10, "tangent": 1e-6}
"""Relative difference that a text may have."""


@typed
def export(
    path: str | Path, folder: str | Path, check: Whole, nu: float | None = None
) -> dict[str, float]:
    """Write umat.f90, law_ufl.py, law_warp.py and law.json of a checkpoint or a material.json. nu: in place of the law's own.

    Returns relative differences at `check` drawn deformations, none for 0. Errors: DataError, ConfigError."""
    found = read_source(path, nu)
    texts = {
        "umat.f90": umat(found),
        "law_ufl.py": ufl_text(found),
        "law_warp.py": warp_text(found),
        "law.json": as_json(found),
    }
    folder = made_folder(folder)
    for name, text in texts.items():
        (folder / name).write_text(text)
    return check_all(found, texts, check) if check else {}

"""A learned or fitted law as text for other programs:  mosa-export-law outputs/.../checkpoints/last.ckpt law/"""

from __future__ import annotations

import argparse
import sys
import warnings
from pathlib import Path

from mosa.system.console import one_line, say_version
from mosa.system.machine_errors import one_message
from mosa.system.threads import settle_threads


def main(words: list[str] | None = None) -> None:
    say_version(words)
    settle_threads()
    parser = argparse.ArgumentParser(prog="mosa-export-law", description=__doc__)
    parser.add_argument("source", help="checkpoint of a run, or material.json of mosa-material")
    parser.add_argument(
        "folder", type=Path, help="where umat.f90, law_ufl.py, law_warp.py and law.json are written"
    )
    parser.add_argument(
        "--check",
        type=int,
        default=1000,
        help="deformations at which every text is compared; 0: none",
    )
    parser.add_argument(
        "--nu",
        type=float,
        help="in place of the law's own, with the same mu: 0.49999 of an incompressible material",
    )
    parser.add_argument(
        "--extensions",
        metavar="MODULE,MODULE",
        help="modules that register the law and its energy (docs/law_export.md)",
    )
    given = parser.parse_args(words)
    from mosa.config.extensions import load_extensions
    from mosa.export.run import LARGEST, export

    warnings.formatwarning = lambda *about: f"{one_line(*about)}\n"
    with one_message():
        load_extensions(given.extensions.split(",") if given.extensions else None)
        differences = export(given.source, given.folder, given.check, given.nu)
    for name, value in differences.items():
        print(f"{name:14s} {value:.1e} relative difference at {given.check} deformations")
    if "umat stress" not in differences and given.check:
        print("umat.f90 was not checked: there is no gfortran here (apt install gfortran)")
    # a difference that is no number is no agreement
    sys.exit(int(not all(v <= LARGEST[name.split()[1]] for name, v in differences.items())))

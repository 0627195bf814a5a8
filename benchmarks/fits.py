"""The command line that the benchmarks of a fit share: make the problems, fit them, and write the table of what was found."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import torch

from mosa.errors import MosaError
from mosa.modules.fitting.identification import Identification


def parser_of(
    description: str, inputs: str, folder: str, pictures: bool = False
) -> argparse.ArgumentParser:
    """inputs: what `make` takes one of each for; folder: where it puts them by default; pictures: whether results can be drawn."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("make", "fit", "table", *(["draw"] if pictures else [])))
    parser.add_argument(
        "inputs", nargs="+", help=f"make: {inputs}; fit: what make wrote; others: results"
    )
    parser.add_argument("--out", type=Path, default=Path(folder), help="make, draw: the folder")
    parser.add_argument(
        "--results", type=Path, default=Path("fits.jsonl"), help="fit: a line is added for each"
    )
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument(
        "--set", nargs="*", default=[], help="fit: overrides of the law and its identification"
    )
    return parser


def run(
    options: argparse.Namespace, make: Callable[[str], object], fit: Callable[[Path], dict], table: Callable[[list[dict]], str],
    draw: Callable[[list[dict], Path], None] | None = None,
) -> None:  # fmt: skip
    """What `options` ask for; a fit that fails is said, and the others go on."""
    if options.what in ("table", "draw"):
        records = [
            json.loads(line)
            for name in options.inputs
            for line in Path(name).read_text().splitlines()
        ]
        if options.what == "draw":
            draw(records, options.out)
        print(table(records))
        return
    for each in options.inputs:
        if options.what == "make":
            make(each)
            continue
        try:
            record = fit(Path(each))
        except MosaError as error:
            print(f"{each}: {error}", flush=True)
            continue
        with options.results.open("a") as file:
            file.write(json.dumps(record) + "\n")
        print(table([record]), flush=True)


def iterated(identification: Identification, most: int) -> int:
    """Iterations taken, until it has converged or `most`."""
    for i in range(most):
        identification.iterate()
        if identification.converged:
            return i + 1
    return most

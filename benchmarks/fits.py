"""The command line that the benchmarks of a fit share: make the problems, fit them, and write the table of what was found."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import torch

from mosa.errors import MosaError


def parser_of(description: str, inputs: str, folder: str) -> argparse.ArgumentParser:
    """inputs: what `make` takes one of each for; folder: where it puts them by default."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("make", "fit", "table"))
    parser.add_argument("inputs", nargs="+", help=f"make: {inputs}; fit: what make wrote; table: results")
    parser.add_argument("--out", type=Path, default=Path(folder), help="make: the folder")
    parser.add_argument("--results", type=Path, default=Path("fits.jsonl"), help="fit: a line is added for each")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--set", nargs="*", default=[], help="fit: overrides of the law and its identification")
    return parser


def run(
    options: argparse.Namespace, make: Callable[[str], object], fit: Callable[[Path], dict], table: Callable[[list[dict]], str]
) -> None:
    """What `options` ask for; a fit that fails is said, and the others go on."""
    if options.what == "table":
        print(table([json.loads(line) for name in options.inputs for line in Path(name).read_text().splitlines()]))
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

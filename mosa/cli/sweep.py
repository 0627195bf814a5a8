"""One table over all runs of a sweep, as it also stands at its end:  mosa-sweep multirun/train/<date>/<time>"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from mosa.errors import MosaError
from mosa.system.console import say_version


def main(words: list[str] | None = None) -> None:
    say_version(words)
    parser = argparse.ArgumentParser(prog="mosa-sweep", description=__doc__)
    parser.add_argument("folder", type=Path, help="of the sweep; sweep.csv is written there")
    folder = parser.parse_args(words).folder
    from mosa.training.sweep_table import text_of, write_table

    try:
        rows, files = write_table(folder)
    except MosaError as error:
        print(f"\n{type(error).__name__}: {error}", file=sys.stderr)
        sys.exit(2)
    print(text_of(rows))
    print("\nall figures: " + ", ".join(map(str, files)))


if __name__ == "__main__":
    main()

"""One table over all runs of a sweep, as it also stands at its end:  mosa-sweep multirun/train/<date>/<time>"""

from __future__ import annotations

import argparse
from pathlib import Path

from mosa.system.console import say_version
from mosa.system.machine_errors import one_message


def main(words: list[str] | None = None) -> None:
    say_version(words)
    parser = argparse.ArgumentParser(prog="mosa-sweep", description=__doc__)
    parser.add_argument("folder", type=Path, help="of the sweep; sweep.csv is written there")
    folder = parser.parse_args(words).folder
    from mosa.training.sweep_table import text_of, write_table

    with one_message():
        rows, files = write_table(folder)
    print(text_of(rows))
    print("\nall figures: " + ", ".join(map(str, files)))


if __name__ == "__main__":
    main()

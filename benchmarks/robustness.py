"""Attacks on the program, replayed: what a stranger's files and a user's mistakes end in.

    python benchmarks/robustness.py                     # all groups, about two CPU-minutes
    python benchmarks/robustness.py --only data,npz     # some of them
    python benchmarks/robustness.py --only cuda,gpu_memory  # what a GPU answers otherwise (minutes)
    python benchmarks/robustness.py --runs              # and whole processes: exit codes, a sweep of failures (minutes)
    python benchmarks/robustness.py --only habits_keys,habits_running  # how people type, and machines are (minutes each)
    python benchmarks/robustness.py --only afresh_keys,afresh_running  # values and files that are something else (half an hour)
    python benchmarks/robustness.py --only films_again  # light, exposure, cameras, films of something else (a quarter of an hour)
    python benchmarks/robustness.py --only running      # kills, disks, screens, folders, limits (a quarter of an hour or more)

Each attack ends in one clear message (a MosaError of one line), in a traceback, in a hang (over 60 s), or it runs. What runs is
listed: those are the attacks that the program has no word against. The attacks are in attacks_on_files.py, attacks_on_calls.py,
attacks_on_data.py, attacks_on_meaning.py, attacks_of_habit.py, attacks_afresh.py, attacks_afresh_running.py,
attacks_on_running.py, attacks_on_films.py and attacks_on_cuda.py.
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import attacks_afresh as afresh
import attacks_afresh_running as processes
import attacks_of_habit as habit
import attacks_on_calls as calls
import attacks_on_data as data
import attacks_on_files as files
from attacks_on_cuda import cuda, gpu_memory
from attacks_on_films import films_again
from attacks_on_meaning import MORE
from attacks_on_running import running

from mosa.errors import MosaError

GROUPS = {"checkpoints": files.checkpoints, "npz": files.npz, "overrides": calls.overrides, "colliders": calls.colliders,
          "calls": calls.calls, "data": data.data, "meshes": data.meshes, "caches": files.caches, "poses": data.poses,
          "resumed": files.resumed, "runs": calls.runs} | MORE | {"running": running, "cuda": cuda}  # fmt: skip
GROUPS |= {"gpu_memory": gpu_memory, "habits_data": habit.habits_data, "habits_keys": habit.habits_keys,
           "habits_running": habit.habits_running, "afresh_data": afresh.afresh_data, "afresh_keys": processes.afresh_keys,
           "afresh_running": processes.afresh_running, "films_again": films_again}  # fmt: skip
"""Name -> pairs of what is done and a function that does it, in a folder."""
PATIENCE = 60
LONGER = {"runs": 300, "cuda": 300, "gpu_memory": 300, "habits_keys": 120, "habits_running": 600, "running": 600,
          "afresh_keys": 300, "afresh_running": 600, "films_again": 300}  # fmt: skip
"""Seconds until an attack counts as a hang; of whole processes."""
HEAD = "| group | tried | one clear message | traceback or hang | ran |\n|---|---|---|---|---|"


class Hang(Exception):
    """An attack took longer than PATIENCE seconds."""


def outcome(attack: Callable[[], object], patience: int = PATIENCE) -> tuple[str, str]:
    """(message | traceback | hang | ran, what was said)."""

    def ring(*_):
        raise Hang

    signal.signal(signal.SIGALRM, ring)
    signal.alarm(patience)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            attack()
    except MosaError as error:
        return ("message" if "\n" not in str(error) else "traceback"), str(error)
    except Hang:
        return "hang", ""
    except BaseException as error:  # an attack may end in anything
        return "traceback", f"{type(error).__name__}: {error}"
    finally:
        signal.alarm(0)
    return "ran", ""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default=",".join(name for name in GROUPS if name not in LONGER))
    parser.add_argument("--runs", action="store_true")
    parser.add_argument(
        "--share",
        default="0/1",
        metavar="K/N",
        help="every N-th attack of each group, from the K-th on: N processes make all of them beside each other",
    )
    options = parser.parse_args()
    first, every = map(int, options.share.split("/"))
    rows, said = [], []
    for name in [*options.only.split(","), *(["runs"] if options.runs else [])]:
        counts = dict.fromkeys(("message", "traceback", "hang", "ran"), 0)
        with tempfile.TemporaryDirectory() as folder:
            for what, attack in islice(GROUPS[name](Path(folder)), first, None, every):
                kind, text = outcome(attack, LONGER.get(name, PATIENCE))
                counts[kind] += 1
                if name in LONGER:  # whole processes: minutes in which nothing would be seen
                    print(
                        f"  {time.strftime('%H:%M:%S')} {what[:100]}: {kind} {text[:100]}",
                        flush=True,
                    )
                said += [f"{name}: {kind}: {what[:100]} {text[:150]}"] if kind != "message" else []
        rows.append(
            f"| {name} | {sum(counts.values())} | {counts['message']} | {counts['traceback'] + counts['hang']} | "
            f"{counts['ran']} |"
        )
        print(rows[-1], flush=True)
    print("\n".join(["", HEAD, *rows, "", *said]))
    sys.exit(1 if any("traceback:" in line or "hang:" in line for line in said) else 0)


if __name__ == "__main__":
    main()

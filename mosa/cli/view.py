"""usage: mosa-view <folder> [--live] [checkpoint=<file>] [host=127.0.0.1] [port=8080] [device=cpu]
       (or python -m mosa.viewer run=<folder> ...)

What a run saw, calibrated and learned, side by side in a browser; or with --live its twin, to be dropped and pushed.

  <folder>    of a finished run, as outputs/train/<date>/<time>, or one that Twin.export or eval.py wrote; also as run=<folder>;
              with --live a checkpoint will do
  --live      the learned twin in motion: drop, pause, step, reset, and a ball that the mouse pushes it with
  checkpoint  of the run, where the folder has none: what a motion alone does not say is read from it
  host        127.0.0.1: to be seen from this machine alone; 0.0.0.0: from everywhere
  port        the next free one where it is taken
  device      cpu | cuda: where the twin is simulated (--live)

Needs the package viser: pip install viser."""

import sys

from mosa.system.console import say_version
from mosa.system.threads import settle_threads


def main() -> None:
    say_version()
    if {"--help", "-h"} & set(sys.argv[1:]):
        print(__doc__)
        return
    settle_threads()
    try:
        from mosa.viewer.recorded import main as view

        view(sys.argv[1:])
    except KeyboardInterrupt:  # as it is read and opened
        pass

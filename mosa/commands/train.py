"""Learn a simulator of a deforming object from multi-view video:  mosa-train scene=rabbit prior=corotated"""

import sys

from mosa.commands.configured import command
from mosa.jobs import Failures

train = command(__name__, "mosa.pipeline:train")


def main() -> None:
    train()
    sys.exit(1 if Failures.count else 0)

"""Learn a simulator of a deforming object from multi-view video:  mosa-train scene=rabbit prior=corotated"""

import sys

from mosa.cli.configured import command
from mosa.training.jobs import Failures

train = command(__name__, "mosa.training.workflow:train")


def main() -> None:
    train()
    sys.exit(1 if Failures.count else 0)

"""Learn a simulator of a deforming object from multi-view video:  mosa-train scene=rabbit prior=corotated"""

import os
import sys

from mosa.commands.configured import command
from mosa.jobs import Failures

train = command(__name__, "mosa.pipeline:train")


def main() -> None:
    if os.environ.get("LOCAL_RANK", "0") != "0":  # a further process of a fit on several devices: the first speaks for all
        os.environ["TQDM_DISABLE"] = "1"
        sys.stdout = open(os.devnull, "w")  # until the process ends
    train()
    sys.exit(1 if Failures.count else 0)

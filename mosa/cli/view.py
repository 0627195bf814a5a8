"""What a run saw, calibrated and learned, side by side in a browser, or its twin live:  mosa-view outputs/train/<date>/<time>"""

import sys

from mosa.system.console import say_version
from mosa.system.threads import settle_threads
from mosa.viewer.usage import USAGE


def main() -> None:
    say_version()
    if {"--help", "-h"} & set(sys.argv[1:]):
        print(USAGE)
        return
    settle_threads()
    from mosa.viewer.recorded import main as view

    view(sys.argv[1:])

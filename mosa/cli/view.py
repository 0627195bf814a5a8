"""What a run saw, calibrated and learned, side by side in a browser, or its twin live:  mosa-view outputs/train/<date>/<time>"""

import sys

from mosa.system.threads import settle_threads


def main() -> None:
    settle_threads()
    from mosa.viewer.recorded import main as view

    view(sys.argv[1:])

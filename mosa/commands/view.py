"""What a run saw, calibrated and learned, side by side in a browser, or its twin live:  mosa-view outputs/train/<date>/<time>"""

import os
import sys


def main() -> None:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from mosa.viewer import main as view

    view(sys.argv[1:])

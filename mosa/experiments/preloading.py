"""Imported by the server of `processes` before anything else: the libraries that a job imports, with signals held off meanwhile."""

import contextlib
import importlib
import signal

LIBRARIES = ("lightning", "kornia", "cv2", "hydra", "imageio", "torch.utils.tensorboard", "warp")
"""What train.py imports, but no part of mosa that begins Warp. With Warp or CUDA begun, or with threads, a process cannot be forked
(`tests/experiments/test_processes.py`)."""

for number in (signal.SIGINT, signal.SIGTERM):  # sent to a whole group of processes: jobs answer them, and the server goes last
    signal.signal(number, signal.SIG_IGN)
for name in LIBRARIES:
    with contextlib.suppress(Exception):  # the job that needs it says what is wrong with it
        importlib.import_module(name)

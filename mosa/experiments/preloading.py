"""Imported by the server of `processes`: the libraries that a job imports."""

import contextlib
import importlib

LIBRARIES = ("lightning", "kornia", "cv2", "hydra", "imageio", "torch.utils.tensorboard", "warp")
"""What train.py imports, but no part of mosa that begins Warp. With Warp or CUDA begun, or with threads, a process cannot be forked
(`tests/experiments/test_processes.py`)."""

for name in LIBRARIES:
    with contextlib.suppress(Exception):  # the job that needs it says what is wrong with it
        importlib.import_module(name)

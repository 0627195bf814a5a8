"""Threads that make kernels at once."""

import ast
import gc
import inspect
import sys
import threading

import pytest

from mosa.physics.grid import transfer_kernels
from mosa.system.warp_start import ONE_PARSER


class Cycle:
    """Garbage whose end runs Python, where another thread may go on."""

    def __init__(self):
        self.itself = self

    def __del__(self):
        sum(range(20))


@pytest.mark.skipif(not ONE_PARSER, reason="CPython keeps a depth for each call of ast.parse")
def test_threads_parse_at_once():
    """As Warp does when kernels are made. Without the lock about one call in ten fails here."""
    source = inspect.getsource(transfer_kernels)
    failed, threshold, interval = [], gc.get_threshold(), sys.getswitchinterval()

    def work():
        try:
            for _ in range(25):
                Cycle()
                ast.parse(source)
        except SystemError as error:
            failed.append(error)

    try:
        gc.set_threshold(50)
        sys.setswitchinterval(1e-6)
        threads = [threading.Thread(target=work) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        gc.set_threshold(*threshold)
        sys.setswitchinterval(interval)
    assert not failed

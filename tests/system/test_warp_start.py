"""Threads that make and compile kernels."""

import ast
import gc
import inspect
import sys
import threading

import pytest
import warp as wp

from mosa.physics.grid import transfer_kernels
from mosa.physics.launching import launch
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


@wp.kernel(module="unique", enable_backward=False)
def one(a: wp.array(dtype=int)):
    a[0] = 1


@wp.kernel(module="unique", enable_backward=False)
def two(a: wp.array(dtype=int)):
    a[1] = 2


def test_headers_are_precompiled_once_for_all_threads(tmp_path, monkeypatch):
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(wp.config, "optimization_level", 0)
    numbers, made = wp.zeros(2, dtype=int, device="cpu"), []
    for kernel in (one, two):
        words = (kernel, 1, [numbers], wp.get_device("cpu"))
        thread = threading.Thread(target=launch, args=words)
        thread.start()
        thread.join()
        (header,) = tmp_path.glob("wp_headers_*/*.pch")
        made.append(header.stat().st_mtime_ns)
    assert made[0] == made[1] and numbers.list() == [1, 2]

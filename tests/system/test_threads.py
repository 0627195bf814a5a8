"""Work in threads comes back in order, with its errors."""

import functools
import os
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from mosa.system.threads import settle_threads, threaded


def test_results_keep_the_order_of_the_items(monkeypatch):
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1, 2}, raising=False)
    second = threading.Event()

    def late_first(item: int) -> int:
        if item == 0:
            assert second.wait(10)  # ends only where another thread runs meanwhile
        second.set()
        return 10 * item

    assert list(threaded(late_first, range(7))) == [10 * i for i in range(7)]


def test_threads_share_work_out_among_threads_and_keep_none_of_it(monkeypatch):
    """One helper, which is busy with the other item: both ask it for help, do all by themselves, and what they had goes at once."""
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1}, raising=False)
    monkeypatch.setattr("mosa.system.threads._helpers", lambda _: pool)
    both, kept = threading.Barrier(2, timeout=10), []

    def outer(item: int) -> list[int]:
        both.wait()
        work = functools.partial(lambda array, i: i * len(array), np.zeros(item))
        kept.append(weakref.ref(work.args[0]))
        found = list(threaded(work, range(3)))
        del work
        both.wait()
        assert not any(each() is not None for each in kept)
        both.wait()
        return found

    with ThreadPoolExecutor(1) as pool:
        assert list(threaded(outer, [5, 7])) == [[0, 5, 10], [0, 7, 14]]


@pytest.mark.parametrize("cores", [1, 2])
def test_errors_reach_the_caller(monkeypatch, cores):
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(cores)), raising=False)
    with pytest.raises(ZeroDivisionError):
        list(threaded(lambda x: 1 / x, [1, 0]))
    assert list(threaded(float, [])) == []


@pytest.mark.parametrize(("given", "kept"), [
    (None, "1"), ("", "1"), ("0", "1"), ("-2", "1"), ("many", "1"), ("\u0662", "1"), ("3", "3"), ("4,2", "4,2"), (" 2 ", " 2 "),
])  # fmt: skip
def test_what_is_no_number_of_threads_is_one_thread(monkeypatch, capsys, given, kept):
    """The libraries take all cores for it: minutes in the place of seconds, and sums in another order."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if given is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", given)
    settle_threads()
    assert os.environ["OMP_NUM_THREADS"] == kept
    assert ("OMP_NUM_THREADS: expected a whole number above 0" in capsys.readouterr().err) == (
        bool(given) and kept != given
    )

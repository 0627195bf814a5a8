"""Work in threads comes back in order, with its errors."""

import threading

import pytest

from mosa.threads import threaded


def test_results_keep_the_order_of_the_items(monkeypatch):
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1, 2}, raising=False)
    second = threading.Event()

    def late_first(item: int) -> int:
        if item == 0:
            assert second.wait(10)  # ends only where another thread runs meanwhile
        second.set()
        return 10 * item

    assert list(threaded(late_first, range(7))) == [10 * i for i in range(7)]


@pytest.mark.parametrize("cores", [1, 2])
def test_errors_reach_the_caller(monkeypatch, cores):
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(cores)), raising=False)
    with pytest.raises(ZeroDivisionError):
        list(threaded(lambda x: 1 / x, [1, 0]))
    assert list(threaded(float, [])) == []

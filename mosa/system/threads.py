"""Independent work on the host in threads: for what leaves Python's lock alone (OpenCV, NumPy's arithmetic, Warp's CPU kernels)."""

from __future__ import annotations

import copy
import functools
import os
import re
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def settle_threads() -> None:
    """OMP_NUM_THREADS is 1 where nothing is set: on small tensors and shared machines a second thread was measured 30x slower. So
    it is, with a word, where what is set is no number: the libraries would take all cores, and sums in another order."""
    given = os.environ.get("OMP_NUM_THREADS", "").strip()
    if re.fullmatch(r"[1-9]\d*(\s*,\s*[1-9]\d*)*", given, re.ASCII):
        return
    if given:
        print(
            f"OMP_NUM_THREADS: expected a whole number above 0, found {given[:40]!r}: one thread is used",
            file=sys.stderr,
        )
    os.environ["OMP_NUM_THREADS"] = "1"


def cores() -> int:
    """CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def threaded(function: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
    """function(item) of each item, in their order, by this thread and the others that there are cores for. It may itself ask for
    that: what no other thread has begun this one does."""
    others = min(len(items), cores()) - 1
    if others < 1:
        yield from map(function, items)
        return
    found = deque[Future[Result]](Future() for _ in items)
    left: deque[tuple[Any, ...]] = deque((function, *each) for each in zip(items, found))
    helping = [_helpers(os.getpid()).submit(_work_off, left) for _ in range(others)]
    try:
        while found:
            while not found[0].done() and _worked(left):
                pass
            yield found.popleft().result()
    finally:
        left.clear()  # what waits for a helper still refers to it
        wait([each for each in helping if not each.cancel()])


def _work_off(left: deque[tuple[Any, ...]]) -> None:
    while _worked(left):
        pass


def _worked(left: deque[tuple[Any, ...]]) -> bool:
    """Whether anything was left, the first of which is done then."""
    try:
        function, item, result = left.popleft()
    except IndexError:
        return False
    try:
        result.set_result(function(item))
    except BaseException as error:
        left.clear()
        result.set_exception(error)
        if not isinstance(error, Exception):
            raise
    return True


@functools.cache
def _helpers(process: int) -> ThreadPoolExecutor:
    """Of this process: a forked one has no threads of the first one's."""
    return ThreadPoolExecutor(max(1, cores() - 1))


def apart(
    body: Any, items: Sequence[Item], function: Callable[[Any, Item], Result]
) -> Iterator[Result]:
    """function(body, item) of each item, in their order, without gradients; on a CPU on as many threads as there are cores, each
    item with a copy of the body, as simulators are not for two threads."""
    import torch  # not before `settle_threads`

    inferring = torch.is_inference_mode_enabled()  # a thread has switches of its own

    def of_copy(item: Item) -> Result:
        with torch.inference_mode(inferring), torch.no_grad():
            return function(copy.deepcopy(body), item)

    if body.rest.is_cpu and len(items) > 1:
        return threaded(of_copy, items)
    return (function(body, item) for item in items)

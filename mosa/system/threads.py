"""Independent work on the host in threads: for what leaves Python's lock alone (OpenCV, NumPy's arithmetic, Warp's CPU kernels)."""

from __future__ import annotations

import copy
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
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
    """function(item) of each item, in their order, on as many threads as this process has cores."""
    workers = min(len(items), cores())
    if workers <= 1:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(workers) as pool:
        yield from pool.map(function, items)


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

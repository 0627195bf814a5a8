"""Sums that are the same in whatever order their terms come: what `deterministic=true` adds with on a GPU.

Threads of a GPU add to the same memory in another order in every run, and floating point rounds each partial sum. Here a term is
parted into two whole numbers, of units 2^-20 and 2^-60, which are added without rounding; afterwards both become one number again.
What is lost of a term is less than 2^-60 = 8.7e-19 in its own unit. Terms that are not finite, or larger than 2^24 = 1.7e7,
are counted, and their sum is not a number.

On a CPU a launch is one thread, whose order is always the same: nothing is switched there.
"""

import os
import warnings
from functools import cache
from types import SimpleNamespace

import torch
import warp as wp

HIGH, LOW = 2.0**20, 2.0**40
"""Units of the high part in 1, of the low part in one of the high part."""
LARGEST = 2.0**44
"""Of a term, in units of the high part: 2^18 such terms, or 2^23 low parts, fill no 63 bits."""
COLUMNS = 3
"""Of a sum: high part, low part, terms that are none."""


def use(wanted: bool = True) -> None:
    """Have every computation of this process from now on give the same bits each time it is made, on the same GPU.

    Sums of Warp's kernels are exact, and torch takes its algorithms of fixed order. To be called before the first one."""
    if wanted:
        # read when torch first multiplies matrices there
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        # of what has no such algorithm only the gradient of grid_sample is used, and of it only that of the places, which is one
        # thread's each
        warnings.filterwarnings("ignore", message=".*grid_sampler.*deterministic.*")
    torch.use_deterministic_algorithms(wanted, warn_only=True)
    torch.utils.deterministic.fill_uninitialized_memory = (
        False  # nothing here reads memory that was not written
    )


def needed(device: torch.device) -> bool:
    """Whether sums on a device have to be exact to be the same each time."""
    return torch.are_deterministic_algorithms_enabled() and device.type == "cuda"


@cache
def sum_functions(scalar) -> SimpleNamespace:
    """Warp function add_exactly(sums (n, COLUMNS) int64, i, value) and kernel settle(sums, values (n,)), for wp.float32 or
    wp.float64 values."""

    @wp.func
    def add_exactly(sums: wp.array2d(dtype=wp.int64), i: int, value: scalar):
        q = wp.float64(value) * wp.float64(HIGH)
        if wp.abs(q) <= wp.float64(LARGEST):  # false where it is not a number
            high = wp.floor(q)
            low = wp.floor((q - high) * wp.float64(LOW))
            wp.atomic_add(sums, i, 0, wp.int64(high))
            wp.atomic_add(sums, i, 1, wp.int64(low))
        else:
            wp.atomic_add(sums, i, 2, wp.int64(1))

    @wp.func
    def total(sums: wp.array2d(dtype=wp.int64), i: int):
        if sums[i, 2] != wp.int64(0):
            return scalar(wp.float64(wp.nan))
        return scalar(
            (wp.float64(sums[i, 0]) + wp.float64(sums[i, 1]) / wp.float64(LOW)) / wp.float64(HIGH)
        )

    @wp.func
    def clear(sums: wp.array2d(dtype=wp.int64), i: int):
        sums[i, 0] = wp.int64(0)
        sums[i, 1] = wp.int64(0)
        sums[i, 2] = wp.int64(0)

    @wp.kernel(module=f"mosa.exact_sums_{scalar.__name__}", enable_backward=False)
    def settle(sums: wp.array2d(dtype=wp.int64), values: wp.array(dtype=scalar)):
        i = wp.tid()
        values[i] = total(sums, i)

    return SimpleNamespace(add_exactly=add_exactly, total=total, clear=clear, settle=settle)

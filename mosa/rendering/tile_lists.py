"""The Gaussians that each 16 x 16 tile of each image sees, in depth order: what tile_kernels.py walks.

All Gaussians of all images are sorted by depth once; in this order each writes one entry per tile that it touches, and a stable
sort by tile, whose number has few bits, keeps the depth order inside every tile.
"""

import functools

import torch
import warp as wp
from torch import Tensor

from mosa.rendering.projection_kernels import TILE
from mosa.rendering.records import record_functions, record_type
from mosa.system.limits import counted

ENTRIES_MAX = 2**30
"""Places are counted in int32."""


@functools.cache
def list_kernels(dtype: type):
    """(count, emit): how many tiles a Gaussian's rectangle touches, and which; one thread per Gaussian, in depth order."""
    record = record_type(dtype)
    load, *_, pixels = record_functions(dtype)

    @wp.func
    def touched(r: record):
        """First and last + 1 column, first and last + 1 row of tiles."""
        rect = pixels(r)
        result = wp.vec4i(0, 0, 0, 0)
        if rect[1] > rect[0] and rect[3] > rect[2]:
            end = TILE - 1
            result = wp.vec4i(
                rect[0] // TILE, (rect[1] + end) // TILE, rect[2] // TILE, (rect[3] + end) // TILE
            )
        return result

    @wp.kernel(enable_backward=False, module="unique")
    def count(
        order: wp.array(dtype=wp.int32), records: wp.array(dtype=record),
        numbers: wp.array(dtype=wp.int32),
    ):  # fmt: skip
        k = wp.tid()
        tiles = touched(load(records, order[k]))
        numbers[k] = (tiles[1] - tiles[0]) * (tiles[3] - tiles[2])

    @wp.kernel(enable_backward=False, module="unique")
    def emit(
        order: wp.array(dtype=wp.int32), records: wp.array(dtype=record),
        numbers: wp.array(dtype=wp.int32), ends: wp.array(dtype=wp.int64), gaussians: int,
        columns: int, rows: int,
        # out
        keys: wp.array(dtype=wp.int32), entries: wp.array(dtype=wp.int32),
    ):  # fmt: skip
        k = wp.tid()
        if numbers[k] > 0:
            i = order[k]
            tiles = touched(load(records, i))
            at = int(ends[k]) - numbers[k]
            for row in range(tiles[2], tiles[3]):
                for column in range(tiles[0], tiles[1]):
                    keys[at] = (i // gaussians * rows + row) * columns + column
                    entries[at] = i
                    at += 1

    return count, emit


def tile_lists(depths: Tensor, records: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """(entries, starts), int32: those of tile k, entries[starts[k] : starts[k + 1]], are places in `records` by depth.

    depths: (2 B N,), of which the first half counts and all is overwritten: sorting needs the room; records: (B, N, 8).
    Tiles are counted row by row, image by image. Waits once for the GPU, to learn how many entries there are."""
    images, gaussians, _ = records.shape
    number, columns, rows = images * gaussians, -(-width // TILE), -(-height // TILE)
    last, remedy = images * rows * columns, "render fewer images at once"
    larger = max(number, last)
    counted("rasterize: Gaussians, or tiles, of all images", [larger], remedy, most=ENTRIES_MAX)
    device = wp.device_from_torch(records.device)
    scalar = wp.dtype_from_torch(records.dtype)
    count, emit = list_kernels(scalar)
    order = torch.arange(2 * number, dtype=torch.int32, device=records.device)
    wp.utils.radix_sort_pairs(wp.from_torch(depths), wp.from_torch(order), number)
    numbers = torch.empty(number, dtype=torch.int32, device=records.device)
    flat = functools.partial(wp.from_torch, return_ctype=True)
    given: list = [flat(order), flat(records.view(-1, 8), dtype=record_type(scalar))]
    wp.launch(count, dim=number, inputs=given, outputs=[flat(numbers)], device=device)
    ends = numbers.cumsum(0, dtype=torch.int64)
    total = int(ends[-1])
    counted("rasterize: pairs of a Gaussian and a tile", [total], remedy, most=ENTRIES_MAX)
    tiles, entries = torch.empty(2, 2 * total, dtype=torch.int32, device=records.device)
    given += [flat(numbers), flat(ends), gaussians, columns, rows]
    wp.launch(emit, number, inputs=given, outputs=[flat(tiles), flat(entries)], device=device)
    wp.utils.radix_sort_pairs(
        wp.from_torch(tiles), wp.from_torch(entries), total, end_bit=last.bit_length()
    )
    marks = torch.arange(last + 1, dtype=torch.int32, device=records.device)
    starts = torch.searchsorted(tiles[:total], marks, out_int32=True)
    return entries[:total].clone(), starts  # half as long as what sorting needed

"""Compositing on CUDA: one thread per pixel, the 32 threads of a CUDA warp together on a block of 8 x 4 pixels.

A block walks the depth-ordered list of its 16 x 16 tile (tile_lists.py), 32 entries at a time: each thread tests one of them
against the block, then all threads together visit those that reach it. Most of a tile's list is skipped that way. In the backward
pass the threads add up a Gaussian's gradients among themselves before they go to memory.

The same sums as raster_kernels.py, Gaussian by Gaussian. On a CPU, where a warp is one thread, they are there to be compared.
"""

import functools

import warp as wp

from mosa.rendering.lanes import (
    add_sums,
    any_lane,
    ballot,
    from_lane,
    highest,
    lane_count,
    lane_of,
    lowest,
)
from mosa.rendering.projection_kernels import ALPHA_MIN, TILE
from mosa.rendering.raster_kernels import STOP
from mosa.rendering.records import record_functions, record_type

BLOCK_WIDTH, BLOCK_HEIGHT = 8, 4
"""Pixels of a CUDA warp."""

TILE_PIXELS = TILE * TILE
BLOCK_PIXELS = BLOCK_WIDTH * BLOCK_HEIGHT
BLOCKS_ACROSS = TILE // BLOCK_WIDTH

ROUNDING = 1.0e-5
"""Bound on the rounding errors of q, relative to a dx^2 + c dy^2: 84 units of float32's last place."""


def tile_threads(images: int, width: int, height: int) -> int:
    """Threads of a launch: every pixel of every tile, those beyond the image's border included."""
    return images * -(-width // TILE) * -(-height // TILE) * TILE_PIXELS


@functools.cache
def reach_function(dtype: type):
    """reaches(record, x, y, width, height): may alpha be ALPHA_MIN or more at some pixel of a rectangle, whose first is (x, y)?

    Never false where it is, rounding included."""
    record = record_type(dtype)
    *_, pixels = record_functions(dtype)

    @wp.func
    def reaches(r: record, x: int, y: int, width: int, height: int):
        rect = pixels(r)
        result = False
        if rect[0] < x + width and rect[1] > x and rect[2] < y + height and rect[3] > y:
            zero = dtype(0.0)
            left = dtype(x) + dtype(0.5) - r[0]
            top = dtype(y) + dtype(0.5) - r[1]
            right = left + dtype(width - 1)
            bottom = top + dtype(height - 1)
            a = r[4]
            b = r[5]
            c = r[6]
            # outside the rectangle's centre, the least q is on the side nearest to it in x, or in y
            dx = wp.clamp(zero, left, right)
            dy = wp.clamp(zero, top, bottom)
            v = wp.clamp(-b * dx / c, top, bottom)
            u = wp.clamp(-b * dy / a, left, right)
            least = wp.min(
                a * dx * dx + dtype(2.0) * b * dx * v + c * v * v,
                a * u * u + dtype(2.0) * b * u * dy + c * dy * dy,
            )
            far_x = wp.max(wp.abs(left), wp.abs(right))
            far_y = wp.max(wp.abs(top), wp.abs(bottom))
            slack = dtype(ROUNDING) * (dtype(1.0) + a * far_x * far_x + c * far_y * far_y)
            result = least - slack <= dtype(2.0) * wp.log(r[2] / dtype(ALPHA_MIN))
        return result

    return reaches


@functools.cache
def tile_kernels(dtype: type, channels: int, exact: bool = False):
    """(forward, backward) for one Warp scalar type and number of channels, to be launched over `tile_threads`.

    exact: the backward pass adds to exact sums, see `lanes.add_sums`."""
    record = record_type(dtype)
    vec2 = wp.types.vector(length=2, dtype=dtype)
    vec6 = wp.types.vector(length=6, dtype=dtype)
    vecc = wp.types.vector(length=channels, dtype=dtype)
    load, _, _, center, _, pixels = record_functions(dtype)
    reaches = reach_function(dtype)
    add_to_gradients = add_sums(dtype, channels, exact)
    sums = wp.array2d(dtype=wp.int64)
    to_records, to_features = (
        (sums, sums) if exact else (wp.array(dtype=record), wp.array(dtype=vecc))
    )

    @wp.func
    def block_of(thread: int, width: int, height: int):
        """(image, tile, column and row of the block's first pixel) of a thread."""
        columns = (width + TILE - 1) // TILE
        rows = (height + TILE - 1) // TILE
        tile = thread // TILE_PIXELS
        block = thread % TILE_PIXELS // BLOCK_PIXELS
        left = tile % columns * TILE + block % BLOCKS_ACROSS * BLOCK_WIDTH
        top = tile // columns % rows * TILE + block // BLOCKS_ACROSS * BLOCK_HEIGHT
        return tile // (rows * columns), tile, left, top

    @wp.func
    def from_center(r: record, x: int, y: int):
        return vec2(dtype(x) + dtype(0.5), dtype(y) + dtype(0.5)) - center(r)

    @wp.func
    def falloff(r: record, x: int, y: int):
        """exp(-q/2) at a pixel, zero outside the Gaussian's rectangle."""
        rect = pixels(r)
        result = dtype(0.0)
        if x >= rect[0] and x < rect[1] and y >= rect[2] and y < rect[3]:
            d = from_center(r, x, y)
            q = r[4] * d[0] * d[0] + dtype(2.0) * r[5] * d[0] * d[1] + r[6] * d[1] * d[1]
            result = wp.exp(dtype(-0.5) * q)
        return result

    @wp.kernel(enable_backward=False, module="unique")
    def forward(
        entries: wp.array(dtype=wp.int32), starts: wp.array(dtype=wp.int32),
        records: wp.array(dtype=record), features: wp.array(dtype=vecc), feature_stride: int,
        alpha_max: dtype, count: int, width: int, height: int,
        # out; ends: behind the last entry of the list that the pixel counts
        transmittance: wp.array(dtype=dtype), image: wp.array(dtype=vecc),
        ends: wp.array(dtype=wp.int32),
    ):  # fmt: skip
        thread = wp.tid()
        b, tile, left, top = block_of(thread, width, height)
        x = left + thread % BLOCK_WIDTH
        y = top + thread % BLOCK_PIXELS // BLOCK_WIDTH
        seen = x < width and y < height
        lane = lane_of(thread)
        T = dtype(1.0)
        total = vecc()
        at = int(starts[tile])
        stop = starts[tile + 1]
        end = int(at)
        going = bool(seen)
        while at < stop and any_lane(going):
            i = 0
            near = False
            if at + lane < stop:
                i = entries[at + lane]
                near = reaches(load(records, i), left, top, BLOCK_WIDTH, BLOCK_HEIGHT)
            visits = ballot(near)
            while visits != wp.uint32(0):
                source = lowest(visits)
                visits &= visits - wp.uint32(1)
                k = from_lane(i, source)
                r = load(records, k)
                alpha = wp.min(alpha_max, r[2] * falloff(r, x, y))
                after = T * (dtype(1.0) - alpha)
                weight = dtype(0.0)
                if going and alpha >= dtype(ALPHA_MIN):
                    going = after > dtype(STOP)
                    if going:
                        weight = T * alpha
                        T = after
                        end = at + source + 1
                total += weight * features[k - b * (count - feature_stride)]
            at += lane_count()
        if seen:
            pixel = (b * height + y) * width + x
            transmittance[pixel] = T
            image[pixel] = total
            ends[pixel] = end

    @wp.kernel(enable_backward=False, module="unique")
    def backward(
        entries: wp.array(dtype=wp.int32), starts: wp.array(dtype=wp.int32),
        records: wp.array(dtype=record), features: wp.array(dtype=vecc), feature_stride: int,
        alpha_max: dtype, count: int, width: int, height: int, ends: wp.array(dtype=wp.int32),
        grad_image: wp.array(dtype=vecc), transmittance: wp.array(dtype=dtype),
        grad_alpha: wp.array(dtype=dtype),
        # out, zero at first
        moments: to_records, grad_features: to_features,
    ):  # fmt: skip
        thread = wp.tid()
        b, tile, left, top = block_of(thread, width, height)
        x = left + thread % BLOCK_WIDTH
        y = top + thread % BLOCK_PIXELS // BLOCK_WIDTH
        lane = lane_of(thread)
        start = starts[tile]
        end = int(start)
        T = dtype(0.0)  # behind the Gaussians that are still to come
        behind = dtype(0.0)  # dL/dT T of all that is behind
        g = vecc()
        if x < width and y < height:
            pixel = (b * height + y) * width + x
            end = ends[pixel]
            T = transmittance[pixel]
            behind = -grad_alpha[pixel] * T
            g = grad_image[pixel]
        at = highest(end)
        while at > start:
            i = 0
            near = False
            if at - 1 - lane >= start:
                i = entries[at - 1 - lane]
                near = reaches(load(records, i), left, top, BLOCK_WIDTH, BLOCK_HEIGHT)
            visits = ballot(near)
            while visits != wp.uint32(0):
                source = lowest(visits)
                visits &= visits - wp.uint32(1)
                k = from_lane(i, source)
                f = k - b * (count - feature_stride)
                r = load(records, k)
                e = dtype(0.0)
                if at - 1 - source < end:
                    e = falloff(r, x, y)
                alpha = wp.min(alpha_max, r[2] * e)
                counts = alpha >= dtype(ALPHA_MIN)
                if any_lane(counts):
                    weight = dtype(0.0)
                    gq = dtype(0.0)
                    if counts:
                        unfold = dtype(1.0) / (dtype(1.0) - alpha)
                        own = wp.dot(g, features[f])
                        T *= unfold
                        weight = T * alpha
                        if r[2] * e <= alpha_max:
                            gq = dtype(-0.5) * alpha * (own * T - behind * unfold)
                        behind += weight * own
                    d = from_center(r, x, y)
                    moment = gq * vec6(
                        dtype(1.0), d[0], d[1], d[0] * d[0], d[0] * d[1], d[1] * d[1]
                    )
                    add_to_gradients(thread, moment, weight, g, moments, k, grad_features, f)
            at -= lane_count()

    return forward, backward

"""Compositing on CUDA: one thread per pixel walks the depth-ordered list of Gaussians that touch its 16 x 16 tile.

The lists hold ranks in depth order, tile after tile. 256 consecutive threads are the pixels of one tile, so that the 32
threads of a CUDA warp walk one list in step: they read the same Gaussian at the same time, and sum its gradients among
themselves before one of them adds to memory. The same sums as raster_kernels.py, Gaussian by Gaussian; on a CPU, where
every thread is a warp of its own, they are only there to be compared.
"""

import functools

import torch
import warp as wp
from torch import Tensor

from mosa.rendering.projection_kernels import ALPHA_MIN, TILE
from mosa.rendering.raster_kernels import STOP

WARP_SUM = """
#if defined(__CUDA_ARCH__)
    for (int offset = 16; offset > 0; offset /= 2)
        value += __shfl_down_sync(0xffffffffu, value, offset);
#endif
    return value;
"""
WARP_ANY = """
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, flag);
#else
    return flag;
#endif
"""
LEADS_WARP = """
#if defined(__CUDA_ARCH__)
    return (thread & 31) == 0;
#else
    return 1;
#endif
"""


@wp.kernel(enable_backward=False)
def _emit(
    order: wp.array(dtype=wp.int32),
    rects: wp.array(dtype=wp.vec4i),
    offsets: wp.array(dtype=wp.int64),
    count: int,
    columns: int,
    rows: int,
    tiles: wp.array(dtype=wp.int32),
    gaussians: wp.array(dtype=wp.int32),
):
    k = wp.tid()
    b = k // count
    n = order[k]
    rect = rects[b * count + n]
    if rect[1] > rect[0] and rect[3] > rect[2]:
        at = int(offsets[k])
        for r in range(rect[2] // TILE, (rect[3] - 1) // TILE + 1):
            for c in range(rect[0] // TILE, (rect[1] - 1) // TILE + 1):
                tiles[at] = (b * rows + r) * columns + c
                gaussians[at] = k
                at += 1


def tile_lists(order: Tensor, rects: Tensor, width: int, height: int) -> tuple[Tensor, Tensor, Tensor]:
    """Depth-ordered Gaussians of each tile: (order, entries, starts), all int32 and flat.

    order: (B, N) indices by depth; rects: (B, N, 4) pixel bounds. `entries` holds positions b * N + rank in
    `order`; those of tile k are entries[starts[k] : starts[k + 1]], tiles counted row by row, image by image.
    """
    images, count = order.shape
    columns, rows = -(-width // TILE), -(-height // TILE)
    sorted_rects = torch.gather(rects, 1, order.long()[..., None].expand(-1, -1, 4))
    x0, x1, y0, y1 = sorted_rects.unbind(-1)
    touched = ((x1 - 1) // TILE - x0 // TILE + 1) * ((y1 - 1) // TILE - y0 // TILE + 1)
    touched = torch.where((x1 > x0) & (y1 > y0), touched, torch.zeros_like(touched)).view(-1)
    ends = touched.cumsum(0, dtype=torch.int64)
    total = int(ends[-1])
    tiles = torch.empty(max(total, 1), dtype=torch.int32, device=order.device)
    entries = torch.empty_like(tiles)
    wp.launch(
        _emit,
        dim=images * count,
        inputs=[
            wp.from_torch(order.view(-1)),
            wp.from_torch(rects.view(-1, 4), dtype=wp.vec4i),
            wp.from_torch(ends - touched),
            count,
            columns,
            rows,
        ],
        outputs=[wp.from_torch(tiles), wp.from_torch(entries)],
        device=wp.device_from_torch(order.device),
    )
    tiles, index = tiles[:total].sort(stable=True)  # emitted in depth order, and stable sorting keeps it inside each tile
    marks = torch.arange(images * rows * columns + 1, dtype=torch.int32, device=order.device)
    starts = torch.searchsorted(tiles, marks).to(torch.int32)
    return order.view(-1), entries[:total][index] if total else entries, starts


def tile_threads(images: int, width: int, height: int) -> int:
    """Threads of a launch: every pixel of every tile, those beyond the image's border included."""
    return images * -(-width // TILE) * -(-height // TILE) * TILE * TILE


@functools.cache
def warp_functions(dtype: type):
    """(sum over the 32 threads of a CUDA warp, valid in its first thread; whether any of them says 1; is this the first).

    All threads of the warp have to come by: no return, break or divergent loop before.
    """

    @wp.func_native(WARP_SUM)
    def warp_sum(value: dtype) -> dtype: ...

    @wp.func_native(WARP_ANY)
    def warp_any(flag: int) -> int: ...

    @wp.func_native(LEADS_WARP)
    def leads_warp(thread: int) -> int: ...

    return warp_sum, warp_any, leads_warp


@functools.cache
def tile_kernels(dtype: type, channels: int):
    """(forward, backward) with the signatures of raster_kernels.py, but launched over the pixels of `tile_threads` and with
    three list arrays."""
    warp_sum, warp_any, leads_warp = warp_functions(dtype)
    vec2 = wp.types.vector(length=2, dtype=dtype)
    vec3 = wp.types.vector(length=3, dtype=dtype)
    vecc = wp.types.vector(length=channels, dtype=dtype)

    @wp.func
    def inside(rect: wp.vec4i, x: int, y: int):
        return x >= rect[0] and x < rect[1] and y >= rect[2] and y < rect[3]

    @wp.kernel(enable_backward=False, module="unique")
    def forward(
        order: wp.array(dtype=wp.int32),
        entries: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        centers: wp.array(dtype=vec2),
        conics: wp.array(dtype=vec3),
        weights: wp.array(dtype=dtype),
        rects: wp.array(dtype=wp.vec4i),
        features: wp.array(dtype=vecc),
        feature_stride: int,
        alpha_max: dtype,
        count: int,
        width: int,
        height: int,
        transmittance: wp.array(dtype=dtype),
        image: wp.array(dtype=vecc),
        ends: wp.array(dtype=wp.int32),
    ):
        thread = wp.tid()
        tile = thread // (TILE * TILE)
        lane = thread % (TILE * TILE)
        columns = (width + TILE - 1) // TILE
        rows = (height + TILE - 1) // TILE
        b = tile // (rows * columns)
        y = (tile // columns) % rows * TILE + lane // TILE
        x = tile % columns * TILE + lane % TILE
        pixel = (b * height + y) * width + x
        T = dtype(1.0)
        total = vecc()
        end = count
        if x < width and y < height:
            for slot in range(starts[tile], starts[tile + 1]):
                k = entries[slot]
                n = order[k]
                i = b * count + n
                if inside(rects[i], x, y):
                    conic = conics[i]
                    d = vec2(dtype(x) + dtype(0.5), dtype(y) + dtype(0.5)) - centers[i]
                    q = conic[0] * d[0] * d[0] + dtype(2.0) * conic[1] * d[0] * d[1] + conic[2] * d[1] * d[1]
                    alpha = wp.min(alpha_max, weights[i] * wp.exp(dtype(-0.5) * q))
                    if alpha >= dtype(ALPHA_MIN):
                        after = T * (dtype(1.0) - alpha)
                        if after <= dtype(STOP):
                            end = k - b * count
                            break
                        total += T * alpha * features[b * feature_stride + n]
                        T = after
            transmittance[pixel] = T
            image[pixel] = total
            ends[pixel] = end

    @wp.kernel(enable_backward=False, module="unique")
    def backward(
        order: wp.array(dtype=wp.int32),
        entries: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        centers: wp.array(dtype=vec2),
        conics: wp.array(dtype=vec3),
        weights: wp.array(dtype=dtype),
        rects: wp.array(dtype=wp.vec4i),
        features: wp.array(dtype=vecc),
        feature_stride: int,
        alpha_max: dtype,
        count: int,
        width: int,
        height: int,
        ends: wp.array(dtype=wp.int32),
        grad_image: wp.array(dtype=vecc),
        transmittance: wp.array(dtype=dtype),
        behind: wp.array(dtype=dtype),
        grad_centers: wp.array(dtype=vec2),
        grad_conics: wp.array(dtype=vec3),
        grad_weights: wp.array(dtype=dtype),
        grad_features: wp.array(dtype=vecc),
    ):
        thread = wp.tid()
        tile = thread // (TILE * TILE)
        lane = thread % (TILE * TILE)
        columns = (width + TILE - 1) // TILE
        rows = (height + TILE - 1) // TILE
        b = tile // (rows * columns)
        y = (tile // columns) % rows * TILE + lane // TILE
        x = tile % columns * TILE + lane % TILE
        pixel = (b * height + y) * width + x
        after = dtype(0.0)
        later = dtype(0.0)
        g = vecc()
        end = 0
        if x < width and y < height:
            after = transmittance[pixel]
            later = behind[pixel]
            g = grad_image[pixel]
            end = b * count + ends[pixel]
        first = starts[tile]
        number = starts[tile + 1] - first
        for step in range(number):
            k = entries[first + number - 1 - step]
            n = order[k]
            i = b * count + n
            f = b * feature_stride + n
            hit = 0
            gf = vecc()
            go = dtype(0.0)
            gu = dtype(0.0)
            gv = dtype(0.0)
            gxx = dtype(0.0)
            gxy = dtype(0.0)
            gyy = dtype(0.0)
            if k < end:
                if inside(rects[i], x, y):
                    conic = conics[i]
                    o = weights[i]
                    d = vec2(dtype(x) + dtype(0.5), dtype(y) + dtype(0.5)) - centers[i]
                    q = conic[0] * d[0] * d[0] + dtype(2.0) * conic[1] * d[0] * d[1] + conic[2] * d[1] * d[1]
                    e = wp.exp(dtype(-0.5) * q)
                    alpha = wp.min(alpha_max, o * e)
                    if alpha >= dtype(ALPHA_MIN):
                        hit = 1
                        rest = dtype(1.0) - alpha
                        T = after / rest
                        own = wp.dot(g, features[f])
                        ga = own * T - later / rest
                        gf = T * alpha * g
                        later += T * alpha * own
                        after = T
                        if o * e <= alpha_max:
                            go = e * ga
                            gq = dtype(-0.5) * alpha * ga
                            two = dtype(2.0)
                            gu = -two * gq * (conic[0] * d[0] + conic[1] * d[1])
                            gv = -two * gq * (conic[1] * d[0] + conic[2] * d[1])
                            gxx = gq * d[0] * d[0]
                            gxy = gq * two * d[0] * d[1]
                            gyy = gq * d[1] * d[1]
            if warp_any(hit) != 0:
                go = warp_sum(go)
                center = vec2(warp_sum(gu), warp_sum(gv))
                shape = vec3(warp_sum(gxx), warp_sum(gxy), warp_sum(gyy))
                for c in range(channels):
                    gf[c] = warp_sum(gf[c])
                if leads_warp(thread) != 0:
                    wp.atomic_add(grad_features, f, gf)
                    wp.atomic_add(grad_weights, i, go)
                    wp.atomic_add(grad_centers, i, center)
                    wp.atomic_add(grad_conics, i, shape)

    return forward, backward

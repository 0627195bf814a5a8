"""Compositing on a CPU: one thread per image goes through its Gaussians in depth order and touches only the pixels
they reach.

Per image the Gaussians are visited front to back, and inside each one the pixels of its ellipse row by row; the
state of a pixel (transmittance, colour so far) lives in the image. Work is proportional to the (pixel, Gaussian)
pairs that count, there are no lists to build, and in the backward pass every Gaussian's gradient is a local sum.
tile_kernels.py has the same sums pixel by pixel, for CUDA. Both meet the conventions of `rasterizer`.
"""

import functools

import warp as wp

from mosa.rendering.projection_kernels import ALPHA_MIN
from mosa.rendering.records import record_functions, record_type

STOP = 1.0e-4
"""A Gaussian that would bring the transmittance to or below this is not added and ends the pixel."""


@functools.cache
def raster_kernels(dtype: type, channels: int):
    """(forward, backward) for one Warp scalar type and number of channels. All arrays flat over images, Gaussians
    and pixels."""
    vec2 = wp.types.vector(length=2, dtype=dtype)
    vec3 = wp.types.vector(length=3, dtype=dtype)
    vecc = wp.types.vector(length=channels, dtype=dtype)
    record = record_type(dtype)
    load, _, _, center_of, conic_of, pixels = record_functions(dtype)

    @wp.func
    def row_span(center: vec2, conic: vec3, across: dtype, reach: dtype, y: int, rect: wp.vec4i):
        """First and last + 1 pixel of row y where q can be below `reach`, an eighth of a pixel of slack on both sides. across:
        1 / conic[0]."""
        dy = dtype(y) + dtype(0.5) - center[1]
        first = 0
        last = 0
        disc = (conic[1] * dy) * (conic[1] * dy) - conic[0] * (conic[2] * dy * dy - reach)
        if disc > dtype(0.0):
            half = wp.sqrt(disc) * across
            middle = center[0] - conic[1] * dy * across
            left = dtype(rect[0])
            right = dtype(rect[1])
            first = int(wp.clamp(wp.ceil(middle - half - dtype(0.625)), left, right))
            last = int(wp.clamp(wp.floor(middle + half + dtype(0.625)), left, right))
        return wp.vec2i(first, last)

    @wp.kernel(enable_backward=False, module="unique")
    def forward(
        order: wp.array(dtype=wp.int32), records: wp.array(dtype=record),
        features: wp.array(dtype=vecc), feature_stride: int, alpha_max: dtype, count: int,
        width: int, height: int,
        # out; transmittance starts at 1, image at 0, ends at `count`
        transmittance: wp.array(dtype=dtype), image: wp.array(dtype=vecc),
        ends: wp.array(dtype=wp.int32),
    ):  # fmt: skip
        b = wp.tid()
        base = b * width * height
        for rank in range(count):
            n = order[b * count + rank]
            i = b * count + n
            r = load(records, i)
            rect = pixels(r)
            if rect[1] > rect[0]:
                center = center_of(r)
                conic = conic_of(r)
                o = r[2]
                color = features[b * feature_stride + n]
                reach = dtype(2.0) * wp.log(o / dtype(ALPHA_MIN))
                across = dtype(1.0) / conic[0]
                for y in range(rect[2], rect[3]):
                    span = row_span(center, conic, across, reach, y, rect)
                    dy = dtype(y) + dtype(0.5) - center[1]
                    qyy = conic[2] * dy * dy
                    row = base + y * width
                    for x in range(span[0], span[1]):
                        pixel = row + x
                        if ends[pixel] == count:
                            dx = dtype(x) + dtype(0.5) - center[0]
                            q = conic[0] * dx * dx + dtype(2.0) * conic[1] * dx * dy + qyy
                            alpha = wp.min(alpha_max, o * wp.exp(dtype(-0.5) * q))
                            if alpha >= dtype(ALPHA_MIN):
                                T = transmittance[pixel]
                                after = T * (dtype(1.0) - alpha)
                                if after <= dtype(STOP):
                                    ends[pixel] = rank
                                else:
                                    image[pixel] = image[pixel] + T * alpha * color
                                    transmittance[pixel] = after

    @wp.kernel(enable_backward=False, module="unique")
    def backward(
        order: wp.array(dtype=wp.int32), records: wp.array(dtype=record),
        features: wp.array(dtype=vecc), feature_stride: int, alpha_max: dtype, count: int,
        width: int, height: int, ends: wp.array(dtype=wp.int32), grad_image: wp.array(dtype=vecc),
        # changed: final transmittance on entry; `behind` is dL/dT_final T_final on entry
        transmittance: wp.array(dtype=dtype), behind: wp.array(dtype=dtype),
        # out, of each image
        moments: wp.array(dtype=record), grad_features: wp.array(dtype=vecc),
    ):  # fmt: skip
        b = wp.tid()
        base = b * width * height
        for back in range(count):
            rank = count - 1 - back
            n = order[b * count + rank]
            i = b * count + n
            r = load(records, i)
            rect = pixels(r)
            if rect[1] > rect[0]:
                center = center_of(r)
                conic = conic_of(r)
                o = r[2]
                color = features[b * feature_stride + n]
                reach = dtype(2.0) * wp.log(o / dtype(ALPHA_MIN))
                across = dtype(1.0) / conic[0]
                gq_sum = dtype(0.0)
                gx = dtype(0.0)
                gy = dtype(0.0)
                gxx = dtype(0.0)
                gxy = dtype(0.0)
                gyy = dtype(0.0)
                gf = vecc()
                for y in range(rect[2], rect[3]):
                    span = row_span(center, conic, across, reach, y, rect)
                    dy = dtype(y) + dtype(0.5) - center[1]
                    qyy = conic[2] * dy * dy
                    row = base + y * width
                    for x in range(span[0], span[1]):
                        pixel = row + x
                        if rank < ends[pixel]:
                            dx = dtype(x) + dtype(0.5) - center[0]
                            q = conic[0] * dx * dx + dtype(2.0) * conic[1] * dx * dy + qyy
                            e = wp.exp(dtype(-0.5) * q)
                            alpha = wp.min(alpha_max, o * e)
                            if alpha >= dtype(ALPHA_MIN):
                                rest = dtype(1.0) - alpha
                                T = transmittance[pixel] / rest
                                g = grad_image[pixel]
                                own = wp.dot(g, color)
                                later = behind[pixel]
                                ga = own * T - later / rest
                                gf += T * alpha * g
                                behind[pixel] = later + T * alpha * own
                                transmittance[pixel] = T
                                if o * e <= alpha_max:
                                    gq = dtype(-0.5) * alpha * ga
                                    gq_sum += gq
                                    gx += gq * dx
                                    gy += gq * dy
                                    gxx += gq * dx * dx
                                    gxy += gq * dx * dy
                                    gyy += gq * dy * dy
                zero = dtype(0.0)
                moments[i] = record(gq_sum, gx, gy, gxx, gxy, gyy, zero, zero)
                grad_features[i] = gf

    return forward, backward

"""A projected Gaussian in memory: eight numbers that are read together, in float32 one 32-byte sector of a GPU's memory.

A record is (u, v, opacity, columns, a, b, c, rows): the centre [px], the conic of q = a dx^2 + 2 b dx dy + c dy^2, and the
rectangle of pixels that see the Gaussian, first and last + 1 column and row, each pair in the bits of one number.

Its gradient has eight numbers too: sums over pixels of g (1, dx, dy, dx^2, dx dy, dy^2), g = dL/dq, d = pixel - centre, and two
zeros. All that compositing depends on follows from these moments once per Gaussian: alpha = o exp(-q/2) has dL/do = -2 sum(g) / o.
"""

import functools

import warp as wp

SIDE_MAX = 2**16 - 1
"""Longest side of an image [px]: what the bits of a rectangle hold."""

# A record in 16-byte pieces: by its type the compiler may only move one number at a time.
LOAD = """
#if defined(__CUDA_ARCH__)
    wp::vec_t<8, wp::SCALAR> record;
    int4 pieces[sizeof(record) / sizeof(int4)];
    #pragma unroll
    for (int k = 0; k < sizeof(record) / sizeof(int4); ++k)
        pieces[k] = __ldg(reinterpret_cast<const int4*>(records.data + i) + k);
    memcpy(&record, pieces, sizeof(record));
    return record;
#else
    return records.data[i];
#endif
"""
STORE = """
    struct alignas(16) Aligned { wp::vec_t<8, wp::SCALAR> record; };
    reinterpret_cast<Aligned*>(records.data + i)->record = value;
"""


def record_type(dtype: type) -> type:
    return wp.types.vector(length=8, dtype=dtype)


@functools.cache
def record_functions(dtype: type):
    """(load, store, pack, center, conic, pixels) for one Warp scalar type."""
    record = record_type(dtype)
    vec2 = wp.types.vector(length=2, dtype=dtype)
    vec3 = wp.types.vector(length=3, dtype=dtype)
    bits = wp.int32 if dtype == wp.float32 else wp.int64

    @wp.func_native(LOAD.replace("SCALAR", dtype.__name__))
    def load(records: wp.array(dtype=record), i: int) -> record: ...

    @wp.func_native(STORE.replace("SCALAR", dtype.__name__))
    def store(records: wp.array(dtype=record), i: int, value: record): ...

    @wp.func
    def pair(first: int, end: int):
        return wp.cast(bits(first | (end << 16)), dtype)

    @wp.func
    def pack(center: vec2, opacity: dtype, conic: vec3, rect: wp.vec4i):
        columns = pair(rect[0], rect[1])
        rows = pair(rect[2], rect[3])
        return record(center[0], center[1], opacity, columns, conic[0], conic[1], conic[2], rows)

    @wp.func
    def center(r: record):
        return vec2(r[0], r[1])

    @wp.func
    def conic(r: record):
        return vec3(r[4], r[5], r[6])

    @wp.func
    def pixels(r: record):
        """First and last + 1 column, first and last + 1 row; all zero for what is not seen."""
        columns = int(wp.cast(r[3], bits))
        rows = int(wp.cast(r[7], bits))
        return wp.vec4i(
            columns & SIDE_MAX, (columns >> 16) & SIDE_MAX, rows & SIDE_MAX, (rows >> 16) & SIDE_MAX
        )

    return load, store, pack, center, conic, pixels


@functools.cache
def gradient_functions(dtype: type):
    """(gradient of the centre, of the conic, of the opacity) from a record and its moments."""
    record = record_type(dtype)
    vec2 = wp.types.vector(length=2, dtype=dtype)
    vec3 = wp.types.vector(length=3, dtype=dtype)

    @wp.func
    def center_gradient(r: record, m: record):
        return dtype(-2.0) * vec2(r[4] * m[1] + r[5] * m[2], r[5] * m[1] + r[6] * m[2])

    @wp.func
    def conic_gradient(m: record):
        return vec3(m[3], dtype(2.0) * m[4], m[5])

    @wp.func
    def opacity_gradient(r: record, m: record):
        return dtype(-2.0) * m[0] / r[2]

    return center_gradient, conic_gradient, opacity_gradient

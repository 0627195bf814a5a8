"""A particle's own numbers, loaded into float64 by the one thread that works on it, as functions for Warp kernels.

The adjoint that Warp generates for `field[i]` adds to the gradient one number at a time: 36 for a stress operator, each in a
transaction of its own on a GPU. Here 16 bytes are added at a time where the size of a particle's part allows it, and no thread
waits for that; pieces to which nothing is added are left alone, which costs nothing where the compiler sees that a law does not
read them. Arrays must be contiguous and begin at a multiple of 16 bytes, see `launching.aligned`.

An operator may be the same for many particles: it is read at a `place` that they share, and its gradient is added to row i, which
several may share too.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from mosa.physics.launching import BYTES
from mosa.physics.memory_sums import added

# a CPU's compiler would take the promise of alignment for faults rather than for speed
PIECE = """
#if defined(__CUDA_ARCH__)
    struct alignas({width} * sizeof({scalar})) Piece {{ {scalar} part[{width}]; }};
#else
    struct Piece {{ {scalar} part[{width}]; }};
#endif"""
LOAD = """
    const Piece* source = reinterpret_cast<const Piece*>(field.data + {place});
    {result} value;
    double* target = reinterpret_cast<double*>(&value);
#pragma unroll
    for (int k = 0; k < {pieces}; ++k) {{
        const Piece piece = source[k];
#pragma unroll
        for (int l = 0; l < {width}; ++l) target[{width} * k + l] = static_cast<double>(piece.part[l]);
    }}
    return value;"""
ADD = """
    if (!adj_field.data) return;
    const double* source = reinterpret_cast<const double*>(&adj_ret);
    {scalar}* target = reinterpret_cast<{scalar}*>(adj_field.data + i);
#pragma unroll
    for (int k = 0; k < {pieces}; ++k) {{
        {scalar} part[{width}];
        bool any = false;
#pragma unroll
        for (int l = 0; l < {width}; ++l) {{
            part[l] = static_cast<{scalar}>(source[{width} * k + l]);
            any = any || part[l] != 0;
        }}
#if defined(__CUDA_ARCH__)
        const size_t address = __cvta_generic_to_global(target + {width} * k);
        const int adds = any;{added}
#else
        if (any)
            for (int l = 0; l < {width}; ++l) target[{width} * k + l] += part[l];
#endif
    }}"""

# of pieces of one number, which are not worth an instruction of memory each: they are read, added to and written back at once
ADD_WHOLE = """
    if (!adj_field.data) return;
    {scalar}* target = reinterpret_cast<{scalar}*>(adj_field.data + i);
    const double* source = reinterpret_cast<const double*>(&adj_ret);
    bool any = false;
#pragma unroll
    for (int k = 0; k < {pieces}; ++k) any = any || source[k] != 0.0;
    if (!any) return;
#pragma unroll
    for (int k = 0; k < {pieces}; ++k) target[k] += static_cast<{scalar}>(source[k]);"""

# of a 6 x 6 matrix and a vector, in the order of Warp's own product: neither the matrix nor its gradient is held in float64, for
# which a GPU's thread has not enough registers. A CPU's compiler makes vectors of Warp's own
WHOLE = """
    const {scalar}* numbers = reinterpret_cast<const {scalar}*>(field.data + place);
    wp::mat_t<6, 6, double> matrix;
    for (int k = 0; k < 36; ++k) matrix.data[k / 6][k % 6] = static_cast<double>(numbers[k]);"""
PRODUCT = f"""
#if defined(__CUDA_ARCH__)
{PIECE}
    const Piece* source = reinterpret_cast<const Piece*>(field.data + place);
    wp::vec_t<6, double> value;
#pragma unroll
    for (int k = 0; k < {{pieces}}; ++k) {{{{
        const Piece piece = source[k];
#pragma unroll
        for (int l = 0; l < {{width}}; ++l) {{{{
            const int row = ({{width}} * k + l) / 6, column = ({{width}} * k + l) % 6;
            const double term = static_cast<double>(piece.part[l]) * x[column];
            value[row] = column == 0 ? term : value[row] + term;
        }}}}
    }}}}
    return value;
#else
{WHOLE}
    return wp::mul(matrix, x);
#endif
"""
ADD_PRODUCT = f"""
#if defined(__CUDA_ARCH__)
{PIECE}
    const Piece* source = reinterpret_cast<const Piece*>(field.data + place);
    wp::vec_t<6, double> sums;
#pragma unroll
    for (int k = 0; k < {{pieces}}; ++k) {{{{
        const Piece piece = source[k];
#pragma unroll
        for (int l = 0; l < {{width}}; ++l) {{{{
            const int row = ({{width}} * k + l) / 6, column = ({{width}} * k + l) % 6;
            const double term = static_cast<double>(piece.part[l]) * adj_ret[row];
            sums[column] = row == 0 ? term : sums[column] + term;
        }}}}
    }}}}
    if (adj_field.data) {{{{
        {{scalar}}* target = reinterpret_cast<{{scalar}}*>(adj_field.data + i);
#pragma unroll
        for (int k = 0; k < {{pieces}}; ++k) {{{{
            {{scalar}} part[{{width}}];
#pragma unroll
            for (int l = 0; l < {{width}}; ++l) {{{{
                const int row = ({{width}} * k + l) / 6, column = ({{width}} * k + l) % 6;
                part[l] = static_cast<{{scalar}}>(adj_ret[row] * x[column]);
            }}}}
            const size_t address = __cvta_generic_to_global(target + {{width}} * k);
            const int adds = 1;{{added}}
        }}}}
    }}}}
    adj_x += sums;
#else
{WHOLE}
    wp::mat_t<6, 6, double> adj_matrix = {{{{}}}};
    wp::adj_mul(matrix, x, adj_matrix, adj_x, adj_ret);
    if (!adj_field.data) return;
    {{scalar}}* target = reinterpret_cast<{{scalar}}*>(adj_field.data + i);
    for (int k = 0; k < 36; ++k) target[k] += static_cast<{{scalar}}>(adj_matrix.data[k / 6][k % 6]);
#endif
"""

# rotations of LANES particles by `polar_value`'s iteration, bit for bit, in one register each number: a CPU's launch is one thread,
# which comes to one particle after the other. Whether that of particle i is there: that iteration may take another way
LANES = 8
TURNED = f"""
#if defined(__CUDA_ARCH__)
    return false;
#else
#define ALL(k, n) _Pragma("unroll") for (int k = 0; k < n; ++k)
    if (!block.data) return false;
    typedef decltype(field.data[0].data[0][0] + 0) S;
    typedef S W __attribute__((ext_vector_type({LANES})));
    typedef double V __attribute__((ext_vector_type({LANES})));
    // once, and not in the kernel and again in its adjoint
    const auto find = [&]() __attribute__((noinline)) {{
        V a[9], b[9], size = 0;
        ALL(k, 9) {{
            W w;
            ALL(l, {LANES}) w[l] = field.data[i + l < field.shape[0] ? i + l : i].data[k / 3][k % 3];
            a[k] = __builtin_convertvector(w, V);
            size += a[k] * a[k];
        }}
        auto turning = size < 100.0, found = size < 0.0;
        for (int step = 0; step < 20 && __builtin_reduce_or(turning); ++step) {{
            ALL(k, 9) {{
                const int r = (k / 3 + 1) % 3 * 3, s = (k / 3 + 2) % 3 * 3, l = (k + 1) % 3, m = (k + 2) % 3;
                b[k] = a[r + l] * a[s + m] - a[r + m] * a[s + l];
            }}
            const V d = a[0] * b[0] + a[1] * b[1] + a[2] * b[2], f = 0.5 / d;
            turning &= d > 0.02;
            ALL(k, 9) {{
                const V half = 0.5 * a[k], other = f * b[k], next = half + other;
                b[k] = next - a[k];
                a[k] = turning ? next : a[k];
            }}
            const V x = b[0] * b[0] + b[1] * b[1] + b[2] * b[2], y = b[3] * b[3] + b[4] * b[4] + b[5] * b[5];
            const V z = b[6] * b[6] + b[7] * b[7] + b[8] * b[8];
            found |= turning & (x + y + z < 1.0e-18);
            turning &= ~found;
        }}
        ALL(k, 9 * {LANES}) block.data[k / 9].data[k % 9 / 3][k % 3] = found[k / 9] ? a[k % 9][k / 9] : 0;
    }};
    if (i % {LANES} == 0) find();
    const double* own = block.data[i % {LANES}].data[0];
    return own[0] != 0 || own[1] != 0 || own[2] != 0;
#endif
"""


@cache
def particle_access(scalar, slots: int) -> SimpleNamespace:
    """matrix33 and parameters (vectors of `slots` numbers): f(field, i) -> the same in float64; vector6(field, i, place) -> that at
    `place`; times66(field, i, place, x) -> the matrix at `place` times x; turned(field, i, block) -> whether block[i % LANES] is
    the polar rotation of matrix i, on a CPU alone.

    scalar: of the fields, wp.float32 or wp.float64. Gradients are added to number i, on which no other thread may work but
    in vector6 and times66."""
    name, size = {wp.float32: ("float", 4), wp.float64: ("double", 8)}[scalar]

    def pieces(count: int, width: int) -> dict:
        numbers = added(scalar, [f"part[{k}]" for k in range(width)])
        return {"scalar": name, "width": width, "pieces": count // width, "added": numbers}

    def snippets(count: int, result: str, place: str = "i") -> tuple[str, str]:
        width = next(k for k in (BYTES // size, BYTES // 2 // size, 1) if count % k == 0)
        parts = pieces(count, width) | {"result": result, "place": place}
        return (PIECE + LOAD).format(**parts), (ADD_WHOLE if width == 1 else ADD).format(**parts)

    field33, field66 = (wp.array(dtype=wp.types.matrix(shape=(k, k), dtype=scalar)) for k in (3, 6))
    field6, fields = (wp.array(dtype=wp.types.vector(length=k, dtype=scalar)) for k in (6, slots))
    vec6, vector = (wp.types.vector(length=k, dtype=wp.float64) for k in (6, slots))

    @wp.func_native(*snippets(9, "wp::mat_t<3, 3, double>"))
    def matrix33(field: field33, i: int) -> wp.mat33d: ...

    @wp.func_native(*snippets(6, "wp::vec_t<6, double>", "place"))
    def vector6(field: field6, i: int, place: int) -> vec6: ...

    whole = pieces(36, BYTES // size)

    @wp.func_native(PRODUCT.format(**whole), ADD_PRODUCT.format(**whole))
    def times66(field: field66, i: int, place: int, x: vec6) -> vec6: ...

    @wp.func_native(*snippets(slots, f"wp::vec_t<{slots}, double>"))
    def parameters(field: fields, i: int) -> vector: ...

    @wp.func_native(TURNED)
    def turned(field: field33, i: int, block: wp.array(dtype=wp.mat33d)) -> bool: ...

    return SimpleNamespace(
        matrix33=matrix33,
        vector6=vector6,
        times66=times66,
        parameters=parameters,
        turned=turned,
    )

"""What the 32 threads (lanes) of a CUDA warp do together, as functions for Warp kernels.

On a CPU every thread is a warp of one lane: the same kernels run there, one pixel at a time. All lanes of a warp have to come by
each of these calls: no return, break or condition that differs between them before.
"""

import functools

import warp as wp

from mosa.physics.exact_sums import COLUMNS, HIGH, LARGEST, LOW
from mosa.rendering.records import record_type


def _either(cuda: str, cpu: str) -> str:
    return f"#if defined(__CUDA_ARCH__)\n{cuda}\n#else\n{cpu}\n#endif\n"


ALL = "0xffffffffu"


@wp.func_native(_either("return 32;", "return 1;"))
def lane_count() -> int: ...


@wp.func_native(_either("return thread & 31;", "return 0;"))
def lane_of(thread: int) -> int: ...


@wp.func_native(_either(f"return __any_sync({ALL}, flag) != 0;", "return flag;"))
def any_lane(flag: bool) -> bool: ...


@wp.func_native(_either(f"return __ballot_sync({ALL}, flag);", "return flag ? 1u : 0u;"))
def ballot(flag: bool) -> wp.uint32:
    """A bit for each lane whose flag is set."""
    ...


@wp.func_native(_either("return __ffs(mask) - 1;", "return 0;"))
def lowest(mask: wp.uint32) -> int:
    """The first lane of a mask that is not empty."""
    ...


@wp.func_native(_either(f"return __shfl_sync({ALL}, value, lane);", "return value;"))
def from_lane(value: int, lane: int) -> int: ...


@wp.func_native(
    _either(
        f"""
    for (int offset = 16; offset > 0; offset /= 2)
        value = max(value, __shfl_xor_sync({ALL}, value, offset));
    return value;""",
        "return value;",
    )
)
def highest(value: int) -> int:
    """The largest value of all lanes."""
    ...


ADD_SUMS = """
    // numbers of a Gaussian to sum over lanes: its moments, then scale * direction
    constexpr int moments = 6, total = moments + sizeof(direction.c) / sizeof(direction.c[0]);
    auto number = [&](int k) { return k < moments ? moment.c[k] : scale * direction.c[k - moments]; };
    auto add = [&](int k, decltype(scale * scale) sum) {
        TO_MEMORY
    };
#if defined(__CUDA_ARCH__)
    constexpr int width = total <= 8 ? 8 : total <= 16 ? 16 : 32;
    decltype(scale * scale) sums[width];
    // one half of the lanes goes on with the first half of the numbers, the other with the second: each gives what it drops
    auto exchange = [&](int half) {
        const bool upper = thread & half;
        const int kept = half * width / 32;
        #pragma unroll
        for (int k = 0; k < kept; ++k) {
            const auto given = upper ? sums[k] : sums[k + kept];
            sums[k] = (upper ? sums[k + kept] : sums[k]) + __shfl_xor_sync(0xffffffffu, given, half);
        }
        if (kept == 0)
            sums[0] += __shfl_xor_sync(0xffffffffu, sums[0], half);
    };
    #pragma unroll
    for (int first = 0; first < total; first += width) {
        #pragma unroll
        for (int k = 0; k < width; ++k)
            sums[k] = first + k < total ? number(first + k) : 0;
        exchange(16);
        exchange(8);
        exchange(4);
        exchange(2);
        exchange(1);
        const int lane = thread & 31, mine = first + lane * width / 32;
        if (lane % (32 / width) == 0 && mine < total)
            add(mine, sums[0]);
    }
#else
    for (int k = 0; k < total; ++k)
        add(k, number(k));
#endif
"""


PLAIN = """
        auto* start = k < moments ? &records.data[i].c[k] : &features.data[f].c[k - moments];
        wp::atomic_add(start, sum);"""

# as `exact_sums.add_exactly`
EXACT = f"""
        const int number_of = k < moments ? 8 * i + k : (total - moments) * f + k - moments;
        wp::int64* start = (k < moments ? records.data : features.data) + {COLUMNS} * number_of;
        const double q = static_cast<double>(sum) * {HIGH:.1f};
        if (fabs(q) <= {LARGEST:.1f}) {{
            const double high = floor(q);
            wp::atomic_add(start, static_cast<wp::int64>(high));
            wp::atomic_add(start + 1, static_cast<wp::int64>(floor((q - high) * {LOW:.1f})));
        }} else {{
            wp::atomic_add(start + 2, wp::int64(1));
        }}"""


@functools.cache
def add_sums(dtype: type, channels: int, exact: bool = False):
    """A function that adds what the lanes bring for one Gaussian to its gradients in memory.

    Instead of summing one number after the other over all lanes, which takes five exchanges each, the lanes share out the
    numbers (up to 32 at a time): 16 numbers take 16 exchanges, lane 2 k ends with the sum of number k, and one instruction
    adds all of them to memory that lies together. exact: to exact sums (8 records, COLUMNS), (channels features, COLUMNS)."""
    moments = wp.types.vector(length=6, dtype=dtype)
    vecc = wp.types.vector(length=channels, dtype=dtype)

    sums = wp.array2d(dtype=wp.int64)
    to_records, to_features = (
        (sums, sums) if exact else (wp.array(dtype=record_type(dtype)), wp.array(dtype=vecc))
    )

    @wp.func_native(ADD_SUMS.replace("TO_MEMORY", EXACT if exact else PLAIN))
    def function(
        thread: int, moment: moments, scale: dtype, direction: vecc, records: to_records, i: int,
        features: to_features, f: int,
    ): ...  # fmt: skip

    return function

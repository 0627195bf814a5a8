"""Whole 4-vectors of a grid node in one memory instruction, as functions for Warp kernels.

Warp compiles an access to a vector into one instruction per component. A node's four float32 are 16 aligned bytes, which a GPU
loads, stores and, from compute capability 9.0 on, adds with one instruction. Float64 goes in pairs and is added one by one. On a
CPU these are plain accesses. Arrays must be contiguous, as torch and Warp allocate them.

Sums in memory are what bounds the transfers of a GPU, and neighbouring threads mostly have neighbouring particles: two of them in a
row that have the same nodes (`pair`) add up their terms in registers, and the first of them adds both to memory.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from mosa.physics.exact_sums import sum_functions
from mosa.physics.memory_sums import added


def _either(cuda: str, cpu: str) -> str:
    return f"#if defined(__CUDA_ARCH__)\n{cuda}\n#else\n{cpu}\n#endif\n"


# `__ldg`: not ordered after the atomics before it, so that loads of all nodes may be under way at once
LOAD = {
    wp.float32: """const float4 q = __ldg(reinterpret_cast<const float4*>(field.data + i));""",
    wp.float64: """
    const double2* pairs = reinterpret_cast<const double2*>(field.data + i);
    const double2 first = __ldg(pairs), second = __ldg(pairs + 1);
    const struct { double x, y, z, w; } q = { first.x, first.y, second.x, second.y };""",
}

STORE = {
    wp.float32: """*reinterpret_cast<float4*>(field.data + i) = make_float4(x, y, z, w);""",
    wp.float64: """
    double2* pairs = reinterpret_cast<double2*>(field.data + i);
    pairs[0] = make_double2(x, y);
    pairs[1] = make_double2(z, w);""",
}

# x: index of the lowest node; -> (threads that take part, 1 where this one adds to memory + 2 where it adds the next one's too).
# Runs of threads with the same nodes are taken two by two; the thread after the last one has others, or takes no part
PAIR = """
    const unsigned mask = __activemask(), lane = threadIdx.x & 31;
    const int before = __shfl_up_sync(mask, x, 1);
    const bool begins = lane == 0 || !(mask >> (lane - 1) & 1) || before != x;
    const unsigned starts = __ballot_sync(mask, begins);
    const unsigned start = 31 - __clz(starts & ((2u << lane) - 1));
    const bool adds = ((lane - start) & 1) == 0, next = lane < 31 && (mask >> (lane + 1) & 1) && !(starts >> (lane + 1) & 1);
    return {static_cast<int>(mask), (adds ? 1 : 0) + (adds && next ? 2 : 0)};"""
# of three nodes in a row, a, b and c; the next thread's numbers are asked for by all: it would wait for those that do not ask
SHARED = """
    const unsigned mask = static_cast<unsigned>(together.c[0]);
    const bool both = together.c[1] & 2;
    const int adds = together.c[1] & 1;
    decltype(a) values[3] = {a, b, c};
#pragma unroll
    for (int n = 0; n < 3; ++n)
#pragma unroll
        for (int k = 0; k < NUMBERS; ++k) {
            const auto more = __shfl_down_sync(mask, values[n].c[k], 1);
            if (both) values[n].c[k] += more;
        }
#pragma unroll
    for (int n = 0; n < 3; ++n) {
        const auto x = values[n].c[0], y = values[n].c[1], z = values[n].c[2], w = FOURTH;
        const size_t address = __cvta_generic_to_global(field.data + i + n);ADD
    }"""
PLAIN = """
    const decltype(a) values[3] = {a, b, c};
    for (int n = 0; n < 3; ++n)
        for (int k = 0; k < NUMBERS; ++k) field.data[i + n].c[k] += values[n].c[k];"""

PARTS = "const auto x = value.c[0], y = value.c[1], z = value.c[2], w = {};"


@cache
def node_access(scalar) -> SimpleNamespace:
    """load4, load3, store3, store4, pair, add3, add4, clear on arrays of 4-vectors of wp.float32 or wp.float64.

    load(field, i), for memory that nothing in the same launch writes; store(field, i, value), for memory that nothing in the same
    launch reads; clear(field, i); add(field, i, a, b, c, together), to i, i + 1 and i + 2, for the same, together = pair(x) of a
    number x that tells to which i a thread adds, one after the other. The functions on 3-vectors leave the fourth number out; a
    store sets it to 0.
    """
    vec3 = wp.types.vector(length=3, dtype=scalar)
    vec4 = wp.types.vector(length=4, dtype=scalar)
    field4 = wp.array(dtype=vec4)
    three, four = PARTS.format("decltype(x)(0)"), PARTS.format("value.c[3]")

    def add_row(names: str) -> str:
        fourth = "values[n].c[3]" if len(names) == 4 else "decltype(x)(0)"
        cuda = SHARED.replace("FOURTH", fourth).replace(
            "ADD", added(scalar, names, filler=None if len(names) == 4 else "w")
        )
        return _either(cuda, PLAIN).replace("NUMBERS", str(len(names)))

    @wp.func_native(_either(PAIR, "return {0, 1};"))
    def pair(x: int) -> wp.vec2i: ...

    @wp.func_native(
        _either(f"{LOAD[scalar]} return {{q.x, q.y, q.z, q.w}};", "return field.data[i];")
    )
    def load4(field: field4, i: int) -> vec4: ...

    @wp.func_native(
        _either(
            f"{LOAD[scalar]} return {{q.x, q.y, q.z}};",
            "const auto& q = field.data[i].c; return {q[0], q[1], q[2]};",
        )
    )
    def load3(field: field4, i: int) -> vec3: ...

    @wp.func_native(_either(f"{four} {STORE[scalar]}", "field.data[i] = value;"))
    def store4(field: field4, i: int, value: vec4): ...

    @wp.func_native(_either(f"{three} {STORE[scalar]}", f"{three} field.data[i] = {{x, y, z, w}};"))
    def store3(field: field4, i: int, value: vec3): ...

    @wp.func_native(add_row("xyzw"))
    def add4(field: field4, i: int, a: vec4, b: vec4, c: vec4, together: wp.vec2i): ...

    @wp.func_native(add_row("xyz"))
    def add3(field: field4, i: int, a: vec3, b: vec3, c: vec3, together: wp.vec2i): ...

    @wp.func
    def clear(field: field4, i: int):
        z = scalar(0.0)
        store4(field, i, vec4(z, z, z, z))

    return SimpleNamespace(
        load4=load4, load3=load3, store4=store4, store3=store3, pair=pair, add4=add4, add3=add3, clear=clear
    )  # fmt: skip


@cache
def exact_node_access(scalar) -> SimpleNamespace:
    """pair, add4, add3 as `node_access`, onto exact sums (4 nodes, COLUMNS) int64, to which every thread adds its own: a sum of two
    in registers would be rounded; settle_node(sums, field, i), which stores a node's sums and clears them."""
    vec3 = wp.types.vector(length=3, dtype=scalar)
    vec4 = wp.types.vector(length=4, dtype=scalar)
    store4, functions = node_access(scalar).store4, sum_functions(scalar)
    add_exactly, total, clear = functions.add_exactly, functions.total, functions.clear

    @wp.func
    def pair(x: int):
        return wp.vec2i(0, 1)

    def add(numbers: int):
        vector = vec4 if numbers == 4 else vec3

        @wp.func
        def add_row(
            sums: wp.array2d(dtype=wp.int64), node: int, a: vector, b: vector, c: vector, together: wp.vec2i
        ):  # fmt: skip
            for k in range(numbers):
                add_exactly(sums, 4 * node + k, a[k])
            for k in range(numbers):
                add_exactly(sums, 4 * node + 4 + k, b[k])
            for k in range(numbers):
                add_exactly(sums, 4 * node + 8 + k, c[k])

        return add_row

    @wp.func
    def settle_node(sums: wp.array2d(dtype=wp.int64), field: wp.array(dtype=vec4), node: int):
        first = 4 * node
        x = total(sums, first)
        y = total(sums, first + 1)
        z = total(sums, first + 2)
        store4(field, node, vec4(x, y, z, total(sums, first + 3)))
        for k in range(4):
            clear(sums, first + k)

    return SimpleNamespace(pair=pair, add4=add(4), add3=add(3), settle_node=settle_node)

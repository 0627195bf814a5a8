"""Whole 4-vectors of a grid node in one memory instruction, as functions for Warp kernels.

Warp compiles an access to a vector into one instruction per component. A node's four float32 are 16 aligned bytes, which a GPU
loads, stores and, from compute capability 9.0 on, adds with one instruction. Float64 goes in pairs and is added one by one. On a
CPU these are plain accesses. Arrays must be contiguous, as torch and Warp allocate them.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from mosa.exact_sums import sum_functions


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

# without a result (Warp's own atomic returns the old value, which costs float64 a branch for shared memory), and without a memory
# clobber: the kernels do not read what they add to
ADD = {
    wp.float32: """
    const size_t address = __cvta_generic_to_global(field.data + i);
#if __CUDA_ARCH__ >= 900
    asm volatile("red.relaxed.gpu.global.add.v4.f32 [%0], {%1, %2, %3, %4};" :: "l"(address), "f"(x), "f"(y), "f"(z), "f"(w));
#else
    asm volatile("red.relaxed.gpu.global.add.f32 [%0], %1;" :: "l"(address), "f"(x));
    asm volatile("red.relaxed.gpu.global.add.f32 [%0 + 4], %1;" :: "l"(address), "f"(y));
    asm volatile("red.relaxed.gpu.global.add.f32 [%0 + 8], %1;" :: "l"(address), "f"(z));
    FOURTH asm volatile("red.relaxed.gpu.global.add.f32 [%0 + 12], %1;" :: "l"(address), "f"(w));
#endif""",
    wp.float64: """
    const size_t address = __cvta_generic_to_global(field.data + i);
    asm volatile("red.relaxed.gpu.global.add.f64 [%0], %1;" :: "l"(address), "d"(x));
    asm volatile("red.relaxed.gpu.global.add.f64 [%0 + 8], %1;" :: "l"(address), "d"(y));
    asm volatile("red.relaxed.gpu.global.add.f64 [%0 + 16], %1;" :: "l"(address), "d"(z));
    FOURTH asm volatile("red.relaxed.gpu.global.add.f64 [%0 + 24], %1;" :: "l"(address), "d"(w));""",
}

PARTS = "const auto x = value.c[0], y = value.c[1], z = value.c[2], w = {};"


@cache
def node_access(scalar) -> SimpleNamespace:
    """load4, load3, store3, store4, add3, add4, clear on arrays of 4-vectors of wp.float32 or wp.float64.

    load(field, i), for memory that nothing in the same launch writes; store and add(field, i, value), add for memory that nothing
    in the same launch reads; clear(field, i). The functions on 3-vectors leave the fourth number out; a store sets it to 0.
    """
    vec3 = wp.types.vector(length=3, dtype=scalar)
    vec4 = wp.types.vector(length=4, dtype=scalar)
    field4 = wp.array(dtype=vec4)
    three, four = PARTS.format("decltype(x)(0)"), PARTS.format("value.c[3]")

    @wp.func_native(_either(f"{LOAD[scalar]} return {{q.x, q.y, q.z, q.w}};", "return field.data[i];"))
    def load4(field: field4, i: int) -> vec4: ...

    @wp.func_native(
        _either(
            f"{LOAD[scalar]} return {{q.x, q.y, q.z}};", "const auto& q = field.data[i].c; return {q[0], q[1], q[2]};"
        )
    )
    def load3(field: field4, i: int) -> vec3: ...

    @wp.func_native(_either(f"{four} {STORE[scalar]}", "field.data[i] = value;"))
    def store4(field: field4, i: int, value: vec4): ...

    @wp.func_native(_either(f"{three} {STORE[scalar]}", f"{three} field.data[i] = {{x, y, z, w}};"))
    def store3(field: field4, i: int, value: vec3): ...

    @wp.func_native(
        _either(f"{four} {ADD[scalar].replace('FOURTH', '')}", "for (int k = 0; k < 4; ++k) field.data[i].c[k] += value.c[k];")
    )
    def add4(field: field4, i: int, value: vec4): ...

    @wp.func_native(
        _either(f"{three} {ADD[scalar].replace('FOURTH', '//')}", "for (int k = 0; k < 3; ++k) field.data[i].c[k] += value.c[k];")
    )
    def add3(field: field4, i: int, value: vec3): ...

    @wp.func
    def clear(field: field4, i: int):
        z = scalar(0.0)
        store4(field, i, vec4(z, z, z, z))

    return SimpleNamespace(load4=load4, load3=load3, store4=store4, store3=store3, add4=add4, add3=add3, clear=clear)


@cache
def exact_node_access(scalar) -> SimpleNamespace:
    """add4, add3 as `node_access`, onto exact sums (4 nodes, COLUMNS) int64; settle_node(sums, field, i), which stores a node's
    sums and clears them."""
    vec3 = wp.types.vector(length=3, dtype=scalar)
    vec4 = wp.types.vector(length=4, dtype=scalar)
    store4, functions = node_access(scalar).store4, sum_functions(scalar)
    add_exactly, total, clear = functions.add_exactly, functions.total, functions.clear

    @wp.func
    def add4(sums: wp.array2d(dtype=wp.int64), node: int, value: vec4):
        for k in range(4):
            add_exactly(sums, 4 * node + k, value[k])

    @wp.func
    def add3(sums: wp.array2d(dtype=wp.int64), node: int, value: vec3):
        for k in range(3):
            add_exactly(sums, 4 * node + k, value[k])

    @wp.func
    def settle_node(sums: wp.array2d(dtype=wp.int64), field: wp.array(dtype=vec4), node: int):
        first = 4 * node
        store4(field, node, vec4(total(sums, first), total(sums, first + 1), total(sums, first + 2), total(sums, first + 3)))
        for k in range(4):
            clear(sums, first + k)

    return SimpleNamespace(add4=add4, add3=add3, settle_node=settle_node)

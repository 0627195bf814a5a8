"""Memory of grid nodes and particles in as few transactions as a GPU allows, as functions for Warp kernels.

Warp compiles an access to a vector into one instruction per component. A node's four float32 are 16 aligned bytes, which a GPU
loads, stores and, from compute capability 9.0 on, adds with one instruction. Float64 goes in pairs and is added one by one. On a
CPU these are plain accesses. Arrays must be contiguous, and begin where `launching.aligned` wants it.

Sums in memory are what bounds the transfers of a GPU, and neighbouring threads mostly have neighbouring particles: those in a row
that have the same nodes (`run`) add up their terms in registers, in twos, fours and eights, and the first of them adds to memory.
Where the next such thread's nodes begin one farther along z, as in a line of a lattice, it takes over the terms of the two nodes
that both have: of three nodes in a row only the last thread of such a line adds more than one.

A particle's vector of 12 bytes or matrix of 36 lies across the 16 that a thread can store at once, and nine stores of a warp to
every 36th byte cost nine times the transactions: a warp puts its particles' numbers in shared memory and stores all of them from
there as they lie in memory. Loads do not gain by it: what one of nine leaves of a cache line, the next one finds.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from mosa.physics.exact_sums import sum_functions
from mosa.physics.memory_sums import added

Together = wp.types.vector(length=5, dtype=int)
"""What `run` tells a thread of those around it."""
STEPS, STEPS_OF_TWO = 3, 2
"""In which threads of a run add up: eights, and fours of threads with two particles each."""


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

# x: index of the lowest node, -1: takes no part; -> (threads here, place in the run of those with the same x, how many come after;
# of the first of GROUP threads that add up: the first of those before, if that has x - 1, else -1, and whether none after it
# takes over its terms)
RUN = """
    const unsigned mask = __activemask(), lane = threadIdx.x & 31;
    const int before = __shfl_up_sync(mask, x, 1);
    // a thread that is not here ends a run, as the next one begins one
    const unsigned starts = __ballot_sync(mask, before != x || !joins) | ~mask | ~mask << 1 | 1;
    const unsigned upto = (2u << lane) - 1, later = starts & ~upto;
    const int end = later ? __ffs(later) - 1 : 32;
    const int own = lane, place = own - 31 + __clz(starts & upto);
    const bool adds = x != -1 && place % GROUP == 0;
    const unsigned adding = __ballot_sync(mask, adds), earlier = adding & upto >> 1, next = adding & ~upto;
    const int last = earlier ? 31 - __clz(earlier) : own, there = __shfl_sync(mask, x, last);
    const bool follows = adds && earlier && there == x - 1;
    const unsigned following = __ballot_sync(mask, follows);
    const bool taken = next && following >> (__ffs(next) - 1) & 1;
    wp::vec_t<5, int> told;
    told.c[0] = mask, told.c[1] = x == -1 ? -1 : place, told.c[2] = end - 1 - own;
    told.c[3] = follows ? last : -1, told.c[4] = adds && !taken;
    return told;"""
# of two particles, at x and y: (same nodes; the first one adds to memory by itself; the first one of the next thread is added here)
MEETING = """
    const unsigned mask = __activemask(), lane = threadIdx.x & 31;
    const int before = __shfl_up_sync(mask, y, 1);
    const bool first = lane > 0 && mask >> (lane - 1) & 1, last = lane == 31 || !(mask >> (lane + 1) & 1);
    const bool differs = x != y && x != -1, given = differs && first && before == x;
    const bool takes = __shfl_down_sync(mask, static_cast<int>(given), 1) && !last;
    return {x == y, differs && !given, takes};"""
# of three nodes in a row; other threads' numbers are asked for by all: it would wait for those that do not ask
# all threads of the warp that there are come here: with a constant mask they need not look which ones are there
FIRST = """
    constexpr unsigned mask = 0xffffffff;
    const decltype(a) firsts[3] = {a, b, c};
    decltype(a) values[3] = {d, e, f};
#pragma unroll
    for (int n = 0; n < 3; ++n)
#pragma unroll
        for (int k = 0; k < NUMBERS; ++k) {
            const auto more = __shfl_down_sync(mask, firsts[n].c[k], 1);
            if (meeting.c[0]) values[n].c[k] += firsts[n].c[k];
            if (meeting.c[2]) values[n].c[k] += more;
        }
#pragma unroll
    for (int n = 0; n < 3; ++n) {
        const int adds = meeting.c[1];
        const auto x = firsts[n].c[0], y = firsts[n].c[1], z = firsts[n].c[2], w = firsts[n].c[3];
        const size_t address = __cvta_generic_to_global(field.data + first + n);ADD
    }"""
ONLY = """
    const unsigned mask = together.c[0];
    decltype(a) values[3] = {a, b, c};"""
SHARED = """
    const int place = together.c[1], after = together.c[2];
#pragma unroll
    for (int step = 0; step < STEPS; ++step) {
        const bool both = (place & ((2 << step) - 1)) == 0 && after >= 1 << step;
#pragma unroll
        for (int n = 0; n < 3; ++n)
#pragma unroll
            for (int k = 0; k < NUMBERS; ++k) {
                const auto more = __shfl_down_sync(mask, values[n].c[k], 1 << step);
                if (both) values[n].c[k] += more;
            }
    }
    const int before = together.c[3], source = before < 0 ? threadIdx.x & 31 : before;
#pragma unroll
    for (int n = 1; n >= 0; --n)
#pragma unroll
        for (int k = 0; k < NUMBERS; ++k) {
            const auto more = __shfl_sync(mask, values[n + 1].c[k], source);
            if (before >= 0) values[n].c[k] += more;
        }
    const int first_adds = place >= 0 && (place & ((1 << STEPS) - 1)) == 0;
#pragma unroll
    for (int n = 0; n < 3; ++n) {
        const int adds = n == 0 ? first_adds : together.c[4];
        const auto x = values[n].c[0], y = values[n].c[1], z = values[n].c[2], w = FOURTH;
        const size_t address = __cvta_generic_to_global(field.data + i + n);ADD
    }"""
PLAIN = """
    const decltype(a) values[3] = {a, b, c};
    for (int n = 0; n < 3; ++n)
        for (int k = 0; k < NUMBERS; ++k) field.data[i + n].c[k] += values[n].c[k];"""

# a CPU's compiler makes no vectors of Warp's own: a node is one of four numbers, in the order of operations of the loops that a GPU
# goes through, so that all bits are theirs
VECTORS = """
#define ALL(k, n) _Pragma("unroll") for (int k = 0; k < n; ++k)
    typedef decltype(wx.c[0] + wx.c[0]) S;
    typedef S V __attribute__((ext_vector_type(4), aligned(sizeof(S))));
    V* nodes = reinterpret_cast<V*>(field.data + i);"""
SCATTER = f"""{VECTORS}
    const V Q = {{q.c[0], q.c[1], q.c[2], m}};
    const V X = {{bx.c[0], bx.c[1], bx.c[2], 0}}, Y = {{by.c[0], by.c[1], by.c[2], 0}}, Z = {{bz.c[0], bz.c[1], bz.c[2], 0}};
    ALL(j, 3) ALL(k, 3) {{
        const V x = S(j) * X, y = S(k) * Y, along = Q + x, here = along + y;
        const S across = wx.c[j] * wy.c[k];
        ALL(l, 3) {{
            const V z = S(l) * Z, momentum = here + z, part = (across * wz.c[l]) * momentum;
            nodes[(j * dims.c[1] + k) * dims.c[2] + l] += part;
        }}
    }}"""
GATHER = f"""{VECTORS}
    V v = 0, x = 0, y = 0, z = 0;
    ALL(j, 3) {{
        V layer = 0;
        ALL(k, 3) {{
            const V* row = nodes + (j * dims.c[1] + k) * dims.c[2];
            const V a = wz.c[0] * row[0], b = wz.c[1] * row[1], c = wz.c[2] * row[2];
            const V line = wy.c[k] * (a + b + c), twice = S(2) * c;
            const V along = (wx.c[j] * S(k)) * line, up = (wx.c[j] * wy.c[k]) * (b + twice);
            layer = layer + line, y = y + along, z = z + up;
        }}
        layer = wx.c[j] * layer, v = v + layer;
        const V across = S(j) * layer;
        x = x + across;
    }}
    wp::mat_t<4, 3, S> found;
    ALL(k, 3) found.data[0][k] = v[k], found.data[1][k] = x[k], found.data[2][k] = y[k], found.data[3][k] = z[k];
    return found;"""

# of a particle's COUNT float32, an odd number: all but one in pairs, which begin with the first of an even particle
TAKE = """
    const float* source = reinterpret_cast<const float*>(field.data + i);
    const int odd = i & 1;
    TYPE value;
    float* target = reinterpret_cast<float*>(&value);
    target[odd ? 0 : COUNT - 1] = __ldg(source + (odd ? 0 : COUNT - 1));
#pragma unroll
    for (int k = 0; k < COUNT / 2; ++k) {
        const float2 q = __ldg(reinterpret_cast<const float2*>(source + odd) + k);
        target[odd + 2 * k] = q.x;
        target[odd + 2 * k + 1] = q.y;
    }
    return value;"""
# of a warp of which all threads are here, all at once
PUT = """
    __shared__ __align__(16) float rooms[WP_TILE_BLOCK_DIM * COUNT];
    const int lane = threadIdx.x & 31;
    if (__activemask() == 0xffffffff) {
        float* room = rooms + (threadIdx.x - lane) * COUNT;
        __syncwarp();
#pragma unroll
        for (int k = 0; k < COUNT; ++k) room[COUNT * lane + k] = reinterpret_cast<const float*>(&value)[k];
        __syncwarp();
#pragma unroll
        for (int q = lane; q < 8 * COUNT; q += 32)
            reinterpret_cast<float4*>(field.data + i - lane)[q] = reinterpret_cast<const float4*>(room)[q];
    } else field.data[i] = value;"""

PARTS = "const auto x = value.c[0], y = value.c[1], z = value.c[2], w = {};"


@cache
def node_access(scalar) -> SimpleNamespace:
    """load4, load3, store3, store4, run, run_of_two, add3, add4, meeting, add4_of_two, clear on arrays of 4-vectors of wp.float32
    or wp.float64, take3, take33, put3, put33 on those of particles' vectors and matrices.

    load(field, i), for memory that nothing in the same launch writes; store(field, i, value), for memory that nothing in the same
    launch reads; clear(field, i); add(field, i, a, b, c, together), to i, i + 1 and i + 2, for the same, together = run(x, True)
    of a number x that tells to which i a thread adds, one after the other, -1 where to none. The functions on 3-vectors leave the
    fourth number out; a store sets it to 0. take(field, i) as load; put(field, i, value) stores for the thread's own number i, in
    blocks of whole warps.
    Of two particles a thread, on a GPU, where no thread may leave before: add4_of_two(field, first, i, a, b, c, d, e, f,
    meeting(x, y), run_of_two(y, x == y)), a, b and c to `first` and the two after it, d, e and f to `i`.
    Where `on_cpu()`: scatter adds what a particle sends (`Sent`) to its 27 nodes, of which `i` is the lowest; gather gives the rows
    v, cx, cy, cz of `g2p`, of theirs."""
    vec3 = wp.types.vector(length=3, dtype=scalar)
    vec4 = wp.types.vector(length=4, dtype=scalar)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=scalar)
    mat43 = wp.types.matrix(shape=(4, 3), dtype=scalar)
    field3, field4, field33 = (wp.array(dtype=kind) for kind in (vec3, vec4, mat33))
    three, four = PARTS.format("decltype(x)(0)"), PARTS.format("value.c[3]")

    def add_row(values: str, numbers: int, steps: int, cpu: str = PLAIN) -> str:
        fourth = "values[n].c[3]" if numbers == 4 else "decltype(x)(0)"
        adding = added(scalar, "xyzw"[:numbers], filler=None if numbers == 4 else "w")
        cuda = (values + SHARED).replace("FOURTH", fourth).replace("ADD", adding)
        return _either(cuda, cpu).replace("NUMBERS", str(numbers)).replace("STEPS", str(steps))

    def own(cuda: str, cpu: str, count: int) -> str:
        if scalar is wp.float64:
            return cpu
        kind = {3: "wp::vec_t<3, float>", 9: "wp::mat_t<3, 3, float>"}[count]
        return _either(cuda, cpu).replace("TYPE", kind).replace("COUNT", str(count))

    @wp.func_native(own(TAKE, "return field.data[i];", 3))
    def take3(field: field3, i: int) -> vec3: ...

    @wp.func_native(own(TAKE, "return field.data[i];", 9))
    def take33(field: field33, i: int) -> mat33: ...

    @wp.func_native(own(PUT, "field.data[i] = value;", 3))
    def put3(field: field3, i: int, value: vec3): ...

    @wp.func_native(own(PUT, "field.data[i] = value;", 9))
    def put33(field: field33, i: int, value: mat33): ...

    def run_of(steps: int) -> str:
        return _either(RUN, "return {};").replace("GROUP", str(1 << steps))

    @wp.func_native(run_of(STEPS))
    def run(x: int, joins: bool) -> Together: ...

    @wp.func_native(run_of(STEPS_OF_TWO))
    def run_of_two(x: int, joins: bool) -> Together: ...

    @wp.func_native(_either(MEETING, "return {0, 0, 0};"))
    def meeting(x: int, y: int) -> wp.vec3i: ...

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

    @wp.func_native(add_row(ONLY, 4, STEPS))
    def add4(field: field4, i: int, a: vec4, b: vec4, c: vec4, together: Together): ...

    @wp.func_native(add_row(ONLY, 3, STEPS))
    def add3(field: field4, i: int, a: vec3, b: vec3, c: vec3, together: Together): ...

    @wp.func_native(add_row(FIRST, 4, STEPS_OF_TWO, cpu=""))
    def add4_of_two(
        field: field4, first: int, i: int, a: vec4, b: vec4, c: vec4, d: vec4, e: vec4, f: vec4,
        meeting: wp.vec3i, together: Together,
    ): ...  # fmt: skip

    @wp.func_native(_either("return false;", "return true;"))
    def on_cpu() -> bool: ...

    @wp.func_native(_either("", SCATTER))
    def scatter(
        field: field4,
        i: int,
        dims: wp.vec3i,
        wx: vec3,
        wy: vec3,
        wz: vec3,
        q: vec3,
        bx: vec3,
        by: vec3,
        bz: vec3,
        m: scalar,
    ): ...

    @wp.func_native(_either("return {};", GATHER))
    def gather(field: field4, i: int, dims: wp.vec3i, wx: vec3, wy: vec3, wz: vec3) -> mat43: ...

    @wp.func
    def clear(field: field4, i: int):
        z = scalar(0.0)
        store4(field, i, vec4(z, z, z, z))

    return SimpleNamespace(
        load4=load4, load3=load3, store4=store4, store3=store3, run=run, run_of_two=run_of_two, meeting=meeting,
        add4=add4, add3=add3, add4_of_two=add4_of_two, clear=clear, take3=take3, take33=take33, put3=put3, put33=put33,
        on_cpu=on_cpu, scatter=scatter, gather=gather,
    )  # fmt: skip


@cache
def exact_node_access(scalar) -> SimpleNamespace:
    """run, add4, add3 as `node_access`, onto exact sums (4 nodes, COLUMNS) int64, to which every thread adds its own: a sum of two
    in registers would be rounded; settle_node(sums, field, i), which stores a node's sums and clears them."""
    vec3 = wp.types.vector(length=3, dtype=scalar)
    vec4 = wp.types.vector(length=4, dtype=scalar)
    store4, functions = node_access(scalar).store4, sum_functions(scalar)
    add_exactly, total, clear = functions.add_exactly, functions.total, functions.clear

    @wp.func
    def run(x: int, joins: bool):
        return Together()

    def add(numbers: int):
        vector = vec4 if numbers == 4 else vec3

        @wp.func
        def add_row(
            sums: wp.array2d(dtype=wp.int64), node: int, a: vector, b: vector, c: vector, together: Together
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

    return SimpleNamespace(run=run, add4=add(4), add3=add(3), settle_node=settle_node)

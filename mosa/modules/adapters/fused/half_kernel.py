"""The Triton kernel of `ProgressiveOperator` forward in float16: all four networks and what lies between them (paper, eq. 4 to 8).

A program takes tiles of BLOCK rows through everything; of the hidden layers nothing leaves it but, where the backward pass follows
(STORE), l1 and l2. Factors of products are float16, sums and all else float32. Networks hold a tile in registers, spread over its
columns too; the assembly has a particle per lane. From one to the other the numbers go by way of global memory, as far as the
multiprocessor's cache, with a barrier between stores and loads: a program reads what it stored itself, never what another did.

A bias is a product as well, with a column of ones of the input (`half_weights.BIAS`) or a tile of its own: no loads, no sums.
"""

import os

import triton
import triton.language as tl

from mosa.modules.adapters.fused.assembly_kernels import (
    corrections,
    store_moved,
    store_normals,
    store_operator,
)
from mosa.modules.adapters.fused.network_kernels import by_column
from mosa.modules.adapters.fused.network_kernels import tanh as exact_tanh

LARGEST = tl.constexpr(65504.0)

if os.environ.get("TRITON_INTERPRET") == "1":

    @triton.jit
    def tanh(z):
        return exact_tanh(z)

    @triton.jit
    def half(x):
        return tl.minimum(tl.maximum(x, -LARGEST), LARGEST).to(tl.float16)

    @triton.jit
    def put(p, value, mask):
        tl.store(p, value, mask=mask)

else:

    @triton.jit
    def tanh(z):
        """To 2^-11."""
        return tl.inline_asm_elementwise(
            "tanh.approx.f32 $0, $1;", "=r,r", [z], dtype=tl.float32, is_pure=True, pack=1
        )

    @triton.jit
    def half(x):
        """In float16, the largest of it where x is larger: infinity would become NaN in the next product."""
        return tl.inline_asm_elementwise(
            "cvt.rn.satfinite.f16x2.f32 $0, $2, $1;",
            "=r,f,f",
            [x],
            dtype=tl.float16,
            is_pure=True,
            pack=2,
        )

    @triton.jit
    def put(p, value, mask):
        """tl.store from the registers where a product left the value: it would move them to others by way of shared memory."""
        tl.inline_asm_elementwise(
            "{ .reg .pred p; setp.ne.s32 p, $3, 0; @p st.global.f32 [$1], $2; mov.b32 $0, 0; }",
            "=r,l,f,r",
            [p.to(tl.uint64), value, mask.to(tl.int32)],
            dtype=tl.int32, is_pure=False, pack=1,
        )  # fmt: skip


@triton.jit
def put_by_column(p, value, r, c, M, count):
    lane = r[:, None] + 0 * c[None, :]
    put(p + c[None, :] * M + lane, value, c[None, :] + 0 * lane < count)


@triton.jit
def silu(u):
    """silu(2 u)."""
    return half(u + u * tanh(u))


@triton.jit
def tile(packed, K: tl.constexpr, COLUMNS: tl.constexpr):
    return tl.load(packed + tl.arange(0, K)[:, None] * COLUMNS + tl.arange(0, COLUMNS)[None, :])


@triton.jit
def row(biases, k: tl.constexpr, BLOCK: tl.constexpr):
    """Row k of a tile of biases, for all rows of a block."""
    one = tl.where(tl.arange(0, 16)[None, :] == k, 1.0, 0.0).to(tl.float16)
    return tl.dot(tl.broadcast_to(one, (BLOCK, 16)), biases)


@triton.jit
def w_and_s(w, s, r, N):
    """(BLOCK, 16): w, s, four zeros."""
    c, lane = tl.arange(0, 16)[None, :], r[:, None]
    return tl.load(tl.where(c < 6, w, s - 6) + lane * 6 + c, mask=(lane < N) & (c < 12), other=0.0)


@triton.jit(do_not_specialize=["N", "known"])
def operator_half(
    w, s, unit, packed, rest, pre, s1, l1, n, t, l2, s2, moved, post, G, h, N, M, known, scale, bound, alpha,
    BOUNDED: tl.constexpr, OPERATOR: tl.constexpr, STORE: tl.constexpr, H: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """packed: see half_weights.py; rest: b of the state at rest (6,), or zeros; known: 1 where it is, so that h is 0 there, or 0.
    That is no constant: the same program finds the rest and subtracts it, so that no more than float32's last bit is left.

    By column: pre, s1 = s / unit + pre, s2 = (I + G) s1, moved = (I + G) pre, post: (6, M); t (48, M), the bounded numbers of C_x,
    C_y, C_z, C_xyz; n (3, M), the scaled normals; STORE: l1, l2 (H, M). OPERATOR: also moved, post, and G (N, 6, 6) and
    h (N, 6) = unit (moved + post - rest)."""
    c, hidden, planes = tl.arange(0, 16), tl.arange(0, H), tl.arange(0, 64)
    of_w, of_s = c[None, :] < 6, (c[None, :] >= 6) & (c[None, :] < 12)
    ones = tl.where(c[None, :] == 12, 1.0, 0.0)
    two = tl.arange(
        0, 2 * BLOCK
    )  # lanes of the assembly, two for each particle: they share the stores
    first, second = two < BLOCK, two >= BLOCK
    # `half_weights._tiles`: five of 16 x H, eight of H x H, three of H x 16, then H x 64, 16 x 16 and 16 x 64
    square = packed + 5 * 16 * H
    narrow = square + 8 * H * H
    wide = narrow + 3 * 16 * H
    F1, A1 = tile(packed, 16, H), tile(packed + 16 * H, 16, H)
    Bn, Tx = tile(packed + 32 * H, 16, H), tile(packed + 48 * H, 16, H)
    biases, plane_bias = tile(packed + 64 * H, 16, H), tile(wide + 64 * H + 256, 16, 64)
    narrow_biases = tile(wide + 64 * H, 16, 16)
    F2, A2, A3 = tile(square, H, H), tile(square + H * H, H, H), tile(square + 2 * H * H, H, H)
    B1, B2, B4 = (
        tile(square + 3 * H * H, H, H),
        tile(square + 4 * H * H, H, H),
        tile(square + 5 * H * H, H, H),
    )
    F3, B3, Ap = tile(narrow, H, 16), tile(narrow + 16 * H, H, 16), tile(wide, H, 64)
    if OPERATOR:
        T1, T2, T3 = (
            tile(square + 6 * H * H, H, H),
            tile(square + 7 * H * H, H, H),
            tile(narrow + 32 * H, H, 16),
        )
    ahead = w_and_s(w, s, tl.program_id(0) * BLOCK + tl.arange(0, BLOCK), N)
    for step in range(tl.program_id(0), M // BLOCK, tl.num_programs(0)):
        r = step * BLOCK + tl.arange(0, BLOCK)
        lane, q = r[:, None], step * BLOCK + two % BLOCK
        x = tl.where(of_s, ahead / tl.load(unit), ahead)
        ahead = w_and_s(
            w, s, r + tl.num_programs(0) * BLOCK, N
        )  # those of the next turn are on their way during this one
        still = (tl.max(tl.abs(x), 1) == 0.0) & (known == 1)
        x = scale * x + ones
        z = silu(tl.dot(half(x), F1))
        z = silu(tl.dot(z, F2, row(biases, 0, BLOCK)))
        y = tl.dot(z, F3, row(narrow_biases, 0, BLOCK))  # in the columns of s
        if BOUNDED:
            y = bound * tanh(y)
        x += scale * y
        put(pre + (c[None, :] - 6) * M + lane, y, of_s & (lane < M))
        put(s1 + (c[None, :] - 6) * M + lane, x / scale, of_s & (lane < M))

        z = silu(tl.dot(half(x), A1))
        z = silu(tl.dot(z, A2, row(biases, 1, BLOCK)))
        z = tl.dot(z, A3, row(biases, 2, BLOCK))
        if STORE:
            put_by_column(l1, z, r, hidden, M, H)
        z = half(z)
        y = alpha * tanh(tl.dot(z, Ap, row(plane_bias, 0, BLOCK)))
        put_by_column(t, y, r, planes, M, 36)

        z = tl.dot(z, B1)
        tl.debug_barrier()
        store_normals(t, s1, n, r, M, scale)
        tl.debug_barrier()
        z = silu(tl.dot(half(by_column(n, r, c, M, 3) + ones), Bn, z))
        z = silu(tl.dot(z, B2, row(biases, 3, BLOCK)))
        y = alpha * tanh(tl.dot(z, B3, row(narrow_biases, 1, BLOCK)))
        put_by_column(t + 36 * M, y, r, c, M, 12)
        z = alpha * tanh(tl.dot(z, B4, row(biases, 4, BLOCK)))
        if STORE:
            put_by_column(l2, z, r, hidden, M, H)
        if OPERATOR:
            z = tl.dot(z.to(tl.float16), T1)
        tl.debug_barrier()
        X, Y, Z, K = corrections(t, q, M)
        store_moved(s1, s2, q, M, X, Y, Z, K, first)
        if OPERATOR:
            store_moved(pre, moved, q, M, X, Y, Z, K, second)
            tl.debug_barrier()
            second_input = scale * tl.load(s2 + (c[None, :] - 6) * M + lane, mask=of_s, other=0.0)
            y0 = by_column(moved, r, c, M, 6) - tl.load(rest + c[None, :], mask=of_w, other=0.0)
            size = tl.load(unit)
            store_operator(
                G, q, X, Y, Z, K, first & (q < N), second & (q < N)
            )  # after all loads, which would wait for it
            x = tl.where(of_s, second_input, x)
            z = silu(tl.dot(half(x), Tx, z))
            z = silu(tl.dot(z, T2, row(biases, 5, BLOCK)))
            y = tl.dot(z, T3, row(narrow_biases, 2, BLOCK))
            if BOUNDED:
                y = bound * tanh(y)
            put_by_column(post, y, r, c, M, 6)
            y = tl.where(still[:, None], 0.0, y + y0)
            put(h + lane * 6 + c[None, :], size * y, (lane < N) & of_w)

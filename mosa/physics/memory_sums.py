"""Sums in a GPU's memory that leave no result, as CUDA for functions of Warp kernels: no thread waits for them.

Warp's own atomic returns the old value, which costs float64 a branch for shared memory. Here there is no memory clobber either:
the kernels do not read what they add to. A predicate takes the place of a branch, behind which a thread's next loads would wait.
From compute capability 9.0 on, two or four aligned float32 are added by one instruction. Subnormal sums of float32 become 0.
"""

from collections.abc import Sequence

import warp as wp


def _red(kind: str, letter: str, names: Sequence[str], address: str, adds: str) -> str:
    numbers = ", ".join(f"%{1 + k}" for k in range(len(names)))
    return (
        f"""
    asm volatile("{{.reg .pred p; setp.ne.s32 p, %{1 + len(names)}, 0; @p red.relaxed.gpu.global.add.{kind} [%0], """
        + (numbers if len(names) == 1 else f"{{{numbers}}}")
        + f""";}}"
                 :: "l"({address}), {", ".join(f'"{letter}"({name})' for name in names)}, "r"({adds}));"""
    )


def added(
    scalar,
    names: Sequence[str],
    address: str = "address",
    adds: str = "adds",
    filler: str | None = None,
) -> str:
    """CUDA that adds names, C++ expressions of one to four wp.float32 or wp.float64, to as many numbers in a row.

    address: expression of a global address, aligned to all of them; adds: of an int, 0 where nothing is to be added; filler: of a
    number that is added to the fourth in a row where one instruction takes four."""
    kind, letter, size = {wp.float32: ("f32", "f", 4), wp.float64: ("f64", "d", 8)}[scalar]
    single = "".join(
        _red(kind, letter, [name], f"{address} + {size * k}", adds) for k, name in enumerate(names)
    )
    wide = [*names, *([filler] if filler else [])]
    if scalar is not wp.float32 or len(wide) not in (2, 4):
        return single
    return f"\n#if __CUDA_ARCH__ >= 900{_red(f'v{len(wide)}.f32', letter, wide, address, adds)}\n#else{single}\n#endif"

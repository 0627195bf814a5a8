"""Where nodes are, and the 27 around a particle: quadratic B-splines, and where the stencil lies in a window."""

# ruff: noqa: UP018, RUF046
# (Warp: `int(0)` makes a variable that a dynamic loop or branch may change)

from functools import cache, partial
from types import SimpleNamespace

import warp as wp


@cache
def stencil_functions(scalar) -> SimpleNamespace:
    """Struct Grids and Warp functions spline, spline_slope, located, node_position, nodes_of for
    wp.float32 or wp.float64 fields."""
    vec3 = wp.types.vector(length=3, dtype=scalar)

    @partial(wp.struct, module=f"mosa.physics.grids_{scalar.__name__}")
    class Grids:
        """windows: three rows of each world (`transfer_kernels`); size: particles of a world."""

        windows: wp.array(dtype=wp.vec3i)
        size: int
        dx: scalar
        inv_dx: scalar

    @wp.func
    def spline(f: scalar):
        """Weights of the three nodes at distances f, f - 1, f - 2 (in cells), f in [0.5, 1.5)."""
        return vec3(
            scalar(0.5) * (scalar(1.5) - f) * (scalar(1.5) - f),
            scalar(0.75) - (f - scalar(1.0)) * (f - scalar(1.0)),
            scalar(0.5) * (f - scalar(0.5)) * (f - scalar(0.5)),
        )

    @wp.func
    def spline_slope(f: scalar):
        return vec3(f - scalar(1.5), scalar(-2.0) * (f - scalar(1.0)), f - scalar(0.5))

    @wp.func
    def window_row(p: int, size: int):
        """Row of the window of particle p, of `size` in each world. The first world's, often the only one, without a division:
        that alone takes 4 to 7 % of a transfer on a CPU."""
        row = int(0)
        if p >= size:
            row = 3 * (p / size)
        return row

    @wp.func
    def located(x: vec3, p: int, grids: Grids):
        """(index of the lowest node of particle p's stencil in the arrays, -1 if the stencil is not inside its world's window or x
        is NaN; that node; row of the window)."""
        h = scalar(0.5)
        base = vec3(
            wp.floor(x[0] * grids.inv_dx - h),
            wp.floor(x[1] * grids.inv_dx - h),
            wp.floor(x[2] * grids.inv_dx - h),
        )
        row = window_row(p, grids.size)
        origin = grids.windows[row]
        dims = grids.windows[row + 1]
        i = base[0] - scalar(origin[0])
        j = base[1] - scalar(origin[1])
        k = base[2] - scalar(origin[2])
        n = int(-1)
        z = scalar(0.0)
        if i >= z and j >= z and k >= z:
            if i <= scalar(dims[0] - 3) and j <= scalar(dims[1] - 3) and k <= scalar(dims[2] - 3):
                n = grids.windows[row + 2][0] + (int(i) * dims[1] + int(j)) * dims[2] + int(k)
        return n, base, row

    @wp.func
    def node_position(node: int, world: int, grids: Grids):
        """[m] of a node, counted from the first of its world."""
        origin = grids.windows[3 * world]
        dims = grids.windows[3 * world + 1]
        plane = dims[1] * dims[2]
        i = node / plane
        j = (node - i * plane) / dims[2]
        k = node - i * plane - j * dims[2]
        return grids.dx * vec3(scalar(origin[0] + i), scalar(origin[1] + j), scalar(origin[2] + k))

    @wp.func
    def nodes_of(grids: Grids, world: int):
        """(first, last + 1) of a world's nodes in the arrays."""
        dims = grids.windows[3 * world + 1]
        first = grids.windows[3 * world + 2][0]
        return first, first + dims[0] * dims[1] * dims[2]

    return SimpleNamespace(
        Grids=Grids, spline=spline, spline_slope=spline_slope, located=located,
        node_position=node_position, nodes_of=nodes_of,
    )  # fmt: skip

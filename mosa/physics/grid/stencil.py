"""Where nodes are, and the 27 around a particle: quadratic B-splines, and where the stencil lies in a window."""

# ruff: noqa: UP018, RUF046
# (Warp: `int(0)` makes a variable that a dynamic loop or branch may change)

from functools import cache
from types import SimpleNamespace

import warp as wp


@cache
def stencil_functions(scalar) -> SimpleNamespace:
    """Warp functions spline, spline_slope, cell, window_row, local_cell for wp.float32 or wp.float64 fields."""
    vec3 = wp.types.vector(length=3, dtype=scalar)

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
    def cell(x: vec3, inv_dx: scalar):
        """Lowest node of the stencil."""
        h = scalar(0.5)
        return vec3(
            wp.floor(x[0] * inv_dx - h), wp.floor(x[1] * inv_dx - h), wp.floor(x[2] * inv_dx - h)
        )

    @wp.func
    def window_row(p: int, size: int):
        """Row of the window of particle p, of `size` in each world. The first world's, often the only one, without a division:
        that alone takes 4 to 7 % of a transfer on a CPU."""
        row = int(0)
        if p >= size:
            row = 3 * (p / size)
        return row

    @wp.func
    def local_cell(base: vec3, window: wp.array(dtype=wp.vec3i), row: int):
        """Index of the stencil's lowest node, -1 if the stencil is not inside the window at `row` (or x is NaN)."""
        origin = window[row]
        dims = window[row + 1]
        i = base[0] - scalar(origin[0])
        j = base[1] - scalar(origin[1])
        k = base[2] - scalar(origin[2])
        r = int(-1)
        z = scalar(0.0)
        if i >= z and j >= z and k >= z:
            if i <= scalar(dims[0] - 3) and j <= scalar(dims[1] - 3) and k <= scalar(dims[2] - 3):
                r = window[row + 2][0] + (int(i) * dims[1] + int(j)) * dims[2] + int(k)
        return r

    return SimpleNamespace(
        spline=spline,
        spline_slope=spline_slope,
        cell=cell,
        window_row=window_row,
        local_cell=local_cell,
    )


@cache
def node_functions(scalar) -> SimpleNamespace:
    """Warp functions node_position, nodes_of."""
    vec3 = wp.types.vector(length=3, dtype=scalar)

    @wp.func
    def node_position(node: int, origin: wp.vec3i, dims: wp.vec3i, dx: scalar):
        plane = dims[1] * dims[2]
        i = node / plane
        j = (node - i * plane) / dims[2]
        k = node - i * plane - j * dims[2]
        return dx * vec3(scalar(origin[0] + i), scalar(origin[1] + j), scalar(origin[2] + k))

    @wp.func
    def nodes_of(window: wp.array(dtype=wp.vec3i), world: int):
        """(first, last + 1) of a world's nodes in the arrays."""
        dims = window[3 * world + 1]
        first = window[3 * world + 2][0]
        return first, first + dims[0] * dims[1] * dims[2]

    return SimpleNamespace(node_position=node_position, nodes_of=nodes_of)

"""Signed distances of the solids a body may meet, with gradient and curvature, for Warp kernels.

A shape is given in its own axes, with its centre at the origin; the axis of capsule, cylinder and half space is z. phi < 0
inside. On the surface and outside phi is the exact distance; inside, too (box and cylinder: to the nearest face).
Where phi has an edge (medial axis; the planes where the nearest feature of a box or cylinder changes from face to face inside)
one side's gradient is taken; at the centre of a sphere it is z. The gradient of box and cylinder is continuous outside, but its
differential jumps where the nearest feature changes from face to edge to corner. A field (triangle mesh) is trilinear between the
values of a regular lattice: its gradient jumps at the faces of the lattice's cells.
"""

# ruff: noqa: UP018, RUF046
# (Warp: `int(0)` makes a variable that a branch may change)

from functools import cache
from types import SimpleNamespace

import warp as wp

HALF_SPACE, SPHERE, CAPSULE, CYLINDER, BOX, FIELD = range(6)

# columns of the packed shapes (K, 11) and codes (K, 5)
SIZE, FRICTION, ORIGIN, SPACING, STIFFNESS, HOLD, REACH, SHAPE_COLUMNS = 0, 3, 4, 7, 8, 9, 10, 11
KIND, DIMS, OFFSET, CODE_COLUMNS = 0, 1, 4, 5

_SPHERE = wp.constant(SPHERE)
_CAPSULE = wp.constant(CAPSULE)
_CYLINDER = wp.constant(CYLINDER)
_BOX = wp.constant(BOX)
_FIELD = wp.constant(FIELD)


@cache
def shape_functions(scalar) -> SimpleNamespace:
    """Warp functions signed_distance -> (phi, gradient) and curvature -> Hessian of phi times a vector, for float32 or float64.

    Arguments: shape k, point q (3,) in its axes [m], packed shapes (K, 11), codes (K, 5) and fields (flat lattice values, z
    fastest). Sizes: sphere radius; capsule and cylinder radius, half length; box half edges."""
    vec3 = wp.types.vector(length=3, dtype=scalar)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=scalar)

    @wp.func
    def sign(a: scalar):
        r = scalar(1.0)
        if a < scalar(0.0):
            r = scalar(-1.0)
        return r

    @wp.func
    def radial(d: vec3):
        """d/|d|, z where d = 0."""
        length = wp.length(d)
        r = vec3(scalar(0.0), scalar(0.0), scalar(1.0))
        if length > scalar(0.0):
            r = d / length
        return r

    @wp.func
    def bent(d: vec3, b: vec3):
        """Differential of d/|d| along b; 0 where d = 0."""
        length = wp.length(d)
        r = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        if length > scalar(0.0):
            n = d / length
            r = (b - wp.dot(n, b) * n) / length
        return r

    @wp.func
    def beyond(q: vec3, size: vec3):
        """How far q is beyond the faces of a box, signed, per axis (0 where it is not)."""
        z = scalar(0.0)
        return vec3(
            sign(q[0]) * wp.max(wp.abs(q[0]) - size[0], z),
            sign(q[1]) * wp.max(wp.abs(q[1]) - size[1], z),
            sign(q[2]) * wp.max(wp.abs(q[2]) - size[2], z),
        )

    @wp.func
    def off_axis(q: vec3, half: scalar):
        """q relative to the nearest point of a capsule's segment."""
        return vec3(q[0], q[1], q[2] - wp.clamp(q[2], -half, half))

    @wp.func
    def lattice(q: vec3, k: int, shapes: wp.array2d(dtype=scalar), codes: wp.array2d(dtype=int)):
        """(flat index of the cell's lowest node, -1 outside the lattice; place in the cell, in [0, 1])."""
        h = shapes[k, 7]
        t = (q - vec3(shapes[k, 4], shapes[k, 5], shapes[k, 6])) / h
        i = wp.floor(t[0])
        j = wp.floor(t[1])
        l = wp.floor(t[2])
        z = scalar(0.0)
        n = int(-1)
        if i >= z and j >= z and l >= z:
            if (
                i < scalar(codes[k, 1] - 1)
                and j < scalar(codes[k, 2] - 1)
                and l < scalar(codes[k, 3] - 1)
            ):
                n = codes[k, 4] + (int(i) * codes[k, 2] + int(j)) * codes[k, 3] + int(l)
        return n, vec3(t[0] - i, t[1] - j, t[2] - l)

    @wp.func
    def corner(f: scalar, i: int):
        """(weight, slope) of the lower (0) or upper (1) node of a cell."""
        w = f
        s = scalar(1.0)
        if i == 0:
            w = scalar(1.0) - f
            s = scalar(-1.0)
        return w, s

    @wp.func
    def trilinear(q: vec3, k: int, shapes: wp.array2d(dtype=scalar), codes: wp.array2d(dtype=int),
                  fields: wp.array(dtype=scalar)):  # fmt: skip
        z = scalar(0.0)
        n, f = lattice(q, k, shapes, codes)
        phi = scalar(1.0e30)  # beyond the lattice nothing is near the surface
        g = vec3(z, z, scalar(1.0))
        if n >= 0:
            phi = z
            g = vec3(z, z, z)
            for i in range(2):
                wx, sx = corner(f[0], i)
                for j in range(2):
                    wy, sy = corner(f[1], j)
                    for l in range(2):
                        wz, sz = corner(f[2], l)
                        value = fields[n + (i * codes[k, 2] + j) * codes[k, 3] + l]
                        phi = phi + wx * wy * wz * value
                        g = g + value * vec3(sx * wy * wz, wx * sy * wz, wx * wy * sz)
            g = g / shapes[k, 7]
        return phi, g

    @wp.func
    def trilinear_curvature(q: vec3, k: int, shapes: wp.array2d(dtype=scalar), codes: wp.array2d(dtype=int),
                            fields: wp.array(dtype=scalar), b: vec3):  # fmt: skip
        z = scalar(0.0)
        n, f = lattice(q, k, shapes, codes)
        r = vec3(z, z, z)
        if n >= 0:
            for i in range(2):
                wx, sx = corner(f[0], i)
                for j in range(2):
                    wy, sy = corner(f[1], j)
                    for l in range(2):
                        wz, sz = corner(f[2], l)
                        value = fields[n + (i * codes[k, 2] + j) * codes[k, 3] + l]
                        xy = sx * sy * wz
                        yz = wx * sy * sz
                        zx = sx * wy * sz
                        r = r + value * vec3(
                            xy * b[1] + zx * b[2], xy * b[0] + yz * b[2], zx * b[0] + yz * b[1]
                        )
            r = r / (shapes[k, 7] * shapes[k, 7])
        return r

    @wp.func
    def signed_distance(q: vec3, k: int, shapes: wp.array2d(dtype=scalar), codes: wp.array2d(dtype=int),
                        fields: wp.array(dtype=scalar)):  # fmt: skip
        z = scalar(0.0)
        kind = codes[k, 0]
        size = vec3(shapes[k, 0], shapes[k, 1], shapes[k, 2])
        phi = q[2]
        g = vec3(z, z, scalar(1.0))
        if kind == _SPHERE:
            phi = wp.length(q) - size[0]
            g = radial(q)
        elif kind == _CAPSULE:
            d = off_axis(q, size[1])
            phi = wp.length(d) - size[0]
            g = radial(d)
        elif kind == _CYLINDER:
            flat = vec3(q[0], q[1], z)
            out = wp.length(flat) - size[0]
            over = wp.abs(q[2]) - size[1]
            side = vec3(scalar(1.0), z, z)
            if wp.length(flat) > z:
                side = flat / wp.length(flat)
            cap = vec3(z, z, sign(q[2]))
            if out > z and over > z:
                phi = wp.sqrt(out * out + over * over)
                g = (out * side + over * cap) / phi
            elif out > over:
                phi = out
                g = side
            else:
                phi = over
                g = cap
        elif kind == _BOX:
            d = beyond(q, size)
            phi = wp.length(d)
            if phi > z:
                g = d / phi
            else:
                dx = wp.abs(q[0]) - size[0]
                dy = wp.abs(q[1]) - size[1]
                dz = wp.abs(q[2]) - size[2]
                if dx >= dy and dx >= dz:
                    phi = dx
                    g = vec3(sign(q[0]), z, z)
                elif dy >= dz:
                    phi = dy
                    g = vec3(z, sign(q[1]), z)
                else:
                    phi = dz
                    g = vec3(z, z, sign(q[2]))
        elif kind == _FIELD:
            phi, g = trilinear(q, k, shapes, codes, fields)
        return phi, g

    @wp.func
    def curvature(q: vec3, k: int, shapes: wp.array2d(dtype=scalar), codes: wp.array2d(dtype=int),
                  fields: wp.array(dtype=scalar), b: vec3):  # fmt: skip
        z = scalar(0.0)
        kind = codes[k, 0]
        size = vec3(shapes[k, 0], shapes[k, 1], shapes[k, 2])
        r = vec3(z, z, z)
        if kind == _SPHERE:
            r = bent(q, b)
        elif kind == _CAPSULE:
            # along the straight part d does not follow q in z
            inner = b
            if wp.abs(q[2]) < size[1]:
                inner = vec3(b[0], b[1], z)
            r = bent(off_axis(q, size[1]), inner)
        elif kind == _CYLINDER:
            flat = vec3(q[0], q[1], z)
            rho = wp.length(flat)
            out = rho - size[0]
            over = wp.abs(q[2]) - size[1]
            turn = bent(flat, vec3(b[0], b[1], z))
            if out > z and over > z:
                # on the rim: a circle's distance in the half plane of q, and the turn of that half plane
                phi = wp.sqrt(out * out + over * over)
                side = flat / rho
                cap = vec3(z, z, sign(q[2]))
                n = (out * side + over * cap) / phi
                inplane = wp.dot(side, b) * side + wp.dot(cap, b) * cap
                r = (inplane - wp.dot(n, b) * n) / phi + (out / phi) * turn
            elif out > over:
                r = turn
        elif kind == _BOX:
            d = beyond(q, size)
            inner = vec3(z, z, z)
            if d[0] != z:
                inner = inner + vec3(b[0], z, z)
            if d[1] != z:
                inner = inner + vec3(z, b[1], z)
            if d[2] != z:
                inner = inner + vec3(z, z, b[2])
            r = bent(d, inner)
        elif kind == _FIELD:
            r = trilinear_curvature(q, k, shapes, codes, fields, b)
        return r

    return SimpleNamespace(
        signed_distance=signed_distance, curvature=curvature, vec3=vec3, mat33=mat33
    )

"""Transfers between particles and grid, with hand-written adjoints: MLS-MPM, APIC, quadratic B-splines.

A node (i, j, k) sits at dx (i, j, k). Every world has a grid of its own: a window, flat, z fastest, told by three rows, its lowest
node, its number of nodes per axis, and (place of its first node in the arrays, 0, 0). It holds (momentum, mass) as one 4-vector,
and the node velocity after gravity and contact as another, of which the fourth is unused. Arrays of nodes may be longer than all
windows. Particles are ordered by world, `size` in each: particle p is in world p / size, and worlds never meet.
The adjoint of P2G is a pure gather; the adjoint of G2P scatters three numbers per node.
Stencils are nested static loops over 3: a single loop over 27 nodes compiles to a dynamic loop.
"""

# ruff: noqa: UP018, RUF046
# (Warp: `int(0)` makes a variable that a dynamic loop or branch may change, and results are unpacked whole)

from functools import cache
from types import SimpleNamespace

import warp as wp

from mosa.physics.contact.planes import make_fade, make_plane_functions
from mosa.physics.grid.node_access import node_access

# slots of the flag array: the first substep * N + particle at which the event happened
WINDOW, NONFINITE, OUTSIDE, INVERTED = 0, 1, 2, 3
NO_EVENT = 2**62

_LEFT = wp.constant(WINDOW)
_BAD = wp.constant(NONFINITE)
_OUT = wp.constant(OUTSIDE)
_FLIPPED = wp.constant(INVERTED)


@cache
def transfer_kernels(scalar) -> SimpleNamespace:
    """Kernels clear, p2g, grid_update, g2p, adj_g2p, adj_grid, adj_p2g for wp.float32 or wp.float64 fields.

    Those over nodes are launched with `threads` for each world and take all nodes of its window, however many threads that is."""
    vec3 = wp.types.vector(length=3, dtype=scalar)
    vec4 = wp.types.vector(length=4, dtype=scalar)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=scalar)
    collide, adj_collide = make_plane_functions(scalar)
    fade = make_fade(scalar)
    memory = node_access(scalar)
    load3, load4, store3, store4, add3, add4 = (
        memory.load3, memory.load4, memory.store3, memory.store4, memory.add3, memory.add4
    )  # fmt: skip
    module = f"mosa.physics.transfers_{scalar.__name__}"

    # `steps` in the kernels holds the node offsets as scalars: Warp 1.19 retypes a loop variable that is cast to float64

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
        return vec3(wp.floor(x[0] * inv_dx - h), wp.floor(x[1] * inv_dx - h), wp.floor(x[2] * inv_dx - h))

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

    @wp.kernel(module=module, enable_backward=False)
    def p2g(
        x: wp.array(dtype=vec3), v: wp.array(dtype=vec3), C: wp.array(dtype=mat33), F: wp.array(dtype=mat33),
        tau: wp.array(dtype=mat33), mass: wp.array(dtype=scalar), volume: wp.array(dtype=scalar),
        window: wp.array(dtype=wp.vec3i), size: int, dx: scalar, inv_dx: scalar, dt: scalar,
        check_J: int, substep: int, flags: wp.array(dtype=wp.int64), grid: wp.array(dtype=vec4),
    ):  # fmt: skip
        p = wp.tid()
        xp = x[p]
        base = cell(xp, inv_dx)
        place = 3 * (p / size)
        dims = window[place + 1]
        n = local_cell(base, window, place)
        if n < 0:
            wp.atomic_min(flags, _LEFT, wp.int64(substep) * wp.int64(x.shape[0]) + wp.int64(p))
            return
        if check_J == 1:
            if wp.determinant(F[p]) <= scalar(0.0):
                wp.atomic_min(flags, _FLIPPED, wp.int64(substep) * wp.int64(x.shape[0]) + wp.int64(p))
        f = xp * inv_dx - base
        wx = spline(f[0])
        wy = spline(f[1])
        wz = spline(f[2])
        steps = vec3(scalar(0.0), scalar(1.0), scalar(2.0))
        m = mass[p]
        B = m * C[p] - (dt * volume[p] * scalar(4.0) * inv_dx * inv_dx) * tau[p]
        q0 = m * v[p] - dx * (B * f)
        B = dx * B
        # q is affine in the node: columns of B are its increments along the axes
        bx = vec3(B[0, 0], B[1, 0], B[2, 0])
        by = vec3(B[0, 1], B[1, 1], B[2, 1])
        bz = vec3(B[0, 2], B[1, 2], B[2, 2])
        for i in range(3):
            for j in range(3):
                wij = wx[i] * wy[j]
                row = n + (i * dims[1] + j) * dims[2]
                qij = q0 + steps[i] * bx + steps[j] * by
                for k in range(3):
                    w = wij * wz[k]
                    q = w * (qij + steps[k] * bz)
                    add4(grid, row + k, vec4(q[0], q[1], q[2], w * m))

    @wp.func
    def free_velocity(g: vec4, impulse: vec3):
        return vec3(g[0], g[1], g[2]) / g[3] + impulse

    @wp.func
    def node_position(node: int, origin: wp.vec3i, dims: wp.vec3i, dx: scalar):
        plane = dims[1] * dims[2]
        i = node / plane
        j = (node - i * plane) / dims[2]
        k = node - i * plane - j * dims[2]
        return dx * vec3(scalar(origin[0] + i), scalar(origin[1] + j), scalar(origin[2] + k))

    @wp.func
    def touch(y: vec3, planes: wp.array2d(dtype=scalar), i: int):
        """Weight of plane i's contact of a node at y."""
        normal = vec3(planes[i, 0], planes[i, 1], planes[i, 2])
        w, _slope = fade(wp.dot(y, normal) - planes[i, 3], planes[i, 5])
        return w

    @wp.func
    def contact(
        u: vec3, y: vec3, planes: wp.array2d(dtype=scalar), modes: wp.array(dtype=int), count: int
    ):
        """Velocity after the first `count` planes."""
        r = u
        for i in range(count):
            w = touch(y, planes, i)
            if w > scalar(0.0):
                hit = collide(r, vec3(planes[i, 0], planes[i, 1], planes[i, 2]), modes[i], planes[i, 4])
                if w < scalar(1.0):
                    r = r + w * (hit - r)
                else:
                    r = hit
        return r

    @wp.func
    def adj_contact(
        u: vec3, y: vec3, planes: wp.array2d(dtype=scalar), modes: wp.array(dtype=int), count: int, seed: vec3
    ):
        a = seed
        for reverse in range(count):
            i = count - 1 - reverse
            w = touch(y, planes, i)
            if w > scalar(0.0):
                before = contact(u, y, planes, modes, i)
                normal = vec3(planes[i, 0], planes[i, 1], planes[i, 2])
                a = (scalar(1.0) - w) * a + adj_collide(before, normal, modes[i], planes[i, 4], w * a)
        return a

    @wp.func
    def nodes_of(window: wp.array(dtype=wp.vec3i), world: int):
        """(first, last + 1) of a world's nodes in the arrays."""
        dims = window[3 * world + 1]
        first = window[3 * world + 2][0]
        return first, first + dims[0] * dims[1] * dims[2]

    @wp.kernel(module=module, enable_backward=False)
    def clear(window: wp.array(dtype=wp.vec3i), threads: int, grid: wp.array(dtype=vec4)):
        z = scalar(0.0)
        world = wp.tid() / threads
        first, end = nodes_of(window, world)
        for node in range(first + wp.tid() - world * threads, end, threads):
            store4(grid, node, vec4(z, z, z, z))

    @wp.kernel(module=module, enable_backward=False)
    def grid_update(
        window: wp.array(dtype=wp.vec3i), threads: int, grid: wp.array(dtype=vec4), impulses: wp.array(dtype=vec3), cutoff: scalar,
        dx: scalar, planes: wp.array2d(dtype=scalar), modes: wp.array(dtype=int), count: int,
        velocity: wp.array(dtype=vec4),
    ):  # fmt: skip
        world = wp.tid() / threads
        origin = window[3 * world]
        dims = window[3 * world + 1]
        impulse = impulses[world]
        first, end = nodes_of(window, world)
        for node in range(first + wp.tid() - world * threads, end, threads):
            g = load4(grid, node)
            u = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
            if g[3] > cutoff:
                u = free_velocity(g, impulse)
                if count > 0:
                    u = contact(u, node_position(node - first, origin, dims, dx), planes, modes, count)
            store3(velocity, node, u)

    @wp.kernel(module=module, enable_backward=False)
    def adj_grid(
        window: wp.array(dtype=wp.vec3i), threads: int, grid: wp.array(dtype=vec4), impulses: wp.array(dtype=vec3), cutoff: scalar,
        dx: scalar, planes: wp.array2d(dtype=scalar), modes: wp.array(dtype=int), count: int,
        adj_velocity: wp.array(dtype=vec4), adj_grid: wp.array(dtype=vec4),
    ):  # fmt: skip
        world = wp.tid() / threads
        origin = window[3 * world]
        dims = window[3 * world + 1]
        impulse = impulses[world]
        first, end = nodes_of(window, world)
        for node in range(first + wp.tid() - world * threads, end, threads):
            g = load4(grid, node)
            if g[3] > cutoff:
                u = free_velocity(g, impulse)
                a = load3(adj_velocity, node)
                if count > 0:
                    a = adj_contact(u, node_position(node - first, origin, dims, dx), planes, modes, count, a)
                a = a / g[3]
                # v = p/m: dL/dm = -a.(p/m)/m
                store4(adj_grid, node, vec4(a[0], a[1], a[2], -(a[0] * g[0] + a[1] * g[1] + a[2] * g[2]) / g[3]))
            else:
                z = scalar(0.0)
                store4(adj_grid, node, vec4(z, z, z, z))

    @wp.kernel(module=module, enable_backward=False)
    def g2p(
        x: wp.array(dtype=vec3), A: wp.array(dtype=mat33), velocity: wp.array(dtype=vec4),
        window: wp.array(dtype=wp.vec3i), size: int, dx: scalar, inv_dx: scalar, dt: scalar,
        low: vec3, high: vec3, substep: int, flags: wp.array(dtype=wp.int64),
        x_new: wp.array(dtype=vec3), v_new: wp.array(dtype=vec3), C_new: wp.array(dtype=mat33),
        A_new: wp.array(dtype=mat33),
    ):  # fmt: skip
        """Also advances the deformation gradient that is never return-mapped: A <- (I + dt C) A."""
        p = wp.tid()
        xp = x[p]
        base = cell(xp, inv_dx)
        place = 3 * (p / size)
        dims = window[place + 1]
        n = local_cell(base, window, place)
        if n < 0:
            x_new[p] = xp
            return
        f = xp * inv_dx - base
        wx = spline(f[0])
        wy = spline(f[1])
        wz = spline(f[2])
        steps = vec3(scalar(0.0), scalar(1.0), scalar(2.0))
        zero = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        v = zero
        cx = zero
        cy = zero
        cz = zero
        for i in range(3):
            layer = zero
            for j in range(3):
                row = n + (i * dims[1] + j) * dims[2]
                a = wz[0] * load3(velocity, row)
                b = wz[1] * load3(velocity, row + 1)
                c = wz[2] * load3(velocity, row + 2)
                line = wy[j] * (a + b + c)
                layer = layer + line
                cy = cy + (wx[i] * steps[j]) * line
                cz = cz + (wx[i] * wy[j]) * (b + scalar(2.0) * c)
            layer = wx[i] * layer
            v = v + layer
            cx = cx + steps[i] * layer
        # sum w v (x_I - x)^T = dx (sum w v index^T - v f^T)
        s = scalar(4.0) * inv_dx
        cx = s * (cx - f[0] * v)
        cy = s * (cy - f[1] * v)
        cz = s * (cz - f[2] * v)
        C = mat33(cx[0], cy[0], cz[0], cx[1], cy[1], cz[1], cx[2], cy[2], cz[2])
        y = xp + dt * v
        Ap = A[p]
        An = Ap + dt * (C * Ap)
        x_new[p] = y
        v_new[p] = v
        C_new[p] = C
        A_new[p] = An
        key = wp.int64(substep) * wp.int64(x.shape[0]) + wp.int64(p)
        total = y[0] + y[1] + y[2] + v[0] + v[1] + v[2] + An[0, 0] + An[1, 1] + An[2, 2]
        if not wp.isfinite(total):
            wp.atomic_min(flags, _BAD, key)
        elif (
            y[0] < low[0] or y[1] < low[1] or y[2] < low[2] or y[0] > high[0] or y[1] > high[1] or y[2] > high[2]
        ):
            wp.atomic_min(flags, _OUT, key)

    @wp.kernel(module=module, enable_backward=False)
    def adj_g2p(
        x: wp.array(dtype=vec3), A: wp.array(dtype=mat33), velocity: wp.array(dtype=vec4), C_new: wp.array(dtype=mat33),
        window: wp.array(dtype=wp.vec3i), size: int, dx: scalar, inv_dx: scalar, dt: scalar,
        adj_x_new: wp.array(dtype=vec3), adj_v_new: wp.array(dtype=vec3), adj_C_new: wp.array(dtype=mat33),
        adj_A_new: wp.array(dtype=mat33),
        adj_x: wp.array(dtype=vec3), adj_A: wp.array(dtype=mat33), adj_velocity: wp.array(dtype=vec4),
    ):  # fmt: skip
        """Writes adj_x and adj_A, adds to adj_velocity."""
        p = wp.tid()
        xp = x[p]
        base = cell(xp, inv_dx)
        place = 3 * (p / size)
        dims = window[place + 1]
        n = local_cell(base, window, place)
        if n < 0:
            return
        f = xp * inv_dx - base
        wx = spline(f[0])
        wy = spline(f[1])
        wz = spline(f[2])
        steps = vec3(scalar(0.0), scalar(1.0), scalar(2.0))
        sx = spline_slope(f[0])
        sy = spline_slope(f[1])
        sz = spline_slope(f[2])
        an = adj_A_new[p]
        Ap = A[p]
        adj_A[p] = an + dt * (wp.transpose(C_new[p]) * an)
        ac = (scalar(4.0) * inv_dx) * (adj_C_new[p] + dt * (an * wp.transpose(Ap)))
        ax = adj_x_new[p]
        # adjoint of a node's velocity is w r, r affine in the node
        r0 = adj_v_new[p] + dt * ax - ac * f
        rx = vec3(ac[0, 0], ac[1, 0], ac[2, 0])
        ry = vec3(ac[0, 1], ac[1, 1], ac[2, 1])
        rz = vec3(ac[0, 2], ac[1, 2], ac[2, 2])
        zero = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        v = zero
        gx = scalar(0.0)
        gy = scalar(0.0)
        gz = scalar(0.0)
        for i in range(3):
            for j in range(3):
                row = n + (i * dims[1] + j) * dims[2]
                rij = r0 + steps[i] * rx + steps[j] * ry
                wij = wx[i] * wy[j]
                flat = scalar(0.0)
                for k in range(3):
                    u = load3(velocity, row + k)
                    r = rij + steps[k] * rz
                    w = wij * wz[k]
                    add3(adj_velocity, row + k, w * r)
                    e = wp.dot(u, r)
                    flat = flat + wz[k] * e
                    gz = gz + wij * sz[k] * e
                    v = v + w * u
                gx = gx + sx[i] * wy[j] * flat
                gy = gy + wx[i] * sy[j] * flat
        adj_x[p] = ax + inv_dx * (vec3(gx, gy, gz) - wp.transpose(ac) * v)

    @wp.kernel(module=module, enable_backward=False)
    def adj_p2g(
        x: wp.array(dtype=vec3), v: wp.array(dtype=vec3), C: wp.array(dtype=mat33), tau: wp.array(dtype=mat33),
        mass: wp.array(dtype=scalar), volume: wp.array(dtype=scalar),
        window: wp.array(dtype=wp.vec3i), size: int, dx: scalar, inv_dx: scalar, dt: scalar,
        adj_grid: wp.array(dtype=vec4),
        adj_x: wp.array(dtype=vec3), adj_v: wp.array(dtype=vec3), adj_C: wp.array(dtype=mat33),
        adj_tau: wp.array(dtype=mat33),
    ):  # fmt: skip
        """Adds to adj_x, writes adj_v, adj_C and adj_tau."""
        p = wp.tid()
        xp = x[p]
        base = cell(xp, inv_dx)
        place = 3 * (p / size)
        dims = window[place + 1]
        n = local_cell(base, window, place)
        if n < 0:
            return
        f = xp * inv_dx - base
        wx = spline(f[0])
        wy = spline(f[1])
        wz = spline(f[2])
        steps = vec3(scalar(0.0), scalar(1.0), scalar(2.0))
        sx = spline_slope(f[0])
        sy = spline_slope(f[1])
        sz = spline_slope(f[2])
        m = mass[p]
        stiffness = dt * volume[p] * scalar(4.0) * inv_dx * inv_dx
        B = dx * (m * C[p] - stiffness * tau[p])
        q0 = m * v[p] - B * f
        bx = vec3(B[0, 0], B[1, 0], B[2, 0])
        by = vec3(B[0, 1], B[1, 1], B[2, 1])
        bz = vec3(B[0, 2], B[1, 2], B[2, 2])
        zero = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        s = zero
        cx = zero
        cy = zero
        cz = zero
        gx = scalar(0.0)
        gy = scalar(0.0)
        gz = scalar(0.0)
        for i in range(3):
            layer = zero
            for j in range(3):
                row = n + (i * dims[1] + j) * dims[2]
                qij = q0 + steps[i] * bx + steps[j] * by
                wij = wx[i] * wy[j]
                flat = scalar(0.0)
                line = zero
                for k in range(3):
                    g = load4(adj_grid, row + k)
                    a = vec3(g[0], g[1], g[2])
                    e = wp.dot(qij + steps[k] * bz, a) + m * g[3]
                    flat = flat + wz[k] * e
                    gz = gz + wij * sz[k] * e
                    line = line + wz[k] * a
                    cz = cz + (wij * wz[k] * steps[k]) * a
                gx = gx + sx[i] * wy[j] * flat
                gy = gy + wx[i] * sy[j] * flat
                layer = layer + wy[j] * line
                cy = cy + (wij * steps[j]) * line
            layer = wx[i] * layer
            s = s + layer
            cx = cx + steps[i] * layer
        adj_v[p] = m * s
        cx = dx * (cx - f[0] * s)
        cy = dx * (cy - f[1] * s)
        cz = dx * (cz - f[2] * s)
        aB = mat33(cx[0], cy[0], cz[0], cx[1], cy[1], cz[1], cx[2], cy[2], cz[2])
        adj_C[p] = m * aB
        adj_tau[p] = -stiffness * aB
        adj_x[p] = adj_x[p] + inv_dx * (vec3(gx, gy, gz) - wp.transpose(B) * s)

    return SimpleNamespace(
        clear=clear, p2g=p2g, grid_update=grid_update, g2p=g2p, adj_g2p=adj_g2p, adj_grid=adj_grid, adj_p2g=adj_p2g,
        node_position=node_position, nodes_of=nodes_of, vec3=vec3, vec4=vec4, mat33=mat33,
    )  # fmt: skip

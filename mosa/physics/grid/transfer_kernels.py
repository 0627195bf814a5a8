"""Transfers between particles and grid, with hand-written adjoints: MLS-MPM, APIC, quadratic B-splines.

A node (i, j, k) sits at dx (i, j, k). Every world has a grid of its own: a window, flat, z fastest, told by three rows, its lowest
node, its number of nodes per axis, and (place of its first node in the arrays, 0, 0). It holds (momentum, mass) as one 4-vector,
and the node velocity after gravity and contact as another, of which the fourth is unused. Arrays of nodes may be longer than all
windows. Particles are ordered by world, `size` in each: particle p is in world p / size, and worlds never meet.
The adjoint of P2G is a pure gather; the adjoint of G2P scatters three numbers per node.
Stencils are nested static loops over 3: a single loop over 27 nodes compiles to a dynamic loop.
"""

from functools import cache, partial
from types import SimpleNamespace

import warp as wp

from mosa.physics.grid.node_access import exact_node_access, node_access
from mosa.physics.grid.stencil import stencil_functions

# slots of the flag array: the first substep * N + particle at which the event happened
WINDOW, NONFINITE, OUTSIDE, INVERTED = 0, 1, 2, 3
NO_EVENT = 2**62

_LEFT = wp.constant(WINDOW)
_BAD = wp.constant(NONFINITE)
_OUT = wp.constant(OUTSIDE)
_FLIPPED = wp.constant(INVERTED)


@cache
def transfer_kernels(scalar, exact: bool = False, each: int = 1) -> SimpleNamespace:
    """Struct Particles and kernels clear, p2g, g2p, adj_g2p, adj_p2g, settle for wp.float32 or wp.float64 fields.

    clear and settle are launched with `threads` for each world and take all nodes of its window, however many threads that is.
    exact: p2g and adj_g2p add to exact sums, which `settle` turns into the nodes' numbers and clears.
    each: particles a thread of p2g, 1 or, on a GPU that sums not exactly, 2: half of what goes from thread to thread."""
    vec3 = wp.types.vector(length=3, dtype=scalar)
    vec4 = wp.types.vector(length=4, dtype=scalar)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=scalar)
    memory, stencil = node_access(scalar), stencil_functions(scalar)
    load3, load4, clear_node = memory.load3, memory.load4, memory.clear
    adding = exact_node_access(scalar) if exact else memory
    run, add3, add4 = adding.run, adding.add3, adding.add4
    take3, take33, put3, put33 = memory.take3, memory.take33, memory.put3, memory.put33
    meeting, run_of_two, add4_of_two = memory.meeting, memory.run_of_two, memory.add4_of_two
    twice = each == 2
    on_cpu, scatter, gather = memory.on_cpu, memory.scatter, memory.gather
    settle_node = exact_node_access(scalar).settle_node
    added_to = wp.array2d(dtype=wp.int64) if exact else wp.array(dtype=vec4)
    Grids, located, nodes_of = stencil.Grids, stencil.located, stencil.nodes_of
    spline, spline_slope = stencil.spline, stencil.spline_slope
    module = f"mosa.physics.{'exact_' if exact else ''}transfers_{each}_{scalar.__name__}"

    @partial(wp.struct, module=module)
    class Particles:
        """All particles between two substeps, or the adjoint of that. A: the deformation gradient
        that is never return-mapped."""

        x: wp.array(dtype=vec3)
        v: wp.array(dtype=vec3)
        C: wp.array(dtype=mat33)
        F: wp.array(dtype=mat33)
        A: wp.array(dtype=mat33)

    # `steps` in the kernels holds the node offsets as scalars: Warp 1.19 retypes a loop variable that is cast to float64

    @wp.kernel(module=module, enable_backward=False)
    def clear(grids: Grids, threads: int, grid: wp.array(dtype=vec4)):
        world = wp.tid() / threads
        first, end = nodes_of(grids, world)
        for node in range(first + wp.tid() - world * threads, end, threads):
            clear_node(grid, node)

    @wp.kernel(module=module, enable_backward=False)
    def settle(
        grids: Grids, threads: int, sums: wp.array2d(dtype=wp.int64), grid: wp.array(dtype=vec4)
    ):
        world = wp.tid() / threads
        first, end = nodes_of(grids, world)
        for node in range(first + wp.tid() - world * threads, end, threads):
            settle_node(sums, grid, node)

    # A GPU's thread waits for memory where it first needs a number: kernels load all of a particle's before that

    @partial(wp.struct, module=module)
    class Loaded:
        """A particle's own numbers. there: whether there is such a particle."""

        there: bool
        x: vec3
        v: vec3
        C: mat33
        tau: mat33
        m: scalar
        V: scalar

    @partial(wp.struct, module=module)
    class Sent:
        """What a particle sends to its nodes: to (i, j, k), counted from the lowest one, n, -1 where it sends nothing,
        w (q0 + i bx + j by + k bz, m) with w = wx_i wy_j wz_k. dims: nodes of its window."""

        n: int
        dims: wp.vec3i
        wx: vec3
        wy: vec3
        wz: vec3
        q0: vec3
        bx: vec3
        by: vec3
        bz: vec3
        m: scalar

    @wp.func
    def weighted(w: scalar, momentum: vec3, m: scalar):
        q = w * momentum
        return vec4(q[0], q[1], q[2], w * m)

    @wp.func
    def loaded(
        p: int, now: Particles, v: wp.array(dtype=vec3), tau: wp.array(dtype=mat33), mass: wp.array(dtype=scalar),
        volume: wp.array(dtype=scalar),
    ):  # fmt: skip
        own = Loaded()
        own.there = p < now.x.shape[0]
        if own.there:
            own.x = take3(now.x, p)
            own.v = take3(v, p)
            own.C = take33(now.C, p)
            own.tau = take33(tau, p)
            own.m = mass[p]
            own.V = volume[p]
        return own

    @wp.func
    def sent(
        own: Loaded, p: int, now: Particles, grids: Grids, dt: scalar, check_J: int, substep: int,
        flags: wp.array(dtype=wp.int64),
    ):  # fmt: skip
        s = Sent()
        s.n = -1
        if own.there:
            n, base, place = located(own.x, p, grids)
            s.n = n
            s.dims = grids.windows[place + 1]
            key = wp.int64(substep) * wp.int64(now.x.shape[0]) + wp.int64(p)
            if n < 0:
                wp.atomic_min(flags, _LEFT, key)
            elif check_J == 1:
                if wp.determinant(now.F[p]) <= scalar(0.0):
                    wp.atomic_min(flags, _FLIPPED, key)
            f = own.x * grids.inv_dx - base
            s.wx = spline(f[0])
            s.wy = spline(f[1])
            s.wz = spline(f[2])
            s.m = own.m
            B = own.m * own.C - (dt * own.V * scalar(4.0) * grids.inv_dx * grids.inv_dx) * own.tau
            s.q0 = own.m * own.v - grids.dx * (B * f)
            B = grids.dx * B
            # q is affine in the node: columns of B are its increments along the axes
            s.bx = vec3(B[0, 0], B[1, 0], B[2, 0])
            s.by = vec3(B[0, 1], B[1, 1], B[2, 1])
            s.bz = vec3(B[0, 2], B[1, 2], B[2, 2])
        return s

    @wp.func
    def row_of(s: Sent, i: int, j: int):
        """What goes to nodes (i, j, 0), (i, j, 1) and (i, j, 2)."""
        steps = vec3(scalar(0.0), scalar(1.0), scalar(2.0))
        wij = s.wx[i] * s.wy[j]
        qij = s.q0 + steps[i] * s.bx + steps[j] * s.by
        a = weighted(wij * s.wz[0], qij + steps[0] * s.bz, s.m)
        b = weighted(wij * s.wz[1], qij + steps[1] * s.bz, s.m)
        c = weighted(wij * s.wz[2], qij + steps[2] * s.bz, s.m)
        return a, b, c

    @wp.kernel(module=module, enable_backward=False)
    def p2g(
        now: Particles, v: wp.array(dtype=vec3), tau: wp.array(dtype=mat33), mass: wp.array(dtype=scalar),
        volume: wp.array(dtype=scalar), grids: Grids, dt: scalar, check_J: int, substep: int,
        flags: wp.array(dtype=wp.int64), grid: added_to,
    ):  # fmt: skip
        """Adds momentum and mass to the nodes. v: velocities after what particles meet themselves."""
        p = each * wp.tid()
        own = loaded(p, now, v, tau, mass, volume)
        if wp.static(twice):
            # no thread of a warp returns: one whose particles send nothing adds nothing
            other = loaded(p + 1, now, v, tau, mass, volume)
            s = sent(own, p, now, grids, dt, check_J, substep, flags)
            r = sent(other, p + 1, now, grids, dt, check_J, substep, flags)
            who = meeting(s.n, r.n)
            together = run_of_two(r.n, s.n == r.n)
            for i in range(3):
                for j in range(3):
                    a, b, c = row_of(s, i, j)
                    d, e, f = row_of(r, i, j)
                    first = s.n + (i * s.dims[1] + j) * s.dims[2]
                    row = r.n + (i * r.dims[1] + j) * r.dims[2]
                    add4_of_two(grid, first, row, a, b, c, d, e, f, who, together)
        else:
            s = sent(own, p, now, grids, dt, check_J, substep, flags)
            if s.n < 0:
                return
            if wp.static(not exact):
                if on_cpu():
                    scatter(grid, s.n, s.dims, s.wx, s.wy, s.wz, s.q0, s.bx, s.by, s.bz, s.m)
                    return
            together = run(s.n, True)
            for i in range(3):
                for j in range(3):
                    a, b, c = row_of(s, i, j)
                    add4(grid, s.n + (i * s.dims[1] + j) * s.dims[2], a, b, c, together)

    @wp.kernel(module=module, enable_backward=False)
    def g2p(
        now: Particles, velocity: wp.array(dtype=vec4), grids: Grids, dt: scalar, low: vec3, high: vec3,
        substep: int, flags: wp.array(dtype=wp.int64), then: Particles,
    ):  # fmt: skip
        """Writes x, v, C and A <- (I + dt C) A of `then`."""
        p = wp.tid()
        xp = now.x[p]
        Ap = now.A[p]
        n, base, place = located(xp, p, grids)
        dims = grids.windows[place + 1]
        if n < 0:
            then.x[p] = xp
            return
        f = xp * grids.inv_dx - base
        wx = spline(f[0])
        wy = spline(f[1])
        wz = spline(f[2])
        steps = vec3(scalar(0.0), scalar(1.0), scalar(2.0))
        zero = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        v = zero
        cx = zero
        cy = zero
        cz = zero
        if on_cpu():
            found = gather(velocity, n, dims, wx, wy, wz)
            v = found[0]
            cx = found[1]
            cy = found[2]
            cz = found[3]
        else:
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
        s = scalar(4.0) * grids.inv_dx
        cx = s * (cx - f[0] * v)
        cy = s * (cy - f[1] * v)
        cz = s * (cz - f[2] * v)
        C = mat33(cx[0], cy[0], cz[0], cx[1], cy[1], cz[1], cx[2], cy[2], cz[2])
        y = xp + dt * v
        An = Ap + dt * (C * Ap)
        put3(then.x, p, y)
        put3(then.v, p, v)
        put33(then.C, p, C)
        put33(then.A, p, An)
        key = wp.int64(substep) * wp.int64(now.x.shape[0]) + wp.int64(p)
        total = y[0] + y[1] + y[2] + v[0] + v[1] + v[2] + An[0, 0] + An[1, 1] + An[2, 2]
        if not wp.isfinite(total):
            wp.atomic_min(flags, _BAD, key)
        elif (
            y[0] < low[0]
            or y[1] < low[1]
            or y[2] < low[2]
            or y[0] > high[0]
            or y[1] > high[1]
            or y[2] > high[2]
        ):
            wp.atomic_min(flags, _OUT, key)

    @wp.kernel(module=f"{module}_adjoint", enable_backward=False)
    def adj_g2p(
        now: Particles, velocity: wp.array(dtype=vec4), grids: Grids, dt: scalar, then: Particles,
        adj_then: Particles, adj: Particles, adj_velocity: added_to,
    ):  # fmt: skip
        """Writes x and A of adj, adds to adj_velocity."""
        p = wp.tid()
        xp = now.x[p]
        Ap = now.A[p]
        Cp = then.C[p]
        ax = adj_then.x[p]
        av = adj_then.v[p]
        aC = adj_then.C[p]
        an = adj_then.A[p]
        n, base, place = located(xp, p, grids)
        dims = grids.windows[place + 1]
        if n < 0:
            return
        together = run(n, True)
        f = xp * grids.inv_dx - base
        wx = spline(f[0])
        wy = spline(f[1])
        wz = spline(f[2])
        steps = vec3(scalar(0.0), scalar(1.0), scalar(2.0))
        sx = spline_slope(f[0])
        sy = spline_slope(f[1])
        sz = spline_slope(f[2])
        put33(adj.A, p, an + dt * (wp.transpose(Cp) * an))
        ac = (scalar(4.0) * grids.inv_dx) * (aC + dt * (an * wp.transpose(Ap)))
        # adjoint of a node's velocity is w r, r affine in the node
        r0 = av + dt * ax - ac * f
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
                a = load3(velocity, row)
                b = load3(velocity, row + 1)
                c = load3(velocity, row + 2)
                ra = rij + steps[0] * rz
                rb = rij + steps[1] * rz
                rc = rij + steps[2] * rz
                wa = wij * wz[0]
                wb = wij * wz[1]
                wc = wij * wz[2]
                add3(adj_velocity, row, wa * ra, wb * rb, wc * rc, together)
                ea = wp.dot(a, ra)
                eb = wp.dot(b, rb)
                ec = wp.dot(c, rc)
                flat = wz[0] * ea + wz[1] * eb + wz[2] * ec
                gz = gz + wij * sz[0] * ea + wij * sz[1] * eb + wij * sz[2] * ec
                v = v + wa * a + wb * b + wc * c
                gx = gx + sx[i] * wy[j] * flat
                gy = gy + wx[i] * sy[j] * flat
        put3(adj.x, p, ax + grids.inv_dx * (vec3(gx, gy, gz) - wp.transpose(ac) * v))

    @wp.kernel(module=f"{module}_adjoint", enable_backward=False)
    def adj_p2g(
        now: Particles, v: wp.array(dtype=vec3), tau: wp.array(dtype=mat33), mass: wp.array(dtype=scalar),
        volume: wp.array(dtype=scalar), grids: Grids, dt: scalar, adj_grid: wp.array(dtype=vec4),
        adj: Particles, adj_tau: wp.array(dtype=mat33),
    ):  # fmt: skip
        """Adds to x of adj, writes its v and C, and adj_tau."""
        p = wp.tid()
        xp = now.x[p]
        vp = v[p]
        Cp = now.C[p]
        taup = tau[p]
        m = mass[p]
        V = volume[p]
        ax = adj.x[p]
        n, base, place = located(xp, p, grids)
        dims = grids.windows[place + 1]
        if n < 0:
            return
        f = xp * grids.inv_dx - base
        wx = spline(f[0])
        wy = spline(f[1])
        wz = spline(f[2])
        steps = vec3(scalar(0.0), scalar(1.0), scalar(2.0))
        sx = spline_slope(f[0])
        sy = spline_slope(f[1])
        sz = spline_slope(f[2])
        stiffness = dt * V * scalar(4.0) * grids.inv_dx * grids.inv_dx
        B = grids.dx * (m * Cp - stiffness * taup)
        q0 = m * vp - B * f
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
        put3(adj.v, p, m * s)
        cx = grids.dx * (cx - f[0] * s)
        cy = grids.dx * (cy - f[1] * s)
        cz = grids.dx * (cz - f[2] * s)
        aB = mat33(cx[0], cy[0], cz[0], cx[1], cy[1], cz[1], cx[2], cy[2], cz[2])
        put33(adj.C, p, m * aB)
        put33(adj_tau, p, -stiffness * aB)
        of_x = grids.inv_dx * (vec3(gx, gy, gz) - wp.transpose(B) * s)
        put3(adj.x, p, ax + of_x)

    return SimpleNamespace(
        Particles=Particles, Grids=Grids, clear=clear, settle=settle, p2g=p2g, g2p=g2p, adj_g2p=adj_g2p,
        adj_p2g=adj_p2g, vec3=vec3, vec4=vec4, mat33=mat33,
    )  # fmt: skip

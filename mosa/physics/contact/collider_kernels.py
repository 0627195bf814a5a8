"""Moving rigid colliders on the velocities of grid nodes, their reaction, and the exact adjoint of both.

A node at y, r = y - position, in the collider's axes at q = R^T r, of distance phi(q) and outward normal n = R grad phi/|grad phi|,
moves relative to the solid's velocity there, V = linear + angular x r:
    u' = u + w(phi) (V + collide(u - V, n) - u),    force on the collider f = -m (u' - u)/dt,    torque r x f
with `collide` of `planes` and w = 1 inside (tolerance 1e-6 m as for planes), falling to 0 at the collider's `thickness`
(`planes.make_fade`).
Colliders act in the order given, after the planes. The pose is the one at the start of the substep. Worlds have the same solids,
each with poses of its own: solid k of world w has column w count + k of poses and reactions.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from mosa.exact_sums import sum_functions
from mosa.physics.contact.grid_update import update_kernels
from mosa.physics.contact.planes import make_fade, make_normal_adjoint, make_plane_functions
from mosa.physics.contact.shapes import shape_functions
from mosa.physics.grid.node_access import node_access
from mosa.physics.grid.stencil import node_functions


@cache
def collider_kernels(scalar, exact: bool = False) -> SimpleNamespace:
    """Kernels update_and_collide (`grid_update` of planes, then the colliders), adj_collide_nodes, add_mass for wp.float32 or
    wp.float64 fields.

    exact: what nodes add up, reactions and the adjoints of poses, are exact sums (substeps, W K, numbers, COLUMNS) int64."""
    vec3 = wp.types.vector(length=3, dtype=scalar)
    vec4 = wp.types.vector(length=4, dtype=scalar)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=scalar)
    collide, adj_collide = make_plane_functions(scalar)
    adj_collide_normal = make_normal_adjoint(scalar)
    weight = make_fade(scalar)
    shape = shape_functions(scalar)
    signed_distance, curvature = shape.signed_distance, shape.curvature
    nodes = node_functions(scalar)
    node_position, nodes_of = nodes.node_position, nodes.nodes_of
    memory, planar = node_access(scalar), update_kernels(scalar)
    load3, load4, store3, clear = memory.load3, memory.load4, memory.store3, memory.clear
    free_velocity, plane_contact = planar.free_velocity, planar.contact
    module = f"mosa.physics.{'exact_' if exact else ''}colliders_{scalar.__name__}"
    vectors = wp.array4d(dtype=wp.int64) if exact else wp.array2d(dtype=vec3)
    matrices = wp.array4d(dtype=wp.int64) if exact else wp.array2d(dtype=mat33)
    add_exactly = sum_functions(scalar).add_exactly

    if exact:

        @wp.func
        def add_vector(sums: wp.array4d(dtype=wp.int64), substep: int, c: int, value: vec3):
            for i in range(3):
                add_exactly(sums[substep][c], i, value[i])

        @wp.func
        def add_matrix(sums: wp.array4d(dtype=wp.int64), substep: int, c: int, value: mat33):
            for i in range(3):
                for j in range(3):
                    add_exactly(sums[substep][c], 3 * i + j, value[i, j])

    else:

        @wp.func
        def add_vector(field: wp.array2d(dtype=vec3), substep: int, c: int, value: vec3):
            wp.atomic_add(field, substep, c, value)

        @wp.func
        def add_matrix(field: wp.array2d(dtype=mat33), substep: int, c: int, value: mat33):
            wp.atomic_add(field, substep, c, value)

    @wp.func
    def respond(
        u: vec3, y: vec3, k: int, column: int, substep: int, shapes: wp.array2d(dtype=scalar), codes: wp.array2d(dtype=int),
        fields: wp.array(dtype=scalar), position: wp.array2d(dtype=vec3), rotation: wp.array2d(dtype=mat33),
        linear: wp.array2d(dtype=vec3), angular: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        """Velocity u of a node at y after collider k."""
        out = u
        r = y - position[substep, column]
        Q = rotation[substep, column]
        phi, g = signed_distance(wp.transpose(Q) * r, k, shapes, codes, fields)
        w, _slope = weight(phi, shapes[k, 3])
        if w > scalar(0.0):
            V = linear[substep, column] + wp.cross(angular[substep, column], r)
            hit = V + collide(u - V, Q * wp.normalize(g), codes[k, 1], shapes[k, 4])
            if w < scalar(1.0):
                out = u + w * (hit - u)
            else:
                out = hit
        return out

    @wp.kernel(module=module, enable_backward=False)
    def update_and_collide(
        window: wp.array(dtype=wp.vec3i), threads: int, grid: wp.array(dtype=vec4), impulses: wp.array(dtype=vec3), cutoff: scalar,
        dx: scalar, planes: wp.array2d(dtype=scalar), modes: wp.array(dtype=int), plane_count: int,
        inv_dt: scalar, count: int, substep: int, shapes: wp.array2d(dtype=scalar), codes: wp.array2d(dtype=int),
        fields: wp.array(dtype=scalar), position: wp.array2d(dtype=vec3), rotation: wp.array2d(dtype=mat33),
        linear: wp.array2d(dtype=vec3), angular: wp.array2d(dtype=vec3), velocity: wp.array(dtype=vec4),
        cleared: wp.array(dtype=vec4), force: vectors, torque: vectors,
    ):  # fmt: skip
        """Writes velocity, adds to force and torque of the substep. In one launch: another one would read and write all velocities
        again, and most nodes touch no collider."""
        world = wp.tid() / threads
        impulse = impulses[world]
        first, end = nodes_of(window, world)
        for node in range(first + wp.tid() - world * threads, end, threads):
            g = load4(grid, node)
            m = g[3]
            u = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
            if m > cutoff:
                u = free_velocity(g, impulse)
                y = node_position(node - first, window[3 * world], window[3 * world + 1], dx)
                if plane_count > 0:
                    u = plane_contact(u, y, planes, modes, plane_count)
                for k in range(count):
                    c = world * count + k
                    after = respond(u, y, k, c, substep, shapes, codes, fields, position, rotation, linear, angular)
                    f = (m * inv_dt) * (u - after)
                    if wp.dot(f, f) > scalar(0.0):
                        add_vector(force, substep, c, f)
                        add_vector(torque, substep, c, wp.cross(y - position[substep, c], f))
                    u = after
            store3(velocity, node, u)
            if cleared:
                clear(cleared, node)

    @wp.kernel(module=module, enable_backward=False)
    def adj_collide_nodes(
        window: wp.array(dtype=wp.vec3i), threads: int, grid: wp.array(dtype=vec4), cutoff: scalar, dx: scalar,
        inv_dt: scalar, count: int, substep: int, shapes: wp.array2d(dtype=scalar), codes: wp.array2d(dtype=int),
        fields: wp.array(dtype=scalar), position: wp.array2d(dtype=vec3), rotation: wp.array2d(dtype=mat33),
        linear: wp.array2d(dtype=vec3), angular: wp.array2d(dtype=vec3), before: wp.array(dtype=vec4),
        adj_force: wp.array2d(dtype=vec3), adj_torque: wp.array2d(dtype=vec3), adj_velocity: wp.array(dtype=vec4),
        adj_mass: wp.array(dtype=scalar), adj_position: vectors, adj_rotation: matrices, adj_linear: vectors,
        adj_angular: vectors,
    ):  # fmt: skip
        """before: node velocities as the first collider finds them. Turns adj_velocity into theirs, writes adj_mass, adds to the
        adjoints of the pose and of the velocities."""
        world = wp.tid() / threads
        first, end = nodes_of(window, world)
        for node in range(first + wp.tid() - world * threads, end, threads):
            m = grid[node][3]
            am = scalar(0.0)
            if m > cutoff:
                now = adj_velocity[node]
                a = vec3(now[0], now[1], now[2])
                y = node_position(node - first, window[3 * world], window[3 * world + 1], dx)
                for reverse in range(count):
                    k = count - 1 - reverse
                    c = world * count + k
                    r = y - position[substep, c]
                    Q = rotation[substep, c]
                    q = wp.transpose(Q) * r
                    phi, g = signed_distance(q, k, shapes, codes, fields)
                    w, slope = weight(phi, shapes[k, 3])
                    if w > scalar(0.0):
                        u = load3(before, node)
                        for j in range(k):
                            u = respond(u, y, j, c - k + j, substep, shapes, codes, fields, position, rotation, linear, angular)
                        omega = angular[substep, c]
                        local = wp.normalize(g)
                        n = Q * local
                        V = linear[substep, c] + wp.cross(omega, r)
                        D = V + collide(u - V, n, codes[k, 1], shapes[k, 4]) - u
                        # u' = u + w D,  f = -(m w/dt) D,  torque = r x f
                        at = adj_torque[substep, c]
                        af = adj_force[substep, c] + wp.cross(at, r)
                        f = (-m * w * inv_dt) * D
                        am = am - (w * inv_dt) * wp.dot(D, af)
                        aD = w * a - (m * w * inv_dt) * af
                        aw = wp.dot(D, a) - (m * inv_dt) * wp.dot(D, af)
                        ar = wp.cross(f, at)
                        # D = V + collide(u - V, n) - u
                        relative = adj_collide(u - V, n, codes[k, 1], shapes[k, 4], aD)
                        an = adj_collide_normal(u - V, n, codes[k, 1], shapes[k, 4], aD)
                        a = a - aD + relative
                        aV = aD - relative
                        # V = linear + angular x r
                        ar = ar + wp.cross(aV, omega)
                        # n = Q local, local = g/|g|, g = grad phi(q), w(phi)
                        al = wp.transpose(Q) * an
                        ag = (al - wp.dot(local, al) * local) / wp.length(g)
                        aq = curvature(q, k, shapes, codes, fields, ag) + (slope * aw) * g
                        # q = Q^T r, r = y - position
                        ar = ar + Q * aq
                        add_vector(adj_linear, substep, c, aV)
                        add_vector(adj_angular, substep, c, wp.cross(r, aV))
                        add_matrix(adj_rotation, substep, c, wp.outer(an, local) + wp.outer(r, aq))
                        add_vector(adj_position, substep, c, -ar)
                store3(adj_velocity, node, a)
            adj_mass[node] = am

    @wp.kernel(module=module, enable_backward=False)
    def add_mass(
        window: wp.array(dtype=wp.vec3i), threads: int, adj_mass: wp.array(dtype=scalar), adj_grid: wp.array(dtype=vec4)
    ):
        """What the reaction adds to the adjoint of node masses."""
        z = scalar(0.0)
        world = wp.tid() / threads
        first, end = nodes_of(window, world)
        for node in range(first + wp.tid() - world * threads, end, threads):
            adj_grid[node] = adj_grid[node] + vec4(z, z, z, adj_mass[node])

    return SimpleNamespace(
        update_and_collide=update_and_collide, adj_collide_nodes=adj_collide_nodes, add_mass=add_mass, vec3=vec3,
        vec4=vec4, mat33=mat33,
    )  # fmt: skip

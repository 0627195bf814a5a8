"""The grid update: from momentum to velocity, gravity, contact with planes, and the adjoint of it."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from mosa.physics.contact.planes import TOUCHING, make_fade, make_plane_functions, make_slowness
from mosa.physics.grid.node_access import node_access
from mosa.physics.grid.stencil import node_functions


@cache
def update_kernels(scalar) -> SimpleNamespace:
    """Kernels grid_update, adj_grid for wp.float32 or wp.float64 fields, and the functions free_velocity, contact.

    The kernels are launched with `threads` for each world and take all nodes of its window, however many threads that is. cleared:
    what the next substep's particles add to, None where there is none; a launch of its own would take as long as this one."""
    vec3 = wp.types.vector(length=3, dtype=scalar)
    vec4 = wp.types.vector(length=4, dtype=scalar)
    collide, adj_collide = make_plane_functions(scalar)
    fade, slowness = make_fade(scalar), make_slowness(scalar)
    memory, nodes = node_access(scalar), node_functions(scalar)
    load3 = memory.load3
    load4 = memory.load4
    store3 = memory.store3
    store4 = memory.store4
    clear = memory.clear
    node_position, nodes_of = nodes.node_position, nodes.nodes_of
    module = f"mosa.physics.grid_update_{scalar.__name__}"

    @wp.func
    def free_velocity(g: vec4, impulse: vec3):
        return vec3(g[0], g[1], g[2]) / g[3] + impulse

    @wp.func
    def touch(u: vec3, y: vec3, planes: wp.array2d(dtype=scalar), i: int):
        """Weight of plane i's contact of a node at y that comes with velocity u, and its slope in u's normal part [s/m]."""
        normal = vec3(planes[i, 0], planes[i, 1], planes[i, 2])
        phi = wp.dot(y, normal) - planes[i, 3]
        w = fade(phi, planes[i, 5])
        change = scalar(0.0)
        if w > scalar(0.0) and phi > scalar(wp.static(TOUCHING)):
            slow, slope = slowness(wp.dot(u, normal))
            change = w * slope
            w = w * slow
        return w, change

    @wp.func
    def contact(
        u: vec3, y: vec3, planes: wp.array2d(dtype=scalar), modes: wp.array(dtype=int), count: int
    ):
        """Velocity after the first `count` planes."""
        r = u
        for i in range(count):
            w, _change = touch(r, y, planes, i)
            if w > scalar(0.0):
                hit = collide(
                    r, vec3(planes[i, 0], planes[i, 1], planes[i, 2]), modes[i], planes[i, 4]
                )
                if w < scalar(1.0):
                    r = r + w * (hit - r)
                else:
                    r = hit
        return r

    @wp.func
    def adj_contact(
        u: vec3,
        y: vec3,
        planes: wp.array2d(dtype=scalar),
        modes: wp.array(dtype=int),
        count: int,
        seed: vec3,
    ):
        a = seed
        for reverse in range(count):
            i = count - 1 - reverse
            before = contact(u, y, planes, modes, i)
            w, change = touch(before, y, planes, i)
            if w > scalar(0.0):
                normal = vec3(planes[i, 0], planes[i, 1], planes[i, 2])
                hit = collide(before, normal, modes[i], planes[i, 4])
                along = (change * wp.dot(hit - before, a)) * normal
                a = (
                    (scalar(1.0) - w) * a
                    + adj_collide(before, normal, modes[i], planes[i, 4], w * a)
                    + along
                )
        return a

    @wp.kernel(module=module, enable_backward=False)
    def grid_update(
        window: wp.array(dtype=wp.vec3i), threads: int, grid: wp.array(dtype=vec4), impulses: wp.array(dtype=vec3), cutoff: scalar,
        dx: scalar, planes: wp.array2d(dtype=scalar), modes: wp.array(dtype=int), count: int,
        velocity: wp.array(dtype=vec4), cleared: wp.array(dtype=vec4),
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
                    u = contact(
                        u, node_position(node - first, origin, dims, dx), planes, modes, count
                    )
            store3(velocity, node, u)
            if cleared:
                clear(cleared, node)

    @wp.kernel(module=module, enable_backward=False)
    def adj_grid(
        window: wp.array(dtype=wp.vec3i), threads: int, grid: wp.array(dtype=vec4), impulses: wp.array(dtype=vec3), cutoff: scalar,
        dx: scalar, planes: wp.array2d(dtype=scalar), modes: wp.array(dtype=int), count: int,
        adj_velocity: wp.array(dtype=vec4), adj_grid: wp.array(dtype=vec4), cleared: wp.array(dtype=vec4),
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
                    a = adj_contact(
                        u, node_position(node - first, origin, dims, dx), planes, modes, count, a
                    )
                a = a / g[3]
                # v = p/m: dL/dm = -a.(p/m)/m
                store4(
                    adj_grid,
                    node,
                    vec4(a[0], a[1], a[2], -(a[0] * g[0] + a[1] * g[1] + a[2] * g[2]) / g[3]),
                )
            else:
                clear(adj_grid, node)
            if cleared:
                clear(cleared, node)

    return SimpleNamespace(
        grid_update=grid_update, adj_grid=adj_grid, free_velocity=free_velocity, contact=contact
    )

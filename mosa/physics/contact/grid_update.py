"""The grid update: from momentum to velocity, gravity, contact with planes, and the adjoint of it."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from mosa.physics.contact.planes import TOUCHING, make_fade, make_plane_functions, make_slowness
from mosa.physics.contact.touch import planes_struct
from mosa.physics.grid.node_access import node_access
from mosa.physics.grid.stencil import stencil_functions


@cache
def update_kernels(scalar) -> SimpleNamespace:
    """Kernels grid_update, adj_grid for wp.float32 or wp.float64 fields, and the functions free_velocity, contact.

    The kernels are launched with `threads` for each world and take all nodes of its window, however many threads that is. cleared:
    what the next substep's particles add to, None where there is none; a launch of its own would take as long as this one."""
    vec3 = wp.types.vector(length=3, dtype=scalar)
    vec4 = wp.types.vector(length=4, dtype=scalar)
    collide, adj_collide = make_plane_functions(scalar)
    fade, slowness = make_fade(scalar), make_slowness(scalar)
    memory, stencil, Planes = node_access(scalar), stencil_functions(scalar), planes_struct(scalar)
    load3, load4, store3, store4 = memory.load3, memory.load4, memory.store3, memory.store4
    clear, Grids = memory.clear, stencil.Grids
    node_position, nodes_of = stencil.node_position, stencil.nodes_of
    module = f"mosa.physics.grid_update_{scalar.__name__}"

    @wp.func
    def free_velocity(g: vec4, impulse: vec3):
        return vec3(g[0], g[1], g[2]) / g[3] + impulse

    @wp.func
    def touch(u: vec3, y: vec3, planes: Planes, i: int):
        """Weight of plane i's contact of a node at y that comes with velocity u, and its slope in u's normal part [s/m]."""
        values = planes.values
        normal = vec3(values[i, 0], values[i, 1], values[i, 2])
        phi = wp.dot(y, normal) - values[i, 3]
        w = fade(phi, values[i, 5])
        change = scalar(0.0)
        if w > scalar(0.0) and phi > scalar(wp.static(TOUCHING)):
            slow, slope = slowness(wp.dot(u, normal))
            change = w * slope
            w = w * slow
        return w, change

    @wp.func
    def contact(u: vec3, y: vec3, planes: Planes, count: int):
        """Velocity after the first `count` planes."""
        values = planes.values
        r = u
        for i in range(count):
            w, _change = touch(r, y, planes, i)
            if w > scalar(0.0):
                normal = vec3(values[i, 0], values[i, 1], values[i, 2])
                hit = collide(r, normal, planes.modes[i], values[i, 4])
                if w < scalar(1.0):
                    r = r + w * (hit - r)
                else:
                    r = hit
        return r

    @wp.func
    def adj_contact(u: vec3, y: vec3, planes: Planes, seed: vec3):
        values = planes.values
        a = seed
        for reverse in range(planes.count):
            i = planes.count - 1 - reverse
            before = contact(u, y, planes, i)
            w, change = touch(before, y, planes, i)
            if w > scalar(0.0):
                normal = vec3(values[i, 0], values[i, 1], values[i, 2])
                hit = collide(before, normal, planes.modes[i], values[i, 4])
                along = (change * wp.dot(hit - before, a)) * normal
                through = adj_collide(before, normal, planes.modes[i], values[i, 4], w * a)
                a = (scalar(1.0) - w) * a + through + along
        return a

    @wp.kernel(module=module, enable_backward=False)
    def grid_update(
        grids: Grids, threads: int, grid: wp.array(dtype=vec4), impulses: wp.array(dtype=vec3), cutoff: scalar, planes: Planes,
        velocity: wp.array(dtype=vec4), cleared: wp.array(dtype=vec4),
    ):  # fmt: skip
        world = wp.tid() / threads
        impulse = impulses[world]
        first, end = nodes_of(grids, world)
        for node in range(first + wp.tid() - world * threads, end, threads):
            g = load4(grid, node)
            u = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
            if g[3] > cutoff:
                u = free_velocity(g, impulse)
                if planes.count > 0:
                    u = contact(u, node_position(node - first, world, grids), planes, planes.count)
            store3(velocity, node, u)
            if cleared:
                clear(cleared, node)

    @wp.kernel(module=module, enable_backward=False)
    def adj_grid(
        grids: Grids, threads: int, grid: wp.array(dtype=vec4), impulses: wp.array(dtype=vec3), cutoff: scalar, planes: Planes,
        adj_velocity: wp.array(dtype=vec4), adj_grid: wp.array(dtype=vec4), cleared: wp.array(dtype=vec4),
    ):  # fmt: skip
        world = wp.tid() / threads
        impulse = impulses[world]
        first, end = nodes_of(grids, world)
        for node in range(first + wp.tid() - world * threads, end, threads):
            g = load4(grid, node)
            if g[3] > cutoff:
                u = free_velocity(g, impulse)
                a = load3(adj_velocity, node)
                if planes.count > 0:
                    a = adj_contact(u, node_position(node - first, world, grids), planes, a)
                a = a / g[3]
                # v = p/m: dL/dm = -a.(p/m)/m
                m = -(a[0] * g[0] + a[1] * g[1] + a[2] * g[2]) / g[3]
                store4(adj_grid, node, vec4(a[0], a[1], a[2], m))
            else:
                clear(adj_grid, node)
            if cleared:
                clear(cleared, node)

    return SimpleNamespace(
        grid_update=grid_update, adj_grid=adj_grid, free_velocity=free_velocity, contact=contact
    )

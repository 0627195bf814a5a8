"""Moving rigid colliders on the velocities of particles, their reaction, and the exact adjoint of both.

A particle at x, a ball of radius r, R = x - position, is in the collider's axes at q = Q^T R, at distance phi(q) of its surface
with outward normal n = Q grad phi/|grad phi|. It moves with u = v - V relative to the solid, whose velocity there is
V = linear + angular x R. Where phi < r it is met as by a plane of mode `touch` (`contact.touch`); u_t: tangential part of u:
    j = dt stiffness k (r - phi),    v' = v + j n - min(grip, friction j / |u_t|) u_t
    force on the collider f = -m (v' - v)/dt,    torque R x f
No grid takes part in it, so that it is the same at any angle to the grid.
Colliders act in the order given, after the planes. The pose is the one at the start of the substep. Worlds have the same solids,
each with poses of its own: solid k of world w has column w count + k of poses and reactions.
"""

from functools import cache, partial
from types import SimpleNamespace

import warp as wp

from mosa.physics.contact.shapes import shape_functions
from mosa.physics.contact.touch import touch_functions
from mosa.physics.exact_sums import sum_functions


@cache
def collider_kernels(scalar, exact: bool = False) -> SimpleNamespace:
    """Kernels strike, adj_strike for wp.float32 or wp.float64 fields.

    exact: what particles add up, reactions and the adjoints of poses, are exact sums (substeps, W K, numbers, COLUMNS) int64."""
    vec3 = wp.types.vector(length=3, dtype=scalar)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=scalar)
    shape, touch = shape_functions(scalar), touch_functions(scalar)
    signed_distance, curvature = shape.signed_distance, shape.curvature
    near, depth, pushed, adj_pushed = touch.near, touch.depth, touch.pushed, touch.adj_pushed
    module = f"mosa.physics.{'exact_' if exact else ''}colliders_{scalar.__name__}"
    vectors = wp.array4d(dtype=wp.int64) if exact else wp.array2d(dtype=vec3)
    matrices = wp.array4d(dtype=wp.int64) if exact else wp.array2d(dtype=mat33)
    add_exactly = sum_functions(scalar).add_exactly

    @partial(wp.struct, module=module)
    class Solids:
        count: int
        shapes: wp.array2d(dtype=scalar)
        codes: wp.array2d(dtype=int)
        fields: wp.array(dtype=scalar)

    @partial(wp.struct, module=module)
    class Poses:
        position: wp.array2d(dtype=vec3)
        rotation: wp.array2d(dtype=mat33)
        linear: wp.array2d(dtype=vec3)
        angular: wp.array2d(dtype=vec3)

    @partial(wp.struct, module=module)
    class PoseSums:
        position: vectors
        rotation: matrices
        linear: vectors
        angular: vectors

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
    def struck(
        v: vec3, x: vec3, volume: scalar, kick: scalar, k: int, c: int, substep: int,
        solids: Solids, poses: Poses,
    ):  # fmt: skip
        """Velocity v of a particle after collider k in column c."""
        R = x - poses.position[substep, c]
        Q = poses.rotation[substep, c]
        phi, g = signed_distance(wp.transpose(Q) * R, k, solids.shapes, solids.codes, solids.fields)
        inside = depth(phi, volume)
        out = v
        if inside > scalar(0.0):
            V = poses.linear[substep, c] + wp.cross(poses.angular[substep, c], R)
            out = v + pushed(
                v - V,
                Q * wp.normalize(g),
                kick * solids.shapes[k, 8] * inside,
                solids.shapes[k, 3],
                solids.shapes[k, 9],
            )
        return out

    @wp.kernel(module=module, enable_backward=False)
    def strike(
        x: wp.array(dtype=vec3), v: wp.array(dtype=vec3), volume: wp.array(dtype=scalar), springs: wp.array(dtype=scalar),
        mass: wp.array(dtype=scalar), dt: scalar, size: int, substep: int, solids: Solids, poses: Poses,
        v_struck: wp.array(dtype=vec3), force: vectors, torque: vectors,
    ):  # fmt: skip
        """Writes v_struck, adds to force and torque of the substep where they are given. size: particles of a world."""
        p = wp.tid()
        u = v[p]
        for k in range(solids.count):
            c = (p / size) * solids.count + k
            R = x[p] - poses.position[substep, c]
            if near(wp.length(R) - solids.shapes[k, 10], volume[p]):
                after = struck(u, x[p], volume[p], dt * springs[p], k, c, substep, solids, poses)
                f = (mass[p] / dt) * (u - after)
                if force and wp.dot(f, f) > scalar(0.0):
                    add_vector(force, substep, c, f)
                    add_vector(torque, substep, c, wp.cross(R, f))
                u = after
        v_struck[p] = u

    @wp.kernel(module=module, enable_backward=False)
    def adj_strike(
        x: wp.array(dtype=vec3), v: wp.array(dtype=vec3), volume: wp.array(dtype=scalar), springs: wp.array(dtype=scalar),
        mass: wp.array(dtype=scalar), dt: scalar, size: int, substep: int, solids: Solids, poses: Poses,
        adj_force: wp.array2d(dtype=vec3), adj_torque: wp.array2d(dtype=vec3), adj_x: wp.array(dtype=vec3),
        adj_v: wp.array(dtype=vec3), adj_springs: wp.array(dtype=scalar), adj_poses: PoseSums,
    ):  # fmt: skip
        """v: velocities as the first collider finds them. Turns adj_v into theirs, adds to the adjoints of x, of the springs, of
        the poses and of the solids' velocities."""
        p = wp.tid()
        kick = dt * springs[p]
        a = adj_v[p]
        ax = adj_x[p]
        spring = scalar(0.0)
        for reverse in range(solids.count):
            k = solids.count - 1 - reverse
            c = (p / size) * solids.count + k
            R = x[p] - poses.position[substep, c]
            if not near(wp.length(R) - solids.shapes[k, 10], volume[p]):
                continue
            Q = poses.rotation[substep, c]
            q = wp.transpose(Q) * R
            phi, g = signed_distance(q, k, solids.shapes, solids.codes, solids.fields)
            inside = depth(phi, volume[p])
            if inside > scalar(0.0):
                u = v[p]
                for j in range(k):
                    u = struck(u, x[p], volume[p], kick, j, c - k + j, substep, solids, poses)
                omega = poses.angular[substep, c]
                local = wp.normalize(g)
                n = Q * local
                u = u - poses.linear[substep, c] - wp.cross(omega, R)
                stiffness = solids.shapes[k, 8]
                push = kick * stiffness * inside
                # v' = v + D,  f = -(m/dt) D,  torque = R x f
                at = adj_torque[substep, c]
                f = -(mass[p] / dt) * pushed(u, n, push, solids.shapes[k, 3], solids.shapes[k, 9])
                aD = a - (mass[p] / dt) * (adj_force[substep, c] + wp.cross(at, R))
                aR = wp.cross(f, at)
                au, an, aj = adj_pushed(u, n, push, solids.shapes[k, 3], solids.shapes[k, 9], aD)
                spring = spring + dt * stiffness * inside * aj
                # u = v - V, V = linear + angular x R
                a = a + au
                aR = aR + wp.cross(omega, au)
                # n = Q local, local = g/|g|, g = grad phi(q), j = kick stiffness (r - phi(q))
                al = wp.transpose(Q) * an
                ag = (al - wp.dot(local, al) * local) / wp.length(g)
                aq = (
                    curvature(q, k, solids.shapes, solids.codes, solids.fields, ag)
                    - (kick * stiffness * aj) * g
                )
                # q = Q^T R, R = x - position
                aR = aR + Q * aq
                ax = ax + aR
                add_vector(adj_poses.linear, substep, c, -au)
                add_vector(adj_poses.angular, substep, c, wp.cross(au, R))
                add_matrix(adj_poses.rotation, substep, c, wp.outer(an, local) + wp.outer(R, aq))
                add_vector(adj_poses.position, substep, c, -aR)
        adj_v[p] = a
        adj_x[p] = ax
        adj_springs[p] = adj_springs[p] + spring

    return SimpleNamespace(
        Solids=Solids, Poses=Poses, PoseSums=PoseSums,
        strike=strike, adj_strike=adj_strike, add_vector=add_vector, add_matrix=add_matrix, vec3=vec3, mat33=mat33
    )  # fmt: skip

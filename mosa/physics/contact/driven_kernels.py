"""Velocities of driven particles before they go to the grid, the reaction, and the exact adjoint of
both.

A driven particle belongs at y = position + Q local (+ path), and moves with w = linear + angular x
Q local (+ rate). It goes to the grid with
    v' = w + dt k (y - x),   m' = HEAVIER m
k: the spring of `contact.touch`, as stiff as a cell of the material. Its own velocity is dropped:
what holds it says how it moves. Stress and affine velocity are its own. The mass that is added
makes the spring HEAVIER times as stiff at the same time step; no node is treated apart, so that a
set may move across the grid at any angle. With u the velocity before and v'' that after the grid,
the set's holder feels the momentum that the particles lose,
    f = (m (u - v') + (m' - m) (v'' - v' - dt g))/dt,   torque (x - position) x f,
in which the added mass has neither weight nor inertia.
"""

from functools import cache, partial
from types import SimpleNamespace

import warp as wp

from mosa.physics.contact.collider_kernels import collider_kernels

HEAVIER = 50.0
"""Mass with which driven particles go to the grid, over their own: docs/driven.md, "How stiff a
clamp is"."""


@cache
def driven_kernels(scalar, exact: bool = False) -> SimpleNamespace:
    """Kernels hold, feel, adj_feel, adj_hold for wp.float32 or wp.float64 fields. exact: as
    `collider_kernels`."""
    vec3 = wp.types.vector(length=3, dtype=scalar)
    adding = collider_kernels(scalar, exact)
    add_vector, add_matrix = adding.add_vector, adding.add_matrix
    module = f"mosa.physics.{'exact_' if exact else ''}driven_{scalar.__name__}"
    vectors = wp.array4d(dtype=wp.int64) if exact else wp.array2d(dtype=vec3)
    Poses, PoseSums = adding.Poses, adding.PoseSums
    more = HEAVIER - 1.0

    @partial(wp.struct, module=module)
    class Sets:
        """Of every particle its set, its place in the set's axes, its point; of a world the poses
        and points."""

        sets: wp.array(dtype=int)
        local: wp.array(dtype=vec3)
        points: wp.array(dtype=int)
        columns: int
        count: int

    @partial(wp.struct, module=module)
    class Paths:
        places: wp.array2d(dtype=vec3)
        rates: wp.array2d(dtype=vec3)

    @partial(wp.struct, module=module)
    class PathSums:
        places: vectors
        rates: vectors

    @wp.kernel(module=module, enable_backward=False)
    def hold(
        x: wp.array(dtype=vec3), v: wp.array(dtype=vec3), springs: wp.array(dtype=scalar), dt: scalar,
        size: int, substep: int, driven: Sets, poses: Poses, paths: Paths, v_held: wp.array(dtype=vec3),
    ):  # fmt: skip
        """Writes v_held. size: particles of a world."""
        p = wp.tid()
        u = v[p]
        k = driven.sets[p]
        if k >= 0:
            world = p / size
            c = world * driven.columns + k
            arm = poses.rotation[substep, c] * driven.local[p]
            y = poses.position[substep, c] + arm
            u = poses.linear[substep, c] + wp.cross(poses.angular[substep, c], arm)
            if driven.points[p] >= 0:
                y = y + paths.places[substep, world * driven.count + driven.points[p]]
                u = u + paths.rates[substep, world * driven.count + driven.points[p]]
            u = u + (dt * springs[p]) * (y - x[p])
        v_held[p] = u

    @wp.func
    def felt(m: scalar, dt: scalar, before: vec3, held: vec3, after: vec3, impulse: vec3):
        return (m / dt) * (before - held + scalar(wp.static(more)) * (after - held - impulse))

    @wp.kernel(module=module, enable_backward=False)
    def feel(
        x: wp.array(dtype=vec3), v: wp.array(dtype=vec3), v_held: wp.array(dtype=vec3), v_new: wp.array(dtype=vec3),
        mass: wp.array(dtype=scalar), impulses: wp.array(dtype=vec3), dt: scalar, size: int, substep: int,
        driven: Sets, poses: Poses, force: vectors, torque: vectors,
    ):  # fmt: skip
        """Adds to force and torque of the substep. v, v_new: velocities before `hold` and after
        the grid; impulses: dt g of worlds."""
        p = wp.tid()
        if driven.sets[p] >= 0:
            world = p / size
            c = world * driven.columns + driven.sets[p]
            f = felt(mass[p], dt, v[p], v_held[p], v_new[p], impulses[world])
            add_vector(force, substep, c, f)
            add_vector(torque, substep, c, wp.cross(x[p] - poses.position[substep, c], f))

    @wp.kernel(module=module, enable_backward=False)
    def adj_feel(
        x: wp.array(dtype=vec3), mass: wp.array(dtype=scalar), dt: scalar, size: int, substep: int,
        driven: Sets, poses: Poses, adj_force: wp.array2d(dtype=vec3), adj_torque: wp.array2d(dtype=vec3),
        adj_v_new: wp.array(dtype=vec3),
    ):  # fmt: skip
        """Adds to the adjoint of the velocities after the grid; those of all else `adj_hold` has."""
        p = wp.tid()
        if driven.sets[p] >= 0:
            c = (p / size) * driven.columns + driven.sets[p]
            af = adj_force[substep, c] + wp.cross(
                adj_torque[substep, c], x[p] - poses.position[substep, c]
            )
            adj_v_new[p] = adj_v_new[p] + (scalar(wp.static(more)) * mass[p] / dt) * af

    @wp.kernel(module=module, enable_backward=False)
    def adj_hold(
        x: wp.array(dtype=vec3), v: wp.array(dtype=vec3), v_new: wp.array(dtype=vec3), springs: wp.array(dtype=scalar),
        mass: wp.array(dtype=scalar), impulses: wp.array(dtype=vec3), dt: scalar, size: int, substep: int,
        driven: Sets, poses: Poses, paths: Paths, adj_force: wp.array2d(dtype=vec3),
        adj_torque: wp.array2d(dtype=vec3), adj_x: wp.array(dtype=vec3), adj_v: wp.array(dtype=vec3),
        adj_springs: wp.array(dtype=scalar), adj_poses: PoseSums, adj_paths: PathSums,
    ):  # fmt: skip
        """v: velocities as the sets find them. Turns adj_v into theirs, adds to the other adjoints."""
        p = wp.tid()
        k = driven.sets[p]
        if k < 0:
            return
        world = p / size
        c = world * driven.columns + k
        omega = poses.angular[substep, c]
        arm = poses.rotation[substep, c] * driven.local[p]
        y = poses.position[substep, c] + arm
        held = poses.linear[substep, c] + wp.cross(omega, arm)
        n = world * driven.count + driven.points[p]
        if driven.points[p] >= 0:
            y = y + paths.places[substep, n]
            held = held + paths.rates[substep, n]
        pull = dt * springs[p]
        gap = y - x[p]
        held = held + pull * gap
        # torque = R x f
        R = x[p] - poses.position[substep, c]
        at = adj_torque[substep, c]
        aR = wp.cross(felt(mass[p], dt, v[p], held, v_new[p], impulses[world]), at)
        af = (mass[p] / dt) * (adj_force[substep, c] + wp.cross(at, R))
        a = adj_v[p] - scalar(wp.static(more + 1.0)) * af
        # v' = w + pull (y - x)
        ay = pull * a
        adj_v[p] = af
        adj_x[p] = adj_x[p] + aR - ay
        adj_springs[p] = adj_springs[p] + dt * wp.dot(gap, a)
        aarm = ay + wp.cross(a, omega)
        add_vector(adj_poses.position, substep, c, ay - aR)
        add_matrix(adj_poses.rotation, substep, c, wp.outer(aarm, driven.local[p]))
        add_vector(adj_poses.linear, substep, c, a)
        add_vector(adj_poses.angular, substep, c, wp.cross(arm, a))
        if driven.points[p] >= 0:
            add_vector(adj_paths.places, substep, n, ay)
            add_vector(adj_paths.rates, substep, n, a)

    return SimpleNamespace(
        Sets=Sets, Paths=Paths, PathSums=PathSums, hold=hold, feel=feel, adj_feel=adj_feel, adj_hold=adj_hold
    )  # fmt: skip

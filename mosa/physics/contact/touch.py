"""Planes that particles meet at their own height (mode `touch`), acting on their velocities before they go to the grid.

A grid stops a body half a cell above the nodes that hold it. What lies between is squeezed before the body touches, and slides:
of the velocity along the ground with which a tilted body bounces a fifth is missing, on fine grids too
(docs/identification.md#how-the-ground-is-touched). Here a particle, a ball of half a spacing, is pushed out by a spring, and
Coulomb friction acts on what slides:

    j = dt k (r - phi),   v <- v + j n,   v_t <- v_t - min(GRIP, friction j / |v_t|) v_t

r: half the cube root s of the particle's volume; phi: its height above the plane. k = STIFFNESS M / (density dx s), M: modulus of
longitudinal waves: the spring is about as stiff as a cell of the material. A stiffer one gains no height and loses the bounce, as a
grid swallows what goes to single particles. The grip is greater than one because a particle's neighbours share what it is given.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp
from torch import Tensor

TOUCH = wp.constant(3)
"""Of `planes.MODES`."""
STIFFNESS = 1.0
"""Of the spring, over that of a cell of the material."""
GRIP = 3.0
"""Most of its sliding velocity that friction takes from a particle in one substep."""


def springs(modulus: Tensor, mass: Tensor, volume: Tensor, dx: float) -> Tensor:
    """k (N,) [1/s^2] of particles with these moduli [Pa], masses [kg] and volumes [m^3] (N,). dx [m]: of the grid."""
    return STIFFNESS * modulus * volume.pow(2 / 3) / (mass * dx)


@cache
def touch_kernels(scalar) -> SimpleNamespace:
    """Kernels meet and adj_meet for wp.float32 or wp.float64 fields."""
    vec3 = wp.types.vector(length=3, dtype=scalar)
    module = f"mosa.physics.touch_{scalar.__name__}"
    grip, third = scalar(GRIP), scalar(1.0 / 3.0)

    @wp.func
    def met(v: vec3, x: vec3, r: scalar, planes: wp.array2d(dtype=scalar), modes: wp.array(dtype=int), count: int, kick: scalar):
        """Velocity after the first `count` planes."""
        u = v
        for i in range(count):
            if modes[i] == TOUCH:
                n = vec3(planes[i, 0], planes[i, 1], planes[i, 2])
                depth = r - (wp.dot(x, n) - planes[i, 3])
                if depth > scalar(0.0):
                    j = kick * depth
                    t = u - wp.dot(u, n) * n
                    length = wp.length(t)
                    lost = scalar(0.0)
                    if length > scalar(0.0):
                        lost = wp.min(grip, planes[i, 4] * j / length)
                    u = u + j * n - lost * t
        return u

    @wp.kernel(module=module, enable_backward=False)
    def meet(
        x: wp.array(dtype=vec3), v: wp.array(dtype=vec3), volume: wp.array(dtype=scalar), springs: wp.array(dtype=scalar),
        planes: wp.array2d(dtype=scalar), modes: wp.array(dtype=int), count: int, dt: scalar, v_met: wp.array(dtype=vec3),
    ):  # fmt: skip
        p = wp.tid()
        v_met[p] = met(v[p], x[p], scalar(0.5) * wp.pow(volume[p], third), planes, modes, count, dt * springs[p])

    @wp.kernel(module=module, enable_backward=False)
    def adj_meet(
        x: wp.array(dtype=vec3), v: wp.array(dtype=vec3), volume: wp.array(dtype=scalar), springs: wp.array(dtype=scalar),
        planes: wp.array2d(dtype=scalar), modes: wp.array(dtype=int), count: int, dt: scalar,
        adj_x: wp.array(dtype=vec3), adj_v: wp.array(dtype=vec3),
    ):  # fmt: skip
        """Turns adj_v from that of the velocities after it to that of those before, and adds to adj_x."""
        p = wp.tid()
        r = scalar(0.5) * wp.pow(volume[p], third)
        kick = dt * springs[p]
        a = adj_v[p]
        ax = adj_x[p]
        for reverse in range(count):
            i = count - 1 - reverse
            if modes[i] == TOUCH:
                n = vec3(planes[i, 0], planes[i, 1], planes[i, 2])
                depth = r - (wp.dot(x[p], n) - planes[i, 3])
                if depth > scalar(0.0):
                    u = met(v[p], x[p], r, planes, modes, i, kick)
                    j = kick * depth
                    t = u - wp.dot(u, n) * n
                    length = wp.length(t)
                    of_j = wp.dot(a, n)
                    at = a - of_j * n
                    back = a
                    if length > scalar(0.0):
                        lost = planes[i, 4] * j / length
                        if lost < grip:
                            d = t / length
                            along = wp.dot(d, at)
                            back = a - lost * (at - along * d)
                            of_j = of_j - planes[i, 4] * along
                        else:
                            back = a - grip * at
                    a = back
                    ax = ax - (kick * of_j) * n
        adj_v[p] = a
        adj_x[p] = ax

    return SimpleNamespace(meet=meet, adj_meet=adj_meet)

"""Planes that particles meet at their own height (mode `touch`), acting on their velocities before they go to the grid.

A grid stops a body half a cell above the nodes that hold it. What lies between is squeezed before the body touches, and slides:
of the velocity along the ground with which a tilted body bounces a fifth is missing, on fine grids too
(docs/uncertainty.md#how-the-ground-is-touched). Here a particle, a ball of half a spacing, is pushed out by a spring, and
Coulomb friction acts on what slides:

    j = dt k (r - phi),   v <- v + j n,   v_t <- v_t - min(GRIP, friction j / |v_t|) v_t

r: half the cube root s of the particle's volume; phi: its height above the plane. k = STIFFNESS M / (density dx s), M: modulus of
longitudinal waves: the spring is about as stiff as a cell of the material. A stiffer one gains no height and loses the bounce, as a
grid swallows what goes to single particles. The grip is greater than one because a particle's neighbours share what it is given.
Solids are met in the same way (`collider_kernels`).
"""

from functools import cache, partial
from types import SimpleNamespace

import warp as wp
from torch import Tensor

TOUCH = wp.constant(3)
"""Of `planes.MODES`."""
STIFFNESS = 1.0
"""Of the spring, over that of a cell of the material."""
NEAR = 1.001
"""Volumes of a particle to which the cube of a distance is compared: more than rounding."""
GRIP = 3.0
"""Most of its sliding velocity that friction takes from a particle in one substep."""


def springs(modulus: Tensor, mass: Tensor, volume: Tensor, dx: float) -> Tensor:
    """k (N,) [1/s^2] of particles with these moduli [Pa], masses [kg] and volumes [m^3] (N,). dx [m]: of the grid."""
    # in float64: in float32 a power has other last digits in another place of a tensor
    return (STIFFNESS * modulus.double() * volume.double().pow(2 / 3) / (mass.double() * dx)).to(
        mass
    )


@cache
def touch_functions(scalar) -> SimpleNamespace:
    """Warp functions near, depth(phi, volume), pushed and adj_pushed for wp.float32 or wp.float64."""
    vec3 = wp.types.vector(length=3, dtype=scalar)
    third = 1.0 / 3.0

    @wp.func
    def near(phi: scalar, volume: scalar):
        """Whether the ball of a particle, of half its spacing, may reach what is at distance phi of
        its centre: without the power that tells, which takes as long as all the rest."""
        return scalar(8.0) * phi * phi * phi < scalar(wp.static(NEAR)) * volume

    @wp.func
    def depth(phi: scalar, volume: scalar):
        """How far the ball reaches beyond it, 0 where it does not."""
        inside = scalar(0.0)
        if near(phi, volume):
            inside = wp.max(scalar(0.5) * wp.pow(volume, scalar(wp.static(third))) - phi, inside)
        return inside

    @wp.func
    def pushed(u: vec3, n: vec3, j: scalar, friction: scalar, grip: scalar):
        """Change of the velocity of a particle that moves with u relative to a surface of normal n and is pushed by j > 0. grip:
        most of its sliding that friction takes."""
        t = u - wp.dot(u, n) * n
        length = wp.length(t)
        lost = scalar(0.0)
        if length > scalar(0.0):
            lost = wp.min(grip, friction * j / length)
        return j * n - lost * t

    @wp.func
    def adj_pushed(u: vec3, n: vec3, j: scalar, friction: scalar, grip: scalar, a: vec3):
        """(adjoints of u, n, j) of the adjoint a of what `pushed` returns."""
        un = wp.dot(u, n)
        t = u - un * n
        length = wp.length(t)
        at = vec3(scalar(0.0), scalar(0.0), scalar(0.0))
        aj = wp.dot(a, n)
        if length > scalar(0.0):
            lost = friction * j / length
            if lost < grip:
                d = t / length
                along = wp.dot(d, a)
                at = lost * (along * d - a)
                aj = aj - friction * along
            else:
                at = -grip * a
        # t = u - un n
        tilt = wp.dot(at, n)
        return at - tilt * n, j * a - tilt * u - un * at, aj

    return SimpleNamespace(near=near, depth=depth, pushed=pushed, adj_pushed=adj_pushed)


@cache
def planes_struct(scalar):
    """What kernels read of planes: `pack_planes` in wp.float32 or wp.float64, and how many there are."""

    @partial(wp.struct, module=f"mosa.physics.planes_{scalar.__name__}")
    class Planes:
        values: wp.array2d(dtype=scalar)
        modes: wp.array(dtype=int)
        count: int

    return Planes


@cache
def touch_kernels(scalar) -> SimpleNamespace:
    """Kernels meet and adj_meet for wp.float32 or wp.float64 fields."""
    vec3 = wp.types.vector(length=3, dtype=scalar)
    functions, Planes = touch_functions(scalar), planes_struct(scalar)
    depth, pushed, adj_pushed = functions.depth, functions.pushed, functions.adj_pushed
    module, grip = f"mosa.physics.touch_{scalar.__name__}", scalar(GRIP)

    @wp.func
    def met(v: vec3, x: vec3, volume: scalar, planes: Planes, count: int, kick: scalar):
        """Velocity after the first `count` planes."""
        values = planes.values
        u = v
        for i in range(count):
            if planes.modes[i] == TOUCH:
                n = vec3(values[i, 0], values[i, 1], values[i, 2])
                inside = depth(wp.dot(x, n) - values[i, 3], volume)
                if inside > scalar(0.0):
                    u = u + pushed(u, n, kick * inside, values[i, 4], grip)
        return u

    @wp.kernel(module=module, enable_backward=False)
    def meet(
        x: wp.array(dtype=vec3), v: wp.array(dtype=vec3), volume: wp.array(dtype=scalar), springs: wp.array(dtype=scalar),
        planes: Planes, dt: scalar, v_met: wp.array(dtype=vec3),
    ):  # fmt: skip
        p = wp.tid()
        v_met[p] = met(v[p], x[p], volume[p], planes, planes.count, dt * springs[p])

    @wp.kernel(module=module, enable_backward=False)
    def adj_meet(
        x: wp.array(dtype=vec3), v: wp.array(dtype=vec3), volume: wp.array(dtype=scalar), springs: wp.array(dtype=scalar),
        planes: Planes, dt: scalar, adj_x: wp.array(dtype=vec3), adj_v: wp.array(dtype=vec3), adj_springs: wp.array(dtype=scalar),
    ):  # fmt: skip
        """Turns adj_v from that of the velocities after it to that of those before, and adds to adj_x and adj_springs."""
        p = wp.tid()
        values = planes.values
        kick = dt * springs[p]
        a = adj_v[p]
        ax = adj_x[p]
        spring = scalar(0.0)
        for reverse in range(planes.count):
            i = planes.count - 1 - reverse
            if planes.modes[i] == TOUCH:
                n = vec3(values[i, 0], values[i, 1], values[i, 2])
                inside = depth(wp.dot(x[p], n) - values[i, 3], volume[p])
                if inside > scalar(0.0):
                    u = met(v[p], x[p], volume[p], planes, i, kick)
                    au, _an, aj = adj_pushed(u, n, kick * inside, values[i, 4], grip, a)
                    a = a + au
                    ax = ax - (kick * aj) * n
                    spring = spring + dt * inside * aj
        adj_v[p] = a
        adj_x[p] = ax
        adj_springs[p] = adj_springs[p] + spring

    @wp.kernel(module=module, enable_backward=False)
    def loosen(
        adj_springs: wp.array(dtype=scalar), slopes: wp.array2d(dtype=scalar),
        adj_parameters: wp.array2d(dtype=scalar),
    ):  # fmt: skip
        """Adds what springs (N,) with `slopes` (N, S) in packed parameters add to the adjoint of these."""
        p = wp.tid()
        for i in range(slopes.shape[1]):
            adj_parameters[p, i] = adj_parameters[p, i] + adj_springs[p] * slopes[p, i]

    return SimpleNamespace(meet=meet, adj_meet=adj_meet, loosen=loosen)

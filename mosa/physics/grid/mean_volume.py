"""The change of volume of a neighbourhood in place of each particle's own, against volumetric locking; with its adjoint.

Eight particles a cell that all keep their volume are more conditions than a grid has velocities: what is nearly incompressible
is too stiff then. Here the ratio J of a particle's volume to its rest volume V is averaged over nodes of their own, `SPREAD`
cells apart, with hat functions w,

    q_I = sum_p w_Ip V_p (J_p - 1) / sum_p w_Ip V_p,    Jbar_p = 1 + sum_I w_Ip q_I,

and the stress is that of F_bar = (Jbar/J)^(share/3) F (F-bar: de Souza Neto et al. 1996; averaged over nodes: Zhao, Jiang, Choo
2023). Particle p's share of particle q's volume, times V_p, is what q has of p's, times V_q: at small strain the forces are those
of an energy. F itself keeps the particle's own J.

share: of a solid 1 - `OWN` mu/kappa, at least 0: as much of its bulk modulus as does not lock stays with the particle, so that
compressible bodies are left as they are; of a fluid 1 - `OWN_FLUID`.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from mosa.physics.grid.node_access import Together, exact_node_access, node_access
from mosa.physics.grid.stencil import stencil_functions

SPREAD = 1.5
"""Cells between the nodes of the average."""
OWN = 2.0
"""Shear moduli of bulk modulus that act on the particle's own volume: all of it below nu = 2/7."""
OWN_FLUID = 0.02
"""Share of a fluid's bulk modulus that does: without any, particles in a cell would exchange volume freely."""
J_MIN = wp.constant(wp.float64(0.05))
"""Ratios of volume are held above it, as singular values are in logarithms."""

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_THIRD = wp.constant(wp.float64(1.0 / 3.0))


@wp.func
def cofactor(F: wp.mat33d):
    """dJ/dF."""
    a = wp.vec3d(F[0, 0], F[0, 1], F[0, 2])
    b = wp.vec3d(F[1, 0], F[1, 1], F[1, 2])
    c = wp.vec3d(F[2, 0], F[2, 1], F[2, 2])
    return wp.matrix_from_rows(wp.cross(b, c), wp.cross(c, a), wp.cross(a, b))


@wp.func
def own_ratio(F: wp.mat33d):
    return wp.max(wp.determinant(F), J_MIN)


@cache
def mean_volume_kernels(scalar, slots: int, exact: bool = False) -> SimpleNamespace:
    """Kernels collect, average, adj_average, adj_collect for wp.float32 or wp.float64 fields, see `transfer_kernels`.

    collect: adds (V (J - 1), V) to nodes; average: F -> F_bar; adj_average: adds to the gradients of x, F and parameters, and to
    nodes those of q_I; adj_collect: from there to x and F.
    slots: numbers a law can take per particle; moduli: places of mu, lam, kappa, see `Law.moduli_slots`."""
    vec3 = wp.types.vector(length=3, dtype=scalar)
    vec4 = wp.types.vector(length=4, dtype=scalar)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=scalar)
    numbers = wp.types.vector(length=slots, dtype=scalar)
    adding = exact_node_access(scalar) if exact else node_access(scalar)
    run, add3, load3 = adding.run, adding.add3, node_access(scalar).load3
    added_to = wp.array2d(dtype=wp.int64) if exact else wp.array(dtype=vec4)
    Grids, located = stencil_functions(scalar).Grids, stencil_functions(scalar).located
    # numbers made here: Warp computes those made inside a kernel in float32
    zero, one, two_thirds = scalar(0.0), scalar(1.0), scalar(2.0 / 3.0)
    coarser, own_shear, own_fluid = scalar(1.0 / SPREAD), scalar(OWN), scalar(OWN_FLUID)
    module = f"mosa.physics.{'exact_' if exact else ''}mean_volume_{scalar.__name__}"

    @wp.func
    def lowest(x: vec3, p: int, grids: Grids):
        """(index of the lowest of a particle's 8 nodes, -1 outside of the window; rows along x; along y). A window has room for
        these nodes: it is at least 7 cells wide."""
        n, _base, place = located(x, p, grids)
        low = grids.windows[place]
        dims = grids.windows[place + 1]
        along = int(coarser * scalar(dims[2])) + 3
        across = along * (int(coarser * scalar(dims[1])) + 3)
        if n >= 0:
            y = coarser * grids.inv_dx * x
            i = int(wp.floor(y[0])) - int(wp.floor(coarser * scalar(low[0])))
            j = int(wp.floor(y[1])) - int(wp.floor(coarser * scalar(low[1])))
            k = int(wp.floor(y[2])) - int(wp.floor(coarser * scalar(low[2])))
            n = grids.windows[place + 2][0] + i * across + j * along + k
        return wp.vec3i(n, across, along)

    @wp.func
    def hats(x: vec3, inv_dx: scalar):
        """Distance [nodes] from the lowest node: the weight of the next one."""
        y = coarser * inv_dx * x
        return vec3(y[0] - wp.floor(y[0]), y[1] - wp.floor(y[1]), y[2] - wp.floor(y[2]))

    @wp.func
    def hat(f: scalar, i: int):
        return wp.where(i == 0, one - f, f)

    @wp.func
    def slope(i: int):
        return wp.where(i == 0, -one, one)

    @wp.func
    def node_ratio(sums: vec3):
        """q of a node, 0 where there is nothing."""
        return wp.where(sums[1] > zero, sums[0] / sums[1], zero)

    @wp.func
    def interpolated(nodes: wp.array(dtype=vec4), at: wp.vec3i, f: vec3):
        """(its derivatives with respect to f, sum_I w_Ip q_I) of a particle."""
        q = zero
        gx = zero
        gy = zero
        gz = zero
        for i in range(2):
            for j in range(2):
                row = at[0] + i * at[1] + j * at[2]
                a = node_ratio(load3(nodes, row))
                b = node_ratio(load3(nodes, row + 1))
                flat = (one - f[2]) * a + f[2] * b
                q = q + hat(f[0], i) * hat(f[1], j) * flat
                gx = gx + slope(i) * hat(f[1], j) * flat
                gy = gy + hat(f[0], i) * slope(j) * flat
                gz = gz + hat(f[0], i) * hat(f[1], j) * (b - a)
        return vec4(gx, gy, gz, q)

    @wp.func
    def own_part(parameters: numbers, moduli: wp.vec3i):
        """(1 - share, kappa, whether the share depends on the moduli)."""
        part = vec3(own_fluid, one, zero)
        mu = moduli[0]
        if mu >= 0:
            bulk = zero
            if moduli[2] >= 0:
                bulk = parameters[moduli[2]]
            else:
                bulk = parameters[moduli[1]] + two_thirds * parameters[mu]
            own = own_shear * parameters[mu]
            if own < bulk:
                part = vec3(own / bulk, bulk, one)
            else:
                part = vec3(one, bulk, zero)
        return part

    @wp.func
    def spread(field: added_to, at: wp.vec3i, f: vec3, q: vec3, together: Together):
        none = vec3(zero, zero, zero)
        for i in range(2):
            for j in range(2):
                w = hat(f[0], i) * hat(f[1], j)
                row = at[0] + i * at[1] + j * at[2]
                add3(field, row, w * (one - f[2]) * q, w * f[2] * q, none, together)

    @wp.kernel(module=module, enable_backward=False)
    def collect(
        x: wp.array(dtype=vec3), F: wp.array(dtype=mat33), volume: wp.array(dtype=scalar),
        grids: Grids, nodes: added_to,
    ):  # fmt: skip
        p = wp.tid()
        at = lowest(x[p], p, grids)
        if at[0] < 0:
            return
        V = volume[p]
        q = vec3(V * scalar(own_ratio(wp.mat33d(F[p])) - _ONE), V, zero)
        spread(nodes, at, hats(x[p], grids.inv_dx), q, run(at[0], True))

    @wp.kernel(module=module, enable_backward=False)
    def average(
        x: wp.array(dtype=vec3), F: wp.array(dtype=mat33), parameters: wp.array(dtype=numbers), moduli: wp.vec3i,
        grids: Grids, nodes: wp.array(dtype=vec4), F_bar: wp.array(dtype=mat33),
    ):  # fmt: skip
        p = wp.tid()
        at = lowest(x[p], p, grids)
        if at[0] < 0:
            return
        q = interpolated(nodes, at, hats(x[p], grids.inv_dx))[3]
        Fp = wp.mat33d(F[p])
        own = own_part(parameters[p], moduli)
        exponent = _THIRD * wp.float64(one - own[0])
        F_bar[p] = mat33(wp.pow((_ONE + wp.float64(q)) / own_ratio(Fp), exponent) * Fp)

    @wp.kernel(module=module, enable_backward=False)
    def adj_average(
        x: wp.array(dtype=vec3), F: wp.array(dtype=mat33), parameters: wp.array(dtype=numbers), moduli: wp.vec3i,
        grids: Grids, nodes: wp.array(dtype=vec4), adj_F_bar: wp.array(dtype=mat33),
        adj_x: wp.array(dtype=vec3), adj_F: wp.array(dtype=mat33), adj_parameters: wp.array(dtype=numbers), adj_nodes: added_to,
    ):  # fmt: skip
        p = wp.tid()
        at = lowest(x[p], p, grids)
        if at[0] < 0:
            return
        f = hats(x[p], grids.inv_dx)
        found = interpolated(nodes, at, f)
        Fp = wp.mat33d(F[p])
        A = wp.mat33d(adj_F_bar[p])
        J = own_ratio(Fp)
        mean = _ONE + wp.float64(found[3])
        own = own_part(parameters[p], moduli)
        share = wp.float64(one - own[0])
        factor = wp.pow(mean / J, _THIRD * share)
        # of log(factor)
        seed = factor * wp.ddot(Fp, A)
        B = factor * A
        if wp.determinant(Fp) > J_MIN:
            B = B - (_THIRD * share * seed / J) * cofactor(Fp)
        adj_F[p] = adj_F[p] + mat33(B)
        of_mean = scalar(_THIRD * share * seed / mean)
        adj_x[p] = adj_x[p] + (of_mean * coarser * grids.inv_dx) * vec3(
            found[0], found[1], found[2]
        )
        if own[2] > zero:
            # of own[0] = OWN mu/kappa
            of_own = -scalar(_THIRD * seed * wp.log(mean / J))
            of_bulk = -of_own * own[0] / own[1]
            more = adj_parameters[p]
            mu = moduli[0]
            more[mu] = more[mu] + of_own * own_shear / own[1]
            if moduli[2] >= 0:
                more[moduli[2]] = more[moduli[2]] + of_bulk
            else:
                more[moduli[1]] = more[moduli[1]] + of_bulk
                more[mu] = more[mu] + two_thirds * of_bulk
            adj_parameters[p] = more
        spread(adj_nodes, at, f, vec3(of_mean, zero, zero), run(at[0], True))

    @wp.kernel(module=module, enable_backward=False)
    def adj_collect(
        x: wp.array(dtype=vec3), F: wp.array(dtype=mat33), volume: wp.array(dtype=scalar),
        grids: Grids, nodes: wp.array(dtype=vec4),
        adj_nodes: wp.array(dtype=vec4), adj_x: wp.array(dtype=vec3), adj_F: wp.array(dtype=mat33),
    ):  # fmt: skip
        p = wp.tid()
        at = lowest(x[p], p, grids)
        if at[0] < 0:
            return
        f = hats(x[p], grids.inv_dx)
        V = volume[p]
        Fp = wp.mat33d(F[p])
        change = V * scalar(own_ratio(Fp) - _ONE)
        of_J = zero
        gx = zero
        gy = zero
        gz = zero
        for i in range(2):
            for j in range(2):
                for k in range(2):
                    row = at[0] + i * at[1] + j * at[2] + k
                    sums = load3(nodes, row)
                    g = wp.where(sums[1] > zero, load3(adj_nodes, row)[0] / sums[1], zero)
                    # of the weight w: q_I has w V (J - 1) above its line and w V below
                    e = (change - V * node_ratio(sums)) * g
                    of_J = of_J + hat(f[0], i) * hat(f[1], j) * hat(f[2], k) * g
                    gx = gx + slope(i) * hat(f[1], j) * hat(f[2], k) * e
                    gy = gy + hat(f[0], i) * slope(j) * hat(f[2], k) * e
                    gz = gz + hat(f[0], i) * hat(f[1], j) * slope(k) * e
        adj_x[p] = adj_x[p] + (coarser * grids.inv_dx) * vec3(gx, gy, gz)
        if wp.determinant(Fp) > J_MIN:
            adj_F[p] = adj_F[p] + mat33(wp.float64(V * of_J) * cofactor(Fp))

    return SimpleNamespace(
        collect=collect, average=average, adj_average=adj_average, adj_collect=adj_collect
    )

"""Per-particle kernels of a law: stress, return mapping, and the state an adapter reads. Warp generates their adjoints.

Fields may be float32; everything between load and store is float64 (see `kinematics`).
vech order: xx, yy, zz, yz, zx, xy, plain components.
"""

# (Warp: `int(0)` makes a variable that a dynamic loop or branch may change, and results are unpacked whole)

from functools import cache

import warp as wp

from mosa.physics.constitutive.kinematics import (
    contract,
    hencky_material,
    rotation,
    rotation_of,
    svd,
)
from mosa.physics.constitutive.laws import SLOTS, Law
from mosa.physics.constitutive.particle_access import LANES, particle_access

vec6 = wp.types.vector(length=6, dtype=wp.float64)
MOST = 168
"""Registers of a GPU's thread that takes a polar rotation. The compiler gives it 188, 206 in the adjoint, for a decomposition that
hardly any particle comes to; with fewer, more threads run at once, in 0.76 to 0.80 of the time. The adjoint of an operator
needs all it has."""


ROWS = wp.constant(2**16)
"""Rows of its gradient that particles add to in turns where all share one operator: 12 MB, which a GPU's second cache holds, in
place of as many as there are particles."""


@wp.func
def vech(A: wp.mat33d):
    return vec6(A[0, 0], A[1, 1], A[2, 2], A[1, 2], A[2, 0], A[0, 1])


@wp.func
def unvech(a: vec6):
    return wp.mat33d(a[0], a[5], a[4], a[5], a[1], a[3], a[4], a[3], a[2])


@wp.func
def mandel(A: wp.mat33d):
    """vech in Mandel scaling, in which the double contraction is a dot product."""
    r = wp.sqrt(wp.float64(2.0))
    return vec6(A[0, 0], A[1, 1], A[2, 2], r * A[1, 2], r * A[2, 0], r * A[0, 1])


@wp.func
def unmandel(a: vec6):
    r = wp.sqrt(wp.float64(0.5))
    return wp.mat33d(a[0], r * a[5], r * a[4], r * a[5], a[1], r * a[3], r * a[4], r * a[3], a[2])


@wp.func
def deviator(A: wp.mat33d):
    return A - (wp.trace(A) / wp.float64(3.0)) * wp.identity(n=3, dtype=wp.float64)


@wp.func
def green_strain(F: wp.mat33d):
    """(F^T F - I)/2."""
    return wp.float64(0.5) * (wp.transpose(F) * F - wp.identity(n=3, dtype=wp.float64))


@wp.func
def green_stress(F: wp.mat33d, T: wp.mat33d):
    """Kirchhoff stress F T F^T of T = dpsi/dE, E the strain of Green (Ogden, Non-linear Elastic Deformations, section 4.2)."""
    return F * T * wp.transpose(F)


def field_types(scalar):
    """(mat33, vec6, mat66, parameter vector) of a field precision."""
    return (
        wp.types.matrix(shape=(3, 3), dtype=scalar),
        wp.types.vector(length=6, dtype=scalar),
        wp.types.matrix(shape=(6, 6), dtype=scalar),
        wp.types.vector(length=SLOTS, dtype=scalar),
    )


@cache
def stress_kernel(
    stress, uses_rotation: bool, scalar, adapted: bool, energetic: bool = False, shear: int = 0,
    apart: bool = False,
):  # fmt: skip
    """tau(F) [Pa]; adapted: + R mat(G vech(R^T tau R) + h) R^T with the operator held in the material frame.

    energetic: the operator is then a stiffness in units of 2 mu, G in Mandel scaling, and what is added is the stress of the energy
    mu E : G : E, E Green's strain, to 1 + h[0] times the prior's. shear: place of mu among the law's parameters.
    G and h of one row are those of all particles, which add to `ROWS` rows of their gradients in turns; apart: each to its own, so
    that sums do not depend on who comes first.
    block: (LANES,) room for the rotations of a few particles, None to find each by itself."""
    field33, field6, field66, fieldp = field_types(scalar)
    energetic = adapted and energetic
    own = particle_access(scalar, SLOTS)
    needs_rotation = uses_rotation or (adapted and not energetic)

    @wp.kernel(module="unique", cuda_max_registers=MOST if needs_rotation and not adapted else None)
    def stress_of_particles(
        F: wp.array(dtype=field33), C_affine: wp.array(dtype=field33), parameters: wp.array(dtype=fieldp),
        G: wp.array(dtype=field66), h: wp.array(dtype=field6), tau: wp.array(dtype=field33),
        block: wp.array(dtype=wp.mat33d),
    ):  # fmt: skip
        i = wp.tid()
        place = wp.min(i, G.shape[0] - 1)
        row = i
        if wp.static(not apart):
            row = wp.where(G.shape[0] == 1, i % ROWS, i)
        Fi = own.matrix33(F, i)
        R = Fi
        if wp.static(needs_rotation):
            if own.turned(F, i, block):
                R = block[i % LANES]
            else:
                R = rotation_of(Fi)
            R = rotation(Fi, R)
        p = own.parameters(parameters, i)
        T = stress(Fi, R, own.matrix33(C_affine, i), p)
        if wp.static(energetic):
            modulus = wp.float64(2.0) * p[wp.static(shear)]
            T = (wp.float64(1.0) + own.vector6(h, row, place)[0]) * T
            E = mandel(green_strain(Fi))
            T = T + green_stress(Fi, unmandel(modulus * own.times66(G, row, place, E)))
        elif wp.static(adapted):
            s = vech(wp.transpose(R) * T * R)
            T = T + R * unvech(
                own.times66(G, row, place, s) + own.vector6(h, row, place)
            ) * wp.transpose(R)
        tau[i] = field33(T)

    return stress_of_particles


@cache
def return_kernel(return_map, scalar, adapted: bool):
    """F of the next substep: the return mapping of (I + dt C_affine) F.

    adapted: |E'| of the yield function is that of dev(mat((I + G) vech(E) + h)), E = dev(log W) of the trial."""
    field33, field6, field66, fieldp = field_types(scalar)
    own = particle_access(scalar, SLOTS)

    @wp.kernel(module="unique")
    def mapped_gradient(
        F: wp.array(dtype=field33), C_affine: wp.array(dtype=field33), parameters: wp.array(dtype=fieldp),
        G: wp.array(dtype=field66), h: wp.array(dtype=field6), dt: wp.float64, norm_eps: wp.float64, rebuild: int,
        F_new: wp.array(dtype=field33),
    ):  # fmt: skip
        i = wp.tid()
        Fi = own.matrix33(F, i)
        Ci = own.matrix33(C_affine, i)
        trial = Fi + dt * (Ci * Fi)
        U, S, V = svd(trial)
        R = rotation(trial, U * wp.transpose(V))
        H = hencky_material(trial, U, S, V)
        E = deviator(H)
        if wp.static(adapted):
            # as an increment, so that a zero operator leaves the plain map bit for bit
            E = E + deviator(unvech(own.times66(G, i, i, vech(E)) + own.vector6(h, i, i)))
        mapped, yielded = return_map(
            trial, Fi, Ci, R, U, S, V, H, wp.ddot(E, E), norm_eps, own.parameters(parameters, i), dt
        )
        if yielded == 0 and rebuild == 1:
            mapped = contract(trial, U, S, V, wp.float64(1.0))
        F_new[i] = field33(mapped)

    return mapped_gradient


@cache
def state_kernel(stress, uses_rotation: bool, scalar, plastic: bool):
    """w = vech(W - I), s = vech(R^T tau R) [Pa] of the prior, e = vech(dev log W) if plastic."""
    field33, field6, _, fieldp = field_types(scalar)
    own = particle_access(scalar, SLOTS)

    @wp.kernel(module="unique")
    def material_state(
        F: wp.array(dtype=field33), C_affine: wp.array(dtype=field33), parameters: wp.array(dtype=fieldp),
        w: wp.array(dtype=field6), s: wp.array(dtype=field6), e: wp.array(dtype=field6),
    ):  # fmt: skip
        i = wp.tid()
        Fi = own.matrix33(F, i)
        R = rotation(Fi, rotation_of(Fi))
        T = stress(Fi, R, own.matrix33(C_affine, i), own.parameters(parameters, i))
        Rt = wp.transpose(R)
        w[i] = field6(vech(Rt * Fi - wp.identity(n=3, dtype=wp.float64)))
        s[i] = field6(vech(Rt * T * R))
        if wp.static(plastic):
            U, S, V = svd(Fi)
            e[i] = field6(vech(deviator(hencky_material(Fi, U, S, V))))

    return material_state


def kernels_of(
    law: Law, scalar, adapted: bool, plastic_adapted: bool, energetic: bool = False, apart: bool = False
):  # fmt: skip
    """(stress kernel, return-mapping kernel or None) of a law. energetic, apart: as `stress_kernel`."""
    shear = law.offsets["mu"] if adapted and energetic else 0
    stress = stress_kernel(
        law.stress, law.uses_rotation, scalar, adapted, adapted and energetic, shear, adapted and apart
    )  # fmt: skip
    return stress, return_kernel(law.return_map, scalar, plastic_adapted) if law.plastic else None

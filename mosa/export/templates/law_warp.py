"""Law "@LAW@" for Warp, written by MoSA: kirchhoff_stress(F) [Pa] in float64, SI units. For forward use; det F > 0."""

import warp as wp

@CONSTANTS@


@wp.func
def kirchhoff_stress(F: wp.mat33d):
    C = wp.transpose(F) * F
    C11 = C[0, 0]
    C22 = C[1, 1]
    C33 = C[2, 2]
    C23 = C[1, 2]
    C13 = C[0, 2]
    C12 = C[0, 1]
    U, S, V = wp.svd3(F)
    l1 = S[0]
    l2 = S[1]
    l3 = S[2]
    @LINES@
    tau = F * wp.mat33d(S11, S12, S13, S12, S22, S23, S13, S23, S33) * wp.transpose(F)
    return tau + U * wp.diag(wp.vec3d(s1 * l1 * l1, s2 * l2 * l2, s3 * l3 * l3)) * wp.transpose(U)

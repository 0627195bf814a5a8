"""Material axes of the anisotropic truth laws: a rotation per particle in three numbers."""

import warp as wp

_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_ZERO = wp.constant(wp.float64(0.0))


@wp.func
def axes_rotation(r: wp.vec3d):
    """Q = I + 2 ([r]_x + [r]_x^2)/(1 + |r|^2), r = tan(angle/2) times the axis (Cayley): its columns are the material axes."""
    K = wp.mat33d(_ZERO, -r[2], r[1], r[2], _ZERO, -r[0], -r[1], r[0], _ZERO)
    return wp.identity(n=3, dtype=wp.float64) + (_TWO / (_ONE + wp.dot(r, r))) * (K + K * K)

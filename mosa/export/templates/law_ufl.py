"""Law "@LAW@" for FEniCSx, written by MoSA: psi = energy(F) [J/m^3] per rest volume, SI units.

u = fem.Function(V); F = ufl.Identity(3) + ufl.grad(u); residual = ufl.derivative(energy(F) * ufl.dx, u, v)
"""

import itertools
import math

import ufl

PARAMETERS = {
@VALUES@
}


def stretches(C):
    """Principal stretches by the closed form; the discriminant is a sum of squares (Cauchy-Binet), which keeps its digits where two
    stretches are close. Its derivative is singular where two are equal: start from a state that is not undeformed exactly."""
    m = (C[0, 0] + C[1, 1] + C[2, 2]) / 3
    K = [[C[i, j] - (m if i == j else 0) for j in range(3)] for i in range(3)]
    K2 = [[sum(K[i][k] * K[k][j] for k in range(3)) for j in range(3)] for i in range(3)]
    places = [(0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)]
    scale = [1, 1, 1] + 3 * [math.sqrt(2)]
    rows = [(int(i == j), s * K[i][j], s * K2[i][j]) for (i, j), s in zip(places, scale)]
    minors = [
        a[0] * (b[1] * c[2] - b[2] * c[1]) + b[0] * (a[2] * c[1] - a[1] * c[2]) + c[0] * (a[1] * b[2] - a[2] * b[1])
        for a, b, c in itertools.combinations(rows, 3)
    ]
    discriminant = sum(minor * minor for minor in minors)
    p = (K2[0][0] + K2[1][1] + K2[2][2]) / 6
    q = (K[0][0] * K2[0][0] + K[1][1] * K2[1][1] + K[2][2] * K2[2][2]
         + 2 * (K[0][1] * K2[0][1] + K[0][2] * K2[0][2] + K[1][2] * K2[1][2])) / 6
    angle = ufl.atan2(ufl.sqrt(discriminant / 108), q) / 3
    return [ufl.sqrt(m + 2 * ufl.sqrt(p) * ufl.cos(angle + 2 * math.pi * k / 3)) for k in range(3)]


def energy(F, parameters=PARAMETERS):
    C = ufl.dot(ufl.transpose(F), F)
    C11, C22, C33, C23, C13, C12 = C[0, 0], C[1, 1], C[2, 2], C[1, 2], C[0, 2], C[0, 1]
    @STRETCHED@
    @NAMES@
    @LINES@
    return psi

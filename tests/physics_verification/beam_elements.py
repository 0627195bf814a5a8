"""Sag and first frequency of the beam of docs/beam.md by finite elements, linear, clamped at x = 0.

python tests/physics_verification/beam_elements.py E [Pa] nu [load at the end, kg]

An independent program: scikit-fem (`pip install scikit-fem`), hexahedra with 27 nodes, 16 along the
beam and 8 across, graded towards the clamp and the surface.
"""

from __future__ import annotations

import sys

import numpy as np
from scipy.sparse.linalg import eigsh
from skfem import (
    Basis,
    BilinearForm,
    ElementHex2,
    ElementVector,
    FacetBasis,
    LinearForm,
    MeshHex,
    condense,
    solve,
)
from skfem.helpers import dot
from skfem.models.elasticity import lame_parameters, linear_elasticity

LENGTH, SIDE, DENSITY, GRAVITY = 0.1, 0.03, 1070.0, 9.807


def beam(E: float, nu: float, load: float = 0.0, along: int = 16, across: int = 8):
    """(sag of the end's centre [m], first frequency [Hz])."""
    x = LENGTH * np.linspace(0, 1, along + 1) ** 1.7
    y = 0.5 * SIDE * np.sin(np.linspace(-np.pi / 2, np.pi / 2, across + 1))
    mesh = MeshHex.init_tensor(x, y, y)
    basis = Basis(mesh, ElementVector(ElementHex2()), intorder=4)
    end = FacetBasis(
        mesh, basis.elem, facets=mesh.facets_satisfying(lambda x: np.isclose(x[0], LENGTH))
    )
    inertia = BilinearForm(lambda u, v, w: dot(u, v))
    weight = LinearForm(lambda v, w: -GRAVITY * v[1])
    per_area = load / SIDE**2
    K = linear_elasticity(*lame_parameters(E, nu)).assemble(basis)
    M = DENSITY * inertia.assemble(basis) + per_area * inertia.assemble(end)
    f = DENSITY * weight.assemble(basis) + per_area * weight.assemble(end)
    held = basis.get_dofs(lambda x: np.isclose(x[0], 0)).all()
    u = solve(*condense(K, f, D=held))
    tip = basis.get_dofs(lambda x: np.isclose(x[0], LENGTH)).all(["u^2"])
    centre = tip[np.hypot(*basis.doflocs[1:, tip]).argmin()]
    free = np.setdiff1d(np.arange(len(u)), held)
    lowest = eigsh(K[free][:, free].tocsc(), k=1, M=M[free][:, free].tocsc(), sigma=0)[0][0]
    return -u[centre], np.sqrt(lowest) / (2 * np.pi)


if __name__ == "__main__":
    sag, frequency = beam(*map(float, sys.argv[1:4]))
    print(f"sag {1e3 * sag:.3f} mm, frequency {frequency:.3f} Hz")

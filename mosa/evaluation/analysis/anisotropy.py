"""Directions of a learned law: its redistribution w(n) and its directional modulus E(n) (paper, appendix A).

Everything is in the material frame and in Mandel scaling, where the double contraction of symmetric tensors is a dot
product; in plain 6-vectors even an isotropic law would look anisotropic."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from mosa.errors import ConfigError, SimulationDiverged
from mosa.modules.adapters.base import Adapter
from mosa.modules.adapters.microplane import MANDEL, PAIRS
from mosa.physics.adapters.interface import MaterialState

States = Callable[[Tensor], MaterialState]
"""From F (M, 3, 3) float64 to what an adapter reads there: `mosa.modules.body.material.material_states`."""

_PLACES = [[0, 5, 4], [5, 1, 3], [4, 3, 2]]


def mandel_scale(like: Tensor) -> Tensor:
    """(6,) factors of vech components; not by way of single precision, which would leave 2e-8 in everything."""
    return torch.tensor(MANDEL, dtype=like.dtype, device=like.device)


def mandel(vech: Tensor) -> Tensor:
    """(..., 6) in Mandel scaling from vech components xx, yy, zz, yz, zx, xy."""
    return vech * mandel_scale(vech)


def mandel_matrix(operator: Tensor) -> Tensor:
    """(..., 6, 6) operator on Mandel vectors from one on vech components."""
    scale = mandel_scale(operator)
    return scale[:, None] * operator / scale


def dyads(directions: Tensor) -> Tensor:
    """(K, 6) n n^T in Mandel scaling of unit vectors (K, 3)."""
    n = directions
    return mandel(torch.stack([n[:, i] * n[:, j] for i, j in PAIRS], -1))


def directions_in_plane(
    first: Sequence[float], second: Sequence[float], count: int = 37
) -> tuple[Tensor, Tensor]:
    """(angles (K,) [rad] from 0 to pi, unit vectors (K, 3)) from `first` towards `second`, orthogonalised. float64."""
    a, b = (torch.tensor(v, dtype=torch.float64) for v in (first, second))
    b = b - (b @ a) / (a @ a) * a
    if not (float(a.norm()) > 0 and float(b.norm()) > 1e-9):
        found = f"{list(first)} and {list(second)}"
        raise ConfigError(f"plane: expected two directions that differ, found {found}")
    angles = torch.linspace(0, math.pi, count, dtype=torch.float64)
    cosine, sine = torch.cos(angles)[:, None], torch.sin(angles)[:, None]
    return angles, cosine * a / a.norm() + sine * b / b.norm()


def golden_turns(count: int) -> Tensor:
    """(K,) angles [rad] of points of a spiral that turn by the golden angle, one after the other, and so are spread evenly.
    float64."""
    return torch.arange(count, dtype=torch.float64) * math.pi * (3 - 5**0.5)


def directions_on_sphere(count: int = 200) -> Tensor:
    """(K, 3) unit vectors spread over the half sphere z >= 0 (spiral of the golden angle). float64."""
    z = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    turn = golden_turns(count)
    r = torch.sqrt(1 - z**2)
    return torch.stack([r * torch.cos(turn), r * torch.sin(turn), z], -1)


def stress_jacobian(adapter: Adapter, w: Tensor, s: Tensor) -> Tensor:
    """d tau_hat/d tau_iso at held stretch, (N, 6, 6) on vech components, I where the law is the prior.

    w, s: (N, 6) dimensionless states vech(W - I) and vech(R^T tau R)/E_ref. The networks' dependence on the stress is included."""
    adapter = adapter.in_double()
    s = s.detach().double().cpu().requires_grad_(True)
    with torch.enable_grad():
        d = adapter.increment(w.detach().double().cpu(), s)
        # rows of different particles are independent: one backward pass per component serves all of them
        rows = [torch.autograd.grad(d[:, i].sum(), s, retain_graph=True)[0] for i in range(6)]
    return torch.stack(rows, 1) + torch.eye(6, dtype=torch.float64)


def redistribution_response(jacobian: Tensor, directions: Tensor) -> Tensor:
    """w(n) = |(d tau_hat/d tau_iso - I) : n n^T| (..., K) of (..., 6, 6) on vech components; 0 for the prior alone.

    directions: (K, 3) unit vectors. The paper's formula lacks the - I, with which its text ('near zero') fits."""
    change = mandel_matrix(jacobian) - torch.eye(6).to(jacobian)
    return (change @ dyads(directions).to(jacobian).T).norm(dim=-2)


def response_of(states: States, adapter: Adapter | None) -> Callable[[Tensor], Tensor]:
    """Corrected stress (M, 6) [Pa] as a function of the Hencky strain (M, 6): both Mandel, in the material frame.

    Errors: ConfigError for the default adapter, whose operator is a stiffness."""
    if adapter is not None and adapter.energetic:
        raise ConfigError(
            "anisotropy: expected an adapter whose operator acts on the prior's stress; a stiffness has its in "
            "mosa.evaluation.analysis.stiffness"
        )
    adapter = None if adapter is None else adapter.in_double()

    def response(strain: Tensor) -> Tensor:
        plain = strain / mandel_scale(strain)
        W = torch.matrix_exp(plain[:, _PLACES])
        state = states(W)
        stress = state.stress
        if adapter is not None:
            answer = adapter(state)
            stress = stress + (answer.G @ stress[..., None])[..., 0] + answer.h
        return mandel(stress)

    return response


def uniaxial_stress(
    response: Callable[[Tensor], Tensor], directions: Tensor, strain: float, iterations: int = 20
) -> Tensor:
    """Axial stress (K,) [Pa] at Hencky strain `strain` along each of (K, 3), all other stress components zero.

    Newton's method on the strain and the axial stress. Errors: SimulationDiverged naming the direction without an equilibrium."""
    N = dyads(directions).double()
    K = len(N)
    H, axial = strain * N, torch.zeros(K, dtype=torch.float64)
    for _ in range(iterations):
        H = H.detach().requires_grad_(True)
        with torch.enable_grad():
            stress = response(H)
            sums = (stress[:, i].sum() for i in range(6))
            rows = [torch.autograd.grad(each, H, retain_graph=True)[0] for each in sums]
            tangent = torch.stack(rows, 1)
        off_strain = ((N * H).sum(-1) - strain)[:, None]
        residual = torch.cat([stress - axial[:, None] * N, off_strain], -1).detach()
        matrix = torch.zeros(K, 7, 7, dtype=torch.float64)
        matrix[:, :6, :6], matrix[:, :6, 6], matrix[:, 6, :6] = tangent, -N, N
        # in units of the stiffness, or the strain equation would drown in the stress equations
        unit = tangent.abs().amax((1, 2)).clamp(min=1e-30)
        matrix[:, :6, :6] /= unit[:, None, None]
        residual[:, :6] /= unit[:, None]
        step, singular = torch.linalg.solve_ex(matrix, residual[..., None])
        H, axial = H.detach() - step[:, :6, 0], axial - unit * step[:, 6, 0]
        off = residual.abs().amax(-1)
        if bool((singular == 0).all()) and float(off.max()) < 1e-10 * abs(strain):
            return axial
    worst = int(torch.where(torch.isfinite(off), off, torch.full_like(off, torch.inf)).argmax())
    raise SimulationDiverged(
        f"uniaxial stretch: no equilibrium at strain {strain:g} along direction {worst} {directions[worst].tolist()}: "
        "the learned law has lost its stiffness there"
    )


def directional_modulus(
    states: States, adapter: Adapter | None, directions: Tensor, strain: float = 5e-3
) -> Tensor:
    """E(n) (K,) [Pa] along (K, 3): central difference of the uniaxial stress at +-strain, lateral stress free.

    states: of the prior at its global parameters; adapter: None for the prior alone, whose E(n) is Young's modulus."""
    response = response_of(states, adapter)
    tension, compression = (uniaxial_stress(response, directions, e) for e in (strain, -strain))
    return (tension - compression) / (2 * strain)


def directions_about(axis: Tensor, radius: float, count: int) -> Tensor:
    """(K, 3) unit vectors spread over the cap of `radius` [rad] about a unit vector (3,), itself the first (spiral of the golden
    angle). float64."""
    turn = golden_turns(count)
    off = math.tan(radius) * torch.linspace(0, 1, count, dtype=torch.float64).sqrt()
    across = torch.linalg.svd(axis.double()[None]).Vh[1:]
    beside = off[:, None] * torch.stack([turn.cos(), turn.sin()], -1) @ across
    return torch.nn.functional.normalize(axis.double() + beside, dim=-1)


def stiffest_axis(states: States, adapter: Adapter | None) -> tuple[Tensor, float]:
    """(unit vector (3,) of the largest E(n), E_max/E_min) over a half sphere of 200 directions, and as
    many about the best of them, which are within 1.2 degrees of it: the half sphere's alone, within 8."""
    directions = directions_on_sphere()
    modulus = directional_modulus(states, adapter, directions)
    beyond_neighbours = math.sqrt(4 * math.pi / len(directions))
    best = directions[int(modulus.argmax())]
    nearby = directions_about(best, beyond_neighbours, len(directions))
    closer = directional_modulus(states, adapter, nearby)
    both = torch.cat([modulus, closer])
    return nearby[int(closer.argmax())], float(both.max() / both.min())

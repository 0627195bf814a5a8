"""Pure torch float64 twin of the simulator: slow and obvious, for tests. Same state convention as `rollout`.

Plain autograd goes through all of it: the rotation by unrolled Newton steps, Hencky strains by an eigendecomposition (whose
backward pass is only right where the singular values differ).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from mosa.errors import ConfigError
from mosa.physics.adapters.interface import AdapterOperator
from mosa.physics.constitutive.laws import law_named
from mosa.physics.contact.planes import SLOW, THICKNESS, TOUCHING, WHOLE, Plane
from mosa.physics.contact.touch import GRIP, springs
from mosa.physics.engine.simulator import Simulator
from mosa.types import ParticleState

EYE = torch.eye(3, dtype=torch.float64)
VECH = ((0, 0), (1, 1), (2, 2), (1, 2), (2, 0), (0, 1))


def vech(A: Tensor) -> Tensor:
    """(N, 6) entries xx, yy, zz, yz, zx, xy of (N, 3, 3)."""
    return torch.stack([A[:, i, j] for i, j in VECH], 1)


def unvech(a: Tensor) -> Tensor:
    """Symmetric (N, 3, 3) of (N, 6)."""
    rows = [[0, 5, 4], [5, 1, 3], [4, 3, 2]]
    return torch.stack([torch.stack([a[:, k] for k in row], 1) for row in rows], 1)


def deviator(A: Tensor) -> Tensor:
    return A - trace(A)[:, None, None] / 3 * EYE


def trace(A: Tensor) -> Tensor:
    return A.diagonal(dim1=-2, dim2=-1).sum(-1)


def polar(F: Tensor, steps: int = 30) -> Tensor:
    """Rotation of F (N, 3, 3) with det F > 0: Newton's iteration."""
    X = F
    for _ in range(steps):
        X = 0.5 * (X + torch.linalg.inv(X).mT)
    return X


def hencky_material(F: Tensor) -> Tensor:
    """log W (N, 3, 3), singular values clamped at 0.05; det F > 0."""
    values, V = torch.linalg.eigh(F.mT @ F)
    return V @ torch.diag_embed(torch.log(values.clamp_min(0.05**2)) / 2) @ V.mT


RATED = ("herschel_bulkley", "herschel_bulkley_hencky")
"""Laws in mu and kappa that flow at a rate; with `newtonian` those of `viscosity`."""


def stress(law: str, F: Tensor, p: dict[str, Tensor], C_affine: Tensor | None = None) -> Tensor:
    """Kirchhoff stress (N, 3, 3) [Pa]; p: (N,) or () tensors, `reference` (N, 3, 3) for `linear`; C_affine: for `newtonian`."""
    J = torch.linalg.det(F)[:, None, None]
    mu, lam, kappa = (
        torch.as_tensor(p.get(k, 0.0), dtype=torch.float64).expand(len(F))[:, None, None]
        for k in ("mu", "lam", "kappa")
    )
    if law == "newtonian":
        return kappa * (J - J**-6) * EYE + mu * J * 0.5 * (C_affine + C_affine.mT)
    if law == "herschel_bulkley":
        return 0.5 * kappa * (J**2 - 1) * EYE + mu * deviator(J ** (-2 / 3) * F @ F.mT)
    if law == "neo_hookean":
        return mu * (F @ F.mT - EYE) + lam * torch.log(J) * EYE
    if law == "linear":
        G = F @ p["reference"].mT
        P = mu * (G + G.mT - 2 * EYE) + lam * (trace(G) - 3)[:, None, None] * EYE
        return 0.5 * (P @ G.mT + G @ P.mT)
    R = polar(F)
    if law == "corotated":
        return 2 * mu * (F - R) @ F.mT + lam * (J - 1) * J * EYE
    if law == "herschel_bulkley_hencky":
        lam = kappa - 2 * mu / 3
    if law in ("stvk", "stvk_paper", "von_mises", "drucker_prager", "herschel_bulkley_hencky"):
        H = hencky_material(F)
        T = R @ (2 * mu * H + lam * trace(H)[:, None, None] * EYE) @ R.mT
        return T @ R @ F.mT if law == "stvk_paper" else T
    raise ConfigError(f"reference law: found {law!r}, which the torch twin does not have")


def return_map(law: str, F: Tensor, p: dict[str, Tensor], operator=None, norm_eps: float = 0.0, before: Tensor | None = None,
               C_affine: Tensor | None = None, dt: float = 0.0) -> Tensor:  # fmt: skip
    """Mapped F (N, 3, 3) of a trial F = (I + dt C_affine) before; operator: (plastic_G, plastic_h) or None."""
    if law == "newtonian":
        J = ((1 + dt * trace(C_affine)) * torch.linalg.det(before)).clamp_min(0.05)
        return J[:, None, None] ** (1 / 3) * polar(
            (EYE + 0.5 * dt * (C_affine - C_affine.mT)) @ before
        )
    if law not in ("von_mises", "drucker_prager", *RATED):
        return F
    p = {k: torch.as_tensor(v, dtype=torch.float64).expand(len(F)) for k, v in p.items()}
    H = hencky_material(F)
    E = deviator(H)
    corrected = E
    if operator is not None:
        e = vech(E)
        corrected = deviator(unvech(e + (operator[0] @ e[..., None])[..., 0] + operator[1]))
    if law in RATED:
        return _rated_return(law, F, p, H, (corrected**2).sum((1, 2)), norm_eps, dt)
    n = torch.sqrt((corrected**2).sum((1, 2)) + norm_eps + 1e-300)
    if law == "von_mises":
        dgamma = n - p["yield_stress"] / (2 * p["mu"])
        tip = torch.zeros(len(F), dtype=torch.bool)
    else:
        t = trace(H) - 3 * p["cohesion"]
        dgamma = n + p["friction_alpha"] * (3 * p["lam"] + 2 * p["mu"]) / (2 * p["mu"]) * t
        tip = t >= 0
    keep = (1 - dgamma / n).clamp_min(0)
    R = polar(F)
    flowed = R @ torch.linalg.matrix_exp(
        keep[:, None, None] * E + trace(H)[:, None, None] / 3 * EYE
    )
    mapped = torch.where((dgamma > 0)[:, None, None], flowed, F)
    if law == "drucker_prager":
        mapped = torch.where(
            tip[:, None, None], torch.exp(p["cohesion"])[:, None, None] * R, mapped
        )
    return mapped


def _rated_return(
    law: str, F: Tensor, p: dict[str, Tensor], H: Tensor, n2: Tensor, norm_eps: float, dt: float
) -> Tensor:
    """Herschel-Bulkley: |s| = |s_trial| - y/(1 + viscosity/(2 mu' dt)) where y = |s_trial| - sqrt(2/3) yield_stress > 0."""
    b = F @ F.mT
    J = torch.linalg.det(F)[:, None, None]
    if law == "herschel_bulkley":
        d = deviator(J ** (-2 / 3) * b)
        measure = (d**2).sum((1, 2)).sqrt() + 2 * (
            n2.sqrt() - (deviator(H) ** 2).sum((1, 2)).sqrt()
        )
        n = torch.sqrt((p["mu"] * measure) ** 2 + norm_eps)
        modulus = p["mu"]
    else:
        n = torch.sqrt(4 * p["mu"] ** 2 * n2 + norm_eps)
        modulus = p["mu"] * trace(b) / 3
    y = n - (2 / 3) ** 0.5 * p["yield_stress"]
    c = (1 - y / n / (1 + p["viscosity"] / (2 * modulus * dt)))[:, None, None]
    R = polar(F)
    if law == "herschel_bulkley_hencky":
        flowed = R @ torch.linalg.matrix_exp(c * deviator(H) + trace(H)[:, None, None] / 3 * EYE)
    else:
        # c F^T F + a I with the determinant of F^T F: a by bisection, then Newton steps that carry its derivative
        square, V = torch.linalg.eigh(F.mT @ F)
        known, weight = square.detach(), c[:, 0].detach()
        low, high = -weight[:, 0] * known[:, 0], known[:, 2]
        for _ in range(100):
            middle = 0.5 * (low + high)
            below = (weight * known + middle[:, None]).prod(1) < known.prod(1)
            low, high = torch.where(below, middle, low), torch.where(below, high, middle)
        a = 0.5 * (low + high)
        for _ in range(2):
            q = c[:, 0] * square + a[:, None]
            a = a - (torch.log(q) - torch.log(square)).sum(1) / (1 / q).sum(1)
        flowed = R @ V @ torch.diag_embed(torch.sqrt(c[:, 0] * square + a[:, None])) @ V.mT
    return torch.where((y > 0)[:, None, None], flowed, F)


def adapted_stress(
    law: str, F: Tensor, p: dict[str, Tensor], operator=None, C_affine: Tensor | None = None
) -> Tensor:
    """tau + R mat(G vech(R^T tau R) + h) R^T; operator: (G, h) or None."""
    tau = stress(law, F, p, C_affine)
    if operator is None:
        return tau
    R = polar(F)
    s = vech(R.mT @ tau @ R)
    return tau + R @ unvech((operator[0] @ s[..., None])[..., 0] + operator[1]) @ R.mT


def stiffness_energy(F: Tensor, mu: Tensor, S: Tensor) -> Tensor:
    """mu E : S : E (N,) of Green's strain E of F (N, 3, 3); S: (N, 6, 6) on Mandel components, mu: (N,) or ()."""
    e = vech(0.5 * (F.mT @ F - EYE)) * torch.tensor(
        [1.0, 1, 1, 2**0.5, 2**0.5, 2**0.5], dtype=torch.float64
    )
    return mu * torch.einsum("ni,nij,nj->n", e, S, e)


def stiffened_stress(law: str, F: Tensor, p: dict[str, Tensor], S: Tensor) -> Tensor:
    """The law's Kirchhoff stress and (dpsi/dF) F^T of `stiffness_energy`; F (N, 3, 3)."""
    F = F if F.requires_grad else F.clone().requires_grad_()
    energy = stiffness_energy(F, p["mu"], S).sum()
    return stress(law, F, p) + torch.autograd.grad(energy, F, create_graph=True)[0] @ F.mT


def meet(
    x: Tensor, v: Tensor, planes: Sequence[Plane], volume: Tensor, spring: Tensor, dt: float
) -> Tensor:
    """Particle velocities (N, 3) [m/s] after the planes of mode `touch`. x: (N, 3) [m]; volume [m^3] and spring [1/s^2]: (N,)."""
    for plane in planes:
        if plane.mode != "touch":
            continue
        n = torch.tensor(plane.normal, dtype=torch.float64)
        n = n / n.norm()
        depth = 0.5 * volume.pow(1 / 3) - (x - torch.tensor(plane.point, dtype=torch.float64)) @ n
        push = dt * spring * depth.clamp_min(0)
        sliding = v - (v @ n)[:, None] * n
        length = sliding.norm(dim=1)
        lost = (
            plane.friction * push / torch.where(length > 0, length, torch.ones_like(length))
        ).clamp_max(GRIP)
        v = v + push[:, None] * n - lost[:, None] * sliding
    return v


def fade(phi: Tensor, thickness: float) -> Tensor:
    """Weight of the contact of nodes at distances phi (M,) [m]: 1 up to `WHOLE` of the thickness, then a smooth step to 0."""
    if thickness == 0:
        return (phi <= TOUCHING).to(phi)
    s = ((phi / thickness - WHOLE) / (1 - WHOLE)).clamp(0, 1)
    return torch.where(phi <= TOUCHING, torch.ones_like(phi), (1 - s) ** 2 * (1 + 2 * s))


def collide(v: Tensor, y: Tensor, planes: Sequence[Plane], dx: float) -> Tensor:
    """Node velocities (M, 3) after contact; y: (M, 3) node positions [m]."""
    for plane in planes:
        if plane.mode == "touch":
            continue
        n = torch.tensor(plane.normal, dtype=torch.float64)
        n = n / n.norm()
        thickness = (
            plane.thickness
            if plane.thickness is not None
            else THICKNESS * dx * (plane.friction > 0)
        )
        phi, un = (y - torch.tensor(plane.point, dtype=torch.float64)) @ n, v @ n
        w = fade(phi, thickness) * torch.where(
            phi > TOUCHING, 1 / (1 + (un / SLOW) ** 2), torch.ones_like(un)
        )
        tangential = v - un[:, None] * n
        if plane.mode == "sticky":
            after = torch.zeros_like(v)
        elif plane.mode == "slip":
            after = tangential
        else:
            length = tangential.norm(dim=1)
            keep = (length + plane.friction * un).clamp_min(0) / torch.where(
                length > 0, length, torch.ones_like(length)
            )
            sliding = keep[:, None] * tangential if plane.friction > 0 else tangential
            after = torch.where((un < 0)[:, None], sliding, v)
        v = v + w[:, None] * (after - v)
    return v


def substep(law: str, state: ParticleState, p: dict[str, Tensor], volume: Tensor, density: float, *, dx: float, dt: float,
            gravity: Sequence[float], planes: Sequence[Plane] = (), operator=None, plastic_operator=None, norm_eps: float = 0.0,
            cutoff: float = 0.0) -> ParticleState:  # fmt: skip
    """One substep of `rollout`'s algorithm."""
    x, v, C, F = state.x, state.v, state.C_affine, state.F
    tau = adapted_stress(law, F, p, operator, C)
    mass = density * volume
    v = meet(x, v, planes, volume, springs(law_named(law).wave_modulus(p), mass, volume, dx), dt)
    base = torch.floor(x.detach() / dx - 0.5)
    f = x / dx - base
    weights = torch.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2])
    low = base.amin(0).long()
    size = (base.amax(0).long() - low + 3).tolist()
    B = mass[:, None, None] * C - dt * volume[:, None, None] * 4 / dx**2 * tau
    nodes = size[0] * size[1] * size[2]
    momentum, node_mass = torch.zeros(nodes, 3).double(), torch.zeros(nodes).double()
    stencil = []
    for i in range(3):
        for j in range(3):
            for k in range(3):
                node = base.long() + torch.tensor([i, j, k])
                w = weights[i, :, 0] * weights[j, :, 1] * weights[k, :, 2]
                arm = node.double() * dx - x
                local = node - low
                index = (local[:, 0] * size[1] + local[:, 1]) * size[2] + local[:, 2]
                stencil.append((index, w, arm))
                momentum = momentum.index_add(
                    0, index, w[:, None] * (mass[:, None] * v + (B @ arm[..., None])[..., 0])
                )
                node_mass = node_mass.index_add(0, index, w * mass)
    occupied = node_mass > cutoff
    grid_v = momentum / torch.where(occupied, node_mass, torch.ones_like(node_mass))[:, None]
    grid_v = grid_v + dt * torch.as_tensor(gravity, dtype=torch.float64)
    axes = torch.meshgrid(*(torch.arange(s) for s in size), indexing="ij")
    y = dx * (torch.stack(axes, -1).reshape(-1, 3) + low).double()
    grid_v = torch.where(
        occupied[:, None], collide(grid_v, y, planes, dx), torch.zeros_like(grid_v)
    )
    new_v, new_C = torch.zeros_like(v), torch.zeros_like(C)
    for index, w, arm in stencil:
        u = w[:, None] * grid_v[index]
        new_v = new_v + u
        new_C = new_C + 4 / dx**2 * u[:, :, None] * arm[:, None, :]
    trial = F + dt * new_C @ F
    total = state.F_tot + dt * new_C @ state.F_tot
    mapped = return_map(law, trial, p, plastic_operator, norm_eps, F, new_C, dt)
    return ParticleState(x + dt * new_v, new_v, new_C, mapped, mapped if mapped is trial else total)


def drawn_operator(n, seed=3, scale=0.1):
    """What an adapter could answer for n particles, elastic and plastic."""
    g = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return scale * torch.randn(*shape, generator=g, dtype=torch.float64)

    return AdapterOperator(draw(n, 6, 6), 1e3 * draw(n, 6), draw(n, 6, 6), 0.01 * draw(n, 6))


def assert_simulated(
    law, state, parameters, *, operator, density, dx, dt, gravity, planes, twin_parameters=None, steps=4,
):  # fmt: skip
    """The simulator's substeps from a state are the twin's, and so are their gradients to the state
    and to every parameter. parameters: numbers by name; twin_parameters: what the twin takes more."""
    leaves = [t.clone().requires_grad_() for t in (state.x, state.v, state.C_affine, state.F)]
    started = ParticleState(*leaves, leaves[3])
    volume = torch.full((len(state.x),), 0.02**3, dtype=torch.float64)
    parameters = {
        k: torch.tensor(v, dtype=torch.float64, requires_grad=True) for k, v in parameters.items()
    }
    simulator = Simulator(
        law, dx=dx, substeps=steps, frame_dt=steps * dt, gravity=gravity, planes=planes, dtype=torch.float64
    )  # fmt: skip
    adapter = None if operator is None else lambda _: operator
    rollout = simulator.rollout(
        started, parameters, volume, density, 2, adapter=adapter, stride=steps, started=True
    )
    twin = started
    for _ in range(steps):
        twin = substep(
            law, twin, parameters | (twin_parameters or {}), volume, density, dx=dx, dt=dt, gravity=gravity, planes=planes,
            operator=operator and operator[:2], plastic_operator=operator and operator[2:],
        )  # fmt: skip
    names = ("x", "v", "C_affine", "F", "F_tot")
    for name in names:
        value, expected = getattr(rollout.final, name).detach(), getattr(twin, name).detach()
        assert (value - expected).abs().max() < 1e-12 * steps * max(
            1.0, float(expected.abs().max())
        ), name

    generator = torch.Generator().manual_seed(1)
    weights = {
        name: torch.randn(getattr(twin, name).shape, generator=generator).double() for name in names
    }

    def gradient(final):
        loss = sum((weights[name] * getattr(final, name)).sum() for name in names)
        return torch.autograd.grad(loss, [*leaves, *parameters.values()])

    for name, found, expected in zip(
        ("x", "v", "C_affine", "F", *parameters), gradient(rollout.final), gradient(twin)
    ):
        assert (found - expected).abs().max() < 1e-9 * expected.abs().max(), name
        # cohesion acts at the tip of the cone and through tr(eps) - 3c
        assert float(expected.abs().max()) > 0, name

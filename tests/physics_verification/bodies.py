"""Laws with parameters, particle lattices, adapters with random weights: what the measurements of this folder share."""

from __future__ import annotations

import torch
from torch import Tensor

from mosa.modules.adapters.stress import StressAdapter
from mosa.physics.constitutive.laws import law_named, law_names
from mosa.types import ParticleState

E, NU = 8e4, 0.3
MU, LAM = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
DENSITY = 1000.0

VALUES = {
    "mu": MU, "lam": LAM, "kappa": LAM + 2 * MU / 3, "yield_stress": 800.0, "viscosity": 10.0, "friction_alpha": 0.35,
    "cohesion": 0.002, "second_share": 0.3, "yeoh_2": 0.1, "yeoh_3": 0.02,
    "alpha_1": 2.5, "share_2": 0.2, "alpha_2": -4.0, "share_3": 0.3, "alpha_3": 6.0,
    "fibre_stiffness": 2e4, "second_fibre_stiffness": 1e4, "fibre_exponent": 0.5, "dispersion": 0.1,
    "fibre": torch.tensor([0.8, 0.6, 0.0], dtype=torch.float64),
    "second_fibre": torch.tensor([0.6, -0.8, 0.0], dtype=torch.float64),
}  # fmt: skip
"""SI values of every parameter a prior law may take. A law joins the suite when it is registered and its parameters are here."""


def parameters_of(law: str) -> dict[str, float | Tensor]:
    """Values of the parameters a caller hands to the simulator."""
    registered = law_named(law)
    values = {name: VALUES[name] for name in registered.parameters if name != registered.reference}
    return {**values, "mu": 5.0} if is_fluid(law) else values  # [Pa s]: not a stiffness


def is_fluid(law: str) -> bool:
    """Whether the law has no shear stiffness: its mu is a viscosity."""
    return law.startswith("newtonian")


def known_laws() -> list[str]:
    """Prior laws of the registry; truth laws of the built-in scenes have directions and stiffnesses of their own."""
    laws = [law_named(name) for name in law_names()]
    return [
        law.name for law in laws if {n for n in law.parameters if n != law.reference} <= set(VALUES)
    ]


LAWS = known_laws()
ELASTIC = [name for name in LAWS if not law_named(name).plastic]
PRECISIONS = [torch.float32, torch.float64]


def eyes(count: int, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.eye(3, dtype=dtype).repeat(count, 1, 1)


def lattice(cells: tuple[int, ...], spacing: float, origin=(0.0, 0.0, 0.0)) -> Tensor:
    """(N, 3) float64 centres of `cells` cubes of edge `spacing`, the block's corner at `origin`."""
    axes = torch.meshgrid(*(torch.arange(n) for n in cells), indexing="ij")
    return (torch.stack(axes, -1).reshape(-1, 3).double() + 0.5) * spacing + torch.tensor(
        origin, dtype=torch.float64
    )


def resting(
    x: Tensor, velocity=(0.0, 0.0, 0.0), dtype: torch.dtype = torch.float64
) -> ParticleState:
    """Undeformed particles at x (N, 3) with one velocity, no affine part."""
    n = len(x)
    v = torch.tensor(velocity, dtype=dtype).expand(n, 3).contiguous()
    F = eyes(n, dtype)
    return ParticleState(x.to(dtype).contiguous(), v, torch.zeros(n, 3, 3, dtype=dtype), F, F)


def agitated(n: int = 4, spacing: float = 0.02, origin=(0.11, 0.03, 0.07), velocity=(0.3, -1.0, 0.1), seed: int = 0,
             dtype: torch.dtype = torch.float64, strain: float = 0.03, jitter: float = 0.4) -> ParticleState:  # fmt: skip
    """A jittered cube of n^3 particles, strained, spinning and slightly compressed, so that nothing is special."""
    g = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    x = lattice((n, n, n), spacing, origin)
    x = x + jitter * spacing * (torch.rand(x.shape, generator=g, dtype=torch.float64) - 0.5)
    F = 0.98 * (eyes(len(x)) + strain * draw(len(x), 3, 3))
    v = torch.tensor(velocity, dtype=torch.float64) + 0.1 * draw(len(x), 3)
    C = 2.0 * draw(len(x), 3, 3)
    return ParticleState(*(t.to(dtype).contiguous() for t in (x, v, C, F, F)))


def uniform_volume(state: ParticleState, spacing: float) -> Tensor:
    return torch.full((len(state.x),), spacing**3, dtype=state.x.dtype)


def rotations(count: int, seed: int) -> Tensor:
    """(count, 3, 3) float64 random rotations."""
    g = torch.Generator().manual_seed(seed)
    Q = torch.linalg.qr(torch.randn(count, 3, 3, generator=g, dtype=torch.float64)).Q
    return Q * torch.linalg.det(Q)[:, None, None]


def random_adapter(
    seed: int = 0, size: float = 0.3, dtype: torch.dtype = torch.float64, **options
) -> StressAdapter:
    """The paper's adapter with Gaussian weights in place of all initial ones, the zeroed last layers included."""
    adapter = StressAdapter(**options).to(dtype)
    g = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for p in adapter.parameters():
            p.copy_(size * torch.randn(p.shape, generator=g, dtype=torch.float64))
    adapter.switch_on(E, NU)
    return adapter

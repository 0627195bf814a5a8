"""Kirchhoff stress of every registered law, as the simulator's own kernel gives it (checks 4 to 7)."""

from __future__ import annotations

import torch
import warp as wp
from bodies import NU, E, eyes, is_fluid, parameters_of, random_adapter, rotations
from energies import ENERGIES
from torch import Tensor

from mosa.physics.constitutive.laws import law_named
from mosa.physics.constitutive.material_kernels import field_types, kernels_of
from mosa.physics.engine.simulator import Simulator
from mosa.physics.launching import SCALARS


def stress(
    law: str, F: Tensor, C: Tensor | None = None, operator=None, parameters: dict | None = None
) -> Tensor:
    """tau (N, 3, 3) [Pa] in the precision of F (N, 3, 3). operator: what an adapter answered; `linear` is relative to I."""
    n, dtype = len(F), F.dtype
    C = torch.zeros_like(F) if C is None else C
    sim = Simulator(law, dx=0.1, substeps=1, frame_dt=1e-3, dtype=dtype)
    packed = sim.pack(parameters or parameters_of(law), n, eyes(n, dtype))
    mat33, vec6, mat66, vecp = field_types(SCALARS[dtype])
    G, h = (
        (torch.zeros(1, 6, 6, dtype=dtype), torch.zeros(1, 6, dtype=dtype))
        if operator is None
        else operator[:2]
    )
    tau = torch.zeros(n, 3, 3, dtype=dtype)
    kernel, _ = kernels_of(law_named(law), SCALARS[dtype], operator is not None, False)
    arrays = [wp.from_torch(t.detach().contiguous(), dtype=kind) for t, kind in
              zip((F, C, packed, G, h, tau), (mat33, mat33, vecp, mat66, vec6, mat33))]  # fmt: skip
    wp.launch(kernel, n, inputs=[*arrays, None], device="cpu")
    return tau


def adapted_stress(law: str, F: Tensor, C: Tensor | None = None, seed: int = 0) -> Tensor:
    """tau of the law with the full adapter, random weights."""
    adapter = random_adapter(seed, dtype=F.dtype)
    sim = Simulator(law, dx=0.1, substeps=1, frame_dt=1e-3, dtype=F.dtype)
    with torch.no_grad():
        operator = adapter(
            sim.material_state(F, torch.zeros_like(F) if C is None else C, parameters_of(law))
        )
    return stress(law, F, C, operator)


def deformations(count: int, seed: int) -> Tensor:
    """(count, 3, 3) float64, stretches between 0.5 and 2: S_i + S_j > 0.1."""
    g = torch.Generator().manual_seed(seed)
    S = torch.exp(0.69 * (2 * torch.rand(count, 3, generator=g, dtype=torch.float64) - 1))
    return rotations(count, seed + 1) @ torch.diag_embed(S) @ rotations(count, seed + 2)


def frame_error(law: str, adapted: bool) -> float:
    """Largest |tau(Q F) - Q tau(F) Q^T| / max |tau| over 200 rotations and deformations, C_affine turned along."""
    F, Q = deformations(200, 10), rotations(200, 1)
    C = torch.randn(200, 3, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    function = adapted_stress if adapted else stress
    tau, turned = function(law, F, C), function(law, Q @ F, Q @ C @ Q.mT)
    expected = Q @ tau @ Q.mT
    return float(((turned - expected).abs().amax((1, 2)) / expected.abs().amax((1, 2))).max())


def energy_error(law: str) -> float:
    """Largest |tau - dPsi/dF F^T| / max |tau| over 200 deformations; of `linear` the symmetric part."""
    F = deformations(200, 6).requires_grad_()
    (P,) = torch.autograd.grad(ENERGIES[law](F, **parameters_of(law)).sum(), F)
    tau = P @ F.detach().mT
    tau = 0.5 * (tau + tau.mT) if law == "linear" else tau
    return float((stress(law, F.detach()) - tau).abs().max() / tau.abs().max())


def moduli(law: str) -> tuple[float, float]:
    """(C11, C44) [Pa] of the law at small strain: lam + 2 mu and mu; a fluid's are those of its pressure, 7 kappa and 0; a
    family of fibres adds 4 k1 (d + (1 - 3 d) a_x^2)^2 in a stretch."""
    values = parameters_of(law)
    if is_fluid(law):
        return 7 * values["kappa"], 0.0
    if "kappa" in values:
        return values["kappa"] + 4 * values["mu"] / 3, values["mu"]
    c11, d = values["lam"] + 2 * values["mu"], values.get("dispersion", 0.0)
    # families lie in the plane of x and y, which the shear in yz does not stretch
    for which in ("", "second_"):
        if (a := values.get(f"{which}fibre")) is not None:
            along = d + (1 - 3 * d) * float(a[0]) ** 2
            c11 += 4 * values[f"{which}fibre_stiffness"] * along**2
    return c11, E / (2 * (1 + NU))

"""Stress of a law and its derivative at given deformations, by the kernels that the simulator runs."""

from __future__ import annotations

import copy
from functools import cache
from typing import Any
from warnings import warn

import torch
import warp as wp
from torch import Tensor

from mosa.modules.adapters.hyperelastic import HyperelasticAdapter
from mosa.modules.body.material import FORMS, Form, Material
from mosa.physics.adapters.interface import MaterialState
from mosa.physics.constitutive.damping import DAMPED
from mosa.physics.constitutive.laws import SLOTS, law_named
from mosa.physics.constitutive.material_kernels import field_types, kernels_of
from mosa.physics.engine.simulator import Simulator
from mosa.physics.launching import launch
from mosa.settings import Section, Text, typed

KINDS = [field_types(wp.float64)[k] for k in (0, 0, 3, 2, 1, 0)]  # F, C_affine, p, G, h, tau


@cache
def simulator(law: str) -> Simulator:
    """That packs the law's parameters."""
    return Simulator(law, dx=1.0, substeps=1, frame_dt=1.0, dtype=torch.float64)


FORMAT = "mosa material 1"


@torch.no_grad()
def in_double(material: Material, configured: bool = True) -> Material:
    """The same module in float64. Values that are held are on their bounds exactly; configured: what is learned is as it was
    configured, without the rounding to float32."""
    material.double()
    for name in material.held:
        buffer = getattr(material, f"held_{name}")
        buffer.fill_(bound_at(name, float(buffer)))
    for name, value in material.begins.items() if configured else ():
        material.raw[name].fill_(value)
    return material


def bound_at(name: str, value: float) -> float:
    """The bound that a parameter is held at which has this value, rounded; a value at no bound is itself."""
    form = FORMS[name]
    assert isinstance(form, Form)
    return next((bound for bound in form.held if abs(bound - value) < 1e-6), value)


@torch.no_grad()
def values_of(material: Material) -> dict[str, Any]:
    """What `Material` takes: a number of each parameter, three of a direction; what is held is at its bound exactly."""
    values: dict[str, Any] = {}
    found = material.physical()
    for name in material.names:
        if name in material.directions:
            values[name] = material.direction(name).tolist()
        else:
            value = float(found[name])
            values[name] = bound_at(name, value) if name in material.held else value
    return values


def described(material: Material, adapter: HyperelasticAdapter | None) -> dict[str, Any]:
    """A law as plain data, SI units: what material.json holds, and `mosa.export.source` reads."""
    parameters, stiffness = values_of(material), None
    if adapter is not None:
        stiffness = {"strain": "green", "numbers": adapter.numbers.tolist()}
    return {"format": FORMAT, "law": material.law, "parameters": parameters, "stiffness": stiffness}


@torch.no_grad()
def operator(material: Material, adapter: HyperelasticAdapter | None) -> tuple[Tensor, Tensor]:
    """G (1, 6, 6) and h (1, 6), float64, as a stress kernel takes them; zeros without an adapter."""
    none = torch.zeros(1, 6, dtype=torch.float64)
    if adapter is None:
        return torch.zeros(1, 6, 6, dtype=torch.float64), none
    adapter.follow(material.poisson().double())
    return adapter(MaterialState(none, none))[:2]


@torch.no_grad()
def evaluated(
    material: Material, adapter: HyperelasticAdapter | None, F: Tensor
) -> tuple[wp.Kernel, list[Tensor]]:
    """(kernel, its six tensors with tau (n, 3, 3) [Pa] filled in) at F (n, 3, 3) float64."""
    law, n = law_named(material.law), len(F)
    values = {k: v.double() for k, v in material.per_particle().items()}
    packed = simulator(law.name).pack(values, 1, torch.eye(3, dtype=torch.float64)[None])
    G, h = operator(material, adapter)
    parts = [F, torch.zeros_like(F), packed.expand(n, SLOTS), G, h, torch.zeros_like(F)]
    parts = [part.detach().contiguous() for part in parts]
    kernel, _ = kernels_of(law, wp.float64, adapter is not None, False, energetic=True)
    launch(kernel, n, wrapped(parts), wp.get_device("cpu"))
    return kernel, parts


def wrapped(parts: list[Tensor]) -> list:
    return [*(wp.from_torch(part, dtype=kind) for part, kind in zip(parts, KINDS)), None]


def kirchhoff(material: Material, adapter: HyperelasticAdapter | None, F: Tensor) -> Tensor:
    """tau (n, 3, 3) [Pa] of the law, with its learned stiffness if there is an adapter (float64), at F (n, 3, 3) float64."""
    return evaluated(material, adapter, F)[1][-1]


def tangent(material: Material, adapter: HyperelasticAdapter | None, F: Tensor) -> Tensor:
    """d tau_ij/dF_kl (n, 3, 3, 3, 3) [Pa], by the kernel's adjoint; as `kirchhoff`."""
    kernel, parts = evaluated(material, adapter, F)
    result = F.new_zeros(len(F), 3, 3, 3, 3)
    for i in range(3):
        for j in range(3):
            # G and h have a row of gradients for every particle
            sizes = [p.expand(len(F), *p.shape[1:]) for p in parts]
            seeds = [torch.zeros_like(p, memory_format=torch.contiguous_format) for p in sizes]
            seeds[-1][:, i, j] = 1.0
            launch(kernel, len(F), wrapped(parts), wp.get_device("cpu"), wrapped(seeds))
            result[:, i, j] = seeds[0]
    return result


def deformations(count: int, seed: int = 0, strain: float = 0.2) -> Tensor:
    """(count, 3, 3) float64: I plus normal numbers of standard deviation `strain`, turned at random, 0.3 < det F < 3."""
    g = torch.Generator().manual_seed(seed)
    found = torch.empty(0, 3, 3, dtype=torch.float64)
    while len(found) < count:
        F = torch.eye(3, dtype=torch.float64) + strain * torch.randn(
            2 * count, 3, 3, generator=g, dtype=torch.float64
        )
        Q = torch.linalg.qr(torch.randn(2 * count, 3, 3, generator=g, dtype=torch.float64)).Q
        F = Q * torch.linalg.det(Q)[:, None, None] @ F
        J = torch.linalg.det(F)
        found = torch.cat([found, F[(J > 0.3) & (J < 3)]])
    return found[:count]


WRONG = 1e-6  # relative error above which a law is warned of; rounding is at 1e-9
PROPERTIES = {
    "symmetry": "a symmetric Kirchhoff stress: a skew part is a torque from nothing",
    "objectivity": "tau(Q F) = Q tau(F) Q^T of every rotation Q: a turned body has the turned stress (F F^T in place of F^T F?)",
    "gradient": "an adjoint that is the derivative of the stress: see Warp's notes on differentiable functions",
    "residual": "no stress at rest, where F = I: a body of it would not keep its shape",
    "rest": "a stiffness at rest that resists every strain: a wrong sign?",
    "loops": "a stress that is the derivative of an energy: closed loops of deformation make work",
}


@typed
def check_law(law: Text, parameters: Section) -> dict[str, float]:
    """Relative errors of a registered law, at 100 drawn deformations: `symmetry`, `objectivity`, `gradient` (adjoint
    against differences), `residual` (stress at rest), `rest` (how far below 0 a stiffness at rest is), `loops` (d P/dF against its
    transpose; these two not of laws that yield or flow). Warns above `WRONG`.

    parameters: as `prior.parameters`. Errors: ConfigError for an unknown law or parameter."""
    return errors_of(in_double(Material(law, parameters)))


def check_own(material: Material) -> None:
    """`check_law` of a law that is not this program's, at its start, also where it is damped."""
    stress = law_named(material.law.removesuffix(DAMPED)).stress
    if not vars(stress)["func"].__module__.startswith("mosa."):
        errors_of(in_double(copy.deepcopy(material)))


def errors_of(material: Material) -> dict[str, float]:
    law, F = law_named(material.law), deformations(100)
    tau, slope = kirchhoff(material, None, F), tangent(material, None, F)
    D, h = torch.randn(F.shape, generator=torch.Generator().manual_seed(2), dtype=F.dtype), 1e-5
    moved = (kirchhoff(material, None, F + h * D) - kirchhoff(material, None, F - h * D)) / (2 * h)
    parts = {"symmetry": (tau, tau.mT),
             "gradient": (torch.einsum("nijkl,nkl->nij", slope, D), moved)}  # fmt: skip
    if law.reference is None:
        Q = deformations(100, 1, 0.0)
        parts["objectivity"] = kirchhoff(material, None, Q @ F), Q @ tau @ Q.mT
    if law.elastic and law.reference is None:
        inverse = torch.linalg.inv(F)  # P = tau F^-T
        dP = torch.einsum("nimkl,njm->nijkl", slope, inverse)
        dP = dP - torch.einsum("nil,njk->nijkl", tau @ inverse.mT, inverse)
        parts["loops"] = dP, dP.permute(0, 3, 4, 1, 2)
    found = {k: float((a - b).abs().max() / b.abs().max()) for k, (a, b) in parts.items()}
    rest = torch.eye(3, dtype=F.dtype)[None]
    found["residual"] = float(kirchhoff(material, None, rest).abs().max() / tau.abs().max())
    if "loops" in parts:
        C = tangent(material, None, rest)[0]
        C = (C + C.transpose(2, 3)).reshape(9, 9)  # symmetric strains
        stiffness = torch.linalg.eigvalsh(C + C.T)  # three are 0, of rotations
        found["rest"] = float((-stiffness[0] / stiffness.abs().max()).clamp_min(0))
    for name, error in found.items():
        if not error < WRONG:
            said = f"{name} is off by {error:.2g} of the largest: expected {PROPERTIES[name]}"
            warn(f"law {material.law!r}: {said}", stacklevel=3)
    return found

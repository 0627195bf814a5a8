"""Stress of a law and its derivative at given deformations, by the kernels that the simulator runs."""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
import warp as wp
from torch import Tensor

from mosa.modules.adapters.hyperelastic import HyperelasticAdapter
from mosa.modules.body.material import FORMS, Form, Material
from mosa.physics.adapters.interface import MaterialState
from mosa.physics.constitutive.laws import SLOTS, law_named
from mosa.physics.constitutive.material_kernels import field_types, kernels_of
from mosa.physics.engine.simulator import Simulator
from mosa.physics.launching import launch

KINDS = [field_types(wp.float64)[k] for k in (0, 0, 3, 2, 1, 0)]
"""Of a stress kernel's arrays: F, C_affine, parameters, G, h, tau."""


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
    """The bound that a parameter is held at which has this value, rounded."""
    form = FORMS[name]
    assert isinstance(form, Form)
    return min(form.held, key=lambda bound: abs(bound - value))


@torch.no_grad()
def values_of(material: Material) -> dict[str, Any]:
    """What `Material` takes: a number of each parameter, three of a direction; what is held is at
    its bound exactly."""
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
    return [wp.from_torch(part, dtype=kind) for part, kind in zip(parts, KINDS)]


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

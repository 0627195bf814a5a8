"""A law that is exported: which energy, with which values, from a checkpoint or from material.json."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from warnings import warn

import torch

from mosa.config.checkpoints import given_as
from mosa.data.formats.footage import read_json
from mosa.errors import ConfigError, DataError
from mosa.evaluation.analysis.law_stress import described, in_double, operator
from mosa.export.energies import ENERGIES, STIFFNESS, Energy, energy
from mosa.modules.adapters.hyperelastic import HyperelasticAdapter
from mosa.modules.body.material import Material
from mosa.physics.constitutive.laws import law_named
from mosa.twin.twin import Twin

UNEVEN = 0.01  # standard deviation of a stiffness field above which its loss is warned of


@dataclass(frozen=True)
class Source:
    """material, adapter (None: no learned stiffness), in float64; energy: as symbols; values: of its parameters, SI units."""

    material: Material
    adapter: HyperelasticAdapter | None
    energy: Energy
    values: dict[str, float]


def read_source(path: str | Path, nu: float | None = None) -> Source:
    """Of a checkpoint (.ckpt) or of material.json. nu: as `source`. Errors: DataError naming the file, ConfigError for a law
    without energy."""
    path = Path(path)
    if path.suffix == ".json" and os.path.isfile(path):
        found = source(*read_material(path), nu)
        if (note := read_json(path).get("note")) and nu is None:
            warn(f"{path}: {note}", stacklevel=1)
        return found
    with given_as("source"):
        twin = Twin.load(path)
    if float((field := twin.material.field).std()) > UNEVEN:
        low, mean, high = (float(v) for v in (field.min(), field.mean(), field.max()))
        warn(
            f"{path}: the export has no stiffness field: over this body the law's moduli are {low:.2f} to {high:.2f} times as "
            f"large (mean {mean:.2f}; twin.material.field)",
            stacklevel=1,
        )
    return source(twin.body.material, twin.body.adapter, nu)


def read_material(path: Path) -> tuple[Material, HyperelasticAdapter | None]:
    """What `mosa-material` wrote. Errors: DataError naming the file and what is wrong."""
    try:
        found: dict[str, Any] = read_json(path)
        material = in_double(Material(found["law"], found["parameters"]))
        for name in material.directions:  # starts at its own value: the angles are 0
            getattr(material, f"frame_{name}").data = getattr(material, f"frame_{name}").double()
        adapter = None
        if (stiffness := found["stiffness"]) is not None:
            if stiffness["strain"] != "green":
                found_in = stiffness["strain"]
                raise ValueError(f"expected a stiffness in Green's strain, found {found_in}")
            adapter = HyperelasticAdapter().double()
            with torch.no_grad():
                adapter.numbers.copy_(torch.tensor(stiffness["numbers"], dtype=torch.float64))
            adapter.switch_on(material.reference_modulus(), material.poisson())
    except Exception as error:  # whatever the file holds
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        raise DataError(
            f"{path}: expected a material.json of mosa-material (of a twin: its checkpoint), found {reason}"
        ) from error
    return material, adapter


@torch.no_grad()
def set_poisson(material: Material, adapter: object, nu: float) -> None:
    """Give a law in float64 another Poisson number with the same mu, also one that no simulation takes. Errors: ConfigError."""
    if not 0 <= nu < 0.5:
        raise ConfigError(f"nu: expected a number of at least 0 and below 0.5, found {nu:g}")
    if adapter is not None or "nu" not in material.names:
        found = "a learned stiffness, which was fitted at its own" if adapter else material.law
        raise ConfigError(f"nu: expected a law with E and nu alone, found {found}")
    material.raw["E"] += torch.log((1 + nu) / (1 + material.physical()["nu"]))
    material.held.append("nu")
    material.held_nu = torch.tensor(nu, dtype=torch.float64)


def source(material: Material, adapter: object, nu: float | None = None) -> Source:
    """nu: in place of the law's own, whose mu stays. Errors: ConfigError naming the law or the adapter
    that has no energy as text."""
    if material.law not in ENERGIES:
        raise ConfigError(
            f"export: expected a law of {', '.join(ENERGIES)}, found {material.law}: others yield, flow or "
            "are damped (fit without damping); a law of your own needs its energy in "
            "mosa.export.energies.ENERGIES, by a module of --extensions"
        )
    if adapter is not None and not isinstance(adapter, HyperelasticAdapter):
        other = "found another adapter: its law has no energy"
        raise ConfigError(f"export: expected a run with adapter=operator or none, {other}")
    material = in_double(material, configured=False)
    if nu is not None:
        if adapter is not None and not adapter.numbers.any():
            adapter = None  # kept isotropic: it adds nothing at any nu
        set_poisson(material, adapter, nu)
    adapter = None if adapter is None else adapter.double()
    values: dict[str, float] = {}
    found = material.per_particle()
    for name, size in law_named(material.law).parameters.items():
        names = [name] if size == 1 else [f"{name}_{k}" for k in (1, 2, 3)]
        values |= dict(zip(names, found[name].detach().flatten().tolist(), strict=True))
    form = energy(material.law, tuple(values), adapter is not None)
    if adapter is not None:
        G, h = operator(material, adapter)
        values["kept"] = 1 + float(h[0, 0])
        values |= {name: float(G[0, int(name[1]) - 1, int(name[2]) - 1]) for name in STIFFNESS}
    return Source(material, adapter, form, values)


def as_json(found: Source) -> str:
    """material.json with the formula as the program documents it, and the values that the exported texts hold."""
    formula = vars(law_named(found.material.law).stress)["func"].__doc__ or ""
    more = {"formula": " ".join(formula.split()), "values": found.values}
    return json.dumps(described(found.material, found.adapter) | more, indent=1)

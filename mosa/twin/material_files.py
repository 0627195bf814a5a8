"""A twin for other simulators: its material and particles as plain numbers, and the files of newton
and MuJoCo."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any
from warnings import warn

import numpy as np
import torch

from mosa.settings import Expected, such
from mosa.system.npz import write_npz
from mosa.system.whole_files import made_folder, written_whole
from mosa.twin.mujoco_flex import save_mujoco, save_surface
from mosa.twin.newton_usd import save_newton
from mosa.twin.start import as_started

FORMATS = ("json", "npz", "newton_usd", "mujoco", "obj")
Formats = Annotated[Sequence[str], Expected(f"a list of some of {', '.join(FORMATS)}"),
                    such(lambda v: all(name in FORMATS for name in v))]  # fmt: skip


@torch.no_grad()
def particles(twin: Any) -> dict[str, np.ndarray]:
    """Of every particle: points (N, 3) [m] as the training starts, velocities (N, 3) [m/s], volume
    [m^3], mass [kg], E [Pa], nu, damping [Pa s] (N,)."""
    body, material = twin.body, twin.material
    n = len(body.rest)
    points, velocities = as_started(body, twin.training_start, body.rest)
    found = {
        "volume": body.volume,
        "mass": body.volume * body.density,
        "E": material.E * material.field,
        "nu": torch.full((n,), material.nu),
        "damping": torch.full((n,), material.damping),
    }
    numbers = {name: value.double().cpu().numpy() for name, value in found.items()}
    return {"points": points, "velocities": velocities, **numbers}


def described(twin: Any) -> dict[str, Any]:
    """The material as plain data, SI units, and the parts of it that a simulator of E and nu cannot hold."""
    material, lost = twin.material, []
    adapter = twin.body.adapter
    if adapter is not None and adapter.corrects:
        lost.append("the learned correction of the law (its anisotropy is in `stiffness`)")
    if material.law not in ("neo_hookean", "corotated", "stvk", "linear"):
        lost.append(f"the law {material.law} beyond its E and nu")
    return {
        "law": material.law,
        "parameters": material.parameters,
        "E_Pa": material.E,
        "nu": material.nu,
        "density_kg_m3": material.density,
        "damping_Pa_s": material.damping,
        "stiffness_Pa": material.stiffness.tolist(),
        "stiffness_order": "Mandel: xx, yy, zz, sqrt2 yz, sqrt2 zx, sqrt2 xy; axes of the rest shape",
        "spacing_m": twin.body.settings.dx,
        "not_in_E_and_nu": lost,
    }


def export_material(twin: Any, folder: str | Path, formats: Sequence[str] = FORMATS[:2]) -> Path:
    """`Twin.export_material`."""
    values = particles(twin)  # before a folder is made: the truth refuses
    folder, known = made_folder(folder), described(twin)
    lost = "; ".join(known["not_in_E_and_nu"])
    if lost and {"newton_usd", "mujoco"} & set(formats):
        warn(f"newton.usda, mujoco.xml: hold E and nu alone, without {lost}", stacklevel=4)
    if "json" in formats:
        with written_whole(folder / "material.json") as partial:
            partial.write_text(json.dumps(known, indent=1))
    if "npz" in formats:
        write_npz(folder / "particles.npz", values)
    if "newton_usd" in formats:
        save_newton(folder / "newton.usda", twin, values, known)
    if "mujoco" in formats:
        save_mujoco(folder / "mujoco.xml", twin, values)
    if "obj" in formats:
        save_surface(folder / "surface.obj", twin, values)
    return folder

"""A twin's particles as a USD stage for the simulator newton, by newton's own schemas, and as plain
arrays for others."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch

from mosa.errors import ConfigError
from mosa.settings import Expected, such
from mosa.system.npz import write_npz
from mosa.system.whole_files import made_folder, written_whole

FORMATS = ("json", "npz", "newton_usd")
Formats = Annotated[Sequence[str], Expected(f"a list of some of {', '.join(FORMATS)}"),
                    such(lambda v: all(name in FORMATS for name in v))]  # fmt: skip
STEP = 0.01
"""Relative difference of E within which particles share a material: USD has a material a set of
points."""


@torch.no_grad()
def particles(twin: Any) -> dict[str, np.ndarray]:
    """Of every particle: points (N, 3) [m] as the training starts, velocities (N, 3) [m/s], volume
    [m^3], mass [kg], E [Pa], nu, damping [Pa s] (N,)."""
    body, start, material = twin.body, twin.training_start, twin.material
    n = len(body.rest)
    Q, spin = start.rotation.to(body.rest), start.angular_velocity.to(body.rest)
    arm = (body.rest - body.center) @ Q.T
    found = {
        "points": arm + start.center.to(arm),
        "velocities": start.velocity.to(arm) + torch.linalg.cross(spin.expand_as(arm), arm),
        "volume": body.volume,
        "mass": body.volume * body.density,
        "E": material.E * material.field,
        "nu": torch.full((n,), material.nu),
        "damping": torch.full((n,), material.damping),
    }
    return {name: value.double().cpu().numpy() for name, value in found.items()}


def described(twin: Any) -> dict[str, Any]:
    """The material as plain data, SI units, and the parts of it that a simulator of E and nu cannot
    hold."""
    material, lost = twin.material, []
    adapter = twin.body.adapter
    if adapter is not None and adapter.is_on:
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
    folder = made_folder(folder)
    if "json" in formats:
        with written_whole(folder / "material.json") as partial:
            partial.write_text(json.dumps(described(twin), indent=1))
    if "npz" in formats:
        write_npz(folder / "particles.npz", particles(twin))
    if "newton_usd" in formats:
        save_newton(folder / "newton.usda", twin)
    return folder


def save_newton(path: Path, twin: Any) -> Path:
    """Points with masses, widths and velocities, bound to materials of E and nu, in a scene with
    the twin's gravity.

    Errors: ConfigError without usd-core, and for a law without a shear modulus."""
    try:
        from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt
    except ImportError as error:
        raise ConfigError(
            "formats: newton_usd needs the package usd-core: pip install 'mosa[usd]', or usd-core by itself"
        ) from error
    values, world = particles(twin), twin.world
    if not values["E"].min() > 0:
        raise ConfigError(
            f"formats: newton_usd needs a law with E and nu, found {twin.material.law}"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f"{path.stem}.{os.getpid()}.partial{path.suffix}")
    unfinished.unlink(missing_ok=True)
    stage = Usd.Stage.CreateNew(str(unfinished))
    z_up = int(world.up.abs().argmax()) == 2
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z if z_up else UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    scene = UsdPhysics.Scene.Define(stage, "/scene")
    scene.GetPrim().AddAppliedSchema("NewtonMPMSceneAPI")
    pull = float(world.gravity.norm())
    if pull > 0:
        scene.CreateGravityDirectionAttr(Gf.Vec3f(*(world.gravity / pull).tolist()))
    scene.CreateGravityMagnitudeAttr(pull)
    points = UsdGeom.Points.Define(stage, "/body")
    prim = points.GetPrim()
    stage.SetDefaultPrim(prim)
    for name in ("PhysicsDeformableBodyAPI", "NewtonPointsDeformableSimAPI"):
        prim.AddAppliedSchema(name)
    points.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(values["points"].astype(np.float32)))
    points.GetVelocitiesAttr().Set(Vt.Vec3fArray.FromNumpy(values["velocities"].astype(np.float32)))
    widths = np.cbrt(values["volume"]).astype(np.float32)  # newton: a particle fills its cube
    points.GetWidthsAttr().Set(Vt.FloatArray.FromNumpy(widths))
    masses = prim.CreateAttribute("physics:masses", Sdf.ValueTypeNames.FloatArray)
    masses.Set(Vt.FloatArray.FromNumpy(values["mass"].astype(np.float32)))
    UsdShade.MaterialBindingAPI.Apply(prim)
    nu, damping = float(values["nu"][0]), float(values["damping"][0])
    level = np.round(np.log(values["E"]) / STEP).astype(int)
    for k in np.unique(level):
        which = np.flatnonzero(level == k)
        E = float(values["E"][which].mean())
        material = UsdShade.Material.Define(stage, f"/materials/m{k}")
        material.GetPrim().AddAppliedSchema("NewtonMPMMaterialAPI")
        # newton damps in proportion to the stiffness: this makes the shear viscosities equal
        given = {"youngsModulus": E, "poissonsRatio": nu, "elasticDamping": 2 * (1 + nu) * damping,
                 "tensileYieldRatio": 1.0}  # fmt: skip
        for name, value in given.items():
            kind = Sdf.ValueTypeNames.Float
            material.GetPrim().CreateAttribute(f"newton:mpm:{name}", kind).Set(value)
        subset = UsdGeom.Subset.CreateGeomSubset(
            points, f"m{k}", UsdGeom.Tokens.point, Vt.IntArray.FromNumpy(which.astype(np.int32)),
            UsdShade.Tokens.materialBind, UsdGeom.Tokens.partition,
        )  # fmt: skip
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(
            material, materialPurpose="physics"
        )
    stage.GetRootLayer().comment = json.dumps(described(twin)["not_in_E_and_nu"])
    stage.Save()
    with written_whole(path) as partial:
        os.replace(unfinished, partial)
    return path

"""A twin's particles as a USD stage for the simulator newton, by newton's own schemas."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from mosa.errors import ConfigError
from mosa.system.whole_files import written_whole

STEP = 0.01  # relative difference of E within which particles share a material


def save_newton(
    path: Path, twin: Any, values: dict[str, np.ndarray], known: dict[str, Any]
) -> Path:
    """Points with masses, widths and velocities, bound to materials of E and nu, in a scene with
    the twin's gravity. values, known: `particles` and `described` of the twin.

    Errors: ConfigError without usd-core, and for a law without a shear modulus."""
    try:
        from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt
    except ImportError as error:
        raise ConfigError(
            "formats: newton_usd needs the package usd-core: pip install 'mosa[usd]', or usd-core by itself"
        ) from error
    world = twin.world
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
    stage.GetRootLayer().comment = json.dumps(known["not_in_E_and_nu"])
    stage.Save()
    with written_whole(path) as partial:
        os.replace(unfinished, partial)
    return path

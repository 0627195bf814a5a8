"""Moving splats as files: 3DGS PLY or a USD stage, for the viewers, editors and converters that read them.

Each frame is written in the world's axes and in its own light: covariances are taken apart into scales and rotations, harmonics are
turned with the body, and a factor of the colours becomes part of the harmonics, which no format keeps apart.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from mosa.data.io.gaussian_ply import save_ply
from mosa.errors import ConfigError
from mosa.rendering.appearance.carried_splats import Seen
from mosa.rendering.appearance.spherical_harmonics import Y0, degree_of, mean_colors, rotated
from mosa.rendering.covariance import scales_and_rotations
from mosa.settings import Expected, check, such
from mosa.system.whole_files import written_whole
from mosa.types import Appearance, Splats

FORMATS = ("ply", "usd")
Formats = Annotated[
    Sequence[str], Expected(f"a list of some of {', '.join(FORMATS)}"), such(lambda v: all(name in FORMATS for name in v))
]  # fmt: skip


def splats_at(shown: Seen, frame: int) -> Appearance:
    """The Gaussians of a frame in the world's axes and in that frame's light, on the CPU."""
    harmonics = (
        shown.harmonics
        if shown.rotations is None
        else rotated(shown.harmonics, shown.rotations[frame])
    )
    if shown.shades is not None:
        shade = shown.shades[frame][:, None, None]
        harmonics = harmonics * shade
        harmonics[:, :1] += (shade - 1) * 0.5 / Y0  # the colour is 1/2 plus the harmonics
    scales, rotations = scales_and_rotations(shown.covariances[frame])
    splats = Splats(shown.means[frame], scales, rotations, shown.opacities, mean_colors(harmonics))
    return Appearance(splats, harmonics).to("cpu")


def save_usd(path: str | Path, frames: Sequence[Appearance], *, rate: float, up: Tensor) -> Path:
    """Write a USD stage with one `ParticleField3DGaussianSplat`, all of its attributes sampled at every frame. rate: frames per
    second; up: (3,), the stage's is the nearest of y and z. Errors: ConfigError without a usd-core that knows Gaussians."""
    try:
        from pxr import Gf, Usd, UsdGeom, UsdVol, Vt

        define = UsdVol.ParticleField3DGaussianSplat.Define
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            "formats: usd needs the package usd-core, 26.3 or newer: pip install 'mosa[usd]', or usd-core by "
            "itself"
        ) from error
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(
        f"{path.stem}.{os.getpid()}.partial{path.suffix}"
    )  # USD tells its format by the name
    unfinished.unlink(missing_ok=True)
    stage = Usd.Stage.CreateNew(str(unfinished))
    UsdGeom.SetStageUpAxis(
        stage, UsdGeom.Tokens.z if int(up.abs().argmax()) == 2 else UsdGeom.Tokens.y
    )
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(frames) - 1)
    field = define(stage, "/body")
    stage.SetDefaultPrim(field.GetPrim())
    field.GetRadianceSphericalHarmonicsDegreeAttr().Set(degree_of(frames[0].harmonics))
    field.GetOpacitiesAttr().Set(
        Vt.FloatArray.FromNumpy(frames[0].splats.opacities.contiguous().numpy())
    )
    for t, frame in enumerate(frames):
        splats, vectors = (
            frame.splats,
            lambda values: Vt.Vec3fArray.FromNumpy(values.reshape(-1, 3).contiguous().numpy()),
        )
        field.GetPositionsAttr().Set(vectors(splats.means), t)
        field.GetScalesAttr().Set(vectors(splats.scales), t)
        field.GetOrientationsAttr().Set(
            Vt.QuatfArray([Gf.Quatf(*q) for q in splats.rotations.tolist()]), t
        )
        field.GetRadianceSphericalHarmonicsCoefficientsAttr().Set(vectors(frame.harmonics), t)
        reach = 3 * splats.scales.amax()
        field.GetExtentAttr().Set(
            vectors(torch.stack([splats.means.amin(0) - reach, splats.means.amax(0) + reach])), t
        )
    stage.Save()
    with written_whole(path) as partial:
        os.replace(unfinished, partial)
    return path


def drop_later_frames(folder: Path, suffix: str, count: int) -> None:
    """What a longer motion left in the folder before: a viewer would go on from this one into it."""
    for old in folder.glob(f"*{suffix}"):
        if old.stem.isdecimal() and int(old.stem) >= count:
            old.unlink()


def save_frames(
    shown: Seen,
    folder: str | Path,
    formats: Sequence[str],
    *,
    rate: float = 30.0,
    up: Tensor | None = None,
) -> Path:
    """Write every frame of moving Gaussians: `<folder>/ply/000.ply` and so on, and `splats.usdc` for all.

    rate [1/s], up (3,): of the USD stage. Errors: ConfigError for another format, or where a package is missing; DataError.
    """
    check("formats", formats, Formats)
    folder = Path(folder)
    drop_later_frames(folder / "ply", ".ply", len(shown.means))
    frames = [splats_at(shown, t) for t in range(len(shown.means))] if formats else []
    if "ply" in formats:
        for t, frame in enumerate(frames):
            save_ply(folder / "ply" / f"{t:03d}.ply", frame.splats, frame.harmonics)
    if "usd" in formats:
        up = torch.tensor([0.0, 1, 0]) if up is None else up
        save_usd(folder / "splats.usdc", frames, rate=rate, up=up)
    return folder

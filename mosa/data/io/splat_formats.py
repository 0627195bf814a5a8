"""Moving splats as files for the viewers, editors and converters that read them.

Each frame is written in the world's axes and in its own light: covariances are taken apart into scales and rotations, harmonics are
turned with the body, and a factor of the colours becomes part of the harmonics, which no format keeps apart. glTF alone has a
vertical of its own, y, to which its frames are turned."""

from __future__ import annotations

import importlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from mosa.data.io.gaussian_ply import save_ply
from mosa.data.io.gltf import save_glb
from mosa.errors import ConfigError, DataError
from mosa.rendering.appearance.carried_splats import Seen
from mosa.rendering.appearance.spherical_harmonics import Y0, degree_of, mean_colors, rotated
from mosa.rendering.covariance import scales_and_rotations
from mosa.settings import Expected, check, such
from mosa.system.progress import tqdm
from mosa.system.threads import threaded
from mosa.system.whole_files import written_whole
from mosa.types import Appearance, Splats

FORMATS = ("ply", "gltf", "sog", "usd", "rrd")
Formats = Annotated[
    Sequence[str], Expected(f"a list of some of {', '.join(FORMATS)} (to other simulators: Twin.export_material)"),
    such(lambda v: all(name in FORMATS for name in v))
]  # fmt: skip
FRAMES = {"ply": ".ply", "gltf": ".glb", "sog": ".sog"}  # one file a frame
PACKAGES = {"usd": ("pxr.UsdVol", "ParticleField3DGaussianSplat", "usd-core, 26.3 or newer", "usd"),
            "rrd": ("rerun", "GaussianSplats3D", "rerun-sdk, 0.41 or newer", "rerun")}  # fmt: skip
CONVERTER = "splat-transform"  # playCanvas' program, which writes SOG


def check_formats(formats: Sequence[str]) -> None:
    """Errors: ConfigError for an unknown format, or where its package or program is missing."""
    check("formats", formats, Formats)
    for name in formats:
        if name in PACKAGES:
            module, known, package, extra = PACKAGES[name]
            try:
                getattr(importlib.import_module(module), known)
            except (ImportError, AttributeError) as error:
                way = f"pip install 'mosa[{extra}]'"
                raise ConfigError(f"formats: {name} needs the package {package}: {way}") from error
    if "sog" in formats and shutil.which(CONVERTER) is None:
        raise ConfigError(
            f"formats: sog needs the program {CONVERTER} on the PATH: npm install --global "
            "@playcanvas/splat-transform (Node 20 or newer)"
        )


def splats_at(shown: Seen, frame: int, turn: Tensor | None = None) -> Appearance:
    """The Gaussians of a frame in the world's axes, or turned from them by `turn` (3, 3), in that
    frame's light, on the CPU."""
    turn = torch.eye(3).to(shown.means) if turn is None else turn.to(shown.means)
    harmonics = shown.harmonics
    if shown.rotations is not None:
        harmonics = rotated(harmonics, turn @ shown.rotations[frame])
    if shown.shades is not None:
        shade = shown.shades[frame][:, None, None]
        harmonics = harmonics * shade
        harmonics[:, :1] += (shade - 1) * 0.5 / Y0  # the colour is 1/2 plus the harmonics
    scales, rotations = scales_and_rotations(turn @ shown.covariances[frame] @ turn.T)
    means = shown.means[frame] @ turn.T
    splats = Splats(means, scales, rotations, shown.opacities, mean_colors(harmonics))
    return Appearance(splats, harmonics).to("cpu")


def upright(up: Tensor) -> Tensor:
    """(3, 3): the shortest turn that brings `up` (3,) to y."""
    up, y = up / up.norm(), torch.tensor([0.0, 1, 0]).to(up)
    middle = up + y if float((up + y).norm()) > 1e-6 else torch.tensor([1.0, 0, 0]).to(up)
    half_turns = [2 * torch.outer(a, a) / (a @ a) - torch.eye(3).to(up) for a in (middle, up)]
    return half_turns[0] @ half_turns[1]


def save_sog(path: str | Path, shown: Appearance) -> Path:
    """Write SOG (webp images in a zip archive) by PlayCanvas' converter, on the CPU. Errors:
    DataError with the program's text."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "a.sog"
        source = save_ply(made.with_suffix(".ply"), shown.splats, shown.harmonics)
        words = [CONVERTER, "-q", "-g", "cpu", "--max-workers", "0", str(source), str(made)]
        run = subprocess.run(words, capture_output=True, text=True)
        if run.returncode or not made.is_file():
            raise DataError(f"{path}: {CONVERTER} failed: {(run.stderr or run.stdout)[-500:]}")
        with written_whole(path) as partial:
            shutil.copyfile(made, partial)
    return path


def save_usd(path: str | Path, frames: Iterable[Appearance], *, rate: float, up: Tensor) -> Path:
    """Write a USD stage with one `ParticleField3DGaussianSplat`, all of its attributes sampled at every frame. rate: frames per
    second; up: (3,), the stage's is the nearest of y and z."""
    from pxr import Gf, Usd, UsdGeom, UsdVol, Vt

    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # USD tells its format by the name
    unfinished = path.with_name(f"{path.stem}.{os.getpid()}.partial{path.suffix}")
    unfinished.unlink(missing_ok=True)
    stage = Usd.Stage.CreateNew(str(unfinished))
    z_up, axes = int(up.abs().argmax()) == 2, UsdGeom.Tokens
    UsdGeom.SetStageUpAxis(stage, axes.z if z_up else axes.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(0)
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/body")
    stage.SetDefaultPrim(field.GetPrim())

    def vectors(values: Tensor) -> Vt.Vec3fArray:
        return Vt.Vec3fArray.FromNumpy(values.reshape(-1, 3).contiguous().numpy())

    for t, frame in enumerate(frames):
        splats = frame.splats
        if t == 0:
            field.GetRadianceSphericalHarmonicsDegreeAttr().Set(degree_of(frame.harmonics))
            opacities = splats.opacities.contiguous().numpy()
            field.GetOpacitiesAttr().Set(Vt.FloatArray.FromNumpy(opacities))
        stage.SetEndTimeCode(t)
        field.GetPositionsAttr().Set(vectors(splats.means), t)
        field.GetScalesAttr().Set(vectors(splats.scales), t)
        turns = [Gf.Quatf(*q) for q in splats.rotations.tolist()]
        field.GetOrientationsAttr().Set(Vt.QuatfArray(turns), t)
        field.GetRadianceSphericalHarmonicsCoefficientsAttr().Set(vectors(frame.harmonics), t)
        reach = 3 * splats.scales.amax()
        corners = splats.means.amin(0) - reach, splats.means.amax(0) + reach
        field.GetExtentAttr().Set(vectors(torch.stack(corners)), t)
    stage.Save()
    with written_whole(path) as partial:
        os.replace(unfinished, partial)
    return path


def save_rrd(path: str | Path, frames: Iterable[Appearance], *, rate: float, up: Tensor) -> Path:
    """Write a recording of rerun: Gaussians at every frame of the timeline `time` [s], and the
    vertical, the nearest of y and z. rerun keeps mean colours and opacities in 8 bits, harmonics in 16."""
    import rerun as rr

    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    z_up = int(up.abs().argmax()) == 2
    axes = rr.ViewCoordinates.RIGHT_HAND_Z_UP if z_up else rr.ViewCoordinates.RIGHT_HAND_Y_UP
    with written_whole(path) as partial:
        recording = rr.RecordingStream("mosa")
        recording.save(partial)
        recording.log("/", axes, static=True)
        for t, frame in enumerate(frames):
            splats, higher = frame.splats, frame.harmonics[:, 1:]
            colors = torch.cat([splats.colors, splats.opacities[:, None]], 1).clamp(0, 1)
            padded = torch.nn.functional.pad(higher, (0, 0, 0, 15 - higher.shape[1])).numpy()
            recording.set_time("time", duration=t / rate)
            harmonics = {
                "sh_coefficients": padded if higher.shape[1] else None,
                "spherical_harmonics_degree": degree_of(frame.harmonics),
            }
            turns, painted = splats.rotations[:, [1, 2, 3, 0]], (255 * colors + 0.5).byte()
            look = {"quaternions": turns.numpy(), "colors": painted.numpy()} | harmonics
            own = splats.means.numpy(), splats.scales.numpy()
            recording.log("body", rr.GaussianSplats3D(own[0], scales=own[1], **look))
        recording.disconnect()
    return path


def drop_later_frames(folder: Path, suffix: str, count: int) -> None:
    """What a longer motion left in the folder before: a viewer would go on from this one into it."""
    for old in folder.glob(f"*{suffix}"):
        if old.stem.isdecimal() and int(old.stem) >= count:
            old.unlink()


def save_frames(
    shown: Seen, folder: str | Path, formats: Sequence[str], *, rate: float = 30.0, up=None
) -> Path:
    """Write every frame of moving Gaussians: `<folder>/ply/000.ply`, `gltf/000.glb`,
    `sog/000.sog` and so on, and for all of them `splats.usdc` and `splats.rrd`.

    rate [1/s], up (3,): of the motion. Errors: ConfigError as `check_formats`; DataError."""
    check_formats(formats)
    folder, count = Path(folder), len(shown.means)
    up = torch.tensor([0.0, 1, 0]) if up is None else up
    turn = upright(up)
    for name, suffix in FRAMES.items():
        drop_later_frames(folder / name, suffix, count)

    def save(t: int) -> None:
        frame = splats_at(shown, t)
        if "ply" in formats:
            save_ply(folder / "ply" / f"{t:03d}.ply", frame.splats, frame.harmonics)
        if "gltf" in formats:
            save_glb(folder / "gltf" / f"{t:03d}.glb", splats_at(shown, t, turn))
        if "sog" in formats:
            save_sog(folder / "sog" / f"{t:03d}.sog", frame)

    if set(formats) & set(FRAMES):
        quick = "sog" not in formats
        for _ in tqdm(threaded(save, range(count)), "splats", count, leave=False, disable=quick):
            pass
    for name, write in (("usdc", save_usd), ("rrd", save_rrd)):
        if name[:3] in formats:
            frames = (splats_at(shown, t) for t in range(count))
            write(folder / f"splats.{name}", frames, rate=rate, up=up)
    return folder

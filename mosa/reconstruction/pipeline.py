"""Reconstruction of a sequence: hull -> geometry -> static Gaussians -> filling -> appearance -> motion -> cues, carried
Gaussians; stages are cached."""

from __future__ import annotations

import functools
import hashlib
import warnings
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mosa.data.checks.silhouettes import uncovered_and_islands, whole_views
from mosa.data.hull import Volume, occupancy, visual_hull
from mosa.data.io.gaussian_ply import load_ply
from mosa.errors import ConfigError, DataError
from mosa.reconstruction.cache import StageCache
from mosa.reconstruction.gaussians.carried import fit_carried
from mosa.reconstruction.gaussians.initial import inherited_colors, initial_splats, isotropic_splats
from mosa.reconstruction.gaussians.static import fit_splats
from mosa.reconstruction.geometry.behind import fill_behind
from mosa.reconstruction.geometry.body import Geometry, find_geometry
from mosa.reconstruction.geometry.filling import Particles, body_volume, fill
from mosa.reconstruction.motion.moved import MovingParts, cues_of, first_motion
from mosa.reconstruction.motion.observed import Windows, object_windows
from mosa.reconstruction.pose.known import register_known
from mosa.reconstruction.pose.outlines import Similarities
from mosa.reconstruction.pose.registration import light_of
from mosa.reconstruction.resolution import PER_CELL, particles_for
from mosa.reconstruction.settings import FitSettings, ReconstructionSettings
from mosa.rendering.appearance.carried_splats import COLORED
from mosa.rendering.appearance.lighting import shading, surface_normals
from mosa.rendering.appearance.spherical_harmonics import constant_coefficients
from mosa.rendering.covariance import covariance_from, matrix_to_quaternion, quaternion_multiply
from mosa.rendering.rasterizer import rasterize
from mosa.system.progress import tqdm
from mosa.types import Appearance, Reconstruction, Scene, Splats, metres

CACHE_VERSION = 4
"""Raised when a stage computes something else from the same settings."""


def _first_frame(scene: Scene) -> tuple[Tensor, Any]:
    if not scene.training_cameras or scene.training_frames[:1] != [0]:
        raise DataError(f"scene {scene.name}: expected frame 0 and a training camera")
    return scene.mattes[scene.training_cameras, 0], scene.cameras.select(scene.training_cameras)


def object_hull(scene: Scene, settings: ReconstructionSettings) -> Volume:
    """Visual hull of the first frame, occupancy in [0, 1]; training cameras only."""
    mattes, cameras = _first_frame(scene)
    return visual_hull(mattes, cameras, scene.box, resolution=settings.resolution)


def object_geometry(
    scene: Scene,
    settings: ReconstructionSettings,
    *,
    cache_dir: str | Path | None = None,
    device: torch.device | str = "cpu",
) -> Geometry:
    """The body of `scene.body`, or the one inside the visual hull, by settings.geometry; cached apart from the stages that depend
    on the particles' spacing.

    Errors: DataError (empty mattes, empty hull)."""

    def found() -> Geometry:
        if scene.body is not None:
            return known_geometry(scene, settings)
        if settings.geometry.source == "gaussians":
            return geometry_of_gaussians(scene, settings, device)
        return find_geometry(
            scene, object_hull(scene, settings), settings.geometry, ridge_passes=settings.ridge_passes,
            sigma=settings.resolution / 40, margin=settings.margin, device=device,
        )  # fmt: skip

    cache = _geometry_cache(scene, settings, cache_dir)
    return Geometry.read(cache.stage("geometry", lambda: found().stored()))


def known_geometry(scene: Scene, settings: ReconstructionSettings) -> Geometry:
    """The body of `scene.body` where frame 0 shows it. Errors: DataError."""
    found = register_known(scene)
    body, empty = found.body(settings.resolution), torch.empty(0)
    told = found.frames, None, found.figures(), vars(found.place)
    return Geometry(body, body.occupied_volume(), empty, *told)


def geometry_of_gaussians(
    scene: Scene, settings: ReconstructionSettings, device: torch.device | str
) -> Geometry:
    """The body behind static Gaussians, which are kept for the static stage. Errors: DataError."""
    hull, background = object_hull(scene, settings), scene.background.to(device)
    windows = object_windows(scene, scene.training_cameras, [0], margin=settings.margin).to(device)
    start = initial_splats(hull, windows, count=settings.points, seed=0)
    static = fit_splats(start, windows, background, settings.static, move=True, seed=0)
    body = fill_behind(static, windows, hull)
    return Geometry(body, hull.occupied_volume(), torch.empty(0), 1, static)


FEW = 4000
"""Particles that a run has at least where their number is left to it: the fits that the noise was settled on had as many."""


def spacing_for(
    scene: Scene, particles: int | None, settings: ReconstructionSettings | None = None, *,
    per_cell: float = PER_CELL, most: int = FEW, cache_dir: str | Path | None = None,
    device: torch.device | str = "cpu",
) -> float:  # fmt: skip
    """Particle spacing [m] that fills the object of `scene` with about `particles` particles.

    particles: None for as many as resolve its thin parts on a grid of `per_cell` particles to a cell (`resolution`), from `FEW` to
    `most`."""
    if particles is not None and particles < 8:
        raise ConfigError(f"simulation.particles: expected at least 8, found {particles}")
    settings = settings or ReconstructionSettings()
    found = object_geometry(scene, settings, cache_dir=cache_dir, device=device)
    return filling_spacing(found.body, particles, per_cell=per_cell, most=most)


def filling_spacing(
    body: Volume, particles: int | None, *, per_cell: float = PER_CELL, most: int = FEW
) -> float:
    """Particle spacing [m] that fills a solid; arguments as of `spacing_for`."""
    volume, limits = body_volume(body), {"least": FEW, "most": max(most, FEW)}
    if particles is None:
        filled = lambda spacing: fill(body, spacing=spacing).positions  # noqa: E731
        particles = particles_for(filled, volume, per_cell=per_cell, **limits)
    return (volume / particles) ** (1 / 3)


def stored(
    scene: Scene, spacing: Callable[[], float], settings: ReconstructionSettings, *,
    cache_dir: str | Path, seed: int = 0,
) -> bool:  # fmt: skip
    """Whether the cache has the motion of `scene`, the last stage of its reconstruction. spacing: gives that of the particles [m],
    and is asked where the body it follows from is in the cache."""
    folder = _geometry_cache(scene, settings, cache_dir).folder
    if folder is None or settings.splats is not None or not (folder / "geometry.pt").is_file():
        return False
    what = _motion_settings(settings)
    folder = _open_cache(cache_dir, scene, what, seed, spacing=spacing()).folder
    return folder is not None and (folder / "motion.pt").is_file()


def _geometry_cache(
    scene: Scene, settings: ReconstructionSettings, cache_dir: str | Path | None
) -> StageCache:
    kept = {"resolution", "ridge_passes", "margin", "geometry"}
    if settings.geometry.source == "gaussians":
        kept |= {"points", "static"}
    what = settings.model_dump(include=kept)
    return _open_cache(cache_dir, scene, what, 0, free=scene.last_free_frame)


def _open_cache(
    cache_dir: str | Path | None, scene: Scene, settings: Mapping[str, Any], seed: int, **more: Any
) -> StageCache:
    """The cache of what is computed from the training views and frames of `scene`; more: whatever else the results depend on."""
    key = {
        "version": CACHE_VERSION,
        "scene": f"{scene.name}-{scene.sequence}",
        "data": scene.fingerprint,
        "views": scene.training_cameras,
        "frames": scene.training_frames,
        "seed": seed,
        "settings": settings,
        "box": scene.box.tolist(),
    }
    if scene.body is not None:
        key["body"] = [scene.body.fingerprint, scene.body.scale]
    return StageCache(Path(cache_dir) if cache_dir is not None else None, key | more)


def _tensors(splats: Splats) -> dict[str, Tensor]:
    return {f.name: getattr(splats, f.name).cpu() for f in fields(Splats)}


def _motion_settings(settings: ReconstructionSettings) -> dict[str, Any]:
    """What particles and their motion depend on."""
    plain = settings.plain()
    return {name: plain[name] for name in plain if name not in ("carried", "informed")}


def imported_splats(path: str, scene: Scene) -> Appearance:
    """Gaussians of a 3DGS PLY inside the scene's box, with their harmonics.

    Errors: DataError where the file is not one, fewer than eight of its Gaussians lie in the box, or they are not where the mattes
    of frame 0 show the object."""
    splats, harmonics = load_ply(path)
    inside = ((splats.means > scene.box[0]) & (splats.means < scene.box[1])).all(1)
    if int(inside.sum()) < 8:
        low, high = (metres(x) for x in (splats.means.amin(0), splats.means.amax(0)))
        raise DataError(
            f"{path}: expected Gaussians in the scene's box {metres(scene.box)} m, found "
            f"{int(inside.sum())} of {len(inside)}: the file spans {low} to "
            f"{high}; bring it into the scene's world and metres first"
        )
    kept = Splats(*(getattr(splats, f.name)[inside] for f in fields(Splats)))
    check_place(path, kept, scene)
    return Appearance(kept, harmonics[inside])


FILLED, SUSPECT = 0.5, 0.9
"""Shares of imported Gaussians inside of the mattes, and of the mattes that they fill, below which they are another object, or the
same elsewhere; and below which that is said."""


def check_place(path: str, splats: Splats, scene: Scene) -> None:
    """Gaussians lie where the mattes of frame 0 show the object, and fill them. Errors: DataError; a warning where few do not."""
    views = whole_views(scene, 0)
    if len(views) < 2:
        return
    mattes, cameras = scene.mattes[views, 0], scene.cameras.select(views)
    inside = occupancy(splats.means, mattes, cameras) > 0.25
    within = float((splats.opacities * inside).sum() / splats.opacities.sum())
    reach = 2 * float(splats.scales.mean())
    filled = 1 - float(uncovered_and_islands(splats.means, reach, mattes, cameras)[0].median())
    said = (
        f"{path}: expected Gaussians where the mattes of frame 0 show the object, found {within:.0%} of their opacity there "
        f"and {filled:.0%} of the mattes filled: check the file's unit, axes and place in the scene's world"
    )
    if min(within, filled) < FILLED:
        raise DataError(said)
    if within < SUSPECT:
        warnings.warn(said, stacklevel=2)


def _render_still(splats: Splats, windows: Windows, background: Tensor) -> Tensor:
    state = torch.zeros(len(windows), dtype=torch.long, device=background.device)
    shapes = covariance_from(splats.scales, splats.rotations)[None]
    means, colors = splats.means[None], splats.colors[None]
    with torch.no_grad():
        seen = means, shapes, splats.opacities, colors, windows.cameras
        return rasterize(*seen, state, background)[0]


def reconstruct(
    scene: Scene, *, settings: ReconstructionSettings, spacing: float, cache_dir: str | Path | None,
    seed: int = 0, device: torch.device | str = "cpu", progress: bool = True,
) -> Reconstruction:  # fmt: skip
    """Particles at frame 0 with their appearance, and their motion through the training frames, from images alone; and the splats
    that this motion carries, fitted to the same frames (imported ones stay as they are).

    scene: only its training cameras and training frames are read, never its truth. spacing [m] of the particles;
    cache_dir: root of the cache, None for no cache. A stopped run goes on with the first stage that is
    not stored. Returns tensors on the CPU; cues cover the training frames, in order.
    Errors: DataError (empty mattes, empty hull), ConfigError."""
    if spacing <= 0:
        raise ConfigError(f"reconstruct: spacing must be positive, found {spacing}")
    views, frames = scene.training_cameras, scene.training_frames
    more = {"spacing": spacing}
    if settings.splats is not None:
        imported = imported_splats(settings.splats, scene)
        more["splats"] = hashlib.sha256(Path(settings.splats).read_bytes()).hexdigest()[:16]
    cache = _open_cache(cache_dir, scene, _motion_settings(settings), seed, **more)
    geometry = object_geometry(scene, settings, cache_dir=cache_dir, device=device)
    windows = object_windows(scene, views, frames, margin=settings.margin).to(device)
    still, background = windows.of_frame(0), scene.background.to(device)

    def bar(name: str, total: int) -> tqdm:
        return tqdm(total=total, desc=f"reconstruction: {name}", disable=not progress, leave=False)

    def fitted(start: Splats, how: FitSettings, name: str, title: str) -> dict[str, Tensor]:
        with bar(title, how.iterations) as steps:
            moves = name == "static"
            found = fit_splats(
                start, still, background, how, move=moves, seed=seed, progress=steps.update
            )
        cache.strip(name, still, _render_still(found, still, background))
        return _tensors(found)

    @functools.cache  # more than one stage reads it, also where there is no cache folder
    def static_stage() -> dict[str, Tensor]:
        if settings.splats is not None:
            picture = _render_still(imported.splats.to(device), still, background)
            cache.strip("static", still, picture)
            return _tensors(imported.splats)
        if geometry.static is not None:
            return _tensors(geometry.static)
        start = initial_splats(geometry.body, still, count=settings.points, seed=seed)
        return fitted(start, settings.static, "static", "static Gaussians")

    def appearance_stage() -> dict[str, Tensor]:
        static = Splats(**cache.stage("static", static_stage)).to(device)
        filled = fill(geometry.body, spacing=spacing)
        start = scaffold_splats(filled, static, device)
        title = "appearance of the particles"
        return fitted(start, settings.appearance, "particles", title) | {"volume": filled.volume}

    particles = cache.stage("particles", appearance_stage)
    volume = particles.pop("volume")
    splats = Splats(**particles)

    static = Splats(**cache.stage("static", static_stage))
    place = Similarities(**geometry.place) if geometry.place else None
    parts = MovingParts(scene, splats.to(device), static.to(device), settings, place)

    def motion_stage() -> dict[str, Tensor]:
        return first_motion(parts, windows, background, seed, bar, cache)

    motion = cache.stage("motion", motion_stage, (len(frames), len(splats.means)))

    def carried_stage() -> dict[str, Tensor]:
        means, positions = splats.means.to(device), motion["positions"].to(device)
        with bar("carried Gaussians", settings.carried.iterations) as steps:
            found = fit_carried(
                static.to(device), means, positions, windows, background, settings.carried, seed=seed,
                progress=steps.update,
            ).to("cpu")  # fmt: skip
        return _tensors(found.splats) | {name: getattr(found, name) for name in COLORED}

    if settings.splats is not None:
        appearance = imported
    elif settings.carried.iterations == 0:
        appearance = Appearance(static, constant_coefficients(static.colors))
    else:  # a folder of its own: nothing else depends on its settings
        what = _motion_settings(settings) | {"carried": settings.carried.plain()}
        apart = _open_cache(cache_dir, scene, what, seed, **more)
        found = apart.stage("carried", carried_stage)
        colored = {name: found.pop(name) for name in COLORED}
        appearance = Appearance(Splats(**found), **colored)
    cues, figures = cues_of(motion, splats, parts), geometry.figures(spacing)
    return Reconstruction(splats, spacing, volume, cues, static, figures, appearance, parts)


def posed(splats: Splats, rotation: Tensor, center: Tensor, rest_center: Tensor) -> Splats:
    """Splats turned by `rotation` (3, 3) about `rest_center` (3,), which comes to lie at `center` (3,) [m]."""
    Q = rotation.to(splats.means)
    means = (splats.means - rest_center.to(splats.means)) @ Q.T + center.to(splats.means)
    rotations = quaternion_multiply(matrix_to_quaternion(Q), splats.rotations)
    return replace(splats, means=means, rotations=rotations)


def follow(
    scene: Scene, first: Scene, reconstruction: Reconstruction, *, rotation: Tensor, center: Tensor,
    rest_center: Tensor, settings: ReconstructionSettings, cache_dir: str | Path | None,
    seed: int = 0, device: torch.device | str = "cpu", progress: bool = True,
) -> Reconstruction:  # fmt: skip
    """The motion of a known body in another sequence: the particles that `reconstruction` found in the scene `first`, from the
    pose (rotation (3, 3) about rest_center, center (3,) [m]) that frame 0 of `scene` shows.

    Same body, other cues: positions are in the world, rotation and stretch relative to that pose, as those of the first
    sequence are to its frame 0. Cached under the key of both scenes and the pose. Errors: DataError (empty mattes)."""
    views, frames = scene.training_cameras, scene.training_frames
    _first_frame(scene)
    pose = (rotation, center, rest_center)
    cache = _open_cache(
        cache_dir, scene, _motion_settings(settings), seed, light="of its first frame, all along",
        body=[first.fingerprint, first.training_cameras, first.training_frames, reconstruction.spacing],
        pose=[[round(v, 6) for v in part.flatten().tolist()] for part in pose],
    )  # fmt: skip
    windows = object_windows(scene, views, frames, margin=settings.margin).to(device)

    def in_pose(rest: Splats) -> Splats:
        return posed(rest.to("cpu"), *(p.cpu() for p in pose))

    def turned(rest: Splats) -> tuple[Splats, tuple[Tensor, ...]]:
        """In the pose, in the light that falls on it there, which frame 0 shows; (its normals, the light)."""
        normals = surface_normals(rest.means, reconstruction.splats.means)
        still = [c for c in views if bool((scene.mattes[c, 0] > 0.5).any())]
        light = light_of(
            rest.to(device), normals.to(device), (rotation, center), scene.images[still, 0], scene.mattes[still, 0],
            scene.cameras.select(still), background=scene.background, rest_center=rest_center,
        ).cpu()  # fmt: skip
        moved, turn = in_pose(rest), rotation.cpu().to(normals)
        shades = shading(light, normals.cpu(), turn)
        return replace(moved, colors=moved.colors * shades[:, None]), (
            normals @ turn.T.to(normals),
            light,
        )

    rest = reconstruction.splats
    splats = in_pose(rest) if settings.dynamic.carriers == "static" else turned(rest)[0]
    static, lit = turned(rest if reconstruction.static is None else reconstruction.static)

    def bar(name: str, total: int) -> tqdm:
        title = f"reconstruction of {scene.sequence}: {name}"
        return tqdm(total=total, desc=title, disable=not progress, leave=False)

    known = reconstruction.moving.place if reconstruction.moving is not None else None
    place = None if known is None else known.turned(*(p.cpu() for p in pose))
    lit = tuple(part.to(device) for part in lit)
    parts = MovingParts(scene, splats.to(device), static.to(device), settings, place, lit)

    def motion_stage() -> dict[str, Tensor]:
        return first_motion(parts, windows, scene.background.to(device), seed, bar, cache)

    motion = cache.stage("motion", motion_stage, (len(frames), len(splats.means)))
    cues, volume = cues_of(motion, splats, parts), reconstruction.volume
    return Reconstruction(splats, reconstruction.spacing, volume, cues, static, moving=parts)


def scaffold_splats(particles: Particles, static: Splats, device: torch.device | str) -> Splats:
    """First guess of the particles' appearance: isotropic, 0.35 spacings wide (half a cell below the surface the alpha of an
    opaque one is then about one half at the surface), coloured by the static Gaussians nearby."""
    positions = particles.positions.to(device)
    colors = inherited_colors(positions, static)
    return isotropic_splats(positions, 0.35 * particles.spacing, 0.8, colors)

"""A 3DGS file of an object becomes a body that falls, without any video.

The Gaussians' inside is filled with particles, a law is chosen (`prior=...`) or taken from a checkpoint (`ckpt_path=...`), and the
rollout carries the Gaussians, harmonics and all."""

from __future__ import annotations

import copy
import logging
import math
import warnings
from dataclasses import fields, replace
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from scipy.spatial import cKDTree
from torch import Tensor

from mosa.config.build import build_body, plain, world_of
from mosa.config.extensions import load_extensions
from mosa.config.leaf_settings import SplatsSettings
from mosa.config.record import BodyRecord
from mosa.data.formats.scene_from_footage import check_density
from mosa.data.io.gaussian_ply import read_ply
from mosa.errors import ConfigError, DataError
from mosa.modules.body.body import Body, Start
from mosa.physics.engine.inputs import numbers
from mosa.reconstruction.gaussians.initial import inherited_colors
from mosa.reconstruction.geometry.filling import fill
from mosa.reconstruction.geometry.shell import solid_of, together
from mosa.reconstruction.pipeline import FEW, filling_spacing
from mosa.reconstruction.resolution import grid_spacing
from mosa.rendering.appearance.carried_splats import CarriedSplats
from mosa.settings import Number, Positive, typed
from mosa.system.limits import named_device
from mosa.training.preflight import check_splats
from mosa.training.run_folder import most_particles, quiet, run_folder
from mosa.twin.saved import save_twin
from mosa.twin.twin import Twin
from mosa.types import Appearance, Splats, metres

log = logging.getLogger(__name__)

ROOM = 4.0  # of the object's size, to each side of what it falls through
PLAUSIBLE = (0.01, 2.0)  # [m] of the longest side; others need `size`, or are warned of
WIDE = 0.25  # of the longest side: standard deviations of most Gaussians are below
ANYWHERE = 1e4  # [m] from the origin, how far the command lets the object fly
NEAR = 3.0  # spacings from the nearest particle beyond which a Gaussian does not belong to the body
HALF_CELL = 0.35  # sd of a particle's own Gaussian, in spacings (reconstruction)


@typed
def read_object(
    path: str | Path, *, box=None, opacity: Number = 0.1, size: Positive | None = None, up=None
) -> Appearance:
    """The Gaussians of a 3DGS PLY that are the object.

    box: two corners in the file's units; opacity: the least that is kept; size [m] that the longest side gets, None where the file
    is in metres, which is refused where that is implausible; up: compared with the file's header.
    Strays away from the object are left out before it is sized.
    Errors: DataError (damaged, fewer than 100 Gaussians left), ConfigError naming the argument."""
    splats, harmonics, offset, vertical = read_ply(path, centred=True)
    axis = "xyz".find(vertical[-1:] or "?")
    if up is not None and axis >= 0 and abs(up[axis]) < 0.9 * math.hypot(*up):
        warnings.warn(
            f"{path}: its header says that {vertical} is vertical, and up is {list(up)}",
            stacklevel=2,
        )
    chosen = splats.opacities >= opacity
    if box is not None:
        expected = "two corners [[x, y, z], [x, y, z]], min below max"
        corners = numbers("box", box, expected, (2, 3), dtype=torch.float64) - offset
        if not bool((corners[0] < corners[1]).all()):
            raise ConfigError(f"box: expected {expected}, found {box}")
        chosen &= ((splats.means > corners[0]) & (splats.means < corners[1])).all(1)
    if int(chosen.sum()) < 100:
        low, high = ([round(v, 3) for v in x.tolist()] for x in splats.means.aminmax(dim=0))
        where = "" if box is None else " in the box"
        raise DataError(
            f"{path}: expected at least 100 Gaussians of an opacity of {opacity:g} or more{where}, found "
            f"{int(chosen.sum())} of {len(chosen)}; the file spans {low} to {high}"
        )
    chosen[chosen.clone()] = together(splats.means[chosen])
    splats = Splats(*(getattr(splats, f.name)[chosen] for f in fields(Splats)))
    harmonics = harmonics[chosen]
    longest = float((splats.means.amax(0) - splats.means.amin(0)).max())
    if (wide := float(splats.scales.amax(1).median())) > WIDE * longest:
        raise DataError(
            f"{path}: field scale_*: expected logarithms of standard deviations, found half of the Gaussians wider "
            f"than {wide:.3g} in an object of {longest:.3g}: another encoding of the scales?"
        )
    usual = PLAUSIBLE[0] <= (longest if size is None else size) <= PLAUSIBLE[1]
    if size is None and not usual:
        raise ConfigError(
            f"size: {path} has no unit, and in metres its object would be {longest:.3g} m long; "
            f"expected the length of its longest side [m], as size=0.2 (size={longest:.3g} keeps it)"
        )
    factor = 1.0 if size is None else size / longest
    moved = f", {metres(offset)} units subtracted before" if bool(offset.any()) else ""
    if size is None:
        log.info(
            f"no size given: 1 unit is 1 m{moved}; the object's longest side is {longest:.3g} m"
        )
    else:
        log.info(f"size: 1 unit of the file is {factor:.6g} m{moved}")
        splats = replace(splats, means=factor * splats.means, scales=factor * splats.scales)
        if not usual:
            warnings.warn(
                f"size: {size:g} m is unusually {'large' if size > 1 else 'small'} for the longest side; "
                "was it meant in another unit?",
                stacklevel=2,
            )
    return Appearance(splats, harmonics)


def fill_object(
    appearance: Appearance, settings: SplatsSettings, most: int = FEW
) -> tuple[dict[str, Tensor], Appearance, float]:
    """(tensors of a body of particles inside the Gaussians, the Gaussians that belong to it, grid spacing [m]). most: as
    `reconstruction.pipeline.spacing_for` takes it. Errors: DataError."""
    up = torch.tensor(settings.up, dtype=torch.float32) if settings.open_below else None
    solid = solid_of(appearance.splats, resolution=settings.resolution, share=settings.share, up=up)
    grid = settings.simulation
    if grid.dx is None:
        particles = None if grid.particles == "auto" else grid.particles
        spacing = filling_spacing(solid, particles, per_cell=grid.particles_per_cell, most=most)
    else:
        spacing = grid.dx / grid_spacing(1.0, grid.particles_per_cell)
    found = fill(solid, spacing=spacing)
    tree = cKDTree(found.positions.numpy())
    near = torch.from_numpy(tree.query(appearance.splats.means.numpy())[0])
    kept = near < NEAR * found.spacing
    splats = Splats(*(getattr(appearance.splats, f.name)[kept] for f in fields(Splats)))
    n = len(found.positions)
    shapes = (HALF_CELL * spacing) ** 2 * torch.eye(3).expand(n, 3, 3)
    tensors = {"rest": found.positions, "volume": found.volume, "colors": inherited_colors(found.positions, splats),
               "opacities": torch.full((n,), 0.8), "covariances": shapes.contiguous()}  # fmt: skip
    cell = grid_spacing(spacing, grid.particles_per_cell)
    return tensors, Appearance(splats, appearance.harmonics[kept]), cell


@torch.random.fork_rng(devices=[])  # `build_body` seeds the generator, which is the caller's
def object_twin(
    appearance: Appearance, settings: SplatsSettings, learned: Twin | None = None, most: int = FEW
) -> Twin:
    """A twin of the object that Gaussians show.

    learned: of which material, adapter and contact are taken in place of those of the settings, and no stiffness field, which is of
    another body's places; most: as `fill_object` takes it. Errors: ConfigError, DataError."""
    if (density := settings.density) is None:
        density = 1000.0 if learned is None else learned.body.density
    check_density("density", density)
    direction = numbers("up", settings.up, "a direction (x, y, z)", (3,))
    if not float(direction.norm()) > 0:
        raise ConfigError(f"up: expected a direction (x, y, z), found {settings.up}")
    direction = direction / direction.norm()
    tensors, shown, cell = fill_object(appearance, settings, most)
    rest, height = tensors["rest"], settings.height
    if settings.recentre:
        middle = 0.5 * (rest.amin(0) + rest.amax(0))
        above = float(middle @ direction) - float((rest @ direction).min()) + height
        origin = middle - above * direction
        log.info(f"recentre: {metres(origin)} m subtracted from all places")
        tensors["rest"] = rest = rest - origin
        means = shown.splats.means - origin.to(shown.splats.means)
        shown = replace(shown, splats=replace(shown.splats, means=means))
    given, chosen = settings.plain(), None
    if learned is not None:
        given, chosen = copy.deepcopy(dict(learned.record.settings)), learned.record.law
    given["heterogeneity"] = {**given.get("heterogeneity", {}), "enabled": False}
    given["world"] = {"colliders": [dict(each) for each in settings.colliders or ()]}
    room = ROOM * float((rest.amax(0) - rest.amin(0)).max()) + height
    ground = 0.0 if settings.recentre else float((rest @ direction).min()) - height
    met = {"height": ground, **settings.ground.plain()}
    world = {"gravity": (-settings.gravity * direction).tolist(), "up": direction.tolist(),
             "box": [(rest.amin(0) - room).tolist(), (rest.amax(0) + room).tolist()]}  # fmt: skip
    record = BodyRecord(settings=given, law=chosen, ground=met, world=world, density=density, dx=cell,
                        frame_dt=1 / settings.rate)  # fmt: skip
    body = build_body(record, tensors)
    if learned is not None:
        take_law(body, learned.body)
    if settings.appearance == "splats":
        body.splats = CarriedSplats(shown, body.rest)
    start = Start(torch.eye(3), body.center, torch.zeros(3), torch.zeros(3))
    return Twin(body.eval(), world_of(record), record.frame_dt, record, start)


@torch.no_grad()
def take_law(body: Body, learned: Body) -> None:
    """Material, adapter and contact of another body, calibrated variants included; a stiffness field stays with its own."""
    foreign = ("heterogeneity", "rest", "volume", "colors", "opacities", "covariances")
    state = learned.state_dict()
    state = {k: state[k] for k in state if not set(foreign) & set(k.split("."))}
    missing, unexpected = body.load_state_dict(state, strict=False)
    if found := unexpected or [name for name in missing if name not in foreign]:
        raise DataError(f"ckpt_path: expected a law that fits the object, found {found}")


def drop(cfg: DictConfig) -> None:
    """`python -m mosa.splats`: fill the Gaussians of a file, let them fall, write frames, video and a checkpoint of the body."""
    quiet()
    if OmegaConf.is_missing(cfg, "ply"):
        way = "python -m mosa.splats ply=object.ply"
        raise ConfigError(f"ply: expected a 3DGS PLY file of an object, found none; {way}")
    values, folder = plain(cfg), run_folder()
    load_extensions(values.get("extensions"))
    settings = check_splats(values)
    device = named_device(settings.device)
    given = {key: getattr(settings, key) for key in ("box", "opacity", "size", "up")}
    found = read_object(settings.ply, **given)
    learned = None if settings.ckpt_path is None else Twin.load(settings.ckpt_path)
    twin = object_twin(found, settings, learned, most_particles(device))
    twin.body.to(device)
    body, world, means = twin.body, twin.world, found.splats.means
    long = float((means.amax(0) - means.amin(0)).max())
    said = "object: %d Gaussians, %.3g m long; %d particles in it span %.3g m and have %.4g cm^3"
    count = len(means if body.splats is None else body.splats)
    log.info(said, count, long, len(body.rest), body.size, 1e6 * float(body.volume.sum()))
    at = metres(torch.tensor(world.ground.height))
    said = "scene: up %s, ground at %s m along it, the object's centre at %s m; %d obstacles"
    log.info(said, metres(world.up), at, metres(body.center), len(world.colliders))
    if settings.preset is not None:
        twin.material.preset(settings.preset)
        if settings.density is not None:
            twin.material.set(density=settings.density)
    save_twin(twin, folder / "checkpoints" / "last.ckpt")
    rollout = twin.simulate(
        frames=settings.frames, progress=True, box=[[-ANYWHERE] * 3, [ANYWHERE] * 3], height=settings.height,
        rotation=settings.rotation, velocity=settings.velocity, angular_velocity=settings.angular_velocity,
    )  # fmt: skip
    kinds = {"formats": settings.formats, "video": settings.video, **settings.film.plain()}
    twin.export(rollout, folder, title="object", progress=True, **kinds)
    log.info("%d frames in %s; look at them with mosa-view %s", len(rollout.x), folder, folder)

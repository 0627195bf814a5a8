"""What is refused before anything long runs: one function for each moment at which something more is known."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from mosa.config.build import build_world, plain, rehearse, world_config
from mosa.config.checkpoints import check_resumed, check_same_scene, read_checkpoint
from mosa.config.command_settings import EvalSettings, SimulateSection, TrainSettings
from mosa.config.effects import warn_without_effect
from mosa.config.leaf_settings import SplatsSettings
from mosa.config.record import RunRecord
from mosa.data.io.forces import curves_of, forces_from_config, warn_of_clock
from mosa.data.io.splat_formats import check_formats
from mosa.errors import ConfigError, DataError
from mosa.evaluation.analysis.figures import ffmpeg
from mosa.modules.body.body import Body, Start, World
from mosa.modules.fitting.search.backbone import FURTHEST
from mosa.physics.contact.colliders import Collider, colliders_from_config
from mosa.physics.contact.driven import Driven
from mosa.physics.contact.overlap import check_clear
from mosa.physics.contact.planes import ground_plane
from mosa.physics.engine.axes import turn_along
from mosa.reconstruction.pose.starts import first_contact
from mosa.system.limits import counted
from mosa.training.memory import ball_of
from mosa.twin.film import viewed_from
from mosa.twin.presets import preset
from mosa.twin.twin import Twin
from mosa.types import REST, Scene

PARTICLE_BYTES = 5e3  # of a particle in reconstruction and fit, at least
FEWEST = 8
DEFORMED = 3  # frames after contact that a fit needs (tiny scene: three find E to 15 %)


def check_configuration(values: Mapping[str, Any]) -> TrainSettings:
    """All that train.py's configuration says by itself; a warning for each key that was set and does nothing. Errors: ConfigError
    naming the key."""
    settings = TrainSettings.read(values)
    if settings.simulation.particles != "auto":
        check_particles("simulation.particles", settings.simulation.particles)
    if settings.evaluation.video:
        ffmpeg("evaluation.video")
    stages = rehearse(settings)
    warn_without_effect(settings, stages)
    return settings


def check_evaluation(values: Mapping[str, Any]) -> EvalSettings:
    """All that eval.py's configuration says by itself. Errors: ConfigError naming the key."""
    settings = EvalSettings.read(values)
    if settings.evaluation.video:
        ffmpeg("evaluation.video")
    warn_of_idle(settings)
    return settings


def warn_of_idle(settings: EvalSettings) -> None:
    """A warning that names keys of eval.py which have no effect on what it is asked for."""
    own, usual, plans = settings.simulate, SimulateSection(), settings.plan is not None
    given = [
        name for name in SimulateSection.model_fields if getattr(own, name) != getattr(usual, name)
    ]
    simulates = not plans and not set(own.STARTS).isdisjoint(given)
    idle = [f"simulate.{name}" for name in given if not simulates]
    idle += ["scene"] * (settings.scene is not None and (plans or simulates))
    if idle:
        warnings.warn(
            f"{', '.join(idle)}: no effect here. eval.py ranks drops where plan is given; else it simulates a new start where "
            f"one of simulate.{{{', '.join(own.STARTS)}}} is; else it evaluates the scene",
            stacklevel=2,
        )


def check_splats(values: Mapping[str, Any], overrides: Iterable[str] = ()) -> SplatsSettings:
    """All that the configuration of `python -m mosa.splats` says by itself, and that these overrides
    and those of the command line say beside each other. Errors: ConfigError naming the key."""
    settings = SplatsSettings.read(values)
    if settings.video:
        ffmpeg("video")
    check_formats(settings.formats)
    if settings.film.view is not None and any(settings.up):
        up = torch.tensor(settings.up).float()
        if float((viewed_from(settings.film.view, up, name="film.view") @ up).max()) < 0:
            below = f"looks from below the object, as up is {settings.up}"
            warnings.warn(f"film.view: {settings.film.view} {below}", stacklevel=2)
    task = HydraConfig.get().overrides.task if HydraConfig.initialized() else ()
    words = [w for w in (*overrides, *task) if re.match(r"[+~]*(prior|adapter|ckpt_path)\b", w)]
    if settings.preset is not None:
        preset(settings.preset)
        if words:
            raise ConfigError(
                f"preset: {settings.preset} sets the law and all its values: expected no prior, adapter or ckpt_path "
                f"beside it, found {' '.join(words)}; leave out preset={settings.preset} or the rest"
            )
    elif settings.ckpt_path is not None:
        if idle := [w for w in words if "ckpt_path" not in w.partition("=")[0]]:
            warnings.warn(
                f"{' '.join(idle)}: no effect here: the object gets the law of ckpt_path",
                stacklevel=2,
            )
    elif settings.adapter.name is not None:
        warnings.warn(
            "adapter: no effect here: nothing is learned from a file of Gaussians, and the object gets the prior's law "
            "alone; ckpt_path=<run folder>/checkpoints/last.ckpt gives it one that was learned",
            stacklevel=2,
        )
    colliders_from_config(settings.colliders or (), "colliders")
    if settings.simulation.particles != "auto":
        check_particles("simulation.particles", settings.simulation.particles)
    return settings


def check_particles(key: str, count: float) -> None:
    """Errors: ConfigError where the machine cannot hold as many."""
    counted(key, [count], "take as many as this machine has memory for", each=PARTICLE_BYTES / 2)


def check_begin(cfg: DictConfig) -> RunRecord | None:
    """The record of the checkpoint that a fit is to go on from, which is of this scene. Errors: DataError, ConfigError naming the
    keys."""
    if cfg.ckpt_path is None:
        return None
    try:
        record = check_resumed(read_checkpoint(cfg.ckpt_path), cfg.ckpt_path)
    except DataError as error:
        if cfg.resume != "auto":
            raise
        raise DataError(f"{error}; remove the file, and resume=auto begins the fit anew") from error
    check_same_scene(record, plain(cfg), cfg.ckpt_path)
    return record


def check_seen(cfg: DictConfig, scene: Scene) -> None:
    """The object as frame 0 shows it, before its reconstruction: no solid contains it, a grid suits its size, ground and walls.

    Errors: ConfigError naming the key. Silent where fewer than two mattes are whole."""
    world = build_world(world_config(scene) | {"walls": plain(cfg.world).get("walls")})
    ground = [] if world.ground is None else [ground_plane(world.ground, world.up)]
    turn_along([*ground, *world.planes])
    if (seen := ball_of(scene)) is None:
        return
    place, radius = seen
    solids = colliders_from_config(plain(cfg.world)["colliders"] or ())
    check_clear(solids, place[None], "the object, as frame 0 shows it,")
    if (dx := cfg.simulation.dx) is not None:
        count = 4 / 3 * 3.14 * min(radius / dx, 1e30) ** 3 * cfg.simulation.particles_per_cell
        if count < FEWEST:
            raise ConfigError(
                f"simulation.dx: expected less than the object's radius of {radius:.3g} m, found "
                f"{dx} m"
            )


def check_curves(cfg: DictConfig, scenes: Sequence[Scene]) -> None:
    """Measured forces cover frames of their film; scenes: the training film first. Errors: ConfigError."""
    curves = forces_from_config(plain(cfg.world).get("forces"))
    for scene in scenes:
        for curve in curves_of(curves, scene.sequence, scene is scenes[0]):
            film = len(scene.training_frames), scene.frame_dt
            curve.means(*film)
            warn_of_clock(curve, *film)


def check_starts(world: World, body: Body, found: dict[str, Start]) -> None:
    """No sequence starts inside of a solid. Errors: ConfigError naming the collider."""
    for prefix, start in found.items():
        x = (body.rest - body.center) @ start.rotation.to(body.rest).T + start.center.to(body.rest)
        check_clear(world.colliders, x, f"the body of {prefix}", spacing=body.spacing)


def check_held(world: World, body: Body) -> None:
    """Something touches the body that is to deform, and its stiffness can bear its weight, up to where a calibration searches.
    Errors: ConfigError naming the key."""
    if not (world.ground or world.planes or world.colliders or world.driven):
        raise ConfigError(
            "world.driven: expected something that holds, drives or touches the body (a clamp or grip; or scene.ground, "
            "world.walls, world.colliders), found nothing: in free flight it does not deform, so nothing determines its law"
        )
    E = float(body.material.physical().get("E", torch.tensor(math.inf)).detach())
    weight = body.density * float(world.gravity.norm()) * body.size
    if FURTHEST * E < weight:
        raise ConfigError(
            f"prior.parameters.E: expected Pa (1 MPa is 1e6), found {E:.3g}: the body's weight is a pressure of {weight:.3g} Pa "
            f"(density {body.density:g} kg/m^3, {body.size:.3g} m), and a search goes up to {FURTHEST:g} times the start"
        )


def warn_of_little(
    world: World, body: Body, found: Mapping[str, Start], scenes: Sequence[Scene]
) -> None:
    """A warning for a film that is learned from and ends when the object has hardly begun to deform, and for films of given motions
    alone, without a force. found: starts by prefix; scenes: theirs, in this order."""
    if world.colliders or world.planes or world.driven:
        solids: list[Collider | Driven] = [*world.colliders, *world.driven]
        rests = all(
            s.start == REST for prefix, s in zip(found, scenes) if prefix.startswith("train")
        )
        if rests and not world.forces and any(each.motion.max_speed(1.0) > 0 for each in solids):
            warnings.warn(
                "world.forces: expected a measured force beside solids and driven sets of given motion, which determine "
                "strains, found none: only the body's weight determines E, which may be several times off, and its "
                "standard deviation is too small",
                stacklevel=2,
            )
        return
    for (prefix, start), scene in zip(found.items(), scenes):
        if not prefix.startswith("train") or scene.ground is None:
            continue
        after = sum(frame >= first_contact(body, start, scene) for frame in scene.training_frames)  # type: ignore[arg-type]  # a body has the parts of its rest shape
        if after < DEFORMED:
            warnings.warn(f"{prefix}: {after} of the {len(scene.training_frames)} frames that are learned from come after first "
                          f"contact: expected {DEFORMED} at least, in which the object deforms; numbers that the film does "
                          "not determine stay at their start, and their standard deviations are too small (scene.frames, "
                          "scene.holdout_frames, scene.last_free_frame)", stacklevel=2)  # fmt: skip


def evaluated_scene(cfg: DictConfig, twin: Twin) -> DictConfig:
    """The keys of the scene to evaluate on: eval.py's own, else what the run stored, which is read as data. Stored paths are read
    from, and never written to: what is made goes to eval.py's own cache. Errors: DataError."""
    if cfg.get("scene"):
        keys = plain(cfg.scene)
    else:
        stored = twin.record.settings.get("scene")
        if not isinstance(stored, dict) or not all(isinstance(key, str) for key in stored):
            raise DataError(f"ckpt_path: {cfg.ckpt_path}: its run has no scene; set scene=<option>")
        keys = stored | {"cache": None}
        if (path := keys.get("path")) is not None:
            below = keys.get("root")
            way = "as the checkpoint says (scene=... reads another)"
            print(f"scene: reads {path} below {below}, {way}")
    return OmegaConf.create({"scene": keys | {"cache": keys.get("cache") or cfg.get("cache")}})

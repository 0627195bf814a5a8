"""From configuration to objects: the only place that knows both. Everything below takes explicit arguments."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

import mosa.config.composition  # noqa: F401  registers what conf/ refers to
from mosa.config.command_settings import TrainSettings
from mosa.config.known_numbers import known_numbers
from mosa.config.record import BodyRecord
from mosa.data.io.forces import columns_of, forces_from_config
from mosa.data.sequences import further_names
from mosa.errors import ConfigError
from mosa.evaluation.analysis.law_stress import check_own
from mosa.modules.adapters.registry import adapter_class
from mosa.modules.body.body import Body, Start, World
from mosa.modules.body.heterogeneity import HeterogeneityField
from mosa.modules.body.material import Material
from mosa.modules.body.settings import HeterogeneitySettings, PriorSection, names
from mosa.modules.body.stiffness_modes import StiffnessModes
from mosa.modules.fitting.parameters import few_numbers
from mosa.modules.fitting.stages import STAGES, FitSection, Stage, recalibrations
from mosa.modules.fitting.terms import check_terms
from mosa.physics.constitutive.laws import law_named
from mosa.physics.contact.colliders import colliders_from_config, domain_walls
from mosa.physics.contact.driven import driven_from_config
from mosa.physics.contact.motion import Motion
from mosa.physics.contact.planes import Plane
from mosa.physics.engine.law_options import LawOptions
from mosa.physics.world import solids_of
from mosa.reconstruction.rest_shape import RestShape
from mosa.settings import call
from mosa.types import AUTO, Ground, Scene

HETEROGENEITY = {"modes": StiffnessModes, "network": HeterogeneityField}  # heterogeneity.kind


def plain(cfg: DictConfig) -> dict[str, Any]:
    """Resolved plain containers, fit for a checkpoint. Errors: ConfigError where a key cannot be resolved."""
    try:
        return OmegaConf.to_container(cfg, resolve=True)
    except Exception as error:
        raise ConfigError(f"the configuration cannot be resolved: {error}") from error


def world_config(scene: Scene) -> dict[str, Any]:
    """Plain description of the world a scene plays in."""
    return {
        "ground": asdict(scene.ground) if scene.ground is not None else None,
        "gravity": scene.gravity.tolist(),
        "up": scene.up.tolist(),
        "box": scene.box.tolist(),
        "driven": list(scene.driven),
    }


def build_world(config: Mapping[str, Any]) -> World:
    """walls: {mode, friction} of the box's six sides, or None; colliders, driven: lists, see
    `colliders_from_config` and `driven_from_config`; all may be absent."""
    ground = Ground(**config["ground"]) if config["ground"] is not None else None
    # where it is found, it is written down; until then the body sticks
    if ground is not None and ground.mode == AUTO:
        ground = replace(ground, mode="sticky")
    gravity, up, box = (
        torch.tensor(config[k], dtype=torch.float32) for k in ("gravity", "up", "box")
    )
    walls = build_walls(config.get("walls"), box)
    solids = colliders_from_config(config.get("colliders") or ())
    driven = driven_from_config(config.get("driven") or ())
    return World(ground, gravity, up, box, walls, solids, driven)


def build_walls(walls: Mapping[str, Any] | None, box: Tensor) -> tuple[Plane, ...]:
    """The six sides of the box, none where `walls` is None. Errors: ConfigError naming the key."""
    if walls is None:
        return ()
    if not walls:
        raise ConfigError(
            "world.walls: expected null, or keys as in {mode: separate, friction: 0.1}, found none"
        )
    return tuple(call("world.walls", domain_walls, walls, box=box))


def world_of(record: BodyRecord) -> World:
    """The world of a run: what was measured, and the walls and solids of its settings. Errors: ConfigError."""
    given = record.sections.world
    ground = None if record.ground is None else record.ground.plain()
    driven = [*record.world.driven, *(given.driven or ())]
    own = {"ground": ground, "walls": given.walls, "colliders": given.colliders, "driven": driven}
    return build_world(record.world.plain() | own)


def measured(
    settings: Mapping[str, Any], scene: Scene, dx: float, starts: Mapping[str, Start] | None = None,
    data: Mapping[str, str] | None = None,
) -> BodyRecord:  # fmt: skip
    """The record of a body that was found in a scene. settings: of the run, as they were given; dx [m]; data: fingerprints of the
    films by sequence."""
    known = world_config(scene)
    return BodyRecord(
        settings=dict(settings),
        ground=known.pop("ground"),
        world=known,
        density=scene.density,
        dx=dx,
        frame_dt=scene.frame_dt,
        starts={prefix: start.written() for prefix, start in (starts or {}).items()},
        data=dict(data or {}),
    )


def build_body(record: BodyRecord, tensors: Mapping[str, Tensor]) -> Body:
    """A body with the law, adapter and settings of a run. tensors: rest, volume, colors, opacities, covariances."""
    sections = record.sections
    torch.default_generator.manual_seed(sections.seed)  # all modules are made on the CPU
    material, options = build_prior(sections.prior, record.law)
    heterogeneity = build_heterogeneity(
        sections.heterogeneity, tensors["rest"].amin(0), tensors["rest"].amax(0)
    )
    adapter = build_adapter(sections.adapter.plain())
    if not material.candidates:  # else once the law is chosen
        adapter = fitting(adapter, material.law)
    settings = sections.simulation.on_grid(record.dx)
    if record.ground is None and sections.world.walls is None:
        settings = settings.but(contact_offset=False)  # solids keep their place from the body
    return Body(
        **tensors,
        density=record.density,
        material=material,
        heterogeneity=heterogeneity,
        adapter=adapter,
        settings=settings,
        law_options=options,
    )


def body_of(shape: RestShape, record: BodyRecord) -> Body:
    """The body of a reconstruction, with the law, settings and appearance of the run, on the device of `shape`."""
    body = build_body(record, {name: tensor.cpu() for name, tensor in shape.tensors().items()})
    # a copy: a module moves and switches what it holds, and several may be made of one data module
    body.splats = copy.deepcopy(shape.splats)
    return body.to(shape.rest.device)


def fitting(adapter: torch.nn.Module | None, law: str) -> torch.nn.Module | None:
    """The adapter, or None with a warning where there is nothing of this law that it could correct."""
    if adapter is None or (reason := adapter.unsuited(law_named(law))) is None:
        return adapter
    warnings.warn(f"adapter: {reason}", stacklevel=2)
    return None


def build_prior(
    config: Mapping[str, Any] | PriorSection, law: str | None = None
) -> tuple[Material, LawOptions]:
    """The prior's parameters, and how its law is taken. law: the one that was chosen among its candidates. Errors:
    ConfigError naming the key."""
    section = PriorSection.read(config)
    options = LawOptions.read(section.options or {})
    material = Material(
        section.law,
        section.parameters,
        names(section.frozen),
        None if section.modulated is None else names(section.modulated),
        names(section.candidates),
        options.friction_cone,
    )
    if law:
        material.choose(law)
    return material, options


def build_heterogeneity(
    config: Mapping[str, Any] | HeterogeneitySettings, low: Tensor, high: Tensor
) -> torch.nn.Module | None:
    """The field on the box (3,) to (3,) [m], None where it is switched off. Errors: ConfigError naming the key."""
    settings = HeterogeneitySettings.read(config)
    return HETEROGENEITY[settings.kind](low, high, settings) if settings.enabled else None


def rehearse(values: Mapping[str, Any] | TrainSettings) -> list[Stage]:
    """Build what needs no data and drop it: a mistake then shows before the reconstruction. Returns the stages of the fit.

    Errors: ConfigError naming the key."""
    settings = TrainSettings.read(values)
    low, high = torch.zeros(3), torch.ones(3)
    with torch.random.fork_rng(devices=[]):
        material, _ = build_prior(settings.prior)
        check_own(material)
        heterogeneity = build_heterogeneity(settings.heterogeneity, low, high)
        with warnings.catch_warnings():  # said again where the body is built
            warnings.simplefilter("ignore")
            adapter = fitting(build_adapter(settings.adapter.plain()), material.law)
        check_known(settings.identification.known, material, adapter)
    stages = build_stages(settings.fit, heterogeneity, adapter, bool(material.candidates))
    criterion, marked = settings.criterion.name, settings.scene.plain().get("format") == "markers"
    free = criterion == "free" or marked or all(stage.calibrates for stage in stages)
    if settings.simulation.adaptive and not free:
        raise ConfigError(
            f"simulation.adaptive: expected criterion=free beside it, found criterion={criterion}: predictions that are corrected "
            "in every frame have fixed substeps"
        )
    weights = settings.losses.weights()
    check_terms(weights, adapter)
    if not any(weights[name] for name in ("image", "mask", "flow", "rotation", "stretch", "position")):  # fmt: skip
        raise ConfigError(
            "losses: expected a weight above 0 for image, mask, flow, rotation, stretch or position: nothing else "
            "tells the prior anything"
        )
    build_walls(settings.world.walls, torch.stack([low, high]))
    for collider in colliders_from_config(settings.world.colliders or ()):
        if isinstance(collider.motion, Motion) and collider.motion.times is not None:
            collider.motion.sample(1, 1, 1.0)  # as many velocities as times
    check_forces(settings.world.plain(), further_names(settings.scene.plain()))
    if settings.world.forces and not all(stage.newton for stage in stages):
        raise ConfigError(
            "world.forces: expected stages that run Gauss-Newton, which compares forces, found Adam "
            "(fit.<stage>.optimizer); leave the forces out, or choose an adapter of few numbers"
        )
    return stages


def check_known(path: str | None, material: Material, adapter: torch.nn.Module | None) -> None:
    """Another experiment tells of the law, or of one of its candidates. Errors: DataError naming the file, ConfigError."""
    refused = None
    for law in () if path is None else material.candidates or (material.law,):
        own = copy.deepcopy(material)
        own.choose(law)
        try:
            known_numbers(path, own, adapter, "identification.known")
            return
        except ConfigError as error:
            refused = error
    if refused is not None:
        raise refused


def check_forces(world: Mapping[str, Any], recordings: Sequence[str] = ()) -> None:
    """Driven sets and measured forces, before anything takes long. recordings: names of those beside
    the first. Errors: ConfigError naming the key, DataError the file."""
    solids = colliders_from_config(world.get("colliders") or ())
    sets = driven_from_config(world.get("driven") or ())
    curves = forces_from_config(world.get("forces"))
    columns_of(curves, solids_of(solids, sets))
    names = [curve.name for curve in curves]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ConfigError(
            f"world.forces: expected one file for each solid in each recording, found two of {twice[0]!r}; columns of "
            "one time axis go into one file"
        )
    if unknown := [c.recording for c in curves if c.recording not in (None, *recordings)]:
        raise ConfigError(
            "world.forces: recording: expected the name of one of scene.also_train or scene.test "
            f"({', '.join(recordings) or 'there are none'}), no key for that of scene.path, found "
            f"{unknown[0]!r}"
        )


def build_adapter(config: Mapping[str, Any]) -> torch.nn.Module | None:
    """The adapter of that name, None where there is none. Errors: ConfigError naming the key."""
    build = adapter_class(config)
    if build is None:
        return None
    return call("adapter", build, {key: value for key, value in config.items() if key != "name"})


def build_stages(
    fit: Mapping[str, Any] | FitSection,
    heterogeneity: torch.nn.Module | None,
    adapter: torch.nn.Module | None,
    searching: bool = False,
) -> list[Stage]:
    """The stages of a run, without those that have nothing to optimise or no iterations, each with the optimiser that it runs.

    searching: whether the calibration chooses the law too."""
    section = FitSection.read(fit)
    stages = [section.stage(name) for name in STAGES]
    learned = {s.name: s.learns(heterogeneity, adapter) for s in stages}
    learns = {name: any(part is not None for part in parts) for name, parts in learned.items()}
    wanted = [s for s in stages if s.iterations > 0 and (s.calibrates or learns[s.name])]
    later = adapter is not None and adapter.later
    # of networks that come later the stage before has few numbers, also where they have come
    few = {s.name: all(few_numbers(p) or (later and p is adapter) for p in learned[s.name]) for s in wanted}  # fmt: skip
    stages = recalibrations([s.resolved(few[s.name]) for s in wanted])
    if later:
        again = [s.but(name="networks", optimizer="adam", start=None) for s in wanted if s.learns_adapter]  # fmt: skip
        stages += [stage.resolved(few=False) for stage in again]
    if searching and stages and not stages[0].newton:
        raise ConfigError(
            "prior=auto: expected fit.prior.optimizer=auto or gauss_newton, which compares candidates; found adam"
        )
    if not stages or not stages[0].calibrates:
        raise ConfigError(
            "fit.prior.iterations: expected at least 1: every later figure is compared with the calibrated prior"
        )
    return stages


def build_fit(record: BodyRecord, body: Body) -> dict[str, Any]:
    """World, stages, loss weights and settings of a fit, as `LitMosa._begin` takes them. Errors: ConfigError naming the key."""
    settings = TrainSettings.part(record.settings)
    stages = build_stages(settings.fit, body.heterogeneity, body.adapter)
    filmed = settings.scene.plain().get("format") != "markers"
    if not settings.reconstruction.informed.iterations or not filmed:
        stages = [stage for stage in stages if not stage.looks_again]
    return {
        "world": replace(world_of(record), forces=forces_from_config(settings.world.forces)),
        "stages": stages,
        "weights": settings.losses.weights(),
        "clip": settings.fit.clip,
        "criterion": settings.criterion,
        "settings": settings.identification,
    }

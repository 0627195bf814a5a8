"""From configuration to objects: the only place that knows both. Everything below takes explicit arguments."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

import mosa.config.composition  # noqa: F401  registers the resolvers that conf/ uses
from mosa.data.io.forces import columns_of, forces_from_config
from mosa.errors import ConfigError
from mosa.evaluation.settings import EvaluationSettings
from mosa.modules.adapters.registry import adapter_class
from mosa.modules.body.body import Body, SimulationSettings, World
from mosa.modules.body.heterogeneity import HeterogeneityField, HeterogeneitySettings
from mosa.modules.body.material import Material
from mosa.modules.body.stiffness_modes import StiffnessModes
from mosa.modules.fitting.criteria import Criterion
from mosa.modules.fitting.identification_settings import IdentificationSettings
from mosa.modules.fitting.parameters import few_numbers
from mosa.modules.fitting.stages import STAGES, Stage, recalibrations
from mosa.modules.fitting.terms import check_terms
from mosa.physics.constitutive.laws import law_named
from mosa.physics.contact.colliders import colliders_from_config, domain_walls
from mosa.physics.contact.driven import driven_from_config
from mosa.physics.contact.motion import Motion
from mosa.physics.contact.planes import Plane
from mosa.physics.engine.law_options import LawOptions
from mosa.reconstruction.settings import build_settings
from mosa.schema import known_keys
from mosa.types import AUTO, Ground, Scene

SIZES = ("particles", "particles_per_cell", "dx")
"""Keys of `simulation` that say how fine the body is: the reconstruction's."""
HETEROGENEITY = {"modes": StiffnessModes, "network": HeterogeneityField}
"""heterogeneity.kind."""


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
    }


def build_world(config: Mapping[str, Any]) -> World:
    """walls: {mode, friction} of the box's six sides, or None; colliders, driven: lists, see
    `colliders_from_config` and `driven_from_config`; all may be absent."""
    ground = Ground(**config["ground"]) if config["ground"] is not None else None
    if (
        ground is not None and ground.mode == AUTO
    ):  # where it is found, it is written down; until then the body sticks
        ground = replace(ground, mode="sticky")
    gravity, up, box = (
        torch.tensor(config[k], dtype=torch.float32) for k in ("gravity", "up", "box")
    )
    return World(
        ground,
        gravity,
        up,
        box,
        build_walls(config.get("walls"), box),
        colliders_from_config(config.get("colliders") or ()),
        driven_from_config(config.get("driven") or ()),
    )


def build_walls(walls: Mapping[str, Any] | None, box: Tensor) -> tuple[Plane, ...]:
    """The six sides of the box, none where `walls` is None. Errors: ConfigError naming the key."""
    if walls is None:
        return ()
    if not walls:
        raise ConfigError(
            "world.walls: expected null, or keys as in {mode: separate, friction: 0.1}, found none"
        )
    return tuple(known_keys("world.walls", domain_walls, walls, box))


def run_config(cfg: dict[str, Any], scene: Scene, dx: float) -> dict[str, Any]:
    """What a checkpoint keeps: the configuration, and what was measured from the data."""
    return {
        "cfg": cfg,
        "world": world_config(scene) | (cfg.get("world") or {}),
        "density": scene.density,
        "dx": dx,
        "frame_dt": float(scene.times[1] - scene.times[0]),
    }


def build_body(config: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Body:
    """A body with the law, adapter and settings of a run. tensors: rest, volume, colors, opacities, covariances."""
    cfg = config["cfg"]
    torch.manual_seed(cfg["seed"])
    settings = build_simulation(cfg["simulation"], config["dx"])
    material, options = build_prior(cfg["prior"])
    heterogeneity = build_heterogeneity(
        cfg["heterogeneity"], tensors["rest"].amin(0), tensors["rest"].amax(0)
    )
    adapter = fitting(build_adapter(cfg["adapter"]), material.law)
    return Body(
        **tensors,
        density=config["density"],
        material=material,
        heterogeneity=heterogeneity,
        adapter=adapter,
        settings=settings,
        law_options=options,
    )


def fitting(adapter: torch.nn.Module | None, law: str) -> torch.nn.Module | None:
    """The adapter, or None with a warning where there is nothing of this law that it could correct."""
    if adapter is None or (reason := adapter.unsuited(law_named(law))) is None:
        return adapter
    warnings.warn(f"adapter: {reason}", stacklevel=2)
    return None


def build_simulation(config: Mapping[str, Any], dx: float) -> SimulationSettings:
    """Settings of the rollouts on a grid of spacing dx [m]."""
    if missing := [
        k
        for k in ("stride", "max_substeps", "courant", "precision", "contact_offset")
        if k not in config
    ]:
        raise ConfigError(f"simulation.{missing[0]}: expected this key, found none")
    if config["stride"] > config["max_substeps"]:
        raise ConfigError(
            f"simulation.stride: expected at most simulation.max_substeps={config['max_substeps']}, as a frame has "
            f"whole strides, found {config['stride']}"
        )
    # whose grid is given as dx
    return known_keys(
        "simulation",
        SimulationSettings,
        {k: v for k, v in config.items() if k not in SIZES} | {"dx": dx},
    )


def build_prior(config: Mapping[str, Any]) -> tuple[Material, LawOptions]:
    """The prior's parameters, and how its law is taken. Errors: ConfigError naming the key."""
    keys = dict(config)
    options = known_keys("prior.options", LawOptions, keys.pop("options", None) or {})
    keys["frozen"], keys["candidates"] = keys.get("frozen") or (), keys.get("candidates") or ()
    return known_keys("prior", Material, keys), options


def build_heterogeneity(
    config: Mapping[str, Any], low: Tensor, high: Tensor
) -> torch.nn.Module | None:
    """The field on the box (3,) to (3,) [m], None where it is switched off. Errors: ConfigError naming the key."""
    settings = known_keys("heterogeneity", HeterogeneitySettings, config)
    return HETEROGENEITY[settings.kind](low, high, settings) if settings.enabled else None


def rehearse(cfg: Mapping[str, Any]) -> list[Stage]:
    """Build what needs no data and drop it: a mistake then shows before the reconstruction. Returns the stages of the fit.

    Errors: ConfigError naming the key."""
    build_settings(**cfg["reconstruction"])
    low, high = torch.zeros(3), torch.ones(3)
    with torch.random.fork_rng(devices=[]):
        material, _ = build_prior(cfg["prior"])
        heterogeneity = build_heterogeneity(cfg["heterogeneity"], low, high)
        with warnings.catch_warnings():  # said again where the body is built
            warnings.simplefilter("ignore")
            adapter = fitting(build_adapter(cfg["adapter"]), material.law)
    build_simulation(cfg["simulation"], 1.0)
    stages = build_stages(cfg["fit"], heterogeneity, adapter, bool(material.candidates))
    build_criterion(cfg)
    build_identification(cfg)
    build_evaluation(cfg)
    check_terms(cfg["losses"], adapter)
    if not any(
        cfg["losses"].get(name)
        for name in ("image", "mask", "flow", "rotation", "stretch", "position")
    ):
        raise ConfigError(
            "losses: expected a weight above 0 for image, mask, flow, rotation, stretch or position: nothing else "
            "tells the prior anything"
        )
    build_walls(cfg["world"]["walls"], torch.stack([low, high]))
    for collider in colliders_from_config(cfg["world"]["colliders"] or ()):
        if isinstance(collider.motion, Motion) and collider.motion.times is not None:
            collider.motion.sample(1, 1, 1.0)  # as many velocities as times
    check_forces(cfg["world"])
    if cfg["world"].get("forces") and not all(stage.newton for stage in stages):
        raise ConfigError(
            "world.forces: expected stages that run Gauss-Newton, which compares forces, found Adam "
            "(fit.<stage>.optimizer); leave the forces out, or choose an adapter of few numbers"
        )
    return stages


def check_forces(world: Mapping[str, Any]) -> None:
    """Driven sets and measured forces, before anything takes long. Errors: ConfigError naming the
    key, DataError the file."""
    solids = colliders_from_config(world.get("colliders") or ())
    sets = driven_from_config(world.get("driven") or ())
    none = torch.zeros(3)
    columns_of(
        forces_from_config(world.get("forces")), World(None, none, none, none, (), solids, sets)
    )


def build_adapter(config: Mapping[str, Any]) -> torch.nn.Module | None:
    """The adapter of that name, None where there is none. Errors: ConfigError naming the key."""
    build = adapter_class(config)
    if build is None:
        return None
    return known_keys(
        "adapter", build, {k: v for k, v in config.items() if k not in ("name", "_target_")}
    )


def build_criterion(cfg: Mapping[str, Any]) -> Criterion:
    """Free rollouts where a checkpoint is older than the group. Errors: ConfigError naming the key."""
    return known_keys("criterion", Criterion, cfg.get("criterion") or {"name": "free"})


def build_identification(cfg: Mapping[str, Any]) -> IdentificationSettings:
    """Errors: ConfigError naming the key."""
    return known_keys("identification", IdentificationSettings, cfg.get("identification") or {})


def build_evaluation(cfg: Mapping[str, Any]) -> EvaluationSettings:
    """Errors: ConfigError naming the key."""
    return known_keys("evaluation", EvaluationSettings, cfg.get("evaluation") or {})


def build_stages(
    fit: Mapping[str, Any],
    heterogeneity: torch.nn.Module | None,
    adapter: torch.nn.Module | None,
    searching: bool = False,
) -> list[Stage]:
    """The stages of a run, without those that have nothing to optimise or no iterations, each with the optimiser that it runs.

    searching: whether the calibration chooses the law too."""
    stages = [known_keys(f"fit.{name}", Stage, fit[name], name) for name in STAGES]
    learned = {s.name: s.learns(heterogeneity, adapter) for s in stages}
    wanted = [
        s
        for s in stages
        if s.iterations > 0 and (s.calibrates or any(part is not None for part in learned[s.name]))
    ]
    stages = recalibrations([s.resolved(all(map(few_numbers, learned[s.name]))) for s in wanted])
    if searching and stages and not stages[0].newton:
        raise ConfigError(
            "prior=auto: expected fit.prior.optimizer=auto or gauss_newton, which compares candidates; found adam"
        )
    if not stages or not stages[0].calibrates:
        raise ConfigError(
            "fit.prior.iterations: expected at least 1: every later figure is compared with the calibrated prior"
        )
    return stages

"""From configuration to objects: the only place that knows both. Everything below takes explicit arguments."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from mosa.errors import ConfigError
from mosa.modules.adapters import adapter_class
from mosa.modules.body import Body, SimulationSettings, World
from mosa.modules.criteria import Criterion
from mosa.modules.heterogeneity import HeterogeneityField
from mosa.modules.identification import IdentificationSettings, few_numbers
from mosa.modules.material import Material
from mosa.modules.stages import STAGES, Stage, recalibrations
from mosa.modules.stiffness_modes import StiffnessModes
from mosa.modules.terms import check_terms
from mosa.physics.constitutive.laws import law_named
from mosa.physics.contact.colliders import colliders_from_config, domain_walls
from mosa.physics.contact.motion import Motion
from mosa.physics.contact.planes import Plane
from mosa.reconstruction.settings import build_settings
from mosa.types import Ground, Scene

LAW_OPTIONS = ("yield_convention", "norm_eps", "rebuild", "on_inversion", "init_affine")
"""Arguments of `Simulator` that say how a law is taken."""


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
    return {"ground": asdict(scene.ground) if scene.ground is not None else None, "gravity": scene.gravity.tolist(),
            "up": scene.up.tolist(), "box": scene.box.tolist()}


def build_world(config: Mapping[str, Any]) -> World:
    """walls: {mode, friction} of the box's six sides, or None; colliders: list, see `colliders_from_config`; both may be absent."""
    ground = Ground(**config["ground"]) if config["ground"] is not None else None
    gravity, up, box = (torch.tensor(config[k], dtype=torch.float32) for k in ("gravity", "up", "box"))
    return World(ground, gravity, up, box, build_walls(config.get("walls"), box),
                 colliders_from_config(config.get("colliders") or ()))


def build_walls(walls: Mapping[str, Any] | None, box: Tensor) -> tuple[Plane, ...]:
    """The six sides of the box, none where `walls` is None. Errors: ConfigError naming the key."""
    if walls is None:
        return ()
    if not walls:
        raise ConfigError("world.walls: expected null, or keys as in {mode: separate, friction: 0.1}, found none")
    return tuple(known_keys("world.walls", domain_walls, walls, box))


def run_config(cfg: dict[str, Any], scene: Scene, dx: float) -> dict[str, Any]:
    """What a checkpoint keeps: the configuration, and what was measured from the data."""
    return {"cfg": cfg, "world": world_config(scene) | (cfg.get("world") or {}), "density": scene.density, "dx": dx,
            "frame_dt": float(scene.times[1] - scene.times[0])}


def build_body(config: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Body:
    """A body with the law, adapter and settings of a run. tensors: rest, volume, colors, opacities, covariances."""
    cfg = config["cfg"]
    torch.manual_seed(cfg["seed"])
    settings = build_simulation(cfg["simulation"], config["dx"])
    material, options = build_prior(cfg["prior"])
    heterogeneity = build_heterogeneity(cfg["heterogeneity"], tensors["rest"].amin(0), tensors["rest"].amax(0))
    adapter = fitting(build_adapter(cfg["adapter"]), material.law)
    return Body(**tensors, density=config["density"], material=material, heterogeneity=heterogeneity, adapter=adapter,
                settings=settings, law_options=options)


def fitting(adapter: torch.nn.Module | None, law: str) -> torch.nn.Module | None:
    """The adapter, or None with a warning where it adds stiffness and the law is a fluid's."""
    known = law_named(law)
    if getattr(adapter, "strain", None) is None or ("mu" in known.offsets and known.viscosity is None):
        return adapter
    warnings.warn(f"adapter: {law} has no shear stiffness that could be anisotropic; the run learns its parameters and stiffness "
                  "modes alone (adapter=mosa corrects its stress by networks)", stacklevel=2)
    return None


def build_simulation(config: Mapping[str, Any], dx: float) -> SimulationSettings:
    """Settings of the rollouts on a grid of spacing dx [m]."""
    if missing := [k for k in ("stride", "max_substeps", "courant", "precision", "contact_offset") if k not in config]:
        raise ConfigError(f"simulation.{missing[0]}: expected this key, found none")
    if config["stride"] > config["max_substeps"]:
        raise ConfigError(f"simulation.stride: expected at most simulation.max_substeps={config['max_substeps']}, as a frame has "
                          f"whole strides, found {config['stride']}")
    # whose grid is given as dx
    return known_keys("simulation", SimulationSettings, {k: v for k, v in config.items() if k not in SIZES} | {"dx": dx})


def build_prior(config: Mapping[str, Any]) -> tuple[Material, dict[str, Any]]:
    """The prior's parameters, and the options of its law (`Simulator`). Errors: ConfigError naming the key."""
    keys = dict(config)
    options = keys.pop("options", None) or {}
    if unknown := [name for name in options if name not in LAW_OPTIONS]:
        raise ConfigError(f"prior.options.{unknown[0]}: unknown key; expected one of {', '.join(LAW_OPTIONS)}")
    keys["frozen"], keys["candidates"] = keys.get("frozen") or (), keys.get("candidates") or ()
    return known_keys("prior", Material, keys), options


def build_heterogeneity(config: Mapping[str, Any], low: Tensor, high: Tensor) -> torch.nn.Module | None:
    """The field on the box (3,) to (3,) [m], None where it is switched off. Errors: ConfigError naming the key."""
    if not config["enabled"]:
        return None
    kind = config.get("kind", "network")  # checkpoints from before there were modes
    if kind not in HETEROGENEITY:
        raise ConfigError(f"heterogeneity.kind: expected {' or '.join(HETEROGENEITY)}, found {kind!r}")
    build, others = HETEROGENEITY[kind], set()
    for other in HETEROGENEITY.values():
        others |= set(inspect.signature(other).parameters)
    foreign = others - set(inspect.signature(build).parameters)
    keys = {k: v for k, v in config.items() if k not in ("enabled", "kind") and k not in foreign}
    return known_keys("heterogeneity", build, keys | {"low": low, "high": high})


def rehearse(cfg: Mapping[str, Any]) -> None:
    """Build what needs no data and drop it: a mistake then shows before the reconstruction. Errors: ConfigError naming the key."""
    build_settings(**cfg["reconstruction"])
    low, high = torch.zeros(3), torch.ones(3)
    with torch.random.fork_rng(devices=[]):
        material, _ = build_prior(cfg["prior"])
        heterogeneity = build_heterogeneity(cfg["heterogeneity"], low, high)
        with warnings.catch_warnings():  # said again where the body is built
            warnings.simplefilter("ignore")
            adapter = fitting(build_adapter(cfg["adapter"]), material.law)
    build_simulation(cfg["simulation"], 1.0)
    build_stages(cfg["fit"], heterogeneity, adapter, bool(material.candidates))
    build_criterion(cfg)
    build_identification(cfg)
    check_terms(cfg["losses"])
    if not any(cfg["losses"].get(name) for name in ("image", "mask", "flow", "rotation", "stretch", "position")):
        raise ConfigError("losses: expected a weight above 0 for image, mask, flow, rotation, stretch or position: nothing else "
                          "tells the prior anything")
    build_walls(cfg["world"]["walls"], torch.stack([low, high]))
    for collider in colliders_from_config(cfg["world"]["colliders"] or ()):
        if isinstance(collider.motion, Motion) and collider.motion.times is not None:
            collider.motion.sample(1, 1, 1.0)  # as many velocities as times


def known_keys(where: str, build: Callable, keys: Mapping[str, Any], *positional: Any) -> Any:
    """build(*positional, **keys). Errors: ConfigError for a key that it does not take."""
    known = inspect.signature(build).parameters
    if unknown := [k for k in keys if k not in known]:
        raise ConfigError(f"{where}.{unknown[0]}: unknown key; expected one of {', '.join(list(known)[len(positional):])}")
    needed = [k for k, parameter in list(known.items())[len(positional):] if parameter.default is parameter.empty]
    if missing := [k for k in needed if k not in keys]:
        raise ConfigError(f"{where}.{missing[0]}: expected this key, found none")
    return build(*positional, **keys)


def build_adapter(config: Mapping[str, Any]) -> torch.nn.Module | None:
    """The adapter of that name, None where there is none. Errors: ConfigError naming the key."""
    build = adapter_class(config)
    if build is None:
        return None
    return known_keys("adapter", build, {k: v for k, v in config.items() if k not in ("name", "_target_")})


def build_criterion(cfg: Mapping[str, Any]) -> Criterion:
    """Free rollouts where a checkpoint is older than the group. Errors: ConfigError naming the key."""
    return known_keys("criterion", Criterion, cfg.get("criterion") or {"name": "free"})


def build_identification(cfg: Mapping[str, Any]) -> IdentificationSettings:
    """Errors: ConfigError naming the key."""
    return known_keys("identification", IdentificationSettings, cfg.get("identification") or {})


def build_stages(
    fit: Mapping[str, Any], heterogeneity: torch.nn.Module | None, adapter: torch.nn.Module | None, searching: bool = False
) -> list[Stage]:
    """The stages of a run, without those that have nothing to optimise or no iterations, each with the optimiser that it runs.

    searching: whether the calibration chooses the law too."""
    stages = [known_keys(f"fit.{name}", Stage, fit[name], name) for name in STAGES]
    learned = {s.name: s.learns(heterogeneity, adapter) for s in stages}
    wanted = [s for s in stages if s.iterations > 0 and (s.calibrates or any(part is not None for part in learned[s.name]))]
    stages = recalibrations([s.resolved(all(map(few_numbers, learned[s.name]))) for s in wanted])
    if searching and stages and not stages[0].newton:
        raise ConfigError("prior=auto: expected fit.prior.optimizer=auto or gauss_newton, which compares candidates; found adam")
    if not stages or not stages[0].calibrates:
        raise ConfigError("fit.prior.iterations: expected at least 1: every later figure is compared with the calibrated prior")
    return stages

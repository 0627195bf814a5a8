"""From configuration to objects: the only place that knows both. Everything below takes explicit arguments."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import torch
from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from mosa.errors import ConfigError
from mosa.modules.body import Body, SimulationSettings, World
from mosa.modules.heterogeneity import HeterogeneityField
from mosa.modules.material import Material
from mosa.modules.stages import Stage
from mosa.physics.boundary import Plane
from mosa.physics.colliders import colliders_from_config, domain_walls
from mosa.types import Ground, Scene

LAW_OPTIONS = ("yield_convention", "norm_eps", "rebuild", "on_inversion", "init_affine")
"""Arguments of `Simulator` that say how a law is taken."""


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
    return () if walls is None else tuple(known_keys("world.walls", domain_walls, walls, box))


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
    adapter = build_adapter(cfg["adapter"])
    return Body(**tensors, density=config["density"], material=material, heterogeneity=heterogeneity, adapter=adapter,
                settings=settings, law_options=options)


def build_simulation(config: Mapping[str, Any], dx: float) -> SimulationSettings:
    """Settings of the rollouts on a grid of spacing dx [m]."""
    names = ("stride", "max_substeps", "courant", "precision", "contact_offset")
    newer = (name for name in ("adaptive", "min_substeps") if name in config)  # than some checkpoints
    return SimulationSettings(dx=dx, **{name: config[name] for name in (*names, *newer)})


def build_prior(config: Mapping[str, Any]) -> tuple[Material, dict[str, Any]]:
    """The prior's parameters, and the options of its law (`Simulator`). Errors: ConfigError naming the key."""
    keys = dict(config)
    options = keys.pop("options", None) or {}
    if unknown := [name for name in options if name not in LAW_OPTIONS]:
        raise ConfigError(f"prior.options.{unknown[0]}: unknown key; expected one of {', '.join(LAW_OPTIONS)}")
    keys["frozen"] = keys.get("frozen") or ()
    return known_keys("prior", Material, keys), options


def build_heterogeneity(config: Mapping[str, Any], low: Tensor, high: Tensor) -> HeterogeneityField | None:
    """The field on the box (3,) to (3,) [m], None where it is switched off. Errors: ConfigError naming the key."""
    if not config["enabled"]:
        return None
    return known_keys("heterogeneity", HeterogeneityField, {k: v for k, v in config.items() if k != "enabled"} |
                      {"low": low, "high": high})


def rehearse(cfg: Mapping[str, Any]) -> None:
    """Build what needs no data and drop it: a mistake then shows before the reconstruction. Errors: ConfigError naming the key."""
    from mosa.reconstruction.settings import build_settings

    build_settings(**cfg["reconstruction"])
    low, high = torch.zeros(3), torch.ones(3)
    with torch.random.fork_rng(devices=[]):
        build_prior(cfg["prior"])
        heterogeneity, adapter = build_heterogeneity(cfg["heterogeneity"], low, high), build_adapter(cfg["adapter"])
    build_simulation(cfg["simulation"], 1.0)
    build_stages(cfg["fit"], heterogeneity=heterogeneity is not None, adapter=adapter is not None)
    build_walls(cfg["world"]["walls"], torch.stack([low, high]))
    colliders_from_config(cfg["world"]["colliders"] or ())


def known_keys(where: str, build: Callable, keys: Mapping[str, Any], *positional: Any) -> Any:
    """build(*positional, **keys). Errors: ConfigError for a key that it does not take."""
    known = inspect.signature(build).parameters
    if unknown := [k for k in keys if k not in known]:
        raise ConfigError(f"{where}.{unknown[0]}: unknown key; expected one of {', '.join(list(known)[len(positional):])}")
    return build(*positional, **keys)


def build_adapter(config: Mapping[str, Any]) -> torch.nn.Module | None:
    """The adapter that `_target_` names, None where there is none. Errors: ConfigError naming the key."""
    if not config.get("_target_"):
        return None
    try:
        build = get_class(config["_target_"])
    except (ImportError, ValueError) as error:
        raise ConfigError(f"adapter._target_: expected a class, found {config['_target_']!r} ({error})") from error
    return known_keys("adapter", build, {k: v for k, v in config.items() if k != "_target_"})


def build_stages(fit: Mapping[str, Any], *, heterogeneity: bool, adapter: bool) -> list[Stage]:
    """The stages of a run, without those that have nothing to optimise or no iterations."""
    stages = [known_keys(f"fit.{name}", Stage, fit[name], name) for name in ("prior", "prior_eta", "joint")]
    wanted = {"prior": True, "prior_eta": heterogeneity, "joint": adapter or heterogeneity}
    stages = [s for s in stages if wanted[s.name] and s.iterations > 0]
    if not stages or stages[0].name != "prior":
        raise ConfigError("fit.prior.iterations: expected at least 1: every later figure is compared with the calibrated prior")
    return stages

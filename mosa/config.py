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
from mosa.physics.colliders import colliders_from_config, domain_walls
from mosa.types import Ground, Scene


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
    walls = config.get("walls")
    planes = domain_walls(box, **walls) if walls is not None else []
    return World(ground, gravity, up, box, tuple(planes), colliders_from_config(config.get("colliders") or ()))


def run_config(cfg: dict[str, Any], scene: Scene, dx: float) -> dict[str, Any]:
    """What a checkpoint keeps: the configuration, and what was measured from the data."""
    return {"cfg": cfg, "world": world_config(scene) | (cfg.get("world") or {}), "density": scene.density, "dx": dx,
            "frame_dt": float(scene.times[1] - scene.times[0])}


def build_body(config: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Body:
    """A body with the law, adapter and settings of a run. tensors: rest, volume, colors, opacities, covariances."""
    cfg = config["cfg"]
    torch.manual_seed(cfg["seed"])
    settings = SimulationSettings(
        dx=config["dx"], **{k: cfg["simulation"][k] for k in
                            ("stride", "max_substeps", "courant", "precision", "contact_offset")},
        **{k: cfg["simulation"][k] for k in ("adaptive", "min_substeps") if k in cfg["simulation"]})  # newer than some checkpoints
    law = dict(cfg["prior"])
    options = law.pop("options", {})
    material = Material(**{k: v for k, v in law.items() if k != "_target_"})
    heterogeneity = None
    if cfg["heterogeneity"]["enabled"]:
        keys = {k: v for k, v in cfg["heterogeneity"].items() if k != "enabled"}
        low, high = tensors["rest"].amin(0), tensors["rest"].amax(0)
        heterogeneity = known_keys("heterogeneity", HeterogeneityField, keys | {"low": low, "high": high})
    adapter = build_adapter(cfg["adapter"])
    return Body(**tensors, density=config["density"], material=material, heterogeneity=heterogeneity, adapter=adapter,
                settings=settings, law_options=options)


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

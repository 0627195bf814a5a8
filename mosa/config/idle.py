"""Keys that a user sets and that do nothing beside the others: said, because a table of runs that differ in one would say that it
makes no difference."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

from mosa.modules.fitting.stages import STAGES, Stage

IMAGES = ("image", "mask", "flow", "heterogeneity", "operator", "operator_variance")
"""Loss terms that Gauss-Newton does not have; of the others it takes those whose weight is not 0."""


class Rule(NamedTuple):
    """pattern: of keys, or of a group's option as GROUP=NAME; why they do nothing; holds: whether that is so, of the configuration
    and the stages that run."""

    pattern: str
    why: str
    holds: Callable[[Mapping[str, Any], Sequence[Stage]], bool]


def all_newton(_: Mapping[str, Any], stages: Sequence[Stage]) -> bool:
    return all(stage.newton for stage in stages)


def no_newton(_: Mapping[str, Any], stages: Sequence[Stage]) -> bool:
    return not any(stage.newton for stage in stages)


def is_at(path: str, *expected: Any) -> Callable[[Mapping[str, Any], Sequence[Stage]], bool]:
    """Whether the value at a path of the configuration is one of these."""

    def holds(values: Mapping[str, Any], _: Sequence[Stage]) -> bool:
        for key in path.split("."):
            values = values.get(key) if isinstance(values, Mapping) else None
        return values in expected

    return holds


def runs_newton(name: str, wanted: bool) -> Callable[[Mapping[str, Any], Sequence[Stage]], bool]:
    return lambda _, stages: any(stage.name == name and stage.newton == wanted for stage in stages)


NEWTON = "all stages run Gauss-Newton, which looks at no image (fit=adam does)"
RULES = (
    *(Rule(f"losses.{name}", NEWTON, all_newton) for name in IMAGES),
    *(Rule(f"fit.{key}", NEWTON, all_newton) for key in ("views", "clip")),
    Rule("ablation=no_flow", NEWTON, all_newton),
    *(Rule(f"fit.{stage}.{key}", f"fit.{stage} runs Gauss-Newton; the rates are Adam's", runs_newton(stage, True))
      for stage in STAGES for key in ("lr", "lr_*")),
    *(Rule(f"fit.{stage}.newton_iterations", f"fit.{stage} runs Adam", runs_newton(stage, False)) for stage in STAGES),
    Rule("identification.*", "no stage runs Gauss-Newton", no_newton),
    Rule("heterogeneity.[!e]*", "heterogeneity.enabled is false", is_at("heterogeneity.enabled", False)),
    Rule("heterogeneity.hidden", "heterogeneity.kind is modes", is_at("heterogeneity.kind", "modes")),
    Rule("heterogeneity.frequencies", "heterogeneity.kind is modes", is_at("heterogeneity.kind", "modes")),
    Rule("heterogeneity.wavelength", "heterogeneity.kind is network", is_at("heterogeneity.kind", "network")),
    Rule("heterogeneity.most", "heterogeneity.kind is network", is_at("heterogeneity.kind", "network")),
    Rule("criterion.gain", "criterion.name is free", is_at("criterion.name", "free")),
    Rule("simulation.min_substeps", "simulation.adaptive is false", is_at("simulation.adaptive", False)),
    Rule("simulation.particles", "simulation.dx is set", lambda v, _: v["simulation"].get("dx") is not None),
    Rule("reconstruction.static.max_points", "reconstruction.static.densify is relocate",
         is_at("reconstruction.static.densify", "relocate")),
    Rule("reconstruction.static.*", "reconstruction.splats stand in for the static stage",
         lambda v, _: v["reconstruction"].get("splats") is not None),
    Rule("reconstruction.geometry.frames", "reconstruction.geometry.source is hull",
         is_at("reconstruction.geometry.source", "hull")),
    Rule("reconstruction.dynamic.hidden", "reconstruction.dynamic.model is modes", is_at("reconstruction.dynamic.model", "modes")),
    Rule("reconstruction.informed.[!i]*", "reconstruction.informed.iterations is 0",
         is_at("reconstruction.informed.iterations", 0)),
    Rule("reconstruction.carried.[!i]*", "reconstruction.carried.iterations is 0", is_at("reconstruction.carried.iterations", 0)),
)  # fmt: skip


def idle(overrides: Iterable[str], values: Mapping[str, Any], stages: Sequence[Stage]) -> list[str]:
    """A sentence for each key of the overrides (KEY=VALUE) that has no effect in the configuration `values`."""
    found = []
    for override in overrides:
        key = override.partition("=")[0].lstrip("+~").split("@")[0]
        rule = next((rule for rule in RULES if any(fnmatchcase(each, rule.pattern) for each in (key, override))
                     and rule.holds(values, stages)), None)  # fmt: skip
        if rule is not None:
            found.append(f"{key}: has no effect in this run: {rule.why}")
    return found


def warn_of_idle(
    overrides: Iterable[str], values: Mapping[str, Any], stages: Sequence[Stage]
) -> None:
    """One warning for each such key."""
    for sentence in idle(overrides, values, stages):
        warnings.warn(sentence, stacklevel=3)

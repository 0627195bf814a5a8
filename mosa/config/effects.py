"""Warnings for keys that a user sets and that have no effect beside the others: a table of runs that differ in one would show no
difference. A settings model states what its fields need (`Settings.needs`)."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from fnmatch import fnmatchcase

from hydra.core.hydra_config import HydraConfig

from mosa.config.command_settings import TrainSettings
from mosa.modules.fitting.stages import STAGES, Stage
from mosa.settings import Settings, word


def without_effect(settings: Settings, path: Sequence[str], stages: Sequence[Stage]) -> str | None:
    """Why the key at a path has no effect beside the others and the stages that run; None where it has one."""
    where: list[str] = []
    for key in path:
        if key not in type(settings).model_fields and key not in (settings.model_extra or ()):
            return None
        for need in needs_of(type(settings), key):
            if (reason := unmet(settings, need, where, stages)) is not None:
                return reason
        where, inner = [*where, key], getattr(settings, key)
        if not isinstance(inner, Settings):
            return None
        settings = inner
    return None


def needs_of(model: type[Settings], key: str) -> list[str]:
    """What the field needs, by its own model and those that it derives from. `further`: a key that is no field."""
    key = key if key in model.model_fields else "further"
    stated = [vars(each).get("needs", {}) for each in model.__mro__]
    return [
        need
        for needs in stated
        for names, needed in needs.items()
        if any(fnmatchcase(key, name) for name in names.split())
        for need in needed.split(", ")
    ]


def unmet(settings: Settings, need: str, where: list[str], stages: Sequence[Stage]) -> str | None:
    if need in ("newton", "adam"):
        own = where[-1] if where[:1] == ["fit"] and where[-1] in STAGES else None
        running = [stage.newton for stage in stages if own in (None, stage.section)]
        if not running or (need == "newton") in running:
            return None
        if own is not None:
            runs = "Adam" if need == "newton" else "Gauss-Newton, and this key is Adam's"
            return f"fit.{own} runs {runs}"
        return "no stage runs Gauss-Newton" if need == "newton" else (
            "all stages run Gauss-Newton, which compares motion cues alone (fit=adam does not)")  # fmt: skip
    if need == "adapted":
        alone = {(stage.newton, stage.calibrates) for stage in stages} == {(True, True)}
        positions = alone and getattr(settings, "position", True)
        return "an isotropic law is calibrated on positions alone" if positions else None
    key, unequal, value = need.partition("!=") if "!=" in need else need.partition("=")
    found = word(getattr(settings, key))
    return (
        None if (found == value) != (unequal == "!=") else f"{'.'.join([*where, key])} is {found}"
    )


def sentences(
    overrides: Iterable[str], settings: TrainSettings, stages: Sequence[Stage]
) -> Iterator[str]:
    """One for each key of the overrides (KEY=VALUE), and each weight of another package's loss term, that has no effect."""
    given = [override.partition("=")[0].lstrip("+~").split("@")[0] for override in overrides]
    # without defaults: somebody set them; and what an option of another group switches off, as ablation=no_rot does
    losses, fields = settings.losses, type(settings.losses).model_fields
    set_ = [f"losses.{name}" for name, weight in (losses.model_extra or {}).items() if weight]
    set_ += [f"losses.{n}" for n, f in fields.items() if f.default and not getattr(losses, n)]
    for key in dict.fromkeys([*given, *set_]):
        if (reason := without_effect(settings, key.split("."), stages)) is not None:
            yield f"{key}: has no effect in this run: {reason}"


def warn_without_effect(
    settings: TrainSettings, stages: Sequence[Stage], overrides: Iterable[str] = ()
) -> None:
    """One warning for each such key of these overrides and those of the command line."""
    task = HydraConfig.get().overrides.task if HydraConfig.initialized() else ()
    for sentence in sentences([*task, *overrides], settings, stages):
        warnings.warn(sentence, stacklevel=3)

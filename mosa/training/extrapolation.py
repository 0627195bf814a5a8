"""The law's global numbers on two grids, and where a grid without spacing would put them.

What a grid gets wrong pulls at the moduli that are identified through it. The same scene is identified once more with a third of
the particles, on a grid 1.44 times as coarse, and the numbers are continued along the line through both to a spacing of 0
(Richardson, Philosophical Transactions A 210, 1911, to first order).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from omegaconf import DictConfig, open_dict

from mosa.errors import ConfigError
from mosa.evaluation.metrics import identification_errors
from mosa.evaluation.uncertainty import INFLATION, physical_sd
from mosa.modules.body.material import FORMS, Form
from mosa.training.assembly import Run, assemble
from mosa.training.lit_mosa import LitMosa

FEWER = 3.0
"""Particles of the run over those of the coarser one."""


@dataclass(frozen=True)
class Identified:
    """One grid's. dx [m]: its spacing; numbers: (value, standard deviation) of each global parameter in unconstrained form."""

    dx: float
    numbers: Mapping[str, tuple[float, float]]


def check_can_extrapolate(module: LitMosa) -> None:
    """Errors: ConfigError where a stage is learned by Adam, which says nothing about how sure its numbers are."""
    for stage in module.stages:
        if not stage.newton:
            raise ConfigError(
                f"extrapolate: expected Gauss-Newton in every stage, found fit.{stage.name}.optimizer=adam; adapter="
                "operator or none and heterogeneity.kind=modes let it learn all"
            )


def identified(module: LitMosa) -> Identified:
    """Numbers of a module whose stages have ended, as `id/` has them: of the mean stiffness over the body."""
    if module.posterior is None:
        raise ConfigError("extrapolate: this run kept no posterior")
    body, posterior = module.body, module.posterior
    mean = float(body.factor(body.heterogeneity).detach().mean())
    numbers = {}
    for name, raw in body.material.raw.items():
        if not raw.requires_grad or not isinstance(FORMS.get(name), Form):
            continue  # held, or an angle of a direction
        value = float(body.material.physical_of(name, raw.detach())) * (
            mean if name in body.material.modulated else 1.0
        )
        variance = float(
            posterior.covariance[posterior.names.index(name), posterior.names.index(name)]
        )
        numbers[name] = FORMS[name].inverse(value), INFLATION * math.sqrt(variance)
    return Identified(body.settings.dx, numbers)


def coarser(cfg: DictConfig, run: Run, law: str) -> Identified:
    """The scene of a run identified with a third of its particles, under its `law`. Errors: those of a run."""
    fewer = copy.deepcopy(cfg)
    with open_dict(fewer):
        fewer.simulation.particles, fewer.simulation.dx = (
            max(1, round(len(run.body.rest) / FEWER)),
            None,
        )
        fewer.prior.law, fewer.ckpt_path = law, None
        fewer.prior.pop("candidates", None)
    module = assemble(fewer, run.device, held_out=False).module
    if module.ground_is_sought:
        module.settle_ground(run.module.world.ground)
    module.identify()
    return identified(module)


def continued(fine: Identified, coarse: Identified) -> dict[str, tuple[float, float, float]]:
    """By parameter: (on the coarser grid, at a spacing of 0, standard deviation of the latter), physical values."""
    weight = fine.dx / (coarse.dx - fine.dx)
    found = {}
    for name, (value, sd) in fine.numbers.items():
        other, other_sd = coarse.numbers[name]
        raw = torch.tensor(value + weight * (value - other), dtype=torch.float64)
        spread = physical_sd(name, raw, math.hypot((1 + weight) * sd, weight * other_sd))
        coarse_value, limit = (
            float(FORMS[name].physical(each))
            for each in (torch.tensor(other, dtype=torch.float64), raw)
        )
        found[name] = coarse_value, limit, spread
    return found


def extrapolated(cfg: DictConfig, run: Run, known: Mapping[str, float]) -> dict[str, float]:
    """Figures `extrapolated/<name>`, `_sd`, `_coarse` of a run that has been fitted, with errors where `known` has the truth.

    Errors: ConfigError, and those of a run."""
    module = run.module
    fine = identified(module)
    coarse = coarser(cfg, run, module.body.material.law)
    figures = {"extrapolated/dx_m": fine.dx, "extrapolated/coarse_dx_m": coarse.dx}
    for name, (other, limit, sd) in continued(fine, coarse).items():
        figures |= {
            f"extrapolated/{name}": limit,
            f"extrapolated/{name}_sd": sd,
            f"extrapolated/{name}_coarse": other,
        }
        if name in known:
            errors = identification_errors(name, limit, known[name])
            figures |= {f"extrapolated/{key}": value for key, value in errors.items()}
    return figures

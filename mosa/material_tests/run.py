"""`mosa-material`: the tests of a csv file, a law by `prior`, a learned stiffness by `adapter=operator`."""

from __future__ import annotations

import logging
from dataclasses import replace
from warnings import warn

from omegaconf import DictConfig, OmegaConf

from mosa.config.build import build_adapter, build_prior, plain
from mosa.config.extensions import load_extensions
from mosa.config.known_numbers import known_numbers
from mosa.config.leaf_settings import MaterialSettings
from mosa.data.formats.scene_from_footage import check_density
from mosa.errors import ConfigError
from mosa.evaluation.analysis.law_stress import check_own
from mosa.material_tests.fitting import Fitting, Law
from mosa.material_tests.measurements import read_tests
from mosa.material_tests.report import doubts, figures, table, write
from mosa.modules.adapters.hyperelastic import HyperelasticAdapter
from mosa.modules.body.material import AUTO
from mosa.physics.constitutive.laws import law_named
from mosa.training.run_folder import quiet, run_folder, write_figures

log = logging.getLogger(__name__)
NEEDED = {"tests": "a csv file of tests (docs/material_tests.md)", "unit": "Pa, kPa or MPa"}


def build_law(values: dict) -> Law:
    """The law of a configuration, at its start. Errors: ConfigError naming the key."""
    material, _ = build_prior(values["prior"])
    law = law_named(material.law)
    if material.candidates or values["prior"]["law"] == AUTO:
        raise ConfigError("prior: expected one law, found auto; fit its candidates one by one")
    if law.plastic or law.viscosity is not None or law.reference is not None:
        raise ConfigError(
            f"prior: expected an elastic law that turns with the body, found {law.name}: tests are states without a history"
        )
    adapter = build_adapter(values["adapter"])
    if adapter is not None and not isinstance(adapter, HyperelasticAdapter):
        raise ConfigError("adapter: expected operator or none, found one without an energy")
    check_own(material)
    if adapter is None and values["incompressible"] and "nu" in material.raw:
        material.raw["nu"].requires_grad_(False)  # the pressure replaces it
    if adapter is not None:
        adapter.switch_on(material.reference_modulus(), material.poisson())
    return Law(material, adapter, values["symmetry"])


def fit_tests(cfg: DictConfig) -> float:
    """Fit, predict every test from the others, write; returns the rms [Pa]."""
    quiet()
    for key, expected in NEEDED.items():
        if OmegaConf.is_missing(cfg, key):
            raise ConfigError(f"{key}: expected {expected}, found none")
    values, folder = plain(cfg), run_folder()
    load_extensions(values.get("extensions"))
    settings = MaterialSettings.read(values)
    if settings.symmetry == "orthotropic" and values["adapter"]["name"] is None:
        warn(
            "symmetry: has no effect in this run: no stiffness is learned (adapter=operator)",
            stacklevel=1,
        )
    check_density("density", values["density"])
    data = read_tests(values["tests"], values["unit"])
    law, known = build_law(values), None
    if values["known"] is not None:
        known = known_numbers(values["known"], law.material, law.adapter, "known")
    options = {name: values[name] for name in ("incompressible", "starts", "seed", "evidence")}
    fitting = Fitting(law, data, known=known, true=values["stress"] == "cauchy", **options)
    if not fitting.law.names:
        raise ConfigError("prior.frozen: expected a parameter that is learned, found none")
    fit = fitting.fit()
    several = values["leave_out"] and len(data.names) > 1
    left_out = fitting.left_out() if several else {}
    fit = replace(fit, other=fitting.other_reading())
    law = fitting.law.set(fit.theta)
    write(folder, law, data, fit, left_out, values["unit"], values, values["density"])
    found = figures(data, fit, left_out)
    write_figures(folder, found)
    for doubt in doubts(law, data, fit, values["unit"]):
        warn(doubt, stacklevel=1)
    log.info("%s", table(law, data, fit, left_out, values["unit"]))
    log.info("%s: results.md, tests.png, material.json, checkpoints/specimen.ckpt", folder)
    return float(found["rms"])

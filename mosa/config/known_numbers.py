"""What another experiment said of a law's numbers: the posterior of a checkpoint, or of a material.json of stress-strain tests."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from warnings import warn

import torch
from torch import Tensor

from mosa.config.checkpoints import given_as, read_checkpoint, reading, record_of
from mosa.config.record import PosteriorRecord
from mosa.data.formats.footage import read_json
from mosa.errors import ConfigError, DataError
from mosa.evaluation.analysis.law_stress import values_of
from mosa.evaluation.uncertainty import INFLATION
from mosa.modules.adapters.registry import adapter_class
from mosa.modules.body.material import Direction, Material, taken
from mosa.modules.fitting.gauss_newton import Posterior
from mosa.settings import Names, check


def known_numbers(path: str, material: Material, adapter: Any, where: str) -> Posterior:
    """What another experiment said of the numbers that are learned of a law: the checkpoint of a
    fit, or the material.json of `mosa-material`. Other numbers of it are integrated out: the
    contact's and the stiffness modes' belong to one body. A fit's standard deviations are those
    that its results say. Warns where they hold for a value that is another one here. Errors:
    DataError naming the file, ConfigError naming `where`, or a direction whose angles begin
    elsewhere."""
    record: PosteriorRecord | None
    if os.path.isfile(path) and Path(path).suffix == ".json":
        try:
            found = read_json(Path(path))
            law, own = str(found["law"]), found["posterior"]
            values = {k: torch.tensor(own[k], dtype=torch.float64) for k in ("theta", "covariance")}
            check("posterior.names", own["names"], Names)
            begun = Material(law, {**found["parameters"], **own["begins"]})
            # fits to films have other names for numbers of the learned stiffness
            operator = partial(re.sub, r"^stiffness_(\d+)", lambda m: f"operator[{int(m[1]) - 1}]")
            named = list(map(operator, own["names"]))
            ones = torch.ones(len(named), dtype=torch.float64)
            record = PosteriorRecord.read({"names": named, "mean": values["theta"], "determined": ones,
                                           "covariance": values["covariance"], "model_error": 0.0}, "posterior")  # fmt: skip
        except Exception as error:  # whatever the file holds
            raise DataError(
                f"{where}: {path}: expected a material.json of mosa-material with its posterior, or a checkpoint "
                f"({type(error).__name__}: {error})"
            ) from error
        inflation, alike = 1.0, adapter is not None and adapter.energetic
    else:
        with given_as(where):
            run = record_of(read_checkpoint(path), path)
            law, given = run.law or run.sections.prior.law, run.sections.prior.parameters
            with reading(path):
                begun = Material(law, {name: given[name] for name in taken(law, given)})
        record = run.posterior
        # numbers of another kind of operator have the same names
        build = adapter_class(run.sections.adapter.plain())
        inflation, alike = INFLATION, build is not None and build is type(adapter)
    if record is None:
        raise DataError(
            f"{where}: {path}: expected the checkpoint of an ended fit by Gauss-Newton, whose standard deviations are read, "
            "found one without (a fit by Adam has none)"
        )
    count = adapter.numbers.numel() if alike and adapter.few_numbers else 0
    learned = [*material.learned, *(f"operator[{k}]" for k in range(count))]
    posterior = Posterior.read(record.plain()).only(learned)
    if law.split("~")[0] != material.law.split("~")[0] or not posterior.names:
        raise ConfigError(
            f"{where}: expected numbers of {material.law} that are learned "
            f"({', '.join(learned)}), found {', '.join(record.names)} of {law}: {path}"
        )
    check_alike(begun, record.names, material, f"{where}: {path}")
    return replace(posterior, covariance=inflation**2 * posterior.covariance)


@torch.no_grad()
def check_alike(begun: Material, names: Sequence[str], material: Material, where: str) -> None:
    """The numbers `names` that were learned of `begun`, another experiment's law at its start, mean the same of `material`: angles
    of a direction count from its start. Warns where a value that was not learned there is another one here, or learned. Errors:
    ConfigError."""
    there, here = values_of(begun), values_of(material)

    def said(value: Tensor) -> str:
        return ", ".join(f"{part:.4g}" for part in value.flatten().tolist())

    for name in set(begun.names).intersection(material.names):
        own = {name, *(Direction.coordinates(name) if name in material.directions else ())}
        moves = bool(own.intersection(material.learned))
        one, other = (torch.tensor(each[name], dtype=torch.float64) for each in (there, here))
        if not own.intersection(names):
            same = torch.allclose(one, other, rtol=1e-4, atol=1e-5)
            if name in material.directions:  # of fibres: its sign means nothing
                same = float(one.dot(other).abs()) > 1 - 1e-8
            if moves or not same:
                found = "it is learned" if moves else f"it is {said(other)}"
                warn(
                    f"{where}: its numbers hold for {name} = {said(one)}, and here {found}: freeze it at the same value "
                    f"(prior.parameters.{name}, prior.frozen)",
                    stacklevel=3,
                )
        elif moves and name in material.directions:
            other = material.begin_of(name).double()
            if not torch.allclose(one, other, atol=1e-5):
                raise ConfigError(
                    f"{where}: its angles count from prior.parameters.{name} = [{said(one)}]: expected the same here, found "
                    f"[{said(other)}]"
                )

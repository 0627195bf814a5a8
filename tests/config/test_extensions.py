"""What another package registers: once, under a name of its own, with its keys known to the check of a configuration."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import mosa
from mosa.baselines import direct
from mosa.baselines.direct import DirectAdapter
from mosa.config.build import plain
from mosa.config.extensions import load_extensions
from mosa.data import scene
from mosa.errors import ConfigError
from mosa.evaluation import metrics
from mosa.evaluation.metrics import Metric, register_metric
from mosa.modules.adapters import registry as adapters
from mosa.modules.adapters.penalties import PENALTIES, OperatorStatistics
from mosa.modules.adapters.registry import register_adapter
from mosa.modules.fitting import terms
from mosa.modules.fitting.terms import register_term


@pytest.mark.parametrize("names", [["no_such_package"], "text", [1]])
def test_a_package_that_cannot_be_imported_is_named(names):
    with pytest.raises(ConfigError, match=r"extensions: expected .*found"):
        load_extensions(names)


@pytest.mark.parametrize(
    "text", ["raise ValueError('x')", "import sys; sys.exit(3)", "def (", "import no_such_package"]
)
def test_a_package_that_fails_while_it_is_imported_is_named(tmp_path, monkeypatch, text):
    (tmp_path / "fails_at_once.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(
        ConfigError,
        match=r"extensions: expected a module that can be imported .*found 'fails_at_once'",
    ):
        load_extensions(["fails_at_once"])


@pytest.mark.parametrize("name", ["", ".", ".a", "../a", "a b", "a/b", "a.py.", "a;b"])
def test_what_is_no_name_of_a_module_is_not_imported(name):
    with pytest.raises(ConfigError, match=r"extensions: expected the name of a module"):
        load_extensions([name])


def test_an_adapter_that_was_registered_and_is_not_there_is_named(monkeypatch):
    monkeypatch.setattr(
        adapters,
        "ADAPTERS",
        adapters.ADAPTERS | {"gone": "no_such_package:Adapter", "empty": "math:Adapter"},
    )
    for name in ("gone", "empty"):
        with pytest.raises(
            ConfigError, match=rf"adapter\.name: '{name}' is registered as .*cannot be imported"
        ):
            adapters.adapter_class({"name": name})


def test_compose_imports_what_it_names_and_a_configuration_that_is_handed_on_does_not(
    tmp_path, monkeypatch
):
    (tmp_path / "brings_a_format.py").write_text(
        "from mosa.data.scene import register_format\nregister_format('brought', 'math:sqrt')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(scene, "FORMATS", dict(scene.FORMATS))
    given = mosa.compose("debug=default")
    given.extensions = ["brings_a_format"]  # as of a checkpoint
    mosa.SceneDataModule(given)
    mosa.LitMosa(plain(given))
    assert "brought" not in scene.FORMATS
    mosa.compose("debug=default", "extensions=[brings_a_format]")
    assert "brought" in scene.FORMATS
    with pytest.raises(ConfigError, match="extensions: expected a list of names"):
        mosa.compose("extensions=brings_a_format")


def test_no_extensions_are_none():
    load_extensions(None)
    load_extensions([])


def test_a_name_is_taken_once(monkeypatch):
    monkeypatch.setattr(terms, "TERMS", dict(terms.TERMS))
    monkeypatch.setattr(adapters, "ADAPTERS", dict(adapters.ADAPTERS))
    monkeypatch.setattr(scene, "FORMATS", dict(scene.FORMATS))
    monkeypatch.setattr(metrics, "MOTION_METRICS", {})
    mine, other = lambda *_: 0.0, lambda *_: 1.0
    for register, first, second in (
        (register_term, mine, other), (register_adapter, "a:b", "c:d"), (scene.register_format, "a:b", "c:d"),
        (register_metric, Metric(mine, "mine"), Metric(other, "mine")),
    ):  # fmt: skip
        register("mine", first)
        register("mine", first)
        with pytest.raises(ConfigError, match="another"):
            register("mine", second)
    for name in ("rms_m", "psnr", "a/b", ""):
        with pytest.raises(ConfigError, match=r"metric .*expected a name"):
            register_metric(name, Metric(mine, "mine"))


def test_a_metric_may_give_a_tensor_or_a_number_of_numpy(monkeypatch):
    """They ended a run in a traceback of json, after the fit."""
    x, y = torch.full((4, 5, 3), 3.0), torch.ones(4, 5, 3)
    for mean in (lambda a, b: (a - b).mean(), lambda a, b: np.mean((a - b).numpy())):
        value = Metric(mean, "mine").of("mine", x, y)
        assert type(value) is float and value == 2.0
    for wrong in (lambda a, b: a - b, lambda *_: None, lambda *_: "good"):
        with pytest.raises(
            ConfigError, match=r"^metric 'mine': expected one number of its functio"
        ):
            Metric(wrong, "mine").of("mine", x, y)


def test_an_adapter_brings_its_penalties(monkeypatch):
    class Costly(DirectAdapter):
        penalties = {**PENALTIES, "cost": lambda found, misfit: found.mean_abs_C + misfit}

    monkeypatch.setattr(direct, "Costly", Costly, raising=False)
    monkeypatch.setattr(
        adapters, "ADAPTERS", adapters.ADAPTERS | {"costly": "mosa.baselines.direct:Costly"}
    )
    terms.check_terms({"cost": 1.0}, Costly())
    with pytest.raises(ConfigError, match=r"cost.*another package is known once .*extensions"):
        terms.check_terms({"cost": 1.0}, DirectAdapter())
    found = OperatorStatistics(torch.tensor(2.0), torch.zeros(3), torch.ones(3))
    step = SimpleNamespace(operator=found, misfit=0.5, body=SimpleNamespace(adapter=Costly()))
    assert terms.evaluate_terms({"cost": 1.0, "operator_variance": 1.0}, step) == {
        "operator_variance": 1.0,
        "cost": 2.5,
    }
    assert terms.evaluate_terms({"cost": 1.0}, SimpleNamespace(operator=None)) == {}
    for wrong in 3.0, np.float64(3.0), torch.ones(2):
        monkeypatch.setitem(Costly.penalties, "cost", lambda *_: wrong)  # noqa: B023
        with pytest.raises(ConfigError, match=r"losses\.cost: expected a tensor of shape"):
            terms.evaluate_terms({"cost": 1.0}, step)
    with pytest.raises(ConfigError, match="another"):
        register_term("operator", lambda step: None)

"""The rollout benchmark's check: ratios of times in one run against the stored ones."""

import importlib
import json
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def rollout(monkeypatch):
    """The benchmark as a module, as it is when run as a script."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("rollout")


def test_no_ratio_has_degraded_by_more_than_a_quarter(rollout):
    found, stored, bad = rollout.check()
    assert not bad, {name: (stored[name], found.get(name)) for name in bad}


def test_a_degraded_or_missing_ratio_is_named(rollout):
    stored = {"a": 2.0, "b": 4.0, "c": 1.0}
    assert rollout.degraded({"a": 2.49, "b": 5.01}, stored) == ["b", "c"]
    assert rollout.degraded({"a": float("nan"), "b": 4.0, "c": 0.5}, stored) == ["a"]


def test_the_stored_ratios_cover_every_variant(rollout):
    stored = json.loads(rollout.STORED.read_text())
    assert {key: stored[key] for key in rollout.CHECK} == rollout.CHECK
    best = {f"{variant} {what}": 1.0 for variant in rollout.VARIANTS for what in ("forward", "both")} | {"yardstick": 1.0}
    assert stored["ratios"].keys() == rollout.ratios(best).keys()

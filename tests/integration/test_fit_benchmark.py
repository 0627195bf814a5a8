"""benchmarks/fit.py: time of a step by stage and part."""

import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.chdir(ROOT)
    return importlib.import_module("fit")


def test_every_part_of_every_stage_is_timed(benchmark, cache, capsys):
    figures, about = benchmark.measure(
        ["debug=default", "prior=corotated", f"scene.cache={cache}"], "cpu", 2
    )
    assert list(figures) == ["prior", "prior_eta", "joint"] and "1 views" in about
    for parts in figures.values():
        assert list(parts) == list(benchmark.PARTS) and all(
            len(each) == 2 and min(each) > 0 for each in parts.values()
        )
        assert min(parts["backward"]) > max(parts["update"])
    benchmark.print_table({"this one": figures, "the other": figures}, "cpu")
    assert capsys.readouterr().out.count("| joint |") == 2


def test_what_is_no_checkout_is_named(benchmark):
    with pytest.raises(
        SystemExit, match=r"--against: expected a folder with train.py or a commit, found 'nowhere'"
    ):
        with benchmark.checkout("nowhere"):
            pass

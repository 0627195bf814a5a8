"""The package away from its repository: configuration inside, commands, version; and what the commands do around a run."""

import importlib
import logging
import os
import shutil
import subprocess
import sys
import tomllib
import warnings
from pathlib import Path

import pytest
from omegaconf import OmegaConf

import mosa
from mosa.cli import view
from mosa.config import composition
from mosa.system import console
from mosa.viewer import recorded as viewer

ROOT = Path(__file__).parents[2]


def test_a_configuration_is_shown_where_there_is_no_run_folder(monkeypatch):
    monkeypatch.setattr(composition.HydraConfig, "initialized", lambda: True)
    for folder, found in (("???", "outputs"), ("own_run", "own_run")):  # of --cfg job, and of a run
        hydra = OmegaConf.create({"runtime": {"output_dir": folder}})
        monkeypatch.setattr(composition.HydraConfig, "get", lambda hydra=hydra: hydra)
        assert composition.current_folder() == found


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """What a wheel holds, from a copy of the sources."""
    source, library = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("library")
    for name in ("mosa", "conf"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE", "MANIFEST.in"):
        shutil.copy(ROOT / name, source / name)
    built = subprocess.run(
        [sys.executable, "setup.py", "-q", "build_py", "-d", str(library)],
        cwd=source,
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stderr[-2000:]
    shutil.rmtree(source)
    return library


def test_a_wheel_holds_the_whole_configuration(built):
    inside = {
        p.relative_to(built / "mosa" / "conf") for p in (built / "mosa" / "conf").rglob("*.yaml")
    }
    assert (
        inside == {p.relative_to(ROOT / "conf") for p in (ROOT / "conf").rglob("*.yaml")}
        and len(inside) > 50
    )
    assert (built / "mosa" / "py.typed").is_file()


def call(built, tmp_path, module, *arguments):
    """The command as an installed script runs it, with nothing of the repository in reach."""
    start = (
        f"import sys; sys.argv[0] = 'mosa'; from mosa.cli.{module} import main; sys.exit(main())"
    )
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | {
        "PYTHONPATH": str(built)
    }
    return subprocess.run(
        [sys.executable, "-c", start, *arguments],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )


def configured(built, tmp_path, module, *arguments):
    """The configuration that a command would run with, and hydra's own."""
    result = call(built, tmp_path, module, *arguments, "--cfg", "all")
    assert result.returncode == 0, result.stderr[-2000:]
    cfg = OmegaConf.create(result.stdout)
    sources = [
        source.path for source in cfg.hydra.runtime.config_sources if source.provider == "main"
    ]
    assert (
        sources == [str(built / "mosa" / "conf")] and cfg.hydra.job.name == module
    )  # the folder's name: outputs/train/...
    return cfg


def test_the_commands_find_their_configuration_and_an_experiment_of_ones_own(built, tmp_path):
    (tmp_path / "mine" / "experiment").mkdir(parents=True)
    (tmp_path / "mine" / "experiment" / "duck.yaml").write_text(
        "# @package _global_\ndefaults:\n  - override /scene: transforms\nsimulation: {particles: 77}\n"
    )
    cfg = configured(
        built, tmp_path, "train", "--config-dir", "mine", "experiment=duck", "scene.scale=0.3"
    )
    assert (cfg.simulation.particles, cfg.scene.format, cfg.scene.scale) == (77, "transforms", 0.3)
    assert configured(built, tmp_path, "eval", "ckpt_path=x.ckpt").ckpt_path == "x.ckpt"


@pytest.mark.parametrize("name", ["splats", "capture", "environments"])
def test_a_command_is_the_name_of_its_configuration_and_of_its_runs(built, tmp_path, name):
    assert set(OmegaConf.load(ROOT / "conf" / f"{name}.yaml")) - {"defaults"} <= set(
        configured(built, tmp_path, name)
    )


def test_the_experiments_are_installed_with_the_paper_s_figures(built, tmp_path):
    result = call(built, tmp_path, "experiment")
    assert result.returncode == 0 and "table_generalisation" in result.stdout, result.stderr[-2000:]
    assert (built / "mosa" / "experiments" / "report" / "printed.yaml").is_file()
    wrong = call(built, tmp_path, "experiment", "nothing", "--dry-run")
    assert wrong.returncode == 2 and "ConfigError: experiment: expected one of" in wrong.stderr


def test_in_a_clone_the_configuration_is_where_it_is_edited():
    assert Path(composition.configuration()) == ROOT / "conf"


def test_there_is_one_version_and_every_command_has_its_function():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert (
        project["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "mosa.__version__"}
        and mosa.__version__.count(".") == 2
    )
    for target in project["project"]["scripts"].values():
        module, function = target.split(":")
        assert callable(getattr(__import__(module, fromlist=[function]), function))
    assert set(project["project"]["scripts"]) == {
        "mosa-train",
        "mosa-eval",
        "mosa-view",
        "mosa-splats",
        "mosa-capture",
        "mosa-environments",
        "mosa-experiment",
        "mosa-export-law",
        "mosa-material",
        "mosa-sweep",
    }


@pytest.mark.parametrize(
    "name", ["train", "eval", "splats", "view", "experiment", "export_law", "sweep"]
)
def test_every_command_says_mosas_version(monkeypatch, capsys, name):
    monkeypatch.setattr(sys, "argv", [f"mosa-{name}", "--version"])
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(f"mosa.cli.{name}").main()
    assert not ended.value.code and capsys.readouterr().out == f"mosa {mosa.__version__}\n"


def test_help_of_the_viewer_and_a_start_without_a_driver_are_quick_and_quiet():
    code = "import sys, mosa.cli.view as v; sys.argv[1:] = ['-h']; v.main(); sys.exit('torch' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert found.returncode == 0 and "usage: mosa-view" in found.stdout and not found.stderr
    quiet = [sys.executable, "-c", "from mosa.system.warp_start import start_warp; start_warp()"]
    assert not subprocess.run(quiet, cwd=ROOT, capture_output=True, text=True).stderr


@pytest.mark.parametrize("flag", ["--help", "-h"])
def test_the_viewer_explains_itself(monkeypatch, capsys, flag):
    monkeypatch.setattr(sys, "argv", ["mosa-view", flag])
    view.main()
    said = capsys.readouterr().out
    assert said.startswith("usage: mosa-view") and "port" in said


def test_a_folder_alone_is_the_run(tmp_path):
    assert viewer.options([str(tmp_path), "port=9000"]) == {
        "run": str(tmp_path),
        "checkpoint": None,
        "live": "false",
        "host": "127.0.0.1",
        "port": "9000",
        "device": "cpu",
    }


def test_a_warning_and_what_ended_a_run_are_in_the_log(tmp_path, capsys, monkeypatch):
    root, file = logging.getLogger(), logging.FileHandler(tmp_path / "train.log")
    monkeypatch.setattr(root, "handlers", [file])
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        # a command that an earlier test ran in this process has left it on
        logging.captureWarnings(False)
        console.begin_log()
        try:
            warnings.warn("three holes in a matte", stacklevel=1)
            warnings.warn("of a library", DeprecationWarning, stacklevel=1)
        finally:
            logging.captureWarnings(False)
    console.fail("DataError: no image")
    file.close()
    first, second, last = (tmp_path / "train.log").read_text().splitlines()
    assert first == "warning: three holes in a matte" and last == "DataError: no image"
    assert second.endswith("DeprecationWarning: of a library") and "test_commands.py" in second
    assert capsys.readouterr().err == "\nDataError: no image\n"

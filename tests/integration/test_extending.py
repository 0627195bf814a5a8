"""The package of docs/extending.md as the page has it, in a run of every stage: law, adapter, loss term, metric, format; and
the baseline."""

import json
import os
from pathlib import Path

import forked
import numpy as np
import pytest
import yaml
from run_page import written

from mosa.data.scene import load_scene

ROOT = Path(__file__).parents[2]
HELPERS = ROOT / "tests" / "helpers"
PAGE = ROOT / "docs" / "extending.md"
QUICK = ["debug=default", "scene.holdout_frames=0", "fit=adam", "fit.prior.iterations=2", "fit.joint.iterations=2",
         "fit.prior_eta.iterations=0", "heterogeneity.enabled=false", "simulation.particles=100", "reconstruction.resolution=40",
         "reconstruction.static.iterations=30", "reconstruction.appearance.iterations=30", "reconstruction.carried.iterations=10",
         "reconstruction.geometry.source=hull",
         "reconstruction.dynamic.iterations=10", "reconstruction.dynamic.track_iterations=10", "logger=csv",
         "evaluation.video=false", "evaluation.samples=64", "evaluation.assignment=32"]  # fmt: skip


def recorded(folder: Path, cache: Path) -> Path:
    """The tiny scene in the page's format."""
    scene = load_scene(format="builtin", name="tiny", scale=0.5, cache=cache)
    kept = {
        "images": scene.images,
        "mattes": scene.mattes,
        "K": scene.cameras.K,
        "w2c": scene.cameras.w2c,
        "times": scene.times,
    }
    np.savez(folder / "fall.npz", **{name: value.numpy() for name, value in kept.items()})
    return folder / "fall.npz"


TABLES = """
from forked_workers import fork
from mosa.cli.experiment import main
from mosa.experiments import workers
workers.ProcessPoolExecutor = fork()
if __name__ == "__main__":
    main()
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory, cache):
    """The package as a row of a table of its own: a specification in a folder, whose job is the run."""
    folder = tmp_path_factory.mktemp("extending")
    assert len(written(PAGE, folder)) == 11
    row = ["extensions=[my_mosa]", f"hydra.searchpath=[file://{folder}/conf_of_mine]", "prior=fibres", "adapter=softer",
           "+losses.volume=0.5"]  # fmt: skip
    scene = [
        "scene=recording",
        f"scene.path={recorded(folder, cache)}",
        f"scene.cache={folder}/cache",
    ]
    table = {
        "title": "A method of one's own", "rows": "method", "columns": "scene", "common": QUICK, "plot": None,
        "axes": {"method": {"softer": row}, "scene": {"recording": scene}},
        "figures": [{"label": "l1", "figure": "train/l1_crop", "best": "least"}],
    }  # fmt: skip
    (folder / "tables").mkdir()
    (folder / "tables" / "mine.yaml").write_text(yaml.safe_dump(table))
    (folder / "tables.py").write_text(TABLES)
    result = forked.call(str(folder / "tables.py"), "mine", "--specifications", f"{folder}/tables", "--runs", f"{folder}/runs",
                         "--results", f"{folder}/results",
                         environment=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (folder, ROOT, HELPERS)))})  # fmt: skip
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr[-3000:]
    (job,) = (path for path in (folder / "runs").iterdir() if path.is_dir())
    (folder / "run").symlink_to(job)
    return folder


def test_a_method_of_ones_own_is_a_row(run):
    figures = json.loads((run / "run" / "metrics.json").read_text())
    page = (run / "results" / "mine.md").read_text()
    (row,) = [line for line in page.splitlines() if line.startswith("| softer")]
    assert float(row.split("|")[2].strip(" *")) == pytest.approx(
        figures["train/l1_crop"], abs=0.006
    )


def test_the_law_is_learned_with_its_direction(run):
    figures = json.loads((run / "run" / "metrics.json").read_text())
    start = np.array([1, 0.2, 0]) / np.hypot(1, 0.2)
    for prefix in ("id_prior", "id"):
        fibre = np.array([figures[f"{prefix}/fibre_{axis}"] for axis in "xyz"])
        assert (
            np.linalg.norm(fibre) == pytest.approx(1, abs=1e-6)
            and 1e-3 < np.linalg.norm(fibre - start) < 0.5
        )
        assert figures[f"{prefix}/fibre_stiffness"] > 0
        assert figures[f"{prefix}/fibre_stiffness"] != pytest.approx(2e3, rel=1e-3)


def test_adapter_and_term_are_in_the_fit(run):
    lines = next((run / "run").rglob("metrics.csv")).read_text()
    header = lines.splitlines()[0].split(",")
    assert {
        "loss_raw/volume",
        "loss_weighted/volume",
        "loss_raw/operator",
        "adapter/mean_abs_C",
    } <= set(header)
    figures = json.loads((run / "run" / "metrics.json").read_text())
    assert 0 < figures["train/mean_abs_C"] < 0.2


def test_the_metric_is_in_the_tables(run):
    figures = json.loads((run / "run" / "metrics.json").read_text())
    for model in ("", "prior/"):
        assert 0 < figures[f"{model}train/l1_crop"] < 255 and f"{model}train/l1_full" in figures
    assert "| L1 crop " in (run / "run" / "results.md").read_text()


LOAD = """
import sys
from mosa.errors import DataError
from mosa.twin import Twin
try:
    Twin.load(sys.argv[1])
except DataError as error:
    print(error)
import my_mosa
twin = Twin.load(sys.argv[1])
print(twin.simulate(frames=3).x.isfinite().all().item(), *twin.body.material.direction("fibre").tolist())
"""


def test_a_checkpoint_needs_the_package_and_does_not_import_it(run):
    (run / "load.py").write_text(LOAD)
    result = forked.call(str(run / "load.py"), str(run / "run" / "checkpoints" / "last.ckpt"),
                         environment=os.environ | {"PYTHONPATH": f"{run}{os.pathsep}{ROOT}"})  # fmt: skip
    assert result.returncode == 0, result.stderr[-2000:]
    refused, found = result.stdout.strip().splitlines()[-2:]
    assert (
        "adapter.name: expected" in refused
        and "found 'softer'" in refused
        and "extensions" in refused
    )
    flag, *numbers = found.split()
    figures = json.loads((run / "run" / "metrics.json").read_text())
    assert flag == "True" and [float(n) for n in numbers] == pytest.approx(
        [figures[f"id/fibre_{a}"] for a in "xyz"], abs=1e-6
    )


BASELINE = """
import my_mosa, torch
from small_bodies import FRAME_DT, WORLD, small_body, start
from mosa.config.build import build_adapter
def rolled(k, E):
    body = small_body(adapter=False, E=E)
    body.settings = type(body.settings)(**{**vars(body.settings), "stride": 1})
    body.adapter = build_adapter({"name": "one_number", "start": k}).double()
    body.adapter.switch_on(3e4, 0.35)
    x = body.simulate(start(), WORLD, 4, FRAME_DT, substeps=80).x
    x[-1].square().sum().backward()
    return x.detach(), float(body.adapter.k.grad)
(one, slope), (other, _), (softer, _) = rolled(0.3, 3e4), rolled(0.3, 2e4), rolled(0.15, 3e4)
print(float((one - other).abs().max()), float((one - softer).abs().max()), slope)
"""


def test_the_baseline_stands_in_for_the_law(tmp_path):
    written(PAGE, tmp_path)
    path = os.pathsep.join(map(str, (tmp_path, ROOT, HELPERS)))
    (tmp_path / "baseline.py").write_text(BASELINE)
    result = forked.call(
        str(tmp_path / "baseline.py"), environment=os.environ | {"PYTHONPATH": path}
    )
    assert result.returncode == 0, result.stderr[-2000:]
    other_prior, other_number, slope = map(float, result.stdout.split()[-3:])
    assert other_prior < 1e-9 < 1e-4 < other_number and abs(slope) > 1e-4

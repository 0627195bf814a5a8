"""Every code block of README, guides and notebook runs (tests/helpers/run_page.py), on the run that the tutorial makes."""

import json
import os
import re
import subprocess
from pathlib import Path

import assembled
import forked
import numpy as np
import pytest
import run_page
import yaml

from mosa.system.caches import cache_home

ROOT = Path(__file__).parents[2]
HELPERS = ROOT / "tests" / "helpers"
FIRST, NOTEBOOK = "docs/tutorial.md", "docs/notebook.ipynb"
PAGES = [
    path.relative_to(ROOT).as_posix()
    for path in (*ROOT.glob("*.md"), *sorted((ROOT / "docs").glob("*.md")), ROOT / "docs" / "notebook.ipynb")
    if path.name != "CHANGELOG.md" and any(block.language not in run_page.NO_CODE for block in run_page.blocks(path))
]  # fmt: skip

ROUGHLY = """
from pathlib import Path
import mosa
from assembled import ROUGHLY
from mosa.system.caches import default_cache
from run_page import ROOT, written
from tests.integration.test_extending import recorded
composed = mosa.compose
mosa.compose = lambda *words: composed(*words, *(ROUGHLY if words[-1] == "scene.holdout_frames=1" else ()))
written(ROOT / "docs" / "extending.md", Path())
recorded(Path(), default_cache())
"""
BEAM = """
from dataclasses import replace
from pathlib import Path
import torch
from small_bodies import FRAME_DT, WORLD, small_body, start
from mosa.twin.twin import Twin
twin = Twin(small_body(counts=(12, 3, 3)), WORLD, FRAME_DT, None, replace(start(), center=torch.tensor([0.12, 0.1, 0]).double()))
Path("cell.csv").write_text("time,fy\\n0,1\\n1,2\\n")
"""
PULLED = """
clamp, grip = force[-1]
assert grip[0] < -0.1 < 0.1 < clamp[0] and clamp[1] + grip[1] < 0  # and the clamp takes the beam's weight beside
"""
GRIPPER = """
import torch
from pathlib import Path
from small_bodies import FRAME_DT, STICKY, small_body, start
from mosa.twin.twin import Twin
JAW = '''<link name="{name}"><collision>
<geometry><box size="0.06 0.12 0.16"/></geometry></collision></link>
<joint name="{name}_slide" type="prismatic"><parent link="lift"/><child link="{name}"/>
<origin xyz="{x} 0 0"/><axis xyz="{side} 0 0"/>
<limit lower="0" upper="1" effort="1" velocity="1"/></joint>'''
jaws = JAW.format(name="left", x=-0.1, side=1) + JAW.format(name="right", x=0.1, side=-1)
Path("gripper.urdf").write_text('''<robot name="gripper"><link name="root"/><link name="lift"/>
<joint name="up" type="prismatic"><parent link="root"/><child link="lift"/><axis xyz="0 1 0"/>
<limit lower="0" upper="1" effort="1" velocity="1"/></joint>''' + jaws + "</robot>")
body = small_body(adapter=False, precision=32, E=6e4)
Twin.load = lambda path: Twin(body, STICKY, FRAME_DT, None, start(height=0.04, speed=0.0, dtype=torch.float32))
carried, step = [], Twin.step
def noted(self, action):
    found = step(self, action)
    carried.append(-float(found.reactions.mean(0)[:, 1].sum()))
    return found
Twin.step = noted
"""
LIFTED = """
weight = 9.8 * 1000 * float(body.volume.sum())
assert state.positions[:, 1].mean() - states[0].positions[:, 1].mean() > 0.08 and abs(sum(carried[-20:]) / 20 / weight - 1) < 0.03
"""
FALL = """
height = rollout.x[:, :, 1].mean(1)
fall = 0.165 - 0.5 * 9.8 * rollout.times[:7].square()
torch.testing.assert_close(height[:7], fall, rtol=0, atol=1.5e-3)  # half a substep of gravity early, 0.3 mm in 0.12 s
low = int(height.argmin())
assert 6 < low < 25 and rollout.x[:, :, 1].min() > -dx / 2 and height[low:].max() > 1.5 * height[low]
"""
SMALL = """
import warnings
from mosa.twin.twin import Twin
from tests.twin.test_episode import twin
warnings.simplefilter("error", UserWarning)  # of gradients that are far off
Twin.load = lambda path: twin(32)
"""
STEPPED = """
from mosa.twin.episode import TwinState
assert not torch.equal(*outcomes) and by_push.abs().max() > 0 and by_modulus.abs() > 0
assert TwinState.read(torch.load("moment.pt", weights_only=True)).x.shape == outcomes[0].shape
"""
DROPS = """
from page_films import drops, foams
drops("data/duck/drop_1", "data/duck/drop_2", "data/duck/drop_3", "data/duck/two_falls")
Path("data/foam").symlink_to("duck")
foams("foam.csv", "more.csv")
"""
SWINGS = """
from page_films import swings
swings(*(f"beams/beam_{name}.csv" for name in ("gravity_V2_a", "gravity_V2_b", "load52_V2_a", "load52_V2_b")))
"""
PHONES = """
from filming import filmed, write_films
write_films(filmed(count=3, size=(80, 60)), Path("data/drop_1"))
Path("data/sparse").mkdir()
Path("data/sparse/0").symlink_to(Path("data/drop_1/sparse").absolute())
"""
SHORTLY = """
from mosa.environments import policies
policies.FITTED, policies.DESCENDED = 10, 3  # steps of a policy's model
"""
LAB = """
import sys
from mosa.training import workflow
workflow.figures_of = lambda *_: sys.exit()  # after the fit, about which its commands are; test_own_script.py runs one to its end
Path("mylab.py").write_text("import lightning as L\\nclass MyCallback(L.Callback): pass\\n")
"""
OWN = """
assert "loss_raw/height" in next(Path("heights").rglob("metrics.csv")).read_text() and data.scene.name == "fall"
"""
FIT = ["debug=default", "simulation.courant=1", "simulation.stride=4", "simulation.contact_offset=false", "fit.prior.looks=0",
       "fit.prior.newton_iterations=1", "fit.joint.newton_iterations=1", "prior.frozen=[nu]", "heterogeneity.enabled=false",
       "identification.grid_error=0", "reconstruction.informed.iterations=0", "evaluation.floor=false", "evaluation.samples=64",
       "evaluation.assignment=16", "evaluation.video=false"]  # fmt: skip
"""Overrides of a run that does all of a documented run's steps, each at its smallest."""
BUILT_IN = [*FIT, "scene.name=tiny", "scene.scale=0.5"]
LOOKED_AT = ["fit.prior.newton_iterations=1", "fit.joint.newton_iterations=1", "identification.grid_error=0",
             "reconstruction.informed.iterations=0", "evaluation.floor=false", "evaluation.samples=64",
             "evaluation.assignment=16"]  # fmt: skip
"""Of the tutorial's run, which other pages take up. As the tutorial has it, test_main_job.py runs it."""
FILMED = [
    *FIT,
    *assembled.ROUGHLY,
    "adapter=none",
    "simulation.courant=0.4",
    "scene.scale=1",
    "scene.ground.mode=sticky",
    "scene.box=[[-0.7,-0.1,-0.7],[0.7,1,0.7]]",
]
TRIALS = ["options.steps=4", "search.iterations=1", "search.batch=1", "search.validation=1", "search.candidates=4", "trials=1",
          "films=1", "seeds=[0]"]  # fmt: skip
FALLS = ["resolution=24", "simulation.particles=200", "frames=3", "film.size=16"]
REALLY = {
    "rabbit": ({"train.py": BUILT_IN, "prior=auto": ["prior.candidates=[neo_hookean,stvk]"], "eval.py": ["plan=2"]}, {}),
    "capture": ({"mosa.capture": ["max_offset=0.5", "before=0.07", "after=0.07", "rate=30"], "scene=transforms": FILMED},
                {"/data/": "{folder}/data/"}),
    "several_recordings": ({"scene=mandarin": BUILT_IN, "scene=transforms": FILMED, "mosa-material": ["starts=1"]},
                           {"/data/": "{folder}/data/", "[0, 30]": "[0, 4]", "[40, 60]": "[5, 9]"}),
    "beam": ({"train.py": [*FIT, "prior.parameters.nu=0.3", "simulation.particles=200", "scene.duration=0.04"]},
             {"../shared/data/real/beams/*.c3d": "beams/beam_gravity_V2_a.csv", "../shared/data/real/beams": "beams",
              ".c3d": ".csv"}),
    "splats": ({"mosa.splats": FALLS}, {}),
    "environments": ({"train.py": BUILT_IN, "mosa.environments": TRIALS, "task=hanging": ["films=0"]},
                     {"truth.spacing=0.0125": "truth.spacing=0.02",
                      "checkpoint=...": f"checkpoint={run_page.RUN}/checkpoints/last.ckpt"}),
    "own_training_script": (
        {"train.py": [*FIT, "adapter=none"], "scene.holdout_cameras=[1]": ["scene.holdout_frames=1", *assembled.ROUGHLY]},
        {"scene.holdout_cameras=[5]": "scene.holdout_cameras=[1]"}),
    "tutorial": ({"train.py": LOOKED_AT}, {}),
    "notebook": ({"train.py": LOOKED_AT}, {}),
}  # fmt: skip
"""Pages whose commands run: overrides by a word of the command, which make it small, and what stands in for what."""
MADE = """
from pathlib import Path
from run_page import RUN
def made(pattern, folder="."):
    assert (found := sorted(Path(folder).rglob(pattern))), pattern
    return found
"""
AROUND = {
    "rabbit": ("", MADE + 'assert "drop" in made("plan.md", "outputs/eval")[0].read_text()'),
    "capture": (PHONES, MADE + 'made("capture.md", "data"), made("results.md", RUN)'),
    "several_recordings": (DROPS, MADE + 'made("material.json", "outputs/foam"), made("results.md", RUN)'),
    "beam": (SWINGS, MADE + 'assert "test/load52_b/rms_m" in made("metrics.json", RUN)[0].read_text()'),
    "splats": ("", MADE + 'assert len(made("simulation.mp4", "outputs")) == len(made("last.ckpt", "outputs/splats")) == 4'),
    "environments": (SHORTLY, MADE + 'made("placement.md", "environments"), made("hanging.csv", "environments")'),
    "own_training_script": (ROUGHLY + LAB, OWN + MADE + 'made("metrics.csv", RUN), made("tensorboard", RUN)'),
    "driven": (BEAM, PULLED), "robots": (GRIPPER, LIFTED), "extending": ("", FALL), "twin": (SMALL, STEPPED),
}  # fmt: skip
"""By page: code before it, as stand-ins for its bodies and films, and after it."""


def run(page: str, folder: Path, environment: dict) -> subprocess.CompletedProcess:
    environment = environment | {"PYTHONPATH": os.pathsep.join(map(str, (folder, ROOT, HELPERS)))}
    before, after = AROUND.get(Path(page).stem, ("", ""))
    if Path(page).stem in REALLY:
        smaller, said = REALLY[Path(page).stem]
        said = {word: stand_in.replace("{folder}", str(folder)) for word, stand_in in said.items()}
        before = f"SMALLER.update({smaller!r})\nSAID.update({said!r})\nfrom pathlib import Path\n{before}"
    else:
        environment.pop("TESTS_REALLY")
    found = forked.call(f"{HELPERS}/run_page.py", page, str(folder), before, after, environment=environment)  # fmt: skip
    assert found.returncode == 0, f"{found.stdout[-2000:]}\n{found.stderr[-3000:]}"
    return found


@pytest.fixture(scope="module")
def environment(cache, tmp_path_factory):
    """Its films are those of other tests, its kernels those of the machine."""
    home, caches = tmp_path_factory.mktemp("home"), Path(cache_home())
    (home / "mosa").symlink_to(cache)
    (home / "warp").symlink_to(caches / "warp")
    runs = tmp_path_factory.mktemp("runs")
    return os.environ | {
        "XDG_CACHE_HOME": str(home),
        "MPLBACKEND": "Agg",
        "TESTS_REALLY": str(runs),
    }


@pytest.fixture(scope="module")
def learned(environment, tmp_path_factory):
    """The run of the tutorial."""
    folder = tmp_path_factory.mktemp("tutorial")
    run(FIRST, folder, environment)
    return folder / run_page.RUN


@pytest.fixture
def folder(learned, tmp_path):
    """Where a page runs: files of the tutorial's run by the names that pages use."""
    (tmp_path / run_page.RUN).parent.mkdir(parents=True)
    for name, target in {run_page.RUN: ".", "notebook_run": ".", "last.ckpt": "checkpoints/last.ckpt",
                         "object.ply": "splats.ply"}.items():  # fmt: skip
        (tmp_path / name).symlink_to(learned / target)
    np.savez(tmp_path / "rollout.npz", **{"simulation/reactions": np.zeros((3, 4, 1, 6))})
    return tmp_path


def test_the_commands_of_all_tutorials_run():
    """But for those that cannot run here, which are few."""
    site = yaml.safe_load((ROOT / "mkdocs.yml").read_text())
    sections = {name: pages for each in site["nav"] for name, pages in each.items()}
    named = [*sections["Tutorials"], *sections["Get started"]]
    tutorials = {Path(page).stem for each in named for page in each.values()} - {"installation"}
    assert tutorials | {"notebook"} == set(REALLY)
    lines = [line for name in tutorials for block in run_page.blocks(ROOT / "docs" / f"{name}.md")
             if block.language == "bash" for line in block.text.splitlines()]  # fmt: skip
    assert sum(word in line for line in lines for word in run_page.CANNOT) == 2 < len(lines) / 10


def test_the_tutorial_runs_with_its_commands(learned):
    assert {"results.md", "strip.png", "video.mp4"} <= {path.name for path in learned.iterdir()}


@pytest.mark.parametrize("page", [page for page in PAGES if page not in (FIRST, NOTEBOOK)])
def test_every_block_of_a_page_runs(page, folder, environment):
    run(page, folder, environment)


def test_the_notebook_runs_from_top_to_bottom(folder, environment):
    for cell in json.loads((ROOT / NOTEBOOK).read_text())["cells"]:
        assert not cell.get("outputs") and cell.get("execution_count") is None
    found = run(NOTEBOOK, folder, environment)
    assert "Held-out positions" in found.stdout and "20 files;" in found.stdout
    losses = [float(loss) for loss in re.findall(r"iteration \d+: loss ([\d.]+)", found.stdout)]
    assert len(losses) == 3 and losses[-1] < 0.5 * losses[0]  # the policy learns
    assert "UserWarning" not in found.stderr and "nan" not in found.stdout.lower()

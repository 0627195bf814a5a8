"""The commands of the README on a tiny scene: train, kill and resume, evaluate, simulate, and what they say on a mistake."""

import csv
import json
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import forked
import imageio.v3 as imageio
import lightning as L
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from mosa import __version__
from mosa.data.synthetic.bodies.objects import RABBIT
from mosa.errors import SimulationDiverged
from mosa.evaluation import evaluate as evaluation
from mosa.modules.body.body import Body, ContactOffset, Start
from mosa.training import workflow as pipeline
from mosa.training.lit_mosa import LitMosa
from mosa.training.run_folder import read_figures
from mosa.twin.twin import Twin
from mosa.types import Ground
from mosa.viewer.clips import read_run

ROOT = Path(__file__).parents[2]
FIGURES = (ROOT / "docs" / "figures.md").read_text()
FEW_FIGURES = [
    "evaluation.video=false",
    "evaluation.floor=false",
    "evaluation.samples=256",
    "evaluation.assignment=64",
]
"""Of runs whose fit is looked at, and not what comes after it."""


@pytest.fixture(scope="module")
def cache(cache, tmp_path_factory):
    """Where nothing is made yet: the first run reconstructs too."""
    return tmp_path_factory.mktemp("cache") if any(cache.iterdir()) else cache


def command(script: str, folder: Path, cache: Path, *overrides: str) -> list[str]:
    common = [f"hydra.run.dir={folder}"]
    common += (
        ["debug=default", f"scene.cache={cache}"] if script == "train.py" else [f"cache={cache}"]
    )
    return [sys.executable, script, *common, *overrides]


def call(script: str, folder: Path, cache: Path, *overrides: str) -> subprocess.CompletedProcess:
    return forked.call(*command(script, folder, cache, *overrides)[1:])


@pytest.fixture(scope="module")
def run(tmp_path_factory, cache):
    folder = tmp_path_factory.mktemp("run")
    words = ["logger=[tensorboard,csv]", "callbacks.pictures.every=2"]
    result = call("train.py", folder, cache, *words)
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-3000:]
    (folder / "screen").write_text(result.stderr)
    return folder


@pytest.fixture(scope="module")
def stepped(tmp_path_factory, cache):
    """A run of Adam in all stages, with steps of two cells of the contact offset."""
    folder = tmp_path_factory.mktemp("stepped")
    adam = [f"fit.{stage}.optimizer=adam" for stage in ("prior", "prior_eta", "joint")]
    result = call(
        "train.py",
        folder,
        cache,
        *adam,
        "fit.prior.lr_contact=2",
        "reconstruction.informed.iterations=0",
        "logger=[tensorboard,csv]",
        *FEW_FIGURES,
    )
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-3000:]
    return folder


def test_a_run_leaves_its_outputs(run):
    figures = json.loads(
        (run / "metrics.json").read_text(), parse_constant=pytest.fail
    )  # strict JSON
    for key in (
        "train/rms_m",
        "prior/test/rms_m",
        "prior_eta/test/rms_m",
        "test/rms_m",
        "floor/test/rms_m",
        "test/psnr_crop",
        "id_prior/E",
        "id/E",
    ):
        assert np.isfinite(figures[key]), key
    rollout = np.load(run / "rollout.npz")
    assert rollout["train/x"].shape[2] == 3 and rollout["train/F"].shape[2:] == (3, 3)
    assert (run / "video.mp4").stat().st_size > 1000
    events = EventAccumulator(str(run / "tensorboard"))
    events.Reload()
    assert events.Scalars("final/test/rms_m")[-1].value == pytest.approx(
        figures["test/rms_m"], rel=1e-6
    )
    assert {"_hparams_/session_start_info", "_hparams_/experiment"} <= set(events.summary_metadata)
    assert "seed: 0" in (run / "tensorboard" / "hparams.yaml").read_text()
    # what two samplings of the body are apart: more than nothing, less than the body
    assert 0 < figures["floor/sampling/cd_m"] < 0.1 and 0 < figures["floor/sampling/emd_m"] < 0.1
    assert figures["id/E_ratio"] == pytest.approx(figures["id/E"] / RABBIT.known["E"])
    assert "id/growth_per_period" not in figures  # it has an energy
    # which of them is least in so small a run is a matter of the processor's rounding
    parts = ("isotropic", "operator", "stiffness", "operator+stiffness")
    assert all(0 < figures[f"held_back/{part}_m"] < 0.005 for part in parts)
    assert figures["unexplained/train/share"] < 0.3 and figures["unexplained/train/off_m"] > 0
    smoke = "**A small smoke run (debug=default): its figures mean nothing.**"
    assert (run / "results.md").read_text().startswith(smoke)
    assert smoke in (run / "checkpoints" / "model_card.md").read_text()
    assert figures["held_back/position_weight"] == 1
    assert figures["time/device"] and figures["time/particle_substeps_per_s"] > 0


def test_the_log_has_the_lines_that_matter(run):
    log = (run / "train.log").read_text()
    for line in (
        f"] mosa {__version__}: debug=default",
        "scene tiny: synthetic",
        "] reconstruction took ",
        "] body: 200 particles, ",
        "] start of test/test_60: velocity (",
        "] stage prior: at most 2 steps",
        "] stage joint: ended after 2 steps, ",
        "| rms [mm]  | adapted ",
        f"run folder: {run}",
    ):
        assert line in log, line
    assert log.count("] stage ") == 6


def test_the_first_picture_is_there_before_the_fit(run):
    """The film, its reconstruction and the prior, in the run folder and in TensorBoard; the log says where."""
    log = (run / "train.log").read_text()
    said = f"first picture, the reconstruction beside the prior: {run / 'first.png'}"
    assert 0 < log.index(said) < log.index("] start of train") < log.index("] fit: ")
    picture = imageio.imread(run / "first.png")
    assert picture.shape[0] > 3 * 60 and picture.std() > 5
    (shown,) = events_of(run).Images("film_reconstruction_prior")
    assert shown.step == 0 and (shown.height, shown.width) == picture.shape[:2]  # with its captions


def test_progress_in_a_file_is_lines(run):
    screen = (run / "screen").read_text()
    assert "\r" not in screen and max(map(len, screen.splitlines())) < 250
    assert screen.count("fit joint:   0% 0/2") == screen.count("fit joint: 100% 2/2") == 1


def events_of(folder: Path) -> EventAccumulator:
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    return events


def table_of(folder: Path) -> list[dict[str, str]]:
    """Rows of the table of the run, all of whose columns docs/figures.md describes."""
    with open(folder / "csv" / "version_0" / "metrics.csv") as file:
        rows = list(csv.DictReader(file))
    for tag in (t for t in rows[0] if t not in ("epoch", "step")):
        group = tag.rpartition("/")[0]
        assert f"`{tag}`" in FIGURES or f"`{group}/<" in FIGURES, (
            f"docs/figures.md does not describe {tag}"
        )
    return rows


def test_steps_times_and_pictures_are_logged(run):
    events, rows = events_of(run), table_of(run)
    seconds = [event.value for event in events.Scalars("time/step_s")]
    assert len(seconds) == 5 and all(0 < s < 400 for s in seconds)
    shares = [event.value for event in events.Scalars("newton/share")]
    assert len(shares) == 5 and all(0 <= s <= 1 for s in shares) and max(shares) > 0
    assert [float(row["newton/share"]) for row in rows] == pytest.approx(shares)
    assert not any(
        tag.startswith("lr/") for tag in events.Tags()["scalars"]
    )  # no optimiser of torch has stepped
    pictures = events.Images("real_above_rendered_below")
    assert [p.step for p in pictures] == [2, 4] and all(p.height >= 320 for p in pictures)


def test_rates_of_adam_are_logged(stepped):
    events, rows = events_of(stepped), table_of(stepped)
    seconds = [event.value for event in events.Scalars("time/step_s")]
    assert len(seconds) == 5 and all(0 < s < 400 for s in seconds)
    rates = [event.value for event in events.Scalars("lr/material")]  # conf/fit/tiny.yaml, decayed
    assert rates == pytest.approx([0.1, 0.1, 0.02, 0.01, 0.01])
    assert [event.value for event in events.Scalars("lr/adapter")] == pytest.approx([2e-3, 2e-3])
    assert [float(row["lr/material"]) for row in rows] == pytest.approx(rates)


def test_a_module_comes_back_from_its_checkpoint_and_is_tested(run):
    module = LitMosa.load_from_checkpoint(run / "checkpoints" / "last.ckpt")
    assert module.stage is None and module.steps_done == 5 and not module.training
    saved = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]
    for name, value in module.state_dict().items():
        assert torch.equal(value, saved[name]), name
    (found,) = L.Trainer(
        logger=False, accelerator="cpu", enable_checkpointing=False, enable_progress_bar=False
    ).test(module, verbose=False)
    figures = json.loads((run / "metrics.json").read_text())
    assert {"train/rms_m", "test/rms_m", "prior/test/test_40/psnr_crop", "test/mean_abs_C"} <= set(
        found
    )
    for key, value in found.items():
        assert value == pytest.approx(figures[key], rel=1e-5), key


def test_a_run_can_be_looked_at(run):
    train, *held_out = read_run(run)
    assert train.name == "train" and {clip.name for clip in held_out} == {
        "test/test_60",
        "test/test_40",
    }
    observed, prior, learned = train.bodies.values()
    assert (
        observed.centers.shape == prior.centers.shape == learned.centers.shape
    )  # all frames were learned from
    assert observed.covariances.shape == prior.covariances.shape == learned.covariances.shape
    assert (
        float(train.deviation(0).max()) < 0.02 * train.size
    )  # one particle is the same one in both
    figures = json.loads((run / "metrics.json").read_text())
    for clip in held_out:
        assert list(clip.bodies) == ["truth", "prior", "learned"]
        for model, key in (
            ("prior", f"prior/{clip.name}/rms_m"),
            ("learned", f"{clip.name}/rms_m"),
        ):
            squares = [np.square(clip.deviation(t, model)).mean() for t in range(len(clip.times))]
            after = [
                np.sqrt(np.mean(squares[contact:])) for contact in range(len(squares))
            ]  # the figure's: from contact on
            assert any(value == pytest.approx(figures[key], rel=1e-5) for value in after), key


def test_eval_reproduces_the_figures_from_the_checkpoint_alone(run, cache, tmp_path):
    result = call("eval.py", tmp_path, cache, f"ckpt_path={run}/checkpoints/last.ckpt")
    assert result.returncode == 0, result.stderr[-3000:]
    first, second = (json.loads((f / "metrics.json").read_text()) for f in (run, tmp_path))
    shared = [k for k in second if not k.startswith("time/")]
    assert len(shared) > 20
    for key in shared:
        assert second[key] == pytest.approx(first[key], rel=1e-6, abs=1e-9), key


def test_the_twin_simulates_from_a_new_start(run, cache, tmp_path):
    result = call(
        "eval.py",
        tmp_path,
        cache,
        f"ckpt_path={run}/checkpoints/last.ckpt",
        "simulate.velocity=[0.1,-1.5,0]",
        "simulate.rotation=[0,0,1,30]",
        "simulate.frames=4",
    )
    assert result.returncode == 0, result.stderr[-3000:]
    assert len(list((tmp_path / "ply").glob("*.ply"))) == 4
    assert (tmp_path / "simulation.mp4").stat().st_size > 1000


def test_the_contact_offset_stays_where_a_grid_can_put_it(stepped):
    """Steps of two cells: without the limits it would end far outside."""
    figures = json.loads((stepped / "metrics.json").read_text())
    assert (
        min(
            abs(figures["id/contact_offset_m"] / figures["dx_m"] - limit)
            for limit in ContactOffset.WITHIN
        )
        < 1e-5
    )


KILLED = """
import os, runpy, signal, sys, threading, time
from pathlib import Path
import torch

def kill(checkpoint):
    while not (
        checkpoint.exists()
        and torch.load(checkpoint, weights_only=True)["mosa"]["fit"]["steps_done"] >= 2
    ):
        time.sleep(0.1)
    os.kill(os.getpid(), signal.SIGKILL)

sys.argv.pop(0)
threading.Thread(target=kill, args=(Path(sys.argv.pop(0)),), daemon=True).start()
runpy.run_path(sys.argv[0], run_name="__main__")
"""
"""A run that ends without a word soon after its second step."""


def test_a_killed_run_resumes_bit_for_bit_and_is_then_skipped(run, cache, tmp_path):
    checkpoint = tmp_path / "killed" / "checkpoints" / "last.ckpt"
    (tmp_path / "killed.py").write_text(KILLED)
    stale = tmp_path / "killed" / "markers.npz"  # of another run, which the viewer would show
    (stale.parent / "checkpoints").mkdir(parents=True)
    (stale.parent / "checkpoints" / "earlier.ckpt").touch()
    stale.touch()
    words = command("train.py", tmp_path / "killed", cache)[1:]
    killed = forked.call(str(tmp_path / "killed.py"), str(checkpoint), *words)
    assert killed.returncode == -signal.SIGKILL, (
        "the run ended before it could be killed: make the scene's fit longer"
    )
    assert not stale.exists()
    begun = [
        call("train.py", tmp_path / "killed", cache, "resume=auto", *FEW_FIGURES) for _ in range(2)
    ]
    first, second = (result.stdout for result in begun)
    assert f"going on from {checkpoint}" in first and "skipped" not in first, begun[0].stderr[
        -3000:
    ]
    assert f"skipped: {tmp_path}" in second and [result.returncode for result in begun] == [0, 0], (
        begun[1].stderr[-3000:]
    )
    whole = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)
    resumed = torch.load(checkpoint, weights_only=True)
    assert whole["mosa"]["fit"]["steps_done"] == resumed["mosa"]["fit"]["steps_done"]
    for key, value in whole["state_dict"].items():
        assert torch.equal(value, resumed["state_dict"][key]), key
    figures, expected = (
        json.loads((folder / "metrics.json").read_text()) for folder in (tmp_path / "killed", run)
    )
    assert {k: v for k, v in figures.items() if k.startswith("id/")} == {
        k: v for k, v in expected.items() if k.startswith("id/")
    }


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (["prior=jelly"], ", found jelly"),
        (["ckpt_path=nowhere.ckpt"], "ckpt_path: nowhere.ckpt: no such file"),
        (["ckpt_path=conf"], "ckpt_path: conf: a folder; a run writes"),
        (["losses.colour=1"], "colour"),
        (["scene.scale=0,5"], "a decimal is written with a point"),
        (["trainer.devices=[1000]", "trainer.accelerator=gpu"], "trainer=cpu runs without one"),
        (["fit.clip=abc"], "fit.clip: expected a number above 0 and at most 1e+20, found 'abc'"),
        (["scene=pacnerf", "scene.path=/nonexistent"], "/nonexistent"),
    ],
)
def test_a_mistake_ends_in_one_message(overrides, expected, cache, tmp_path):
    result = call("train.py", tmp_path, cache, *overrides)
    assert result.returncode != 0
    assert expected in result.stderr
    assert "Traceback" not in result.stderr


def test_eval_without_a_checkpoint_says_what_it_needs(cache, tmp_path):
    result = call("eval.py", tmp_path, cache)
    assert result.returncode == 2 and "ckpt_path: expected the checkpoint of a run" in result.stderr
    assert "Traceback" not in result.stderr


def evaluated(run, tmp_path, monkeypatch, *overrides) -> dict:
    """What eval.py hands to `figures_of`: body, sequences, world. The checkpoint's body is in float64."""
    seen = {}

    def load(path, device):
        twin = Twin.load(path, device)
        twin.body.double()
        return twin

    def stop(_settings, body, sequences, world, *_):
        seen.update(body=body, sequences=sequences, world=world)
        raise InterruptedError

    monkeypatch.setattr(pipeline, "Twin", SimpleNamespace(load=load))
    monkeypatch.setattr(pipeline, "figures_of", stop)
    monkeypatch.setattr(pipeline, "run_folder", lambda: tmp_path)
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        cfg = compose("eval", [f"ckpt_path={run}/checkpoints/last.ckpt", *overrides])
    with pytest.raises(InterruptedError):
        pipeline.evaluate_checkpoint(cfg)
    return seen


TRAINED, HELD_OUT = {"train"}, {"test/test_60", "test/test_40"}


@pytest.mark.parametrize(
    "lost",
    [
        {"adapted": HELD_OUT},
        {"prior": HELD_OUT, "adapted": TRAINED},
    ],
)
def test_a_law_that_cannot_be_simulated_on_a_drop_has_infinite_errors_there(
    run, tmp_path, monkeypatch, lost
):
    """The fit was lost with it, and all other figures. On the training drop too, which no stage has to simulate freely.
    lost: sequences by the law that cannot be simulated there."""
    simulate = Body.simulate

    def diverges(self, start, world, frames, frame_dt, **more):
        asked = more.get("model") or self.model()
        for wanted in map(self.model, getattr(self, "failing", [])):
            if asked.material is wanted.material and asked.heterogeneity is wanted.heterogeneity:
                raise SimulationDiverged("substep 7, particle 3: gone")
        return simulate(self, start, world, frames, frame_dt, **more)

    def rollouts(body, sequence, world):
        # of this body, as each sequence has a thread and a copy of its own
        body.failing = [variant for variant, where in lost.items() if sequence.prefix in where]
        return evaluation_rollouts(body, sequence, world)

    evaluation_rollouts = evaluation.rollouts
    monkeypatch.setattr(Body, "simulate", diverges)
    monkeypatch.setattr(evaluation, "rollouts", rollouts)
    monkeypatch.setattr(pipeline, "run_folder", lambda: tmp_path)
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        cfg = compose("eval", [f"ckpt_path={run}/checkpoints/last.ckpt", *FEW_FIGURES[1:]])
    with pytest.warns(UserWarning) as told:
        pipeline.evaluate_checkpoint(cfg)
    figures, before = read_figures(tmp_path / "metrics.json"), read_figures(run / "metrics.json")
    warned = [str(warning.message) for warning in told]
    for variant, where in lost.items():
        model = evaluation.PREFIX[variant]
        law = {"prior": "the prior", "adapted": "the learned law"}[variant]
        for sequence in where:
            assert any(
                line.startswith(f"{sequence}: {law} cannot be simulated ")
                and "particle 3: gone" in line
                for line in warned
            ), (sequence, law, warned)
        for part in where | ({"test"} if where == HELD_OUT else set()):
            assert figures[f"{model}{part}/rms_m"] == figures[f"{model}{part}/cd_m"] == float("inf")
            assert figures[f"{model}{part}/psnr_crop"] == -float("inf")
        spared = "train" if where == HELD_OUT else "test"
        assert np.isfinite(figures[f"{model}{spared}/rms_m"])
        motion = np.load(tmp_path / {"prior": "prior.npz", "adapted": "rollout.npz"}[variant])
        kept = {key.split("/x")[0] for key in motion if key.endswith("/x")}
        assert kept == (HELD_OUT | TRAINED) - where
    other = "prior_eta/test/rms_m"
    assert figures[other] == pytest.approx(before[other], rel=1e-5)
    assert "inf" in (tmp_path / "results.md").read_text() and (tmp_path / "video.mp4").is_file()
    shutil.copytree(run / "checkpoints", tmp_path / "checkpoints")
    assert read_run(tmp_path)


def test_eval_puts_the_starts_where_the_body_is(run, tmp_path, monkeypatch):
    """Its device and type: on a GPU they stayed on the CPU, where the type is float32."""
    for sequence in evaluated(run, tmp_path, monkeypatch)["sequences"]:
        assert sequence.start.velocity.dtype == sequence.start.rotation.dtype == torch.float64


def test_another_scene_is_evaluated_in_its_own_world(run, cache, tmp_path, monkeypatch):
    raised = Ground(0.07, "separate", 0.3)

    def scenes(keys):
        scene, others = load(keys)
        return replace(scene, ground=raised, gravity=torch.tensor([0.0, -3.7, 0.0])), others

    load = pipeline.load_sequences
    monkeypatch.setattr(pipeline, "load_sequences", scenes)
    monkeypatch.setattr(
        pipeline,
        "sequence_start",
        lambda body, *_, **__: Start(torch.eye(3), body.center, *torch.zeros(2, 3)),
    )
    world = evaluated(run, tmp_path, monkeypatch, "scene=tiny", f"scene.cache={cache}")["world"]
    assert world.ground == raised and world.gravity.tolist() == pytest.approx([0.0, -3.7, 0.0])
    assert evaluated(run, tmp_path, monkeypatch)["world"].ground == Ground(0.0, "sticky", 0.0)


def test_a_sweep_goes_on_after_a_job_that_fails_and_says_so_at_the_end(cache, tmp_path):
    keys = ["debug=default", f"scene.cache={cache}", "trainer.accelerator=tpu,hpu"]
    result = forked.call("train.py", "-m", f"hydra.sweep.dir={tmp_path}", *keys)
    assert result.returncode == 1
    assert (
        result.stderr.count("ConfigError: trainer: expected what lightning.pytorch.Trainer takes")
        >= 2
    )
    assert "2 jobs of the sweep failed:\n  0: ConfigError: trainer: expected" in result.stderr

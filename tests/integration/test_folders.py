"""A body learned from one folder and tested on another: the whole program on what a user has, recordings and nothing else."""

import json
from dataclasses import replace
from pathlib import Path

import forked
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from written_scenes import export_particles, export_transforms, seen_by

from mosa.data.scene import load_scene
from mosa.evaluation.evaluate import run_sequences
from mosa.modules.fitting.search.ground import named, taken_of
from mosa.training import workflow as pipeline
from mosa.twin.twin import Twin

ROOT = Path(__file__).parents[2]
QUICK = ["debug=default", "scene=transforms", "scene.scale=1", "scene.box=[[-0.7,-0.1,-0.7],[0.7,1,0.7]]",
         "fit.prior.newton_iterations=1", "adapter=none", "heterogeneity.enabled=false",
         "reconstruction.static.iterations=40", "reconstruction.resolution=40", "reconstruction.geometry.source=hull",
         "reconstruction.appearance.iterations=40", "reconstruction.dynamic.iterations=20",
         "reconstruction.dynamic.track_iterations=10", "simulation.courant=1", "simulation.contact_offset=false", "logger=none",
         "evaluation.samples=256", "evaluation.assignment=64", "evaluation.video=false"]  # fmt: skip


def call(script, folder, *overrides):
    return forked.call(script, f"hydra.run.dir={folder}", *overrides)


def wider(scene, camera, margin):
    """The scene's images of one camera surrounded by white, as a camera with a larger sensor takes them; (images, mattes, K)."""
    pad = (margin, margin)
    images = torch.nn.functional.pad(
        scene.images[camera].movedim(-1, 1), pad + pad, value=1.0
    ).movedim(1, -1)
    K = scene.cameras.K.clone()
    K[:, :2, 2] += margin
    return images, torch.nn.functional.pad(scene.mattes[camera], pad + pad), K


def capture(scene, folder, camera=0, margin=4):
    """A folder in which one camera has larger images than the others."""
    export_transforms(scene, folder)
    images, mattes, K = wider(scene, camera, margin)
    size = scene.cameras.width + 2 * margin
    larger = replace(
        scene,
        images=images[None].expand(len(scene.cameras), -1, -1, -1, -1),
        cameras=replace(scene.cameras, K=K, width=size, height=size),
        mattes=mattes[None].expand(len(scene.cameras), -1, -1, -1),
    )
    other = export_transforms(larger, folder.parent / f"{folder.name}_larger")
    document, wide = (
        json.loads((place / "transforms.json").read_text()) for place in (folder, other)
    )
    name = scene.cameras.names[camera]
    rest = [entry for entry in document["frames"] if entry["camera"] != name]
    own = [
        entry | {"file_path": str(other / entry["file_path"])}
        for entry in wide["frames"]
        if entry["camera"] == name
    ]
    (folder / "transforms.json").write_text(json.dumps({"frames": own + rest}))
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory, cache):
    folder = tmp_path_factory.mktemp("folders")
    for sequence in ("train", "test_60", "test_40"):
        scene = load_scene(format="builtin", name="tiny", sequence=sequence, scale=0.5, cache=cache)
        scene = seen_by(scene, (0, 2, 4))
        capture(scene, folder / "data" / sequence)
        if sequence == "train":
            export_particles(scene.truth.positions, folder / "data" / "ply")
        if sequence == "test_40":
            export_particles(scene.truth.positions, folder / "data" / sequence / "ply")
    result = call(
        "train.py",
        folder / "run",
        *QUICK,
        f"scene.root={folder}/data",
        "scene.path=train",
        "scene.particles=ply",
        "scene.also_train=[test_60]",
        "scene.test=[{path: test_40, name: second}]",
        f"scene.cache={cache}",
    )
    assert result.returncode == 0, result.stderr[-3000:]
    return folder / "run"


def test_how_the_ground_is_touched_is_found_where_nobody_says_it(run):
    """And the twin of the run meets the same ground."""
    figures = json.loads((run / "metrics.json").read_text())
    tried = {
        key.split("/")[-1].removesuffix("_m"): value
        for key, value in figures.items()
        if key.startswith("id_prior/ground/") and key.endswith("_m")
    }
    assert {"sticky", "separate_0.15", "separate_1.2"} <= set(tried) and all(
        0 < value < 0.1 for value in tried.values()
    )
    ground = Twin.load(run / "checkpoints" / "last.ckpt").world.ground
    assert (
        taken_of(tried) == named(ground) and "Ground: the body" in (run / "results.md").read_text()
    )


def test_a_folder_that_is_held_out_has_figures(run):
    figures = json.loads((run / "metrics.json").read_text())
    for part in ("train", "train/test_60", "test/second"):
        for model in ("", "prior/"):
            assert (
                15 < figures[f"{model}{part}/psnr_crop"] < 50
                and 0.5 < figures[f"{model}{part}/ssim_crop"] <= 1
            )
    assert figures["test/psnr_crop"] == figures["test/second/psnr_crop"]
    assert (
        figures["test/second/cd_m"] > 0 and "train/test_60/cd_m" not in figures
    )  # known particles, beside those images alone
    assert not [key for key in figures if key.endswith("rms_m")]
    assert set(np.load(run / "rollout.npz")) >= {"train/x", "train/test_60/x", "test/second/x"}
    assert set(np.load(run / "observed.npz")) >= {"train/x", "train/test_60/x"}
    log = (run / "train.log").read_text()
    assert "px, brought to" in log and "start of test/second: velocity (" in log


def test_eval_finds_the_folders_again(run, tmp_path, monkeypatch):
    """All of them, each with its own start: a rollout begins where its images do."""
    seen = {}

    def stop(_settings, body, sequences, *_):
        seen.update(body=body, sequences=sequences)
        raise InterruptedError

    monkeypatch.setattr(pipeline, "figures_of", stop)
    monkeypatch.setattr(pipeline, "run_folder", lambda: tmp_path)
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        cfg = compose("eval", [f"ckpt_path={run}/checkpoints/last.ckpt"])
    with pytest.raises(InterruptedError):
        pipeline.evaluate_checkpoint(cfg)
    body, stored = seen["body"], np.load(run / "rollout.npz")
    named = [("train", "train"), ("train/test_60", "test_60"), ("test/second", "second")]
    record = Twin.load(run / "checkpoints" / "last.ckpt").record.plain()
    found = run_sequences(record["settings"]["scene"], record["starts"], body)
    for sequences in (seen["sequences"], found):
        assert [(s.prefix, s.scene.sequence) for s in sequences] == named
        for each in sequences:
            rest = (body.rest - body.center) @ each.start.rotation.T + each.start.center
            assert np.abs(stored[f"{each.prefix}/x"][0] - rest.numpy()).max() < 1e-5

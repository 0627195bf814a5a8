"""Whole runs on CUDA: scene, reconstruction, starts, every stage of the fit, evaluation, and eval.py from the checkpoint."""

import json
import math

import forked
import pytest

pytestmark = pytest.mark.gpu


@pytest.mark.parametrize("adapter", ["operator", "mosa"])
def test_a_run_and_its_evaluation(adapter, cache, tmp_path):
    """An adapter of numbers, by Gauss-Newton, and one of networks, by Adam."""
    few = ["evaluation.video=false", "evaluation.samples=256", "evaluation.assignment=64"]
    trained = forked.call("train.py", f"hydra.run.dir={tmp_path}/run", "debug=default", f"scene.cache={cache}", "trainer=gpu",
                          f"adapter={adapter}", *few)  # fmt: skip
    assert trained.returncode == 0, trained.stderr[-3000:]
    checkpoint = tmp_path / "run" / "checkpoints" / "last.ckpt"
    again = forked.call("eval.py", f"hydra.run.dir={tmp_path}/eval", f"cache={cache}", f"ckpt_path={checkpoint}",
                        "device=cuda", *few)  # fmt: skip
    assert again.returncode == 0, again.stderr[-3000:]
    figures, second = (
        json.loads((tmp_path / name / "metrics.json").read_text()) for name in ("run", "eval")
    )
    for key in ("train/rms_m", "test/test_60/rms_m", "test/test_40/rms_m"):
        for model in ("prior/", "prior_eta/", ""):
            # a learned motion stays within one cell of the truth
            assert 0 < figures[model + key] < figures["dx_m"], model + key
            assert second[model + key] == pytest.approx(figures[model + key], rel=0.02)
    assert math.isfinite(figures["test/psnr_crop"]) and figures["id/E"] > 0
    assert "NVIDIA" in figures["time/device"]

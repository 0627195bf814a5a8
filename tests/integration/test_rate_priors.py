"""Laws without E: a fit starts from the file's values, its loss reaches every global parameter, and a step moves them."""

from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir

from mosa.config import run_config
from mosa.pipeline import assemble_fit, body_of, plain, reconstruct_scene, scenes, starts

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def reconstructed(tmp_path_factory):
    """Function prior -> (config, scene, reconstruction, dx); the reconstruction does not depend on the prior and is cached."""
    cache = tmp_path_factory.mktemp("cache")

    def load(prior: str):
        with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
            cfg = compose("train", overrides=["debug=default", f"scene.cache={cache}", f"prior={prior}"])
        scene, _ = scenes(cfg)
        return cfg, scene, *reconstruct_scene(cfg, scene, "cpu")

    return load


@pytest.mark.parametrize("prior", ["herschel_bulkley", "herschel_bulkley_hencky", "newtonian"])
def test_the_loss_reaches_every_parameter(prior, reconstructed):
    cfg, scene, reconstruction, dx = reconstructed(prior)
    config = run_config(plain(cfg), scene, dx)
    body = body_of(reconstruction, config)
    start = starts(body, reconstruction, scene, [])["train"]
    module, _ = assemble_fit(cfg, scene, reconstruction, body, start, config, "cpu")
    stage = module.stages[0]
    module.begin(stage)
    named = {name: float(value) for name, value in cfg.prior.parameters.items()}
    assert {n: pytest.approx(float(v.detach()), rel=1e-5) for n, v in body.material.physical().items()} == named
    terms, _ = module.terms(stage, [0, 1], scene.frames)
    sum(terms.values()).backward()
    for name, raw in body.material.raw.items():
        assert bool(torch.isfinite(raw.grad)) and float(raw.grad.abs()) > 0, name

"""Laws without E: a fit starts from the file's values, its loss reaches every global parameter, and a step moves them."""

import pytest
import torch
from assembled import assembled, whole


@pytest.mark.parametrize("prior", ["herschel_bulkley", "herschel_bulkley_hencky", "newtonian"])
def test_the_loss_reaches_every_parameter(prior, cache):
    cfg, scene, module = assembled(cache, f"prior={prior}")
    body = module.body
    stage = module.stages[0]
    module.begin(stage)
    named = {name: float(value) for name, value in cfg.prior.parameters.items()}
    assert {
        n: pytest.approx(float(v.detach()), rel=1e-5) for n, v in body.material.physical().items()
    } == named
    terms, _ = module.terms(stage, whole(module.takes[0]), scene.frames, module.takes[0])
    sum(terms.values()).backward()
    for name, raw in body.material.raw.items():
        assert bool(torch.isfinite(raw.grad)) and float(raw.grad.abs()) > 0, name

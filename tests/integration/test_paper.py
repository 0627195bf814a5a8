"""The paper's experiment, small: every stage runs, and steps of Adam move all four networks of both corrections."""

import pytest
import torch
from assembled import made, trainer

SMALL = ["experiment=paper", "prior=von_mises", "prior.parameters.yield_stress=1e3", "simulation.particles=60", "scene.scale=0.25",
         "reconstruction.resolution=32", "reconstruction.points=800", "reconstruction.static.iterations=10",
         "reconstruction.appearance.iterations=5", "reconstruction.dynamic.iterations=5", "reconstruction.dynamic.hidden=16",
         "reconstruction.carried.iterations=0", "adapter.hidden=8"]  # fmt: skip


@pytest.fixture(scope="module")
def fitted(cache):
    run = made(cache, *SMALL)
    before = {name: p.detach().clone() for name, p in run.module.body.named_parameters()}
    trainer().fit(run.module, datamodule=run.data)
    return run, before


def test_every_stage_learns(fitted):
    run, before = fitted
    module, body = run.module, run.module.body
    assert [stage.name for stage in module.stages] == ["prior", "prior_eta", "joint"]
    assert not any(stage.newton for stage in module.stages)
    moved = {n for n, p in body.named_parameters() if not torch.equal(p.detach(), before[n])}
    for part in ("operator", "plastic_operator"):
        for network in ("phi", "planes", "psi2", "theta"):
            assert any(n.startswith(f"adapter.{part}.{network}") for n in moved), (part, network)
    assert any(n.startswith("heterogeneity") for n in moved)
    assert {"material.raw.E", "material.raw.yield_stress"} <= moved
    assert body.contact.cells.item() == 0
    assert all(bool(p.isfinite().all()) for p in body.parameters())


def test_the_body_is_what_lies_behind_the_static_gaussians(fitted):
    run, _ = fitted
    found = run.data.reconstruction
    assert found.geometry["geometry/free_frames"] == 1
    assert "geometry/deviation_m" not in found.geometry  # which the hull's refinement gives
    assert len(found.static.means) <= 800 and 20 <= len(found.splats.means) <= 120
    rotation = found.cues.rotation[1:]
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(rotation.shape[:2]))

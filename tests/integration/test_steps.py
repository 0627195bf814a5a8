"""What a fit does when a step leads nowhere, and a calibration that is all there is."""

import pytest
import torch
from assembled import made, trainer
from lightning.pytorch.callbacks import ModelCheckpoint

from mosa.errors import SimulationDiverged
from mosa.training.fitting import fit
from mosa.training.lit_mosa import LitMosa


def test_a_step_that_cannot_be_simulated_is_taken_back_and_the_fit_goes_on(cache):
    run = made(cache, "adapter=direct", "heterogeneity.enabled=false", "fit.joint.iterations=4")
    module, descend, weights, losses = run.module, run.module.descend, [], []
    adapter = module.body.adapter

    def failing(stage, *arguments):
        if stage.name == "joint":
            losses.append(list(module.losses))
            weights.append([p.detach().clone() for p in adapter.parameters()])
            if len(weights) == 2:
                raise SimulationDiverged("an element turned inside out")
        return descend(stage, *arguments)

    def last_step(stage):
        def ends(*_, **__):
            raise SimulationDiverged("the last step")

        if stage.name != "joint":
            return tried(stage)
        losses.append(list(module.losses))
        module.body.simulate = ends
        try:
            tried(stage)
        finally:
            del module.body.simulate
        return None

    module.descend = failing
    tried, module.try_last_step = module.try_last_step, last_step
    trainer().fit(module, datamodule=run.data)
    assert all(
        torch.equal(a, b) for a, b in zip(weights[0], weights[2])
    )  # where the first step began
    moved = [
        max(float((a - b).abs().max()) for a, b in zip(one, weights[0]))
        for one in (weights[1], weights[3])
    ]
    assert 0 < moved[1] < 0.6 * moved[0]
    assert len(losses[-1]) == 4 and losses[-1][1] == losses[-1][0]
    assert module.stage is None  # the last step was taken back too
    assert all(torch.equal(a, b.detach()) for a, b in zip(weights[3], adapter.parameters()))


def test_networks_begin_where_the_constant_operator_ends(cache, tmp_path):
    run = made(cache, "adapter=mosa_from_linear", "heterogeneity.enabled=false")
    module, starts = run.module, []
    assert [stage.name for stage in module.stages] == ["prior", "joint", "networks"]
    adapter, loss = module.body.adapter, module.gradient_loss

    def noted(stage, iteration, batch):
        starts.append((module.posterior, adapter.operator.planes.weight.abs().max()))
        return loss(stage, iteration, batch)

    module.gradient_loss = noted
    fitter = trainer(enable_checkpointing=True, default_root_dir=tmp_path)
    fitter.fit(module, datamodule=run.data)
    assert starts[0] == (None, 0.0) and adapter.operator.planes.weight.abs().max() > 0
    fitter.save_checkpoint(tmp_path / "end.ckpt")
    loaded = LitMosa.load_from_checkpoint(tmp_path / "end.ckpt")
    assert not loaded.body.adapter.steady and loaded.posterior is None
    for ours, theirs in zip(adapter.parameters(), loaded.body.adapter.parameters()):
        assert torch.equal(ours, theirs)


def test_a_fit_that_its_trainer_cuts_short_says_so(cache):
    run = made(cache, "fit.prior.newton_iterations=3")
    cut = fit(trainer(max_epochs=1), run.module, run.data, None)
    assert "after 1 steps, in stage prior of prior, " in cut and "stages that did not end" in cut


def test_without_a_step_to_take_back_the_fit_stops(cache):
    run = made(cache, "adapter=direct", "heterogeneity.enabled=false", "fit.prior.optimizer=adam")
    run.module.descend = lambda *_: (_ for _ in ()).throw(SimulationDiverged("at its start"))
    with pytest.raises(SimulationDiverged, match="at its start"):
        trainer().fit(run.module, datamodule=run.data)


def test_a_calibration_alone_looks_again_and_goes_on_from_there(cache):
    run = made(cache, "adapter=none", "heterogeneity.enabled=false", "fit.prior.looks=2")
    module = run.module
    assert [stage.looks_again for stage in module.stages] == [False, True, True, True]
    first, loss, seen = module.takes[0].cues.positions, module.newton_loss, {}

    def noted(stage, iteration):
        seen.setdefault(module.stage_index, module.takes[0].cues.positions)
        return loss(stage, iteration)

    module.newton_loss = noted
    trainer().fit(module, datamodule=run.data)
    assert list(seen) == [0, 1, 2] and torch.equal(seen[0], first)
    assert not torch.equal(seen[1], first) and not torch.equal(seen[2], seen[1])
    assert module.posterior is not None


def test_it_does_not_where_there_is_no_look(cache):
    run = made(
        cache, "adapter=none", "heterogeneity.enabled=false", "reconstruction.informed.iterations=0"
    )
    assert not any(stage.looks_again for stage in run.module.stages)


def test_a_fit_goes_on_from_the_last_step_of_a_stage(cache, tmp_path):
    """As a ModelCheckpoint of every step saves it, and one at an exception amid what follows that step."""
    run, again = (made(cache, "adapter=operator") for _ in range(2))
    every = ModelCheckpoint(tmp_path, "{step}", save_top_k=-1, every_n_train_steps=1)
    trainer(enable_checkpointing=True, callbacks=[every]).fit(run.module, datamodule=run.data)
    last = max(tmp_path.glob("*.ckpt"), key=lambda path: path.stat().st_mtime)
    saved = torch.load(last, weights_only=True)["mosa"]
    assert saved["fit"]["stage_over"] and saved["posterior"] is None
    trainer().fit(again.module, datamodule=again.data, ckpt_path=last, weights_only=True)
    assert again.module.stage is None and again.module.steps_done == run.module.steps_done
    for ours, theirs in zip(run.module.body.parameters(), again.module.body.parameters()):
        assert torch.equal(ours, theirs)
    assert again.module.posterior.names == run.module.posterior.names

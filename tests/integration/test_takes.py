"""Learning from more than one sequence of a body."""

from dataclasses import replace

import forked
import pytest
import torch
from assembled import assembled, made, whole

from mosa import SceneDataModule, compose
from mosa.errors import ConfigError
from mosa.modules.fitting import terms


def test_a_step_descends_the_mean_over_the_sequences(cache):
    run = made(cache, "fit.prior.optimizer=adam", taught=["test_60"])
    module, batch = run.module, run.data.batch([0, 1])
    assert len(module.takes) == len(batch.sequences) == 2
    module.configure_optimizers()
    parameters, stage = module.learned(), module.stages[0]

    def gradient(own):
        take = module.takes[own.index]
        frames = stage.active_frames(
            0, min(take.first_contact + 3, len(take.cues.positions)), len(take.cues.positions)
        )
        terms, _ = module.terms(stage, own, frames, take)
        loss = sum(module.weights[k] * v for k, v in terms.items())
        slope = torch.stack(torch.autograd.grad(loss, parameters))
        return float(loss.detach()), slope

    (first, g1), (second, g2) = (gradient(own) for own in batch.sequences)
    loss = module.training_step(batch, 0)
    loss.backward()
    assert float(loss.detach()) == pytest.approx((first + second) / 2, rel=1e-6) and first != second
    found = torch.stack([p.grad for p in parameters])
    assert (found - (g1 + g2) / 2).abs().max() <= 1e-5 * found.abs().max()


def test_a_term_reads_what_the_batch_brings(cache, monkeypatch):
    """Of a data module whose `further_cues` and `sequence_batch` are overridden."""

    class Own(SceneDataModule):
        more = 0.0

        def further_cues(self, scene, reconstruction):
            return {"height": torch.ones(len(scene.training_frames))}

        def sequence_batch(self, index, take, views):
            own = super().sequence_batch(index, take, views)
            own.extra["height"] = own.extra["height"] + self.more
            return own

    steps = []

    def mine(step):
        steps.append(step)
        return step.extra["height"][: step.frames].mean() + 0 * step.rollout.x.sum()

    monkeypatch.setattr(terms, "TERMS", {**terms.TERMS, "mine": mine})
    run = made(cache, "fit.prior.optimizer=adam", "+losses.mine=1.0")
    run.data.__class__ = Own
    run.module.configure_optimizers()
    for more in (0.0, 2.0):
        run.data.more = more
        run.module.training_step(run.data.batch([1]), 0)
        assert float(run.module.terms_of_step["mine"]) == pytest.approx(1 + more)
    step = steps[-1]
    assert list(step.views) == [1] and step.targets.cameras.names == ("1",)
    assert step.frame_dt == run.module.takes[0].frame_dt
    bare = run.data.batch([1])
    bare.sequences[0].extra.clear()
    with pytest.raises(ConfigError, match=r"step\.extra: .*'height', found none: further_cues"):
        run.module.training_step(bare, 0)
    bare.sequences[0].extra["height"] = torch.ones(3).numpy()
    with pytest.raises(ConfigError, match=r"further_cues: height: expected a tensor .*ndarray"):
        bare.to("cpu")


def test_a_take_is_simulated_at_its_own_frame_rate(cache):
    _, _, module = assembled(cache)
    take, stage = module.takes[0], module.stages[0]
    longer = replace(take, frame_dt=2 * take.frame_dt)
    with torch.no_grad():
        _, found = module.terms(stage, whole(take), 3, longer)
        expected = module.body.simulate(
            take.start,
            module.world,
            3,
            longer.frame_dt,
            model=module.body.model().only(adapter=False),
        )
        usual = module.body.simulate(
            take.start,
            module.world,
            3,
            take.frame_dt,
            model=module.body.model().only(adapter=False),
        )
    assert (found.x - expected.x).abs().max() < 1e-6
    assert (expected.x - usual.x).abs().max() > 1e-2


def run(cache, folder, script, *overrides):
    return forked.call(script, f"hydra.run.dir={folder}", *overrides)


def test_what_is_learned_from_is_not_held_out(cache):
    """Of a built-in scene, whose other sequences are held out where nobody says which."""
    chosen = compose("debug=default", f"scene.cache={cache}", "scene.also_train=[test_60]")
    data = SceneDataModule(chosen)
    assert [data.prefix(scene) for scene in data.scenes[1]] == ["train/test_60", "test/test_40"]


def test_a_sequence_that_is_not_there(cache, tmp_path):
    result = run(
        cache,
        tmp_path,
        "train.py",
        "debug=default",
        f"scene.cache={cache}",
        "scene.also_train=[test_90]",
    )
    assert (
        result.returncode == 2
        and "scene.also_train" in result.stderr
        and "test_60, test_40" in result.stderr
    ), result.stderr
    assert "Traceback" not in result.stderr

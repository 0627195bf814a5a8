from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from small_bodies import WORLD, small_body, start, take_of
from without_trainer import identify

from mosa.data.batches import Epochs, ViewSchedule
from mosa.errors import ConfigError
from mosa.modules.body.material import Material
from mosa.modules.fitting.stages import Stage, recalibrations
from mosa.training.lit_mosa import LitMosa


def test_prior_stage_brings_frames_in_progressively_and_reaches_all():
    stage = Stage(name="prior", iterations=30, lr=0.1)
    counts = [stage.active_frames(i, 5, 15) for i in range(30)]
    assert counts[0] == 5 and counts[10] == 15 and counts == sorted(counts)


def test_learning_rate_decays_to_a_tenth():
    stage = Stage(name="joint", iterations=50, lr=0.1)
    assert stage.decay(0) == stage.decay(25) == 1.0
    assert abs(stage.decay(50) - 0.1) < 1e-12


def test_convergence_needs_a_flat_loss_after_all_frames_are_in():
    stage = Stage(name="prior", iterations=100, lr=0.1, converged=1e-3)
    falling = [1.0 / (i + 1) for i in range(60)]
    assert not stage.ended(falling)
    assert stage.ended(falling[:40] + [0.02] * 20)
    assert not stage.ended([0.02] * 20)  # frames are still entering


def test_unknown_stage_is_named():
    with pytest.raises(ConfigError, match="warmup"):
        Stage(name="warmup", iterations=1, lr=0.1)


def test_views_cover_all_cameras_once_per_pass_and_depend_on_seed_and_step_alone():
    schedule = ViewSchedule(12, 2, seed=3)
    one_pass = [v for i in range(6) for v in schedule[i]]
    assert sorted(one_pass) == list(range(12))
    torch.manual_seed(99)
    assert [ViewSchedule(12, 2, seed=3)[i] for i in range(20)] == [schedule[i] for i in range(20)]
    assert [ViewSchedule(12, 2, seed=4)[i] for i in range(6)] != [schedule[i] for i in range(6)]


def test_an_epoch_is_a_pass_over_the_views_and_one_that_is_resumed_is_finished():
    schedule = ViewSchedule(5, 2, seed=1)
    epochs = Epochs(schedule, list)
    first = list(epochs)
    assert first == [schedule[i] for i in range(3)] and {
        view for step in first for view in step
    } == set(range(5))
    epochs.begin(
        whole=False, step=10, done=4, left=9
    )  # four of the stage's steps were made, one of its second epoch
    assert list(epochs) == [schedule[10], schedule[11]]
    epochs.begin(whole=False, step=10, done=4, left=1)
    assert list(epochs) == [schedule[10]]
    epochs.begin(whole=True, step=10, done=4, left=9)
    assert list(epochs) == [list(range(5))]


def test_a_stage_says_what_it_learns_and_what_its_result_is_kept_as():
    prior, prior_eta, joint = (
        Stage(name=name, iterations=1, lr=0.1) for name in ("prior", "prior_eta", "joint")
    )
    assert [s.calibrates for s in (prior, prior_eta, joint)] == [True, False, False]
    assert [s.learns("eta", "adapter") for s in (prior, prior_eta, joint)] == [
        (),
        ("eta",),
        ("eta", "adapter"),
    ]
    assert [set(s.keeps) for s in (prior, prior_eta, joint)] == [
        {"prior", "prior_eta"},
        {"prior_eta"},
        set(),
    ]


@pytest.mark.parametrize("moves", [[1e-2, 9e-3], [1e-2, 5e-3, 2e-3], [1e-3, 2e-4, 2e-4]])
def test_a_calibration_looks_again_until_the_motion_settles(monkeypatch, moves):
    """moves: how far [m] each look moves the motion; three are the most."""
    left = list(moves)
    monkeypatch.setattr(LitMosa, "inform", lambda self, response: left.pop(0))
    begun = Stage(name="prior", iterations=1, lr=0.1, optimizer="gauss_newton", looks=3)
    take = take_of(small_body(adapter=False), start(turn=0.5, speed=-2.0), 4)
    module = LitMosa.of_parts(small_body(adapter=False), takes=[take], world=WORLD, background=torch.ones(3),
                              weights={"position": 1.0}, stages=recalibrations([begun]))  # fmt: skip
    identify(module)
    assert left == [] and module.posterior is not None and module.moves == moves


def test_a_look_that_is_made_again_after_a_stop_counts_once(monkeypatch):
    """The cues have moved already, and hardly move again: that would say that they have settled, or that they never do."""
    moves = iter([1e-2, 1e-5])
    monkeypatch.setattr(LitMosa, "inform", lambda self, response: next(moves))
    begun = Stage(name="prior", iterations=1, lr=0.1, optimizer="gauss_newton", looks=3)
    module = LitMosa.of_parts(small_body(adapter=False), takes=[], world=WORLD, background=torch.ones(3),
                              weights={"position": 1.0}, stages=recalibrations([begun]))  # fmt: skip
    module.stage_index = 1
    for _ in range(2):
        module.begin(module.stage)
    assert module.moves == [1e-2] and next(moves, None) is None


@pytest.mark.parametrize("law, unseen, outlines", [
    ("corotated", None, False), ("newtonian", None, True), ("newtonian", "markers", False), ("newtonian", "forces", False),
    ("newtonian", "colliders", False),
])  # fmt: skip
def test_outlines_end_the_calibration_of_what_yields_or_flows(law, unseen, outlines):
    """Once its looks have settled, or after the last one; not where no camera sees it, something hides it or forces count."""
    parameters = {"E": 3e4, "nu": 0.3} if law == "corotated" else {"mu": 10.0, "kappa": 1e4}
    body = small_body(adapter=False)
    body.material = Material(law, parameters)
    begun = Stage(name="prior", iterations=1, lr=0.1, optimizer="gauss_newton", looks=3)
    for moves in ([1e-2, 9e-3], [1e-2, 5e-3, 2e-3]):
        module = LitMosa.of_parts(body, takes=[], world=WORLD, background=torch.ones(3), weights={"position": 1.0},
                                  stages=recalibrations([begun]))  # fmt: skip
        module.moves, module.stage_index = moves, len(moves)
        module.body.freeze = lambda name: None
        if unseen == "markers":
            module.takes = [SimpleNamespace(observations=SimpleNamespace(cameras=()))]
        elif unseen:
            module.world = replace(WORLD, **{unseen: (None,)})
        module.end(module.stage)
        assert (module.stage is not None and module.stage.silhouettes) == outlines
        if outlines:
            module.end(module.stage)
        assert module.stage is None

"""The floor is measured as the models are, and what cannot be simulated has the worst figures."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from small_bodies import DX, STICKY, small_body

from mosa.errors import SimulationDiverged
from mosa.evaluation import evaluate as evaluation
from mosa.evaluation import floor, metrics
from mosa.evaluation.analysis.statements import determined_text
from mosa.evaluation.evaluate import (
    Sequence,
    evaluate,
    floor_figures,
    hidden_figures,
    motion_metrics,
    true_motion,
)
from mosa.evaluation.settings import EvaluationSettings
from mosa.modules.body.body import VARIANTS
from mosa.types import Ground, Truth


def test_the_floor_has_the_frames_and_samples_of_the_models(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    rest, learner = (torch.rand(n, 3, generator=generator) for n in (900, 700))
    positions = torch.stack([rest + torch.tensor([0.0, 0.1 * t, 0.0]) for t in range(5)])
    truth = Truth(rest, positions, torch.eye(3), torch.zeros(3))
    # as with scene.holdout_frames=1: the models' figures of the training sequence leave the last frame out
    scene = SimpleNamespace(
        truth=truth, markers=None, particles=None, frames=5, training_frames=[0, 1, 2, 3]
    )
    body = SimpleNamespace(rest=learner)
    x = torch.stack([learner + torch.tensor([0.0, 0.1 * t, 0.01 * t**3]) for t in range(5)])
    monkeypatch.setattr(floor, "floor_rollout", lambda *_: x)
    sequences = [Sequence(prefix, scene, None, 2) for prefix in ("train", "test/a")]
    found = floor_figures(body, sequences, None, EvaluationSettings(samples=300, assignment=50))
    for prefix, frames in (("train", [0, 1, 2, 3]), ("test/a", [0, 1, 2, 3, 4])):
        for name, value in motion_metrics(
            x, body, sequences[0], frames, EvaluationSettings(samples=300, assignment=50)
        ).items():
            assert found[f"floor/{prefix}/{name}"] == value
    for name, value in metrics.sampling_floors(rest, 700, 900, samples=300, assignment=50).items():
        assert found[f"floor/sampling/{name}"] == pytest.approx(value)


def test_the_true_motion_is_that_of_the_particles_as_they_are_now():
    """It is remembered by the tensor, into which a checkpoint writes other particles."""
    rest = torch.rand(200, 3, generator=torch.Generator().manual_seed(0))
    positions = torch.stack([rest * factor for factor in (1.0, 1.5)])
    scene = SimpleNamespace(truth=Truth(rest, positions, torch.eye(3), torch.zeros(3)))
    body = SimpleNamespace(rest=rest[:50].clone())
    for _ in range(2):
        torch.testing.assert_close(true_motion(body, scene)[1], 1.5 * body.rest)
        assert true_motion(body, scene) is true_motion(body, scene)
        body.rest.copy_(rest[50:100])


@pytest.mark.parametrize("held_frames, held_cameras", [((3, 4), (1,)), ((), ())])
def test_on_a_training_drop_without_a_rollout_all_that_it_would_have_said_is_worst(
    monkeypatch, held_frames, held_cameras
):
    """A law that was learned from the first frames may turn an element inside out in the held-out ones."""
    scene = SimpleNamespace(truth=None, holdout_frames=held_frames, holdout_cameras=held_cameras)
    sequences = [Sequence("train", scene, None, 2), Sequence("test/a", scene, None, 2)]
    body = SimpleNamespace(rest=torch.zeros(1, 3), variants=VARIANTS)
    lost = {"train": {"adapted"}, "test/a": {"prior_eta"}}

    def rollouts(_, sequence, __):
        return dict.fromkeys({"adapted", "prior", "prior_eta"} - lost[sequence.prefix]), None, 1.0

    def measured(_, sequence, __, model, *___):
        parts = {sequence.prefix: ("rms_m", "psnr_crop")}
        if sequence.prefix == "train":
            parts |= {"frames": ("rms_m", "psnr_crop")} if held_frames else {}
            parts |= (
                {"camera": ("psnr_crop",), "camera/frame_01": ("psnr_crop",)}
                if held_cameras
                else {}
            )
        return {f"{model}{part}/{name}": 1.0 for part, names in parts.items() for name in names}

    monkeypatch.setattr(evaluation, "rollouts", rollouts)
    monkeypatch.setattr(evaluation, "sequence_metrics", measured)
    figures, kept = evaluate(body, sequences, SimpleNamespace(forces=()), EvaluationSettings())
    worst = {key for key, value in figures.items() if value in (float("inf"), -float("inf"))}
    expected = {"train/rms_m", "train/psnr_crop", *(f"prior_eta/{part}/{name}" for part in ("test", "test/a")
                                                     for name in ("rms_m", "psnr_crop"))}  # fmt: skip
    expected |= {"frames/rms_m", "frames/psnr_crop"} if held_frames else set()
    expected |= {"camera/psnr_crop"} if held_cameras else set()
    assert (
        worst == expected
        and figures["train/psnr_crop"] == -float("inf") < figures["test/psnr_crop"] == 1.0
    )
    assert "adapted" not in kept["train"] and "adapted" in kept["test/a"]
    lost |= {prefix: {"adapted", "prior", "prior_eta"} for prefix in lost}
    with pytest.raises(SimulationDiverged, match="train, test/a"):
        evaluate(body, sequences, SimpleNamespace(forces=()), EvaluationSettings())


def test_a_law_without_a_stiffest_direction_has_no_angle_to_the_fibres(monkeypatch):
    """Of an isotropic law the direction is that of rounding."""
    hidden = SimpleNamespace(fibre=[0.0, 0.0, 1.0], ratio=3.0, factor=lambda x: torch.ones(len(x)))
    monkeypatch.setattr(floor, "hidden_of", lambda scene: hidden)
    body, scene = small_body(), SimpleNamespace(truth=object(), synthetic=True)
    law = {"id/stiffest_x": 1.0, "id/stiffest_y": 0.0, "id/stiffest_z": 0.0}
    assert hidden_figures(body, scene, law | {"id/stiffness_ratio": 1 + 1e-12}) == {}
    found = hidden_figures(body, scene, law | {"id/stiffness_ratio": 1.3})
    assert found == {"id/fibre_angle_deg": pytest.approx(90.0)}


@pytest.mark.parametrize("mode, cells", [("sticky", 0.3), ("touch", 0.0)])
def test_the_contact_offset_is_that_of_the_ground_which_was_found(mode, cells):
    """With scene.ground.mode=auto it was that of the ground from which the search begins: 0.3 cells too high of one that particles
    meet."""
    scene = SimpleNamespace(known_parameters={}, ground=Ground(0.0, "auto"))
    world = replace(STICKY, ground=Ground(0.0, mode))
    body = small_body(contact=True)
    found = evaluation.identification(body, scene, world)
    assert found["id/contact_offset_m"] == pytest.approx(cells * DX, abs=1e-9)
    assert found["id_prior/contact_offset_m"] == found["id/contact_offset_m"]


@pytest.mark.parametrize("cells, accuracy, said", [
    (1.0, None, True), (0.3, None, False), (0.9, None, False), (-0.5, None, True), (0.55, None, True),
    (0.6, 0.0, True), (0.5, 0.0, False),
])  # fmt: skip
def test_a_contact_height_at_its_limit_is_said(cells, accuracy, said):
    body = small_body(contact=True)
    body.contact.cells.data.fill_(cells)
    world = replace(STICKY, ground=Ground(0.0, "sticky", accuracy=accuracy))
    found = evaluation.identification(body, SimpleNamespace(known_parameters={}), world)
    assert ("id/contact_at_limit" in found) == said
    text = determined_text(found | {"posterior/draws": 12}, "neo_hookean")
    assert ("The contact height ended **at the limit**" in text) == said

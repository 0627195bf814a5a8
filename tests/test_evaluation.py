"""The floor is measured as the models are."""

from types import SimpleNamespace

import pytest
import torch

from mosa import metrics
from mosa.data.builtin import floor
from mosa.evaluation import Sequence, floor_figures, motion_metrics
from mosa.evaluation_settings import EvaluationSettings
from mosa.types import Truth


def test_the_floor_has_the_frames_and_samples_of_the_models(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    rest, learner = (torch.rand(n, 3, generator=generator) for n in (900, 700))
    positions = torch.stack([rest + torch.tensor([0.0, 0.1 * t, 0.0]) for t in range(5)])
    truth = Truth(rest, positions, torch.eye(3), torch.zeros(3))
    # as with scene.holdout_frames=1: the models' figures of the training sequence leave the last frame out
    scene = SimpleNamespace(truth=truth, particles=None, frames=5, training_frames=[0, 1, 2, 3])
    body = SimpleNamespace(rest=learner)
    x = torch.stack([learner + torch.tensor([0.0, 0.1 * t, 0.01 * t**3]) for t in range(5)])
    monkeypatch.setattr(floor, "floor_rollout", lambda *_: x)
    sequences = [Sequence(prefix, scene, None, 2) for prefix in ("train", "test/a")]
    found = floor_figures(body, sequences, None, EvaluationSettings(samples=300, assignment=50))
    for prefix, frames in (("train", [0, 1, 2, 3]), ("test/a", [0, 1, 2, 3, 4])):
        for name, value in motion_metrics(x, body, sequences[0], frames, EvaluationSettings(samples=300, assignment=50)).items():
            assert found[f"floor/{prefix}/{name}"] == value
    for name, value in metrics.sampling_floors(rest, 700, 900, samples=300, assignment=50).items():
        assert found[f"floor/sampling/{name}"] == pytest.approx(value)

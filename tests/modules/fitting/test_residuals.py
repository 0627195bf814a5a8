"""Distances between a rollout and cues: nothing for its own, known turns and stretches as they are, one unit for each datum."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from small_bodies import FRAME_DT, WORLD, cues_of, lattice, small_body, start

from mosa.data.observations import Observations
from mosa.data.synthetic.renderer import ring_of_cameras
from mosa.modules.fitting import residuals
from mosa.types import MotionCues


def turn(vector) -> torch.Tensor:
    k = torch.as_tensor(vector, dtype=torch.float64)
    return torch.linalg.matrix_exp(
        torch.tensor([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]], dtype=torch.float64)
    )


@torch.no_grad()
def test_a_rollout_has_no_distance_from_its_own_cues():
    body, begins = small_body(), start(turn=1.1)
    rollout = body.simulate(begins, WORLD, 8, FRAME_DT)
    chosen = residuals.sampled(len(body.rest), body.rest.device)
    own = residuals.fields(rollout, cues_of(rollout, begins.rotation), begins.rotation, chosen)
    for field in own:
        assert field.shape == (7, len(chosen), 3) and field.abs().max() < 1e-14
    stretched = rollout.F_tot[1:].sub(begins.rotation).abs().max()
    assert stretched > 0.02  # it was deformed
    other = residuals.fields(
        rollout, cues_of(rollout, torch.eye(3).double()), begins.rotation, chosen
    )
    assert other.rotation.norm(dim=-1).min() == pytest.approx(
        math.sin(1.1), rel=1e-9
    )  # the pose at the start left out


def test_of_outlines_the_width_does_not_count_and_the_place_does(monkeypatch):
    """Mattes of the same particles, drawn a fifth wider or a third of their distance beside where they are."""
    monkeypatch.setattr(residuals, "PIXELS", 1)
    cameras = ring_of_cameras(3, 64, target=(0.0, 0.0, 0.0), distance=0.6, elevations=(0.2,), field=0.1, turn=0.2)  # fmt: skip
    x, spacing = lattice().expand(2, -1, 3), 0.02

    def away(x: torch.Tensor, mattes: torch.Tensor) -> torch.Tensor:
        mattes = mattes.reshape(1, 3, 64, 64).transpose(0, 1).expand(-1, 2, -1, -1)
        seen = Observations(None, mattes, None, cameras, 64)
        edge = residuals.outlines(mattes)
        return residuals.silhouettes(x, spacing, seen, edge).position.flatten()

    nothing = torch.zeros(3 * 64 * 64).double()
    own, ball = away(x, nothing), residuals.BALL
    beside = away(x + torch.tensor([0.3, 0.1, 0.0]) * spacing, nothing)
    monkeypatch.setattr(residuals, "BALL", 1.2 * ball)
    wider = away(x, nothing)
    monkeypatch.setattr(residuals, "BALL", ball)
    assert away(x, wider).norm() < 0.5 * (wider - own).norm()
    assert away(x, beside).norm() > 0.9 * (beside - own).norm()
    assert away(x, own).norm() < 1e-6


def test_known_turns_stretches_and_shifts_are_found():
    """A cue is off by a turn of a about an axis: the vector is sin(a) times the axis, in the rest frame."""
    generator = torch.Generator().manual_seed(1)
    n, Q, vector = 5, turn([0.4, -0.2, 0.9]), torch.tensor([0.03, -0.02, 0.05], dtype=torch.float64)
    R = turn([0.1, 0.7, -0.3])
    S = torch.tensor([1.2, 1.0, 0.7], dtype=torch.float64)
    F = (R @ Q @ turn([0.3, 0.2, 0.1]) @ torch.diag(S) @ turn([0.3, 0.2, 0.1]).T).expand(2, n, 3, 3)
    x = torch.randn(2, n, 3, generator=generator, dtype=torch.float64)
    shift, stretch = (
        torch.tensor([0.1, 0.2, 0.3]).double(),
        torch.tensor([0.02, 0.0, -0.01]).double(),
    )
    weight = torch.tensor([1.0, 1.0, 0.5, 0.0, 1.0]).double().expand(2, n)
    # F = (R Q) (W in the rest frame): the pose Q is taken off on the right
    cues = MotionCues(x - shift, (R @ turn(vector).T).expand(2, n, 3, 3), (S - stretch).expand(2, n, 3), weight,
                      torch.zeros(2, n, 3, 3).double())  # fmt: skip
    found = residuals.fields(SimpleNamespace(x=x, F_tot=F), cues, Q, torch.arange(n))
    angle = float(vector.norm())
    expected = math.sin(angle) / angle * vector * weight[1:, :, None]
    assert torch.allclose(found.position, shift.expand(1, n, 3), rtol=0, atol=1e-14)
    assert torch.allclose(found.rotation, expected, rtol=0, atol=1e-14)
    assert torch.allclose(found.stretch, stretch * weight[1:, :, None], rtol=0, atol=1e-14)


def test_a_frame_counts_as_many_data_as_it_is_given():
    """Scaled by its own root mean square a frame of vectors has the squared length `count`, however many particles it has."""
    generator = torch.Generator().manual_seed(2)
    found = [
        residuals.Fields(
            *(
                size * torch.randn(6, n, 3, generator=generator, dtype=torch.float64)
                for size in (0.1, 1.0, 0.5)
            )
        )
        for n in (10, 300)
    ]
    noise = residuals.spread(found, residuals.floors(0.01, 0.1))
    vector = residuals.whitened(found, noise, [(30.0, 20.0, 10.0), (1.0, 0.0, 0.0)])
    split = 6 * 10 * 9
    assert float(vector[:split].square().sum()) == pytest.approx(6 * 60, rel=1e-12)
    assert float(vector[split:].square().sum()) == pytest.approx(6 * 1, rel=1e-12)
    assert vector.shape == (split + 6 * 300 * 9,)


def test_noise_is_not_below_that_of_the_cues_and_the_grid():
    """Of a field that is nothing, sqrt(3) times the floor of one component: cue and model errors add as squares."""
    none = residuals.Fields(*(torch.zeros(2, 4, 3).double() for _ in range(3)))
    for dx, cells in ((0.02, 0.0), (0.02, 0.1), (0.05, 0.5)):
        expected = [
            math.hypot(0.5e-3, cells * dx),
            math.hypot(0.01, 0.3 * cells),
            math.hypot(0.015, 0.15 * cells),
        ]
        for scale, floor in zip(
            residuals.spread([none], residuals.floors(dx, cells))[0], expected, strict=True
        ):
            assert torch.allclose(
                scale, torch.full((2,), 3**0.5 * floor, dtype=torch.float64), rtol=1e-12
            )


def seen_by(cameras: int | None, x: torch.Tensor) -> MotionCues:
    eyes = torch.randn(cameras, 3, generator=torch.Generator().manual_seed(3)) if cameras else None
    return MotionCues(x, x, x, x, x, eyes)


def test_cues_of_fewer_than_twelve_cameras_are_trusted_less():
    """Errors of so many average out; with several recordings the one that fewest saw counts."""
    x, none = torch.zeros(2, 4, 3), residuals.Fields(*(torch.zeros(2, 4, 3).double(),) * 3)
    for counts, factor in (
        ((None,), 1.0),
        ((24, 12), 1.0),
        ((3,), 2.0),
        ((12, 3, None), 2.0),
        ((1,), 12**0.5),
    ):
        few = residuals.fewer([seen_by(count, x) for count in counts])
        assert few == pytest.approx(factor, rel=1e-15)
        noise = residuals.spread([none], residuals.floors(0.02, 0.1, few))[0][0]
        expected = (3 * ((factor * 0.5e-3) ** 2 + 0.002**2)) ** 0.5
        assert torch.allclose(noise, torch.full_like(noise, expected), rtol=1e-12)


def test_a_single_camera_sees_no_distance_along_its_lines_of_sight():
    generator = torch.Generator().manual_seed(4)
    seen, x = (torch.randn(2, 5, 3, generator=generator) for _ in range(2))
    for cameras in (None, 2, 12):
        assert torch.equal(seen_by(cameras, seen).away(x), x - seen)
    cues = seen_by(1, seen)
    sight = seen - cues.eyes[0]
    expected = torch.linalg.cross(sight, x - seen).norm(dim=-1) / sight.norm(dim=-1)
    assert torch.allclose(cues.away(x).norm(dim=-1), expected, rtol=1e-4)
    farther = replace(cues, positions=cues.eyes[0] + 1.2 * sight)
    assert torch.allclose(farther.away(x), cues.away(x), atol=1e-5)
    hidden = residuals.unseen(cues, None)(x[1], 1)
    assert torch.allclose(seen[1] - x[1] + hidden, -cues.away(x)[1], atol=1e-6)


@pytest.mark.parametrize("particles", [1, 7, 2000, 2001, 12345])
def test_the_sample_is_spread_evenly(particles):
    chosen = residuals.sampled(particles, torch.device("cpu"))
    assert (
        len(chosen) == min(particles, residuals.SAMPLES)
        and chosen[0] == 0
        and chosen[-1] < particles
    )
    gaps = chosen.diff()
    assert len(chosen) == 1 or (gaps.min() >= 1 and gaps.max() - gaps.min() <= 1)

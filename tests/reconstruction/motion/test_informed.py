"""The motion about a simulation's prediction: where images tell nothing the prediction stays, where they tell they are followed."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from mosa.errors import ConfigError
from mosa.reconstruction.motion.cues import neighbourhood
from mosa.reconstruction.motion.dynamic import Objective, Scaffold, Target
from mosa.reconstruction.motion.informed import informed_motion, laid_onto, project
from mosa.reconstruction.motion.modes import deformation_modes
from mosa.reconstruction.motion.motion import ModalMotion
from mosa.reconstruction.motion.observed import object_windows
from mosa.reconstruction.pose.rigid import rotation_exp
from mosa.reconstruction.settings import DynamicSettings, InformedSettings
from mosa.rendering.appearance.spherical_harmonics import basis
from mosa.rendering.covariance import quaternion_to_matrix
from mosa.types import Splats
from tests.reconstruction.motion.test_dynamic import block, rendered_windows

OFFSETS = torch.tensor([[0.0, 0, 0], [0.004, -0.01, 0.0], [0.008, -0.02, 0.004]])
EVERY = torch.arange(3)


@pytest.fixture(scope="module")
def scaffold() -> Scaffold:
    splats = block()
    around = neighbourhood(splats.means)
    return Scaffold(splats, deformation_modes(splats.means, around, count=24), around)


@pytest.fixture(scope="module")
def bent(scaffold):
    """(windows, body, true positions) of a body that bends far."""
    truth = ModalMotion(OFFSETS, scaffold.modes.energy, reach=0.1)
    with torch.no_grad():
        truth.amplitude[1:, 4:10] = 0.04 * torch.randn(
            2, 6, 3, generator=torch.Generator().manual_seed(5)
        )
        scene = rendered_windows(scaffold, truth, 3)
        shifted = Splats(
            **{
                **vars(scaffold.splats),
                "means": scaffold.splats.means + torch.tensor([0.04, 0.25, 0.0]),
            }
        )
        true = truth(EVERY, shifted, scaffold.modes).positions
    return (
        object_windows(scene, list(range(6)), list(range(3))),
        Scaffold(shifted, scaffold.modes, scaffold.around),
        true,
    )


def fitted(bent, predicted, seen, **settings):
    windows, body, _ = bent
    chosen = InformedSettings(**{"iterations": 60, "lr": 0.01} | settings)
    motion, _ = informed_motion(
        Target(body, body, windows, OFFSETS, torch.ones(3), 0.1),
        predicted,
        seen,
        chosen,
        DynamicSettings(carriers="particles"),
        seed=0,
    )
    with torch.no_grad():
        return motion(EVERY, body.splats, body.modes, body.around).positions


def test_a_bright_side_that_stays_tells_nothing_of_a_turn(scaffold):
    """A ball of one colour under a light looks the same however far it turned. With the light in its colours it would be held back
    by its bright side, as a disc of faint colours was that rolled between plates."""
    chosen = scaffold.splats.means.norm(dim=1) < 0.055
    splats = Splats(*(part[chosen] for part in vars(scaffold.splats).values()))
    normals, light = torch.nn.functional.normalize(splats.means, dim=1), torch.zeros(8)
    light[0], light[2], light[7] = 0.6, -0.4, 0.3
    shades = (basis(normals, 2)[:, 1:] @ light).exp()
    splats = replace(splats, colors=(0.5 * shades)[:, None].expand(-1, 3))
    known = Scaffold(
        splats, scaffold.modes.at(splats.means, scaffold.splats.means), None, normals, light
    )
    motion = ModalMotion(0 * OFFSETS, scaffold.modes.energy, reach=0.1)
    with torch.no_grad():
        scene = rendered_windows(known, motion, 3)  # at rest in all frames
        windows = object_windows(scene, list(range(6)), list(range(3)))
        quarter = 0.5 * torch.pi  # which leaves the lattice of the splats as it is
        turns = rotation_exp(quarter * torch.tensor([[0.0, 0, 0], [0, 0, 1], [1, 0, 0]]))
        project(motion, scaffold, scaffold.splats.means @ turns.mT)
        placed = replace(splats, means=splats.means + torch.tensor([0.04, 0.25, 0.0]))
        losses = []
        for light in (known.light, None):
            body = replace(known, splats=placed, light=light)
            target = Target(body, body, windows, 0 * OFFSETS, torch.ones(3), 0.1)
            alone = DynamicSettings(elastic=0.0, bending=0.0, matte=0.0)
            losses.append(float(Objective(motion, target, alone)(EVERY, windows, windows.frame)))
    assert losses[0] < 1e-3 * losses[1]


def away(a, b) -> float:
    return 1e3 * float((a - b)[1:].square().sum(-1).mean().sqrt())


def test_a_frame_is_laid_onto_what_was_seen_by_a_rigid_motion(scaffold):
    rest = scaffold.splats.means
    turn = quaternion_to_matrix(
        torch.nn.functional.normalize(torch.tensor([[0.9, 0.3, -0.2, 0.1]]), dim=-1)
    )
    bent = torch.stack([rest, rest + 0.1 * rest[:, :1] ** 2 / 0.1])
    moved = bent @ turn.mT + torch.tensor([0.3, -0.2, 0.1])
    assert torch.allclose(laid_onto(bent, moved), moved, atol=1e-6)
    # and never by a mirror image
    mirrored = laid_onto(bent, bent * torch.tensor([1.0, 1.0, -1.0]))
    volume = torch.linalg.det(
        (mirrored - mirrored.mean(1, keepdim=True)).mT @ (bent - bent.mean(1, keepdim=True))
    )
    assert bool((volume > 0).all())


def test_amplitudes_of_a_motion_are_found_again(scaffold):
    truth, found = (ModalMotion(OFFSETS, scaffold.modes.energy, reach=0.1) for _ in range(2))
    with torch.no_grad():
        truth.amplitude[1:] = 0.02 * torch.randn(
            2, 24, 3, generator=torch.Generator().manual_seed(1)
        )
        project(found, scaffold, truth(EVERY, scaffold.splats, scaffold.modes).positions)
    assert torch.allclose(found.amplitude[1:], truth.amplitude[1:], atol=1e-5)


def test_without_light_the_predicted_shape_stays(bent):
    """Energies that images cannot stand against: the shape is the predicted one, not that of the body at rest."""
    _, body, true = bent
    found = laid_onto(fitted(bent, true, true, elastic=30.0, bending=30.0), true)
    assert away(found, true) < 0.05
    assert away(laid_onto(body.splats.means + OFFSETS[:, None], true), true) > 5


def test_images_correct_a_wrong_prediction_wherever_it_is(bent):
    """Half of the true bending, and all of it thrown far off and turned: both end as near to the truth as images bring them."""
    _, body, true = bent
    still = body.splats.means + OFFSETS[:, None]
    half = still + 0.5 * (true - still)
    before = away(half, true)
    near = away(fitted(bent, half, half), true)
    turn = quaternion_to_matrix(
        torch.nn.functional.normalize(torch.tensor([[0.8, 0.1, 0.5, -0.2]]), dim=-1)
    )
    far = away(fitted(bent, half @ turn.mT + 0.1, half), true)
    assert near < 0.65 * before and abs(far - near) < 0.02


def test_a_frame_that_was_seen_in_a_wrong_place_does_not_draw_the_prediction_there(bent):
    """One frame was seen 60 mm beside the body: there the prediction stays, and the other is laid onto what was seen."""
    _, _, true = bent
    seen = true + torch.tensor([0.0, 0.0, 0.06]) * torch.tensor([0.0, 0.0, 1.0])[:, None, None]
    predicted = true + torch.tensor([0.0, 0.03, 0.0]) * torch.tensor([0.0, 1.0, 0.0])[:, None, None]
    found = fitted(bent, predicted, seen, iterations=1)
    assert away(laid_onto(predicted, seen), true) > 30 and away(found, true) < 3


def test_a_body_that_rolled_within_its_shape_is_not_turned_back(scaffold):
    """A ball, flattened as it is predicted, but turned within that shape as between plates: laid onto what was seen the flat shape
    is tilted, so that the prediction begins nearer to the images where it is, and ends farther from them."""
    place = torch.tensor([0.04, 0.25, 0.0])
    chosen = scaffold.splats.means.norm(dim=1) < 0.055
    splats = Splats(*(part[chosen] for part in vars(scaffold.splats).values()))
    splats, around = (
        replace(splats, colors=0.5 + 0.3 * (splats.colors - 0.5)),
        neighbourhood(splats.means),
    )
    ball = Scaffold(splats, deformation_modes(splats.means, around, count=24), around)
    flat, turn = torch.tensor([1.15, 0.75, 1.0]), rotation_exp(torch.tensor([[0.0, 0.0, 0.5]]))[0]
    truth = ModalMotion(OFFSETS, ball.modes.energy, reach=0.1)
    project(truth, ball, torch.stack([splats.means, *[splats.means @ turn.T * flat] * 2]))
    with torch.no_grad():
        scene = rendered_windows(ball, truth, 3)
        ball = replace(ball, splats=replace(splats, means=splats.means + place))
        true = truth(EVERY, ball.splats, ball.modes).positions
    windows = object_windows(scene, list(range(6)), list(range(3)))
    predicted = torch.stack([splats.means, *[splats.means * flat] * 2]) + place
    weak = {"iterations": 40, "lr": 0.02, "elastic": 0.03, "bending": 0.1}
    found = fitted((windows, ball, true), predicted, true, **weak)
    assert away(laid_onto(predicted, true), true) > 6 and away(found, true) < 3


@pytest.mark.parametrize("share", [0.1, -0.3])
def test_a_prediction_that_is_no_body_is_not_followed(bent, share):
    """Flattened, and turned inside out: the first motion stays. The true shapes are followed."""
    windows, body, true = bent
    wrong = true.clone()
    wrong[2, :, 1] = wrong[2, :, 1].mean() + share * (wrong[2, :, 1] - wrong[2, :, 1].mean())
    for predicted, followed in ((wrong, False), (true, True)):
        found = informed_motion(
            Target(body, body, windows, OFFSETS, torch.ones(3), 0.1),
            predicted,
            true,
            InformedSettings(iterations=30),
            DynamicSettings(carriers="particles"),
            seed=0,
        )
        assert (found is not None) == followed


def test_the_number_of_iterations_is_checked():
    with pytest.raises(ConfigError, match=r"reconstruction\.informed\.iterations.*found -1"):
        InformedSettings(iterations=-1)

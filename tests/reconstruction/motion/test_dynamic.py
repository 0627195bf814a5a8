"""Dynamic stage: regularisers, optimiser, motion models, and the accuracy of a recovered motion whose truth is known."""

from __future__ import annotations

import pytest
import torch

from mosa.errors import ConfigError
from mosa.reconstruction.gaussians.uniform_adam import UniformAdam
from mosa.reconstruction.motion.cues import neighbourhood
from mosa.reconstruction.motion.dynamic import Scaffold, Target, elastic_energy, fit_motion
from mosa.reconstruction.motion.modes import deformation_modes
from mosa.reconstruction.motion.motion import ModalMotion, MotionBasisNetwork
from mosa.reconstruction.motion.observed import object_windows
from mosa.reconstruction.settings import DynamicSettings
from mosa.rendering.covariance import covariance_from, quaternion_multiply, quaternion_to_matrix
from mosa.types import Splats


def block(n: int = 6, spacing: float = 0.02) -> Splats:
    axis = (torch.arange(n) - (n - 1) / 2) * spacing
    means = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    count = len(means)
    rotations = torch.zeros(count, 4)
    rotations[:, 0] = 1
    colors = 0.5 + 0.4 * torch.sin(60 * means + torch.tensor([0.0, 1.0, 2.0]))
    return Splats(
        means, torch.full((count, 3), 0.4 * spacing), rotations, torch.full((count,), 0.95), colors
    )


@pytest.fixture(scope="module")
def scaffold() -> Scaffold:
    splats = block()
    around = neighbourhood(splats.means)
    return Scaffold(splats, deformation_modes(splats.means, around, count=24), around)


def test_elastic_energy_is_blind_to_rotation_and_has_its_small_strain_limit():
    turn = quaternion_to_matrix(torch.tensor([0.3, 0.5, -0.2, 0.7], dtype=torch.float64))
    strain = 1e-5 * torch.tensor(
        [[1.0, 0.3, 0.0], [0.3, -0.5, 0.2], [0.0, 0.2, 0.7]], dtype=torch.float64
    )
    assert float(elastic_energy(turn, 0.3)) < 1e-25
    deformed = turn @ (torch.eye(3, dtype=torch.float64) + strain)
    expected = (strain**2).sum() + 0.3 / 0.4 * strain.trace() ** 2
    assert float(elastic_energy(deformed, 0.3)) == pytest.approx(float(expected), rel=1e-4)


def test_uniform_adam_keeps_proportions_and_leaves_frames_without_gradient():
    p = torch.nn.Parameter(torch.zeros(2, 2))
    optimizer = UniformAdam([p], lr=0.1)
    p.grad = torch.tensor([[3.0, 0.003], [0.0, 0.0]])
    optimizer.step()
    assert torch.allclose(p.data, torch.tensor([[-0.1, -0.0001], [0.0, 0.0]]), atol=1e-7)


def test_quaternion_product_composes_rotations():
    generator = torch.Generator().manual_seed(0)
    a, b = torch.nn.functional.normalize(
        torch.randn(2, 5, 4, generator=generator, dtype=torch.float64), dim=-1
    )
    composed = quaternion_to_matrix(a) @ quaternion_to_matrix(b)
    assert torch.allclose(quaternion_to_matrix(quaternion_multiply(a, b)), composed, atol=1e-12)


def test_modal_motion_is_at_rest_in_frame_0_and_carries_shapes_along(scaffold):
    motion = ModalMotion(
        torch.tensor([[0.5, 0, 0], [0.6, 0.1, 0]]), scaffold.modes.energy, reach=0.1
    )
    torch.nn.init.normal_(motion.amplitude, std=0.02, generator=torch.Generator().manual_seed(0))
    sample = motion(torch.tensor([0, 1]), scaffold.splats, scaffold.modes)
    assert torch.allclose(sample.positions[0], scaffold.splats.means, atol=1e-7)
    assert torch.allclose(
        sample.deformation[0], torch.eye(3).expand_as(sample.deformation[0]), atol=1e-6
    )
    # the gradient of the modes is what the neighbours' positions say, and A_t = F A_0 F^T
    assert torch.allclose(
        sample.deformation[1], scaffold.around.deformation(sample.positions[1]), atol=1e-4
    )
    F, rest = sample.deformation[1], (0.008**2) * torch.eye(3)
    assert torch.allclose(sample.covariances[1], F @ rest @ F.transpose(-1, -2), atol=1e-9)
    assert (sample.positions[1] - sample.positions[0]).mean(0)[:2].tolist() == pytest.approx(
        [0.1, 0.1], abs=0.02
    )


@pytest.mark.parametrize("model", ["modes", "network"])
def test_free_shapes_start_at_rest_and_get_gradients(model, scaffold):
    offsets = torch.zeros(3, 3)
    if model == "modes":
        motion = ModalMotion(offsets, scaffold.modes.energy, reach=0.1, free_shape=True)
    else:
        motion = MotionBasisNetwork(
            offsets, centre=torch.zeros(3), reach=0.1, hidden=16, basis_layers=2
        )
    sample = motion(torch.tensor([0, 2]), scaffold.splats, scaffold.modes, scaffold.around)
    assert torch.allclose(sample.positions[0], scaffold.splats.means, atol=1e-6)
    assert torch.allclose(sample.scales[0], scaffold.splats.scales, atol=1e-7)
    assert torch.allclose(
        quaternion_to_matrix(sample.rotations[0]),
        torch.eye(3).expand(len(scaffold.splats.means), 3, 3),
        atol=1e-5,
    )
    assert torch.allclose(sample.covariances, covariance_from(sample.scales, sample.rotations))
    target = 2 * sample.covariances.detach()[1] + 1e-4
    ((sample.covariances[1] - target) ** 2).sum().backward()
    touched = motion.shape_amplitude if model == "modes" else motion.basis.last.weight
    assert float(touched.grad.abs().sum()) > 0


def test_unknown_model_or_carriers_is_an_error():
    with pytest.raises(
        ConfigError, match=r"dynamic\.model: expected modes or network, found 'spline'"
    ):
        DynamicSettings(model="spline")
    with pytest.raises(ConfigError, match=r"dynamic\.carriers"):
        DynamicSettings(carriers="mesh")


def rendered_windows(scaffold, truth, frames):
    """Windows of a scene whose images are renders of the scaffold itself in its true motion: the fit can be exact."""
    from dataclasses import replace

    from squashed_body import cameras, make_scene

    from mosa.rendering.rasterizer import rasterize

    rig = cameras(6, 80)
    scene = make_scene(views=1, frames=2, size=16)
    images, mattes = [], []
    for v in range(6):
        sample = truth(torch.arange(frames), scaffold.splats, scaffold.modes)
        view = rig.select([v] * frames)
        image, alpha = rasterize(
            sample.positions + torch.tensor([0.04, 0.25, 0.0]),
            sample.covariances,
            scaffold.splats.opacities,
            scaffold.colors(sample.deformation),
            view,
            torch.arange(frames),
            torch.ones(3),
        )
        images.append(image)
        mattes.append(alpha)
    return replace(
        scene,
        images=torch.stack(images),
        mattes=torch.stack(mattes),
        cameras=rig,
        times=torch.arange(frames) * 0.02,
    )


@pytest.mark.parametrize(
    "settings, bound",
    [
        (
            DynamicSettings(
                carriers="particles",
                track_iterations=60,
                iterations=160,
                bending=0.01,
                elastic=1e-4,
            ),
            5e-4,
        ),
        (
            DynamicSettings(
                model="network",
                carriers="particles",
                iterations=800,
                frames=1,
                hidden=48,
                basis_layers=2,
                lr_network=3e-3,
                elastic=1e-3,
            ),
            4e-3,
        ),
    ],
    ids=["modes", "network"],
)
def test_a_rendered_motion_is_recovered(settings, bound, scaffold):
    """RMS error of all particles, against deviations of 9 mm from the offsets that the fit starts with."""
    frames = 3
    offsets = torch.tensor([[0.0, 0, 0], [0.004, -0.01, 0.0], [0.008, -0.02, 0.004]])
    truth = ModalMotion(offsets, scaffold.modes.energy, reach=0.1)
    with torch.no_grad():
        truth.amplitude[1:, :10] = 0.02 * torch.randn(
            2, 10, 3, generator=torch.Generator().manual_seed(4)
        )
        scene = rendered_windows(scaffold, truth, frames)
        shifted = Splats(
            **{
                **vars(scaffold.splats),
                "means": scaffold.splats.means + torch.tensor([0.04, 0.25, 0.0]),
            }
        )
        true = truth(torch.arange(frames), shifted, scaffold.modes).positions
    windows = object_windows(scene, list(range(6)), list(range(frames)))
    body = Scaffold(shifted, scaffold.modes, scaffold.around)
    motion = fit_motion(Target(body, body, windows, offsets, torch.ones(3), 0.1), settings, seed=0)
    with torch.no_grad():
        found = motion(torch.arange(frames), shifted, scaffold.modes, scaffold.around).positions
        start = shifted.means + offsets[:, None]
    error = float((found - true)[1:].pow(2).sum(-1).mean().sqrt())
    assert error < bound
    assert float((start - true)[1:].pow(2).sum(-1).mean().sqrt()) > 9e-3


def test_a_body_that_bends_far_is_not_straightened(scaffold):
    """Default weights, a curvature of twenty times the scale: with the scale the fit is nearer to the truth, and free frames, whose
    curvature is small, stay as they were."""
    frames, errors, bent = 3, {}, {}
    offsets = torch.tensor([[0.0, 0, 0], [0.004, -0.01, 0.0], [0.008, -0.02, 0.004]])
    truth = ModalMotion(offsets, scaffold.modes.energy, reach=0.1)
    energy = scaffold.modes.energy
    with torch.no_grad():
        truth.amplitude[2, 4:10] = 0.5 * torch.randn(
            6, 3, generator=torch.Generator().manual_seed(5)
        )
        c = truth.coefficients(torch.tensor([2]))[0] / 0.1
        truth.amplitude[2] *= (0.02 / (energy[:, None] * c**2).sum()).sqrt()
        scene = rendered_windows(scaffold, truth, frames)
        shifted = Splats(
            **{
                **vars(scaffold.splats),
                "means": scaffold.splats.means + torch.tensor([0.04, 0.25, 0.0]),
            }
        )
        true = truth(torch.arange(frames), shifted, scaffold.modes).positions
    windows = object_windows(scene, list(range(6)), list(range(frames)))
    body = Scaffold(shifted, scaffold.modes, scaffold.around)
    for scale in (0.0, 0.001):
        settings = DynamicSettings(
            carriers="particles", track_iterations=30, iterations=80, bending_scale=scale
        )
        motion = fit_motion(
            Target(body, body, windows, offsets, torch.ones(3), 0.1), settings, seed=0
        )
        with torch.no_grad():
            found = motion(torch.arange(frames), shifted, scaffold.modes, scaffold.around).positions
            coefficients = motion.coefficients(torch.arange(frames)) / 0.1
        errors[scale] = (found - true).pow(2).sum(-1).mean(-1).sqrt()
        bent[scale] = (energy[:, None] * coefficients**2).sum((-2, -1))
    assert errors[0.001][2] < 0.85 * errors[0.0][2] and errors[0.001][1] < errors[0.0][1] + 1e-4
    assert 1.3 * bent[0.0][2] < bent[0.001][2] < 0.02

"""Gradients of everything a picture is made of besides the four plain inputs: poses, intrinsics, scales and rotations,
spherical harmonics, depth. Every entry against fourth-order differences in float64, rtol 1e-6."""

from dataclasses import replace

import pytest
import torch
from depth import expected_depth, rasterize_with_depth
from drawn_splats import CASES, NAMES, draw, objective, render, slopes
from raster_reference import rasterize_reference

from mosa.rendering.appearance.spherical_harmonics import view_colors
from mosa.rendering.covariance import covariance_from
from mosa.rendering.rasterizer import rasterize


def agree(picture, leaves):
    """autograd of `picture(**leaves)`, a scalar, against differences in every entry of every leaf."""
    live = {name: value.clone().requires_grad_() for name, value in leaves.items()}
    ours = torch.autograd.grad(picture(**live), list(live.values()))
    with torch.no_grad():
        for name, gradient in zip(leaves, ours):
            wanted = slopes(lambda: picture(**leaves), leaves[name])
            scale = float(wanted.abs().max())
            assert scale > 0
            torch.testing.assert_close(
                gradient,
                wanted,
                rtol=1e-6,
                atol=1e-6 * scale,
                msg=lambda text, name=name: f"{name}: {text}",
            )


@pytest.mark.parametrize("scan", ["gaussian", "tile"])
@pytest.mark.parametrize("case", CASES)
def test_camera_poses_and_intrinsics(case, scan):
    """The 3 x 4 entries of w2c and the five of K, each for itself; the edge case evaluates J at the clamped direction, whose
    limits are made of K."""
    scene = CASES[case]()
    K, w2c = scene.cameras.K.clone(), scene.cameras.w2c.clone()
    K[:, 0, 1] = 0.4  # a skewed sensor

    def picture(top, upper):
        cameras = replace(
            scene.cameras, K=torch.cat((upper, K[:, 2:]), 1), w2c=torch.cat((top, w2c[:, 3:]), 1)
        )
        values = [getattr(scene, name) for name in NAMES]
        return objective(
            *rasterize(*values, cameras, scene.state_index, scene.background, scan=scan)
        )

    upper = K[:, :2].clone()
    live = upper.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(picture(w2c[:, :3], live), live)
    assert torch.equal(
        gradient[:, 1, 0], torch.zeros(len(K)).double()
    )  # K[1, 0] is no parameter of a camera
    agree(picture, {"top": w2c[:, :3].clone(), "upper": upper})


def test_poses_agree_with_autograd_through_the_reference():
    """An independent program: plain torch, every pixel looking at every Gaussian."""
    scene = draw(40, images=3)
    found = []
    for function in (rasterize, rasterize_reference):
        K, w2c = (
            scene.cameras.K.clone().requires_grad_(),
            scene.cameras.w2c.clone().requires_grad_(),
        )
        cameras = replace(scene.cameras, K=K, w2c=w2c)
        values = [getattr(scene, name) for name in NAMES]
        output = function(*values, cameras, scene.state_index, scene.background)
        found.append(torch.autograd.grad(objective(*output), (K, w2c)))
    for ours, wanted in zip(*found):
        torch.testing.assert_close(ours, wanted, rtol=1e-9, atol=1e-11 * float(wanted.abs().max()))


def test_a_camera_finds_its_pose():
    """Gradient descent on a twist brings a displaced camera back: what the gradients are for."""
    scene = draw(40, states=1, images=1, size=0.2)
    true = scene.cameras.w2c.clone()
    with torch.no_grad():
        target, _ = render(scene, rasterize)
    twist = torch.tensor([[0.03, -0.02, 0.04, 0.02, -0.03, 0.05]]).double().requires_grad_()
    optimizer = torch.optim.Adam([twist], lr=3e-3)
    for _ in range(120):
        w, t = twist[:, :3], twist[:, 3:]
        zero = torch.zeros_like(w[:, 0])
        cross = torch.stack(
            (zero, -w[:, 2], w[:, 1], w[:, 2], zero, -w[:, 0], -w[:, 1], w[:, 0], zero), -1
        ).view(-1, 3, 3)
        motion = torch.cat((torch.cat((torch.matrix_exp(cross), t[..., None]), 2), true[:, 3:]), 1)
        scene.cameras = replace(scene.cameras, w2c=motion @ true)
        loss = (render(scene, rasterize)[0] - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert float(twist.detach().abs().max()) < 2e-3


def test_scales_and_rotations():
    scene = draw(12, images=2, seed=1)
    g = torch.Generator().manual_seed(5)
    leaves = {
        "scales": 0.06 * (0.3 + torch.rand(2, 12, 3, generator=g, dtype=torch.float64)),
        "rotations": torch.randn(2, 12, 4, generator=g, dtype=torch.float64),
    }

    def picture(scales, rotations):
        return objective(*render(scene, rasterize, covariances=covariance_from(scales, rotations)))

    agree(picture, leaves)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spherical_harmonics(degree):
    """Means and poses move the colour as well as the place."""
    scene = draw(10, images=2, seed=4)
    g = torch.Generator().manual_seed(6)
    w2c = scene.cameras.w2c
    leaves = {
        "coefficients": 0.3
        * torch.randn(10, (degree + 1) ** 2, 3, generator=g, dtype=torch.float64),
        "means": scene.means,
        "top": w2c[:, :3].clone(),
    }

    def picture(coefficients, means, top):
        cameras = replace(scene.cameras, w2c=torch.cat((top, w2c[:, 3:]), 1))
        colors = view_colors(coefficients, means, cameras, scene.state_index)
        return objective(
            *rasterize(
                means, scene.covariances, scene.opacities, colors, cameras, scene.state_index
            )
        )

    agree(picture, leaves)


@pytest.mark.parametrize("expected", [False, True])
def test_depth(expected):
    """Accumulated and expected depth in all they depend on. The expected depth jumps at the rim of what is seen, so it is
    weighted by alpha^2 here, which does not hide its gradient inside."""
    scene = draw(12, images=2, seed=1)
    w2c = scene.cameras.w2c
    leaves = {name: getattr(scene, name).clone() for name in ("means", "covariances", "opacities")}

    def picture(means, covariances, opacities, top):
        cameras = replace(scene.cameras, w2c=torch.cat((top, w2c[:, 3:]), 1))
        arguments = (means, covariances, opacities)
        if expected:
            depth, alpha = expected_depth(*arguments, cameras, scene.state_index)
            depth = torch.where(alpha > 0, depth, torch.zeros_like(depth)) * alpha.square()
        else:
            _, alpha, depth = rasterize_with_depth(
                *arguments, scene.features, cameras, scene.state_index
            )
        return objective(depth[..., None], torch.zeros_like(depth))

    agree(picture, leaves | {"top": w2c[:, :3].clone()})


@pytest.mark.gpu
def test_camera_gradients_on_cuda_match_cpu():
    """1500 Gaussians of float64, nine channels, more than one block of threads to a camera and ragged tiles at the border."""
    scene = draw(1500, states=2, images=4, channels=9, size=0.04)
    scene.cameras = replace(
        scene.cameras,
        width=100,
        height=90,
        K=4 * scene.cameras.K * torch.tensor([[1.0], [1.0], [0.25]]),
    )
    found = []
    for device in ("cpu", "cuda"):
        K, w2c = (
            x.clone().to(device).requires_grad_() for x in (scene.cameras.K, scene.cameras.w2c)
        )
        values = [getattr(scene, name).to(device).requires_grad_() for name in NAMES]
        output = rasterize(
            *values, replace(scene.cameras, K=K, w2c=w2c), scene.state_index.to(device)
        )
        found.append([g.cpu() for g in torch.autograd.grad(objective(*output), [K, w2c, *values])])
    for ours, wanted in zip(*found):
        torch.testing.assert_close(ours, wanted, rtol=1e-9, atol=1e-10 * float(wanted.abs().max()))

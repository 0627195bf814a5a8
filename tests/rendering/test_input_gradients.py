"""Gradients of everything a picture is made of besides the four plain inputs: scales and rotations,
spherical harmonics, depth. Every entry against fourth-order differences in float64, rtol 1e-6."""

import pytest
import torch
from depth import expected_depth, rasterize_with_depth
from drawn_splats import draw, objective, render, slopes

from mosa.rendering.appearance.spherical_harmonics import colors_in
from mosa.rendering.cameras import centers
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
    """Means move the colour as well as the place."""
    scene = draw(10, images=2, seed=4)
    g = torch.Generator().manual_seed(6)
    cameras = scene.cameras
    leaves = {
        "coefficients": 0.3
        * torch.randn(10, (degree + 1) ** 2, 3, generator=g, dtype=torch.float64),
        "means": scene.means,
    }

    def picture(coefficients, means):
        lines = means[scene.state_index] - centers(cameras).to(means)[:, None]
        colors = colors_in(coefficients, lines)
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
    cameras = scene.cameras
    leaves = {name: getattr(scene, name).clone() for name in ("means", "covariances", "opacities")}

    def picture(means, covariances, opacities):
        arguments = (means, covariances, opacities)
        if expected:
            depth, alpha = expected_depth(*arguments, cameras, scene.state_index)
            depth = torch.where(alpha > 0, depth, torch.zeros_like(depth)) * alpha.square()
        else:
            _, alpha, depth = rasterize_with_depth(
                *arguments, scene.features, cameras, scene.state_index
            )
        return objective(depth[..., None], torch.zeros_like(depth))

    agree(picture, leaves)

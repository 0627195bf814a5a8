"""Gaussian flow in six channels against its definition, pixel by pixel and Gaussian by Gaussian."""

import pytest
import torch
from drawn_splats import draw, ring
from raster_reference import alphas, composite, visible_covariance

from mosa.rendering.flow import flow_features, flow_from_features
from mosa.rendering.rasterizer import rasterize


def root(M):
    """Principal square root of symmetric 2x2 matrices through eigenvectors."""
    values, vectors = torch.linalg.eigh(M)
    return vectors @ torch.diag_embed(values.sqrt()) @ vectors.transpose(-1, -2)


def exact_flow(means, covariances, opacities, camera, b):
    """sum_i w_i [B_2 B_1^-1 (u - m_1) + m_2 - u] at every pixel centre u of camera b; states 0 to 1: (H, W, 2)
    [px]."""
    sides = [
        visible_covariance(
            means[s], covariances[s], camera.K[b], camera.w2c[b], camera.width, camera.height
        )
        for s in (0, 1)
    ]
    (m1, M1, depth), (m2, M2, _) = sides
    order = depth.argsort()
    weights, _ = composite(
        alphas(m1[order], M1[order], opacities[order], camera.width, camera.height)
    )
    y, x = torch.meshgrid(
        torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij"
    )
    u = torch.stack((x, y), -1).reshape(-1, 1, 2).double()
    A = root(M2) @ torch.linalg.inv(root(M1))
    moved = ((A @ (u - m1)[..., None])[..., 0] + m2 - u)[:, order]
    return (weights[..., None] * moved).sum(1).view(camera.height, camera.width, 2)


def moving(isotropic):
    """Two states of 40 Gaussians: the second moved and stretched by an affine map; three cameras."""
    scene = draw(40, states=1, images=3)
    if isotropic:
        scene.covariances = (0.05**2 * torch.eye(3).double()).expand(1, 40, 3, 3)
    F = torch.tensor([[1.05, 0.1, 0.0], [-0.05, 0.9, 0.08], [0.02, 0.0, 1.1]]).double()
    means = torch.cat((scene.means, scene.means @ F.T + 0.03))
    covariances = torch.cat((scene.covariances, F @ scene.covariances @ F.T))
    return scene, means, covariances


def render_flow(scene, means, covariances, cameras, dtype=torch.float64, **options):
    m, c = means.to(dtype), covariances.to(dtype)
    first, second = (torch.full((len(cameras),), s) for s in (0, 1))
    features = flow_features(m[first], c[first], m[second], c[second], cameras, **options)
    image, _ = rasterize(m, c, scene.opacities.to(dtype), features, cameras, first)
    return flow_from_features(image, cameras)


@pytest.mark.parametrize("isotropic", [False, True])
@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-11), (torch.float32, 1e-4)])
def test_flow_is_exact(isotropic, dtype, tolerance):
    """Absolute, in pixels of 160 px images."""
    scene, means, covariances = moving(isotropic)
    cameras = ring(3, 160, 120) if dtype == torch.float32 else scene.cameras
    flow = render_flow(scene, means, covariances, cameras, dtype)
    for b in range(3):
        wanted = exact_flow(means, covariances, scene.opacities, cameras, b)
        assert float(wanted.abs().max()) > 0.5
        torch.testing.assert_close(flow[b].double(), wanted, rtol=0, atol=tolerance)


def test_translation_across_the_image_moves_every_pixel_alike():
    """One sheet of Gaussians parallel to the image shifts by fx dx / z; the flow is that shift times alpha."""
    g = torch.Generator().manual_seed(0)
    camera = ring(1, 40, 30)
    seen = torch.cat(
        (0.1 * torch.randn(50, 2, generator=g, dtype=torch.float64), torch.zeros(50, 1).double()), 1
    )
    seen[:, 2] = 1.0
    R, t = camera.w2c[0, :3, :3], camera.w2c[0, :3, 3]
    means = torch.stack(
        ((seen - t) @ R, (seen + torch.tensor([0.02, -0.01, 0.0], dtype=torch.float64) - t) @ R)
    )
    flat = R.T @ torch.diag(torch.tensor([0.05**2, 0.05**2, 0.0], dtype=torch.float64)) @ R
    covariances = flat.expand(2, 50, 3, 3)
    opacities = torch.full((50,), 0.6, dtype=torch.float64)
    features = flow_features(means[:1], covariances[:1], means[1:], covariances[1:], camera)
    image, alpha = rasterize(means, covariances, opacities, features, camera, torch.tensor([0]))
    flow = flow_from_features(image, camera)
    shift = torch.stack((0.02 * camera.K[0, 0, 0], -0.01 * camera.K[0, 1, 1]))
    torch.testing.assert_close(flow, alpha[..., None] * shift, rtol=0, atol=1e-11)


@pytest.mark.parametrize("isotropic", [False, True])
def test_gradients(isotropic):
    """Central differences of the features in all inputs that live; finite for isotropic Gaussians too."""
    scene, means, covariances = moving(isotropic)
    cameras = scene.cameras.select([0])
    inputs = [
        x[:, :4].clone().requires_grad_()
        for x in (means[:1], covariances[:1], means[1:], covariances[1:])
    ]
    live = lambda *x: flow_features(*x, cameras, detach_first=False)  # noqa: E731
    assert torch.autograd.gradcheck(live, inputs, eps=1e-7, rtol=1e-6, atol=1e-5)


def test_first_frame_is_a_constant_by_default():
    scene, means, covariances = moving(False)
    cameras = scene.cameras.select([0])
    a, b = means[:1].clone().requires_grad_(), means[1:].clone().requires_grad_()
    flow_features(a, covariances[:1], b, covariances[1:], cameras).sum().backward()
    assert a.grad is None and float(b.grad.abs().max()) > 0
    b.grad = None
    flow_features(
        a, covariances[:1], b, covariances[1:], cameras, detach_first=False
    ).sum().backward()
    assert float(a.grad.abs().max()) > 0


def test_gaussians_behind_the_camera_keep_gradients_finite():
    scene, means, covariances = moving(True)
    eye = -scene.cameras.w2c[0, :3, :3].T @ scene.cameras.w2c[0, :3, 3]
    means[:, 0], means[1, 1] = eye, 1.5 * eye
    leaves = [means.clone().requires_grad_(), covariances.clone().requires_grad_()]
    flow = render_flow(scene, *leaves, scene.cameras.select([0]), detach_first=False)
    flow.square().sum().backward()
    assert all(torch.isfinite(x.grad).all() for x in leaves)

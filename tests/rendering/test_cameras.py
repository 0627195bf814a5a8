"""Cameras: projection and rays are inverse, windows and scales keep the picture, boxes hold the object."""

import pytest
import torch
from drawn_splats import draw, ring
from raster_reference import visible_covariance
from scipy.spatial.transform import Rotation

from mosa.errors import ConfigError, DataError
from mosa.rendering.cameras import (
    crop_boxes,
    crop_cameras,
    crop_images,
    look_at,
    project,
    rays,
    scale_cameras,
)
from mosa.rendering.covariance import (
    covariance_from,
    matrix_to_quaternion,
    project_gaussians,
    quaternion_multiply,
    quaternion_to_matrix,
    scales_and_rotations,
    square_root,
)
from mosa.rendering.rasterizer import rasterize


def test_rays_pass_through_their_pixel_centres():
    cameras = ring(3, 12, 10)
    origins, directions = rays(cameras)
    points = (origins[:, None, None] + 2.5 * directions).view(3, -1, 3)
    pixels, depth = project(points, cameras)
    y, x = torch.meshgrid(torch.arange(10) + 0.5, torch.arange(12) + 0.5, indexing="ij")
    wanted = torch.stack((x, y), -1).view(-1, 2).double().expand(3, -1, -1)
    torch.testing.assert_close(pixels, wanted, rtol=0, atol=1e-11)
    assert float(depth.min()) > 0
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(3, 10, 12).double())


def test_look_at_axes():
    """The target lies on the axis ahead, up is up in the image (y falls), right-handed."""
    eye, target, up = (
        torch.tensor([1.0, 2.0, 3.0]),
        torch.tensor([0.0, 0.5, 0.0]),
        torch.tensor([0.0, 1.0, 0.0]),
    )
    w2c = look_at(eye, target, up)
    seen = w2c[:3, :3] @ target + w2c[:3, 3]
    torch.testing.assert_close(
        seen, torch.tensor([0.0, 0.0, float((target - eye).norm())]), atol=1e-6, rtol=1e-6
    )
    above = w2c[:3, :3] @ (target + 0.1 * up) + w2c[:3, 3]
    assert float(above[1]) < 0 and abs(float(above[0])) < 1e-6
    assert float(torch.linalg.det(w2c[:3, :3])) == pytest.approx(1, abs=1e-6)
    with pytest.raises(ConfigError, match="parallel to up"):
        look_at(torch.tensor([0.0, 2.0, 0.0]), torch.zeros(3), up)


def test_a_window_shows_what_the_image_shows():
    """Rendering the cropped camera equals cropping the rendering: the windows change nothing."""
    scene = draw(60)
    # the clamp of J depends on the window: keep well inside of all three
    scene.means = scene.means * 0.1 / scene.means.norm(dim=-1, keepdim=True)
    cameras = ring(3, 64, 48)
    x0, y0 = torch.tensor([10, 12, 8]), torch.tensor([4, 9, 12])
    arguments = (scene.means, scene.covariances, scene.opacities, scene.features)
    full, _ = rasterize(*arguments, cameras, scene.state_index)
    part, _ = rasterize(*arguments, crop_cameras(cameras, x0, y0, 40, 32), scene.state_index)
    torch.testing.assert_close(part, crop_images(full, x0, y0, 40, 32), rtol=0, atol=1e-12)
    stacked = crop_images(full[:, None], x0, y0, 40, 32, axis=2)
    assert torch.equal(stacked[:, 0], crop_images(full, x0, y0, 40, 32))


def test_scaled_cameras_scale_pixels():
    cameras, points = ring(2, 64, 48), 0.1 * torch.randn(20, 3).double()
    half = scale_cameras(cameras, 0.5)
    assert (half.width, half.height) == (32, 24)
    torch.testing.assert_close(project(points, half)[0], 0.5 * project(points, cameras)[0])
    with pytest.raises(ConfigError, match="vanish"):
        scale_cameras(cameras, 0.001)


def test_crop_boxes_hold_the_object_of_every_view():
    mattes = torch.zeros(3, 2, 40, 60)
    mattes[0, 0, 10:15, 20:30] = 1.0
    mattes[0, 1, 30:33, 25:28] = 0.5
    mattes[1, 1, 0:4, 55:60] = 1.0  # in the corner; view 2 sees nothing
    x0, y0, width, height = crop_boxes(mattes, margin=2, multiple=4)
    assert (width, height) == (16, 28)  # 10 + 4 and 23 + 4, up to multiples of 4
    assert x0[1] == 60 - width and y0[1] == 0
    for v in range(2):
        outside = mattes[v].clone()
        outside[:, y0[v] : y0[v] + height, x0[v] : x0[v] + width] = 0
        assert float(outside.max()) == 0
    assert x0[2] == (60 - width) // 2 and y0[2] == (40 - height) // 2
    assert crop_boxes(mattes, margin=100)[2:] == (60, 40)
    with pytest.raises(DataError, match="none of 3 mattes"):
        crop_boxes(0 * mattes)


def test_quaternions_agree_with_scipy():
    q = torch.randn(10, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    wanted = torch.as_tensor(Rotation.from_quat(q.numpy(), scalar_first=True).as_matrix())
    torch.testing.assert_close(quaternion_to_matrix(q), wanted)
    product = quaternion_multiply(q[:5], q[5:])
    torch.testing.assert_close(quaternion_to_matrix(product), wanted[:5] @ wanted[5:])
    scales = torch.rand(10, 3, dtype=torch.float64)
    torch.testing.assert_close(
        covariance_from(scales, q), wanted @ torch.diag_embed(scales**2) @ wanted.transpose(1, 2)
    )


def test_projected_gaussians_are_those_of_the_rasteriser():
    scene = draw(30, states=1, images=2)
    scene.means = 2 * scene.means  # some beside and behind the cameras
    means, covariances = scene.means.expand(2, -1, -1), scene.covariances.expand(2, -1, -1, -1)
    centers, M = project_gaussians(means, covariances, scene.cameras)
    for b in range(2):
        wanted, wanted_M, z = visible_covariance(
            means[b],
            covariances[b],
            scene.cameras.K[b],
            scene.cameras.w2c[b],
            scene.cameras.width,
            scene.cameras.height,
        )
        ahead = z > 0.01
        torch.testing.assert_close(centers[b][ahead], wanted[ahead])
        torch.testing.assert_close(M[b][ahead], wanted_M.flatten(1)[:, [0, 1, 3]][ahead])
    assert torch.isfinite(centers).all() and torch.isfinite(M).all()


def test_square_root_and_its_gradient_at_equal_eigenvalues():
    """B B = M; at M = s I every formula through eigenvectors divides 0 by 0, the closed form gives d sqrt = dM / (2
    sqrt s)."""
    g = torch.Generator().manual_seed(1)
    A = torch.randn(50, 2, 2, generator=g, dtype=torch.float64)
    M = A @ A.transpose(1, 2) + 0.3 * torch.eye(2)
    B = square_root(M.flatten(1)[:, [0, 1, 3]])
    full = B[:, [0, 1, 1, 2]].unflatten(1, (2, 2))
    torch.testing.assert_close(full @ full, M)
    round_one = torch.tensor([4.0, 0.0, 4.0], dtype=torch.float64, requires_grad=True)
    gradient = torch.autograd.functional.jacobian(square_root, round_one)
    torch.testing.assert_close(gradient, torch.eye(3).double() / 4)
    assert torch.autograd.gradcheck(
        square_root, (M.flatten(1)[:5, [0, 1, 3]].requires_grad_(),), rtol=1e-6
    )


def test_scales_and_rotations_rebuild_the_covariance():
    """Round, flat and needle-like ones, half turns about every axis included."""
    g = torch.Generator().manual_seed(2)
    q = torch.cat((torch.randn(40, 4, generator=g, dtype=torch.float64), torch.eye(4).double()))
    torch.testing.assert_close(
        quaternion_to_matrix(matrix_to_quaternion(quaternion_to_matrix(q))), quaternion_to_matrix(q)
    )
    scales = torch.rand(44, 3, generator=g, dtype=torch.float64)
    scales[:5], scales[5:10, 1:] = 0.3, 0.01
    covariances = covariance_from(scales, q)
    found, rotations = scales_and_rotations(covariances)
    torch.testing.assert_close(
        covariance_from(found, rotations), covariances, rtol=1e-10, atol=1e-12
    )
    torch.testing.assert_close(found, scales.sort(1).values, rtol=1e-10, atol=1e-10)

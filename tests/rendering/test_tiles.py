"""The kernels for CUDA, run on a CPU: tile lists, which Gaussians a block of pixels may skip, compositing at any size and number
of channels."""

from dataclasses import replace

import pytest
import torch
import warp as wp
from drawn_splats import NAMES, draw, gradients, objective, render, ring, slopes
from raster_reference import rasterize_reference

from mosa.errors import ConfigError
from mosa.physics import exact_sums
from mosa.rendering.projection_kernels import ALPHA_MIN, TILE
from mosa.rendering.rasterizer import rasterize
from mosa.rendering.records import record_functions
from mosa.rendering.splatting import Geometry, depth_lists, project
from mosa.rendering.tile_kernels import BLOCK_HEIGHT, BLOCK_WIDTH, reach_function
from mosa.system.warp_start import start_warp


def agree(scene, rtol=1e-10):
    """Image, alpha and gradients by tiles and by the reference."""
    for ours, wanted in zip(
        render(scene, rasterize, scan="tile"), render(scene, rasterize_reference)
    ):
        torch.testing.assert_close(ours, wanted, rtol=1e-12, atol=1e-13)
    for ours, wanted in zip(
        gradients(scene, rasterize, scan="tile"), gradients(scene, rasterize_reference)
    ):
        torch.testing.assert_close(ours, wanted, rtol=rtol, atol=1e-12 * float(wanted.abs().max()))


@pytest.mark.parametrize("width, height", [(1, 1), (37, 19), (16, 32), (50, 3)])
def test_images_of_any_size(width, height):
    scene = draw(40, images=2, size=0.15)
    scene.cameras = ring(2, width, height)
    agree(scene)


@pytest.mark.parametrize("channels", [1, 3, 9, 17, 40])
@pytest.mark.parametrize("shared", [False, True])
def test_any_number_of_channels(channels, shared):
    scene = draw(30, images=3, channels=channels)
    if shared:
        scene.features = scene.features[:1]
    agree(scene)


@pytest.mark.gpu
@pytest.mark.parametrize("channels", [1, 3, 9, 17, 40])
@pytest.mark.parametrize("shared", [False, True])
def test_warps_of_32_lanes_agree_with_one(channels, shared):
    """On CUDA and on a CPU, lists longer than a warp, capped alphas and pixels that end inside them."""
    scene = draw(1500, images=3, channels=channels)
    scene.cameras = ring(3, 61, 45)
    scene.opacities[::2] = 1.0
    if shared:
        scene.features = scene.features[:1]
    wanted = (*render(scene, rasterize), *gradients(scene, rasterize))
    for name in (*NAMES, "background", "state_index", "cameras"):
        setattr(scene, name, getattr(scene, name).to("cuda"))
    for ours, value in zip((*render(scene, rasterize), *gradients(scene, rasterize)), wanted):
        torch.testing.assert_close(
            ours.cpu(), value, rtol=1e-9, atol=1e-10 * float(value.abs().max())
        )


@pytest.mark.gpu
def test_a_stream_of_its_own():
    """Warp's kernels follow torch's work on whatever stream it is queued."""
    scene = draw(200, images=3)
    for name in (*NAMES, "background", "state_index", "cameras"):
        setattr(scene, name, getattr(scene, name).to("cuda"))
    wanted = gradients(scene, rasterize)
    torch.cuda.synchronize()
    with torch.cuda.stream(torch.cuda.Stream()):
        torch.cuda._sleep(10_000_000)
        scene.means = scene.means + 0.0
        found = gradients(scene, rasterize)
    torch.cuda.synchronize()
    for ours, value in zip(found, wanted):
        torch.testing.assert_close(ours, value, rtol=1e-9, atol=1e-10 * float(value.abs().max()))


def test_gaussians_larger_than_the_image():
    """Also nearly flat ones that cross it as a stripe."""
    scene = draw(15, images=2, size=1.0, channels=9)
    scene.cameras = ring(2, 45, 35, distance=4.0)
    scene.covariances = scene.covariances + 4.0 * torch.diag(torch.tensor([1.0, 0.0, 0.0])).double()
    agree(scene)


@pytest.mark.parametrize("channels, shared", [(1, False), (17, True)])
def test_gradients_against_differences(channels, shared):
    """Every entry of the features and means, in images of one whole and one ragged tile to a side."""
    scene = draw(8, images=2, channels=channels, seed=1)
    scene.cameras = ring(2, 24, 20)
    if shared:
        scene.features = scene.features[:1]
    ours = dict(zip(NAMES, gradients(scene, rasterize, scan="tile")))
    for name in ("means", "features"):
        wanted = slopes(
            lambda: objective(*render(scene, rasterize, scan="tile")), getattr(scene, name)
        )
        torch.testing.assert_close(
            ours[name], wanted, rtol=1e-6, atol=1e-6 * float(wanted.abs().max())
        )


def test_nothing_in_view():
    scene = draw(5)
    scene.means = scene.means + torch.tensor([0.0, 50.0, 0.0])
    image, alpha = render(scene, rasterize, scan="tile")
    assert torch.equal(alpha, torch.zeros_like(alpha))
    assert torch.equal(image, scene.background.expand_as(image))
    assert all(float(g.abs().max()) == 0 for g in gradients(scene, rasterize, scan="tile"))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_lists_hold_what_touches_a_tile_by_depth(dtype):
    scene = draw(50, images=3)
    scene.cameras = ring(3, 37, 50)
    K, w2c = scene.cameras.K.to(dtype), scene.cameras.w2c.to(dtype)
    start_warp()
    g = Geometry(scene.state_index.to(torch.int32), 37, 50, "tile")
    records, depths = project(
        scene.means.to(dtype), scene.covariances.to(dtype), scene.opacities.to(dtype), K, w2c, g
    )
    depth = depths[:150].view(3, 50).clone()
    entries, starts = depth_lists(depths, records, g)
    bits = records.view(torch.int32 if dtype == torch.float32 else torch.int64)
    (x0, x1), (y0, y1) = ((bits[..., k] & 0xFFFF, bits[..., k] >> 16) for k in (3, 7))
    seen = (x0 < x1) & (y0 < y1)
    assert starts[0] == 0 and starts[-1] == len(entries) and len(starts) == 3 * 3 * 4 + 1
    for tile in range(36):
        b, top, left = tile // 12, tile // 3 % 4 * TILE, tile % 3 * TILE
        touches = (seen & (x0 < left + TILE) & (x1 > left) & (y0 < top + TILE) & (y1 > top))[b]
        by_depth = depth[b].argsort(stable=True)
        assert (
            entries[starts[tile] : starts[tile + 1]].tolist()
            == (50 * b + by_depth[touches[by_depth]]).tolist()
        )


def test_blocks_skip_only_what_does_not_reach_them():
    """Ellipses of 0.5 to 60 px, up to a hundred times as long as wide, around a block: whoever has an alpha of 1/255 at one of
    its pixels is visited, of the others most are not, but where rounding makes q uncertain."""
    dtype, count = wp.float32, 20000
    start_warp()
    *_, pack, _, _, _ = record_functions(dtype)
    reaches = reach_function(dtype)

    @wp.kernel(enable_backward=False, module="unique")
    def test(
        centers: wp.array(dtype=wp.vec2),
        opacities: wp.array(dtype=dtype),
        conics: wp.array(dtype=wp.vec3),
        found: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        r = pack(centers[i], opacities[i], conics[i], wp.vec4i(0, 200, 0, 200))
        found[i] = int(reaches(r, 96, 100, BLOCK_WIDTH, BLOCK_HEIGHT))

    g = torch.Generator().manual_seed(0)
    centers, opacities = (
        200 * torch.rand(count, 2, generator=g),
        1 / 255 + torch.rand(count, generator=g) ** 2 * (1 - 1 / 255),
    )
    long = 0.5 * 120 ** torch.rand(count, generator=g)
    wide = (long * 0.01 ** torch.rand(count, generator=g)).clamp(min=0.3**0.5)
    turn = torch.pi * torch.rand(count, generator=g)
    axis = torch.stack((turn.cos(), turn.sin()), -1)
    M = (1 / wide**2)[:, None, None] * torch.eye(2) + (1 / long**2 - 1 / wide**2)[
        :, None, None
    ] * axis[:, :, None] * axis[:, None]
    conics = torch.stack((M[:, 0, 0], M[:, 0, 1], M[:, 1, 1]), -1).contiguous()
    found = torch.empty(count, dtype=torch.int32)
    inputs = [
        wp.from_torch(centers, wp.vec2),
        wp.from_torch(opacities),
        wp.from_torch(conics, wp.vec3),
    ]
    wp.launch(test, dim=count, inputs=inputs, outputs=[wp.from_torch(found)], device="cpu")
    y, x = torch.meshgrid(
        torch.arange(BLOCK_HEIGHT) + 100.5, torch.arange(BLOCK_WIDTH) + 96.5, indexing="ij"
    )
    d = torch.stack((x, y), -1).view(1, -1, 2) - centers[:, None]
    a, b, c = conics[:, None].unbind(-1)
    q = a * d[..., 0] ** 2 + 2 * b * d[..., 0] * d[..., 1] + c * d[..., 1] ** 2
    counts = (opacities[:, None] * torch.exp(-0.5 * q) >= ALPHA_MIN).any(1)
    assert counts.sum() > 1000
    assert bool(found[counts].all())
    assert int(found.sum()) < 1.1 * int(counts.sum())


def test_images_beyond_what_a_record_holds_are_refused():
    scene = draw(5)
    scene.cameras = replace(scene.cameras, width=2**16)
    with pytest.raises(ConfigError, match="no side may be longer than 65535"):
        render(scene, rasterize)


def test_gradients_by_exact_sums_are_the_same_to_rounding(monkeypatch):
    scene = draw(60, images=2, size=0.15)
    plain = gradients(scene, rasterize, scan="tile")
    monkeypatch.setattr("mosa.rendering.splatting.needed", lambda device: True)
    for ours, wanted in zip(gradients(scene, rasterize, scan="tile"), plain, strict=True):
        torch.testing.assert_close(ours, wanted, rtol=1e-9, atol=1e-12 * float(wanted.abs().max()))


@pytest.mark.gpu
def test_on_a_gpu_gradients_are_equal_bit_for_bit_where_that_is_asked_for():
    scene = draw(1500, images=3)
    scene.cameras = ring(3, 61, 45)
    for name in (*NAMES, "background", "state_index", "cameras"):
        setattr(scene, name, getattr(scene, name).to("cuda"))
    exact_sums.use()
    try:
        first = gradients(scene, rasterize)
        assert all(all(map(torch.equal, first, gradients(scene, rasterize))) for _ in range(3))
    finally:
        exact_sums.use(False)

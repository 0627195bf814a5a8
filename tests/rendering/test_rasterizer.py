"""The rasteriser against the obvious one and against central differences."""

from dataclasses import replace

import pytest
import torch
from depth import expected_depth
from drawn_splats import CASES, NAMES, dense, draw, edge, gradients, objective, render, ring, slopes
from raster_reference import alphas, rasterize_reference, visible_covariance

from mosa.errors import ConfigError, DataError
from mosa.rendering.rasterizer import rasterize


def thresholds(scene):
    """Smallest relative distance of any alpha from 1/255 or the cap and of any transmittance from the stop; and
    whether the scene has capped alphas and stopped pixels at all."""
    gaps, capped, stopped = [], False, False
    width, height = scene.cameras.width, scene.cameras.height
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack((x, y), -1).reshape(-1, 1, 2).double()
    for b, s in enumerate(scene.state_index.tolist()):
        K, w2c = scene.cameras.K[b], scene.cameras.w2c[b]
        center, M, z = visible_covariance(
            scene.means[s], scene.covariances[s], K, w2c, width, height
        )
        order = z.argsort()[(z.sort().values > 0.01)]
        d = pixels - center[order]
        raw = scene.opacities[order] * torch.exp(
            -0.5 * (d * torch.linalg.solve(M[order], d[..., None])[..., 0]).sum(-1)
        )
        alpha = alphas(center[order], M[order], scene.opacities[order], width, height)
        after = torch.cumprod(1 - torch.where(alpha >= 1 / 255, alpha, 0), 1)
        gaps += [
            float((value / limit - 1).abs().min())
            for value, limit in ((raw, 1 / 255), (raw, 0.999), (after, 1e-4))
        ]
        capped |= bool((raw > 0.999).any())
        stopped |= bool((after < 1e-4).any())
    return min(gaps), capped, stopped


@pytest.mark.parametrize("scan", ["gaussian", "tile"])
@pytest.mark.parametrize("own_opacities", [False, True])
def test_matches_the_reference(scan, own_opacities):
    scene = draw(60, states=2, images=3)
    if own_opacities:
        scene.opacities = torch.stack((scene.opacities, scene.opacities.flip(0)))
    if scan == "tile":
        scene.features = scene.features[:1]  # shared by all images
    for ours, wanted in zip(
        render(scene, rasterize, scan=scan), render(scene, rasterize_reference)
    ):
        torch.testing.assert_close(ours, wanted, rtol=1e-12, atol=1e-13)
    for ours, wanted in zip(
        gradients(scene, rasterize, scan=scan), gradients(scene, rasterize_reference)
    ):
        torch.testing.assert_close(ours, wanted, rtol=1e-10, atol=1e-12 * float(wanted.abs().max()))


@pytest.mark.parametrize("case", CASES)
def test_gradients_against_central_differences(case):
    """Every entry of every input, fourth-order differences in float64, rtol 1e-6.

    The image jumps where an alpha crosses 1/255 or a transmittance 1e-4, and has a kink at the cap of alpha.
    Differences say nothing across those, so the cases are drawn with a gap to each, which is checked here, far
    above what a step can move.
    """
    scene = CASES[case]()
    assert thresholds(scene)[0] > 1e-4
    ours = dict(zip(NAMES, gradients(scene, rasterize)))
    tiled = dict(zip(NAMES, gradients(scene, rasterize, scan="tile")))
    for name in NAMES:
        wanted = slopes(lambda: objective(*render(scene, rasterize)), getattr(scene, name))
        scale = float(wanted.abs().max())
        for gradient in (ours[name], tiled[name]):
            torch.testing.assert_close(gradient, wanted, rtol=1e-6, atol=1e-6 * scale)


def test_the_cases_reach_what_they_are_for():
    """The dense case caps alpha and stops pixels; the edge case clamps directions and culls one Gaussian in one
    image only."""
    assert thresholds(dense())[1:] == (True, True)
    scene = edge()
    p = (
        scene.means[0] @ scene.cameras.w2c[:, :3, :3].transpose(1, 2)
        + scene.cameras.w2c[:, None, :3, 3]
    )
    limit = 1.3 * 0.5 * scene.cameras.width / scene.cameras.K[0, 0, 0]
    beside = (p[..., 2] > 0.01) & ((p[..., 0] / p[..., 2]).abs() > limit)
    grads = gradients(scene, rasterize)[3].abs().sum(-1)
    assert (beside & (grads > 0)).any()
    assert p[0, 0, 2] < 0 < p[1, 0, 2] and grads[0, 0] == 0


def test_float32_follows_float64():
    scene = draw(200, images=3)
    wide = render(scene, rasterize)
    for name in (*NAMES, "background"):
        setattr(scene, name, getattr(scene, name).float())
    for narrow, value in zip(render(scene, rasterize), wide):
        assert narrow.dtype == torch.float32
        torch.testing.assert_close(narrow.double(), value, rtol=0, atol=2e-5)


def test_repeats_bit_for_bit():
    scene = draw(100)
    for a, b in zip(gradients(scene, rasterize), gradients(scene, rasterize)):
        assert torch.equal(a, b)


def test_nothing_in_view_is_background():
    scene = draw(5)
    scene.means = scene.means + torch.tensor([0.0, 50.0, 0.0])
    image, alpha = render(scene, rasterize)
    assert torch.equal(alpha, torch.zeros_like(alpha))
    assert torch.equal(image, scene.background.expand_as(image))
    assert all(float(g.abs().max()) == 0 for g in gradients(scene, rasterize))
    tiled = render(scene, rasterize, scan="tile")[0]
    assert torch.equal(tiled, image)


def test_expected_depth_of_an_opaque_gaussian():
    scene = draw(1, states=1, images=2)
    scene.means = torch.zeros(1, 1, 3).double()
    depth, alpha = expected_depth(
        scene.means, scene.covariances, scene.opacities, scene.cameras, scene.state_index
    )
    distance = scene.cameras.w2c[:, 2, 3]
    for b in range(2):
        seen = depth[b][alpha[b] > 0]
        torch.testing.assert_close(seen, distance[b].expand_as(seen))
    assert torch.isinf(depth[alpha == 0]).all() and (alpha == 0).any()


@pytest.mark.parametrize("scan", ["gaussian", "tile"])
def test_memory_follows_visible_pairs_not_gaussians_times_pixels(scan):
    """Bytes kept for the backward pass, float64: 288 per Gaussian of two images, 12 per pixel, and with tiles 4 per tile and per
    entry. Every Gaussian with every pixel would be 16 MB already in the smallest case."""

    def kept(count, width, aside=0.0):
        scene = draw(count, states=1, images=2, size=0.02)
        scene.cameras = ring(2, width, width)
        scene.means = scene.means + torch.tensor([0.0, aside, 0.0])
        leaves = {name: getattr(scene, name).clone().requires_grad_() for name in NAMES}
        total = []
        with torch.autograd.graph.saved_tensors_hooks(
            lambda x: total.append(x.numel() * x.element_size()) or x, lambda x: x
        ):
            render(scene, rasterize, scan=scan, **leaves)
        return sum(total)

    small, more, wide = kept(500, 64), kept(1000, 64), kept(500, 256)
    assert (more - small) / 500 < 400
    assert (wide - small) / (2 * (256**2 - 64**2)) < 16
    hidden = kept(500, 256, aside=50.0)
    assert (
        (wide > hidden + 4 * 500) if scan == "tile" else (wide == hidden)
    )  # who is out of view has no entry


@pytest.mark.parametrize(
    "name, value, message",
    [
        ("means", torch.zeros(2, 5, 2).double(), "means has shape"),
        ("covariances", torch.zeros(2, 4, 3, 3).double(), "covariances has shape"),
        ("opacities", torch.zeros(5), "opacities is torch.float32"),
        ("features", torch.zeros(2, 5, 3).double(), "features has shape"),
        ("state_index", torch.tensor([0, 1, 2]), "state_index reaches outside the 2 states"),
    ],
)
def test_wrong_input_is_named(name, value, message):
    scene = draw(5, images=3)
    setattr(scene, name, value)
    with pytest.raises(ConfigError, match=message):
        render(scene, rasterize)


@pytest.mark.parametrize("name", NAMES)
def test_a_number_that_is_none_is_named(name):
    scene = draw(5, images=3)
    value = getattr(scene, name).clone()
    value.view(-1)[-1] = float("nan")
    setattr(scene, name, value)
    with pytest.raises(DataError, match=f"{name}.*4.* is not finite"):
        render(scene, rasterize)


def test_unknown_scan():
    scene = draw(5)
    with pytest.raises(ConfigError, match="unknown scan"):
        render(scene, rasterize, scan="rows")


@pytest.mark.gpu
@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 2e-4), (torch.float64, 1e-10)])
def test_cuda_matches_cpu(dtype, tolerance):
    """Values and gradients; atomics change the order of sums, so not bit for bit."""
    scene = draw(3000, states=2, images=4, size=0.04)
    for name in (*NAMES, "background"):
        setattr(scene, name, getattr(scene, name).to(dtype))
    scene.cameras = replace(scene.cameras, width=100, height=90, K=4 * scene.cameras.K)
    wanted = (*render(scene, rasterize), *gradients(scene, rasterize))
    for name in (*NAMES, "background", "state_index", "cameras"):
        setattr(scene, name, getattr(scene, name).to("cuda"))
    for ours, value in zip((*render(scene, rasterize), *gradients(scene, rasterize)), wanted):
        scale = float(value.abs().max())
        torch.testing.assert_close(ours.cpu(), value, rtol=tolerance, atol=tolerance * scale)

"""Parity of both orders of work, and with gsplat on a GPU (benchmarks/gsplat_adapter.py)."""

import sys
from dataclasses import replace
from types import ModuleType

import pytest
import torch
from drawn_splats import NAMES, draw
from raster_reference import visible_covariance

from benchmarks import gsplat_adapter
from mosa.rendering.rasterizer import rasterize


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("own_opacities", [False, True])
def test_states_and_images_keep_their_order_on_the_way_through_gsplat(
    monkeypatch, shared, own_opacities
):
    """A stand-in with gsplat's documented signature and shapes that draws with warp: every image comes back in its place."""

    def rasterization(
        *,
        means,
        quats,
        scales,
        covars,
        opacities,
        colors,
        viewmats,
        Ks,
        width,
        height,
        near_plane,
        eps2d,
        packed,
    ):
        views, count = len(viewmats), len(means)
        assert (
            means.shape == (count, 3)
            and covars.shape == (count, 3, 3)
            and opacities.shape == (count,)
        )
        assert (
            viewmats.shape == (views, 4, 4)
            and Ks.shape == (views, 3, 3)
            and quats is None
            and scales is None
        )
        assert colors.shape[:-1] in ((count,), (views, count)) and (near_plane, eps2d) == (
            0.01,
            0.3,
        )
        cameras = replace(scene.cameras, K=Ks, w2c=viewmats)
        colors = colors if colors.dim() == 3 else colors[None]
        index = torch.zeros(views, dtype=torch.long)
        image, alpha = rasterize(means[None], covars[None], opacities, colors, cameras, index)
        return image, alpha[..., None], {}

    stand_in = ModuleType("gsplat")
    stand_in.rasterization = rasterization
    monkeypatch.setitem(sys.modules, "gsplat", stand_in)
    scene = draw(20, states=2, images=5)
    scene.state_index = torch.tensor([1, 0, 1, 1, 0])
    if shared:
        scene.features = scene.features[:1]
    if own_opacities:
        scene.opacities = torch.stack((scene.opacities, scene.opacities.flip(0)))
    values = [getattr(scene, name) for name in NAMES]
    for ours, wanted in zip(
        gsplat_adapter.splat(*values, scene.cameras, scene.state_index),
        rasterize(*values, scene.cameras, scene.state_index),
    ):
        torch.testing.assert_close(ours, wanted, rtol=1e-12, atol=1e-13)


def away_from_rims(scene, *, slack=1e-4):
    """(B, H, W) pixels more than one pixel away from every place where some Gaussian's alpha is 1/255 to within `slack`: there
    rounding decides whether it counts."""
    width, height = scene.cameras.width, scene.cameras.height
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack((x, y), -1).reshape(-1, 1, 2).double()
    masks = []
    for b, s in enumerate(scene.state_index.tolist()):
        camera = (scene.cameras.K[b].double(), scene.cameras.w2c[b].double(), width, height)
        center, M, _ = visible_covariance(
            scene.means[s].double(), scene.covariances[s].double(), *camera
        )
        d = pixels - center
        q = (torch.linalg.inv(M) @ d[..., None])[..., 0].mul(d).sum(-1)
        rim = (255 * scene.opacities.double() * torch.exp(-0.5 * q) - 1).abs().amin(1).view(
            1, 1, height, width
        ) < slack
        masks.append(torch.nn.functional.max_pool2d(rim.float(), 3, 1, 1)[0, 0] == 0)
    return torch.stack(masks)


def parity_scene():
    """1000 Gaussians in 2 states seen by 4 cameras, nine channels (colour and flow), float32. Opacities up to 0.95: what
    the stop at 1e-4 leaves out then is below the tolerance."""
    scene = draw(1000, states=2, images=4, channels=9, size=0.05)
    scene.cameras = replace(
        scene.cameras,
        width=96,
        height=80,
        K=4 * scene.cameras.K * torch.tensor([[1.0], [1.0], [0.25]]),
    )
    clear = away_from_rims(scene)
    for name in (*NAMES, "background"):
        setattr(scene, name, getattr(scene, name).float())
    scene.cameras = replace(scene.cameras, K=scene.cameras.K.float(), w2c=scene.cameras.w2c.float())
    return scene, clear


GRADIENT_TOLERANCES = {  # gsplat's own tests of 1.5: rtol, and atol here in units of the largest entry
    "means": (5e-3, 5e-3), "covariances": (1e-2, 1e-2), "opacities": (8e-3, 6e-3), "features": (1e-3, 1e-3),
}  # fmt: skip


def outcome(scene, clear, way):
    """Image, alpha and the gradients of all inputs, by name, of an objective that looks at the clear pixels only."""
    leaves = {name: getattr(scene, name).detach().clone().requires_grad_() for name in NAMES}
    image, alpha = way(*leaves.values(), scene.cameras, scene.state_index, scene.background)
    g = torch.Generator().manual_seed(8)
    weights = [torch.randn(x.shape, generator=g).to(x) for x in (image, alpha)]
    total = (image * weights[0] * clear[..., None]).sum() + (alpha * weights[1] * clear).sum()
    return (
        image.detach(),
        alpha.detach(),
        dict(zip(NAMES, torch.autograd.grad(total, list(leaves.values())))),
    )


def compare(scene, clear, one, other):
    """Image, alpha and all gradients of two ways to draw a scene."""
    assert float(clear.float().mean()) > 0.9
    results = [outcome(scene, clear, way) for way in (one, other)]
    (image, alpha, gradients), (wanted, wanted_alpha, wanted_gradients) = results
    assert float((image - wanted).abs()[clear].max()) < 2e-3
    assert float((alpha - wanted_alpha).abs()[clear].max()) < 2e-3
    for name, (rtol, atol) in GRADIENT_TOLERANCES.items():
        ours, theirs = gradients[name], wanted_gradients[name]
        scale = float(theirs.abs().max())
        torch.testing.assert_close(
            ours,
            theirs,
            rtol=rtol,
            atol=atol * scale,
            msg=lambda text, name=name: f"{name}: {text}",
        )


def test_both_orders_of_work_agree_in_float32():
    """What the comparison with gsplat rests on: pixel by pixel and Gaussian by Gaussian, float32 rounding stays inside its
    tolerances."""
    scene, clear = parity_scene()
    compare(
        scene,
        clear,
        lambda *x: rasterize(*x, scan="tile"),
        lambda *x: rasterize(*x, scan="gaussian"),
    )


@pytest.mark.gpu
def test_parity_with_gsplat():
    reason = gsplat_adapter.why_unavailable()
    if reason:
        pytest.skip(reason)
    scene, clear = parity_scene()
    for name in (*NAMES, "background", "state_index", "cameras"):
        setattr(scene, name, getattr(scene, name).to("cuda"))
    compare(
        scene,
        clear.to("cuda"),
        rasterize,
        gsplat_adapter.splat,
    )

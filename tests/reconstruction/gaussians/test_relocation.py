"""Vanished Gaussians that are moved, anisotropic shape: what may change in a set of Gaussians while it is fitted."""

from __future__ import annotations

import numpy as np
import pytest
import squashed_body
import torch

from mosa.data.hull import visual_hull
from mosa.errors import ConfigError
from mosa.reconstruction.gaussians.gaussians import FreeGaussians
from mosa.reconstruction.gaussians.initial import initial_splats
from mosa.reconstruction.gaussians.relocation import relocate
from mosa.reconstruction.gaussians.static import fit_splats
from mosa.reconstruction.motion.observed import object_windows
from mosa.reconstruction.settings import FitSettings, StaticSettings, build_settings
from mosa.rendering.covariance import covariance_from, quaternion_to_matrix
from mosa.rendering.rasterizer import rasterize
from mosa.types import Splats

WHITE = torch.ones(3)


def rendered(splats, windows, background=WHITE):
    state = torch.zeros(len(windows), dtype=torch.long)
    covariances = covariance_from(splats.scales, splats.rotations)[None]
    return rasterize(
        splats.means[None],
        covariances,
        splats.opacities,
        splats.colors[None],
        windows.cameras,
        state,
        background,
    )[0]


def psnr(splats, windows):
    return float(-10 * torch.log10((rendered(splats, windows) - windows.images).square().mean()))


def some_splats(count=6, seed=0):
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.rand(*shape, generator=generator)  # noqa: E731
    rotations = torch.nn.functional.normalize(draw(count, 4) - 0.5, dim=-1)
    scales = 0.01 + 0.01 * draw(count, 1)
    return Splats(
        0.1 * draw(count, 3),
        scales.repeat(1, 3),
        rotations,
        0.2 + 0.6 * draw(count),
        0.1 + 0.8 * draw(count, 3),
    )


def free(splats, anisotropic=False):
    shape = "anisotropic" if anisotropic else "isotropic"
    return FreeGaussians(splats, FitSettings(shape=shape), move=True)


def pull(gaussians, weights):
    """A step of the optimiser on a loss that tells Gaussians apart, and not those of equal weight."""
    loss = sum(
        (weights.view(-1, *[1] * (p.dim() - 1)) * (p - 0.3) ** 2).sum()
        for p in gaussians.parameters.values()
    )
    gaussians.optimizer.zero_grad(set_to_none=True)
    loss.backward()
    gaussians.optimizer.step()


@pytest.mark.parametrize("anisotropic", [False, True])
def test_moments_follow_their_gaussians(anisotropic):
    """A set that was permuted and grown in between goes on as the set that was not, to the bit; fresh ones start from zero."""
    plain, moved = free(some_splats(), anisotropic), free(some_splats(), anisotropic)
    weights = torch.arange(1.0, 7.0)
    pull(plain, weights), pull(moved, weights)
    source, fresh = torch.tensor([4, 0, 5, 1, 2, 3, 2, 0]), torch.tensor([False] * 6 + [True] * 2)
    moved.take(source, fresh)
    assert len(moved) == 8 and all(len(value) == 8 for value in moved.fixed.values())
    for group in moved.optimizer.param_groups:
        p = moved.parameters[group["name"]]
        state = moved.optimizer.state[p]
        assert (
            group["params"][0] is p
            and p.requires_grad
            and state["exp_avg"].shape == state["exp_avg_sq"].shape == p.shape
        )
        assert (
            state["exp_avg"][:6].abs().min() > 0
            and state["exp_avg"][6:].abs().max() == state["exp_avg_sq"][6:].max() == 0
        )
    assert len(moved.optimizer.state) == len(
        moved.parameters
    )  # nothing is left of the tensors before
    pull(plain, weights), pull(moved, weights[source])
    for name, p in plain.parameters.items():
        assert torch.equal(moved.parameters[name][:6], p[source[:6]]), name
    assert not torch.equal(
        moved.parameters["means"][6], moved.parameters["means"][4]
    )  # the copy has no momentum


def test_the_vanished_are_moved_onto_others():
    splats = some_splats(8)
    splats.opacities[2:4] = 0.01
    gaussians = free(splats)
    relocate(gaussians, torch.Generator().manual_seed(0))
    found = gaussians.splats()
    assert len(gaussians) == 8 and found.opacities.min() > 0.05
    distance = torch.cdist(found.means[2:4], splats.means[[0, 1, 4, 5, 6, 7]]).amin(1)
    moved = (found.means[2:4] - splats.means[2:4]).norm(dim=1)
    assert (distance < 0.05).all() and moved.min() > 1e-3


def test_anisotropic_gaussians_fit_a_rod_better(monkeypatch):
    """Eight each, on a plain ellipsoid four times as long as thick; the long axes come to lie along it."""
    monkeypatch.setattr(squashed_body, "RADII", np.array([0.03, 0.12, 0.03]))
    monkeypatch.setattr(squashed_body, "color", lambda rest: np.full((len(rest), 3), 0.3))
    rod = squashed_body.make_scene(views=6, frames=2, size=64)
    still = object_windows(rod, list(range(6)), [0]).of_frame(0)
    hull = visual_hull(rod.mattes[:, 0], rod.cameras, rod.box, pitch=0.004)
    found = {}
    for shape in ("isotropic", "anisotropic"):
        settings = StaticSettings(iterations=120, shape=shape)
        start = initial_splats(hull, still, count=8, seed=0)
        found[shape] = fit_splats(start, still, WHITE, settings, move=True, seed=0)
    free = found["anisotropic"]
    assert len(free.means) == len(found["isotropic"].means) == 8
    assert psnr(free, still) > psnr(found["isotropic"], still) + 0.5
    axes = quaternion_to_matrix(free.rotations)[torch.arange(8), :, free.scales.argmax(1)]
    assert (free.scales.amax(1) / free.scales.amin(1)).median() > 1.3 and axes[
        :, 1
    ].abs().median() > 0.9
    torch.testing.assert_close(free.rotations.norm(dim=1), torch.ones(8))


def test_the_axis_ratio_is_bounded():
    settings = FitSettings(shape="anisotropic", largest=5.0, axis_ratio=3.0)
    gaussians = FreeGaussians(some_splats(), settings, move=True)
    gaussians.parameters["log_scale"].data += torch.tensor([2.0, 0.0, -2.0])
    gaussians.bound()
    scales = gaussians.splats().scales
    torch.testing.assert_close(scales[:, 0] / scales[:, 2], torch.full((6,), 3.0))
    torch.testing.assert_close(scales[:, 0], 5 * some_splats().scales[:, 0])


def test_the_same_seed_gives_the_same_bits(hull, still):
    settings = StaticSettings(iterations=24, relocate_every=4, shape="anisotropic")
    start = initial_splats(hull, still, count=120, seed=5)
    start.opacities[:20] = 0.01  # these are moved
    first, again, other = (
        fit_splats(start, still, WHITE, settings, move=True, seed=seed) for seed in (5, 5, 6)
    )
    for name, value in vars(first).items():
        assert torch.equal(value, getattr(again, name)), name
    assert not torch.equal(first.means[:100], other.means[:100])


@pytest.mark.parametrize("section, message", [
    ({"static": {"shape": "round"}}, r"shape: expected isotropic or anisotropic, found 'round'"),
    ({"appearance": {"relocate_every": 5}}, r"reconstruction\.appearance\.relocate_every: unknown key"),
])  # fmt: skip
def test_settings_that_cannot_be_are_named(section, message):
    with pytest.raises(ConfigError, match=message):
        build_settings(**section)

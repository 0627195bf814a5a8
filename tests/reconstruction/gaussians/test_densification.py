"""Random start, growth with a bound, anisotropic shape: what may change in a set of Gaussians while it is fitted."""

from __future__ import annotations

import math

import numpy as np
import pytest
import squashed_body
import torch

from mosa.data.hull import visual_hull
from mosa.errors import ConfigError
from mosa.reconstruction.gaussians import densification
from mosa.reconstruction.gaussians.densification import (
    MarkovChain,
    perturb,
    prune,
    refine,
    relocate,
    shared_opacity,
)
from mosa.reconstruction.gaussians.gaussians import FreeGaussians, Rates
from mosa.reconstruction.gaussians.initial import random_splats
from mosa.reconstruction.gaussians.static import fit_splats, start_splats
from mosa.reconstruction.motion.observed import object_windows
from mosa.reconstruction.settings import StaticSettings, build_settings
from mosa.rendering.covariance import covariance_from, matrix_to_quaternion, quaternion_to_matrix
from mosa.rendering.rasterizer import rasterize
from mosa.types import Splats

WHITE = torch.ones(3)
RATES = Rates(means=1e-3, log_scale=0.02, opacity=0.05, color=0.08, rotation=0.02)
BOUNDS = {"smallest": 0.25, "largest": 2.0, "axis_ratio": 10.0}


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
    return FreeGaussians(splats, RATES, move=True, anisotropic=anisotropic, **BOUNDS)


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


def test_shared_opacity_is_the_papers_formula():
    """Equation 9 of Kheradmand et al. 2024: a double sum of alternating binomials."""
    for n in (1, 2, 3, 7):
        for o in (0.05, 0.5, 0.95):
            each, factor = shared_opacity(torch.tensor([o], dtype=torch.float64), torch.tensor([n]))
            new = 1 - (1 - o) ** (1 / n)
            terms = [
                math.comb(i, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
                for i in range(n)
                for k in range(i + 1)
            ]
            assert float(each) == pytest.approx(new, rel=1e-12)
            assert float(factor) == pytest.approx(o / sum(terms), rel=1e-10)


def test_copies_in_one_place_leave_the_image_as_it_is(still, monkeypatch):
    """Large opaque Gaussians, one copy of each on average: 0.01 of RMS in colour; if opacities and scales stayed it would be seven
    times that. With the shift that tells copies apart it is 0.05 (a step of the fit adds a tenth as many)."""
    monkeypatch.setattr(densification, "SPREAD", 0.0)
    splats = random_splats_of_the_body(still, 150)
    before = rendered(splats, still)

    def change(spread, share=True):
        monkeypatch.setattr(densification, "SPREAD", spread)
        if not share:
            monkeypatch.setattr(
                densification, "shared_opacity", lambda o, n: (o, torch.ones_like(o))
            )
        gaussians = free(splats)
        refine(gaussians, torch.Generator().manual_seed(0), growth=1.0, most=300)
        assert len(gaussians) == 300
        return float((rendered(gaussians.splats(), still) - before).square().mean().sqrt())

    exact, apart, doubled = change(0.0), change(0.5), change(0.0, share=False)
    assert exact < 0.01 and apart < 0.05 and doubled > 5 * exact


def random_splats_of_the_body(still, count):
    points = torch.rand(count, 3, generator=torch.Generator().manual_seed(3)) * 2 - 1
    radii = torch.as_tensor(squashed_body.RADII, dtype=torch.float32)
    points = torch.nn.functional.normalize(points, dim=-1) * radii + torch.tensor(
        [0.02, 0.30, 0.01]
    )
    rotations = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    colors = torch.rand(count, 3, generator=torch.Generator().manual_seed(4))
    return Splats(
        points, torch.full((count, 3), 0.012), rotations, torch.full((count,), 0.7), colors
    )


def test_the_vanished_are_moved_onto_others():
    splats = some_splats(8)
    splats.opacities[2:4] = 0.01
    for act in (relocate, lambda g, rng: refine(g, rng, growth=0.0, most=8)):
        gaussians = free(splats)
        act(gaussians, torch.Generator().manual_seed(0))
        found = gaussians.splats()
        assert len(gaussians) == 8 and found.opacities.min() > 0.05
        distance = torch.cdist(found.means[2:4], splats.means[[0, 1, 4, 5, 6, 7]]).amin(1)
        assert (distance < 0.05).all() and (found.means[2:4] - splats.means[2:4]).norm(
            dim=1
        ).min() > 1e-3


def test_noise_moves_those_about_to_vanish_only_and_pruning_drops_them():
    splats = some_splats(4)
    splats.opacities[1] = 0.012
    gaussians = free(splats, anisotropic=True)
    perturb(gaussians, torch.Generator().manual_seed(0), amount=1.0)
    shift = (gaussians.splats().means - splats.means).norm(dim=1) / splats.scales[:, 0]
    assert shift[1] > 0.3 and shift[[0, 2, 3]].max() < 1e-6
    gaussians.parameters["opacity"].data[1] = -6.0
    prune(gaussians)
    assert len(gaussians) == 3 and torch.equal(gaussians.splats().means, splats.means[[0, 2, 3]])


def test_the_number_never_exceeds_its_bound(hull, still, monkeypatch):
    counts, step = [], MarkovChain.after_step

    def noted(self, gaussians, *arguments):
        step(self, gaussians, *arguments)
        counts.append(len(gaussians))

    monkeypatch.setattr(MarkovChain, "after_step", noted)
    settings = StaticSettings(
        iterations=40, densify="mcmc", max_points=157, refine_every=3, growth=0.07
    )
    start = start_splats(hull, still, settings, count=100, seed=0)
    found = fit_splats(start, still, WHITE, settings, move=True, seed=0)
    assert counts[0] == 100 and max(counts) == 157 and counts == sorted(counts)
    assert (
        100 < len(found.means) <= 157 and len({len(value) for value in vars(found).values()}) == 1
    )
    kept = StaticSettings(iterations=12, densify="mcmc", refine_every=3)
    counts.clear()
    fit_splats(start, still, WHITE, kept, move=True, seed=0)
    assert set(counts) == {100}


def test_a_random_start_needs_the_densification(hull, still):
    """From 100 uniform in the box (neither the hull's values nor its surface are read) to 600, against the same 100 left alone."""
    blank = type(hull)(torch.zeros_like(hull.values), hull.origin, hull.pitch)
    found = {}
    for name, more in {
        "alone": {"relocate_every": 0},
        "mcmc": {"densify": "mcmc", "max_points": 600, "growth": 0.3},
    }.items():
        settings = StaticSettings(start="random", iterations=120, **more)
        start = start_splats(blank, still, settings, count=100, seed=0)
        found[name] = psnr(fit_splats(start, still, WHITE, settings, move=True, seed=0), still)
    assert found["mcmc"] > 21 > 20 > found["alone"]


def test_a_random_start_fills_its_box(hull, still):
    splats = random_splats(hull, still, count=2000, seed=1)
    size = hull.pitch * (torch.tensor(hull.values.shape) - 1)
    place = (splats.means - hull.origin) / size
    assert place.min() >= 0 and place.max() <= 1 and (place.mean(0) - 0.5).abs().max() < 0.03
    # of N uniform points a ball of radius r holds N 4/3 pi r^3 / V: the three nearest lie at about 0.55 to 0.9 (V/N)^(1/3)
    spacing = float(size.prod() / 2000) ** (1 / 3)
    assert 0.4 * spacing < float(splats.scales.mean()) < 0.8 * spacing
    assert torch.equal(random_splats(hull, still, count=2000, seed=1).means, splats.means)


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
        start = start_splats(hull, still, settings, count=8, seed=0)
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
    gaussians = FreeGaussians(
        some_splats(),
        RATES,
        move=True,
        anisotropic=True,
        smallest=0.01,
        largest=5.0,
        axis_ratio=3.0,
    )
    gaussians.parameters["log_scale"].data += torch.tensor([2.0, 0.0, -2.0])
    gaussians.bound()
    scales = gaussians.splats().scales
    torch.testing.assert_close(scales[:, 0] / scales[:, 2], torch.full((6,), 3.0))
    torch.testing.assert_close(scales[:, 0], 5 * some_splats().scales[:, 0])


def test_the_same_seed_gives_the_same_bits(hull, still):
    settings = StaticSettings(
        iterations=24,
        start="random",
        densify="mcmc",
        max_points=200,
        refine_every=4,
        growth=0.3,
        shape="anisotropic",
    )
    start = start_splats(hull, still, settings, count=120, seed=5)
    first, again, other = (
        fit_splats(start, still, WHITE, settings, move=True, seed=seed) for seed in (5, 5, 6)
    )
    for name, value in vars(first).items():
        assert torch.equal(value, getattr(again, name)), name
    assert not torch.equal(first.means[:100], other.means[:100])


def test_copies_of_anisotropic_gaussians_keep_their_axes():
    """Shifted along the axes of their own: a rod's copies lie along the rod."""
    turn = torch.linalg.matrix_exp(
        torch.tensor([[0.0, -0.7, 0.2], [0.7, 0.0, -0.4], [-0.2, 0.4, 0.0]])
    )
    gaussians = free(some_splats(1), anisotropic=True)
    gaussians.parameters["rotation"].data[:] = matrix_to_quaternion(turn)
    gaussians.fixed["lower"] -= 10
    gaussians.parameters["log_scale"].data[:] = torch.tensor([0.02, 0.002, 0.002]).log()
    before = gaussians.splats()
    refine(gaussians, torch.Generator().manual_seed(0), growth=100.0, most=101)
    after = gaussians.splats()
    along = (after.means - before.means) @ turn
    assert len(gaussians) == 101 and 5 < along[:, 0].std() / along[:, 1].std() < 20
    torch.testing.assert_close(after.rotations, before.rotations.expand(101, 4))


@pytest.mark.parametrize("section, message", [
    ({"static": {"start": "colmap"}}, r"reconstruction\.static\.start: expected hull or random, found 'colmap'"),
    ({"static": {"densify": "split"}}, r"reconstruction\.static\.densify: expected relocate or mcmc, found 'split'"),
    ({"static": {"shape": "round"}}, r"shape: expected isotropic or anisotropic, found 'round'"),
    ({"static": {"max_points": 5000}}, r"reconstruction\.static\.max_points: expected null, found 5000: densify=relocate keeps"),
    ({"static": {"densify": "mcmc", "max_points": 2000}}, r"max_points: expected at least reconstruction\.points=3000.*found 2000"),
    ({"appearance": {"densify": "mcmc"}}, r"reconstruction\.appearance\.densify: unknown key"),
])  # fmt: skip
def test_settings_that_cannot_be_are_named(section, message):
    with pytest.raises(ConfigError, match=message):
        build_settings(**section)

"""Figures of docs/figures.md: each definition by hand or against an independent computation, and the floors."""

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from mosa.evaluation import metrics
from mosa.evaluation.analysis.statements import unexplained_text
from mosa.types import Ground, MarkerCues, MotionCues


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def ball(spacing: float, offset: float, radius: float = 0.125) -> torch.Tensor:
    """Lattice points of a ball [m]."""
    axis = torch.arange(-radius - spacing, radius + spacing, spacing, dtype=torch.float64) + offset
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    return points[points.norm(dim=1) < radius]


def turned(degrees: float) -> torch.Tensor:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)


# --- motion ---------------------------------------------------------------------------------------------------------


def test_rms_by_hand():
    x = torch.zeros(2, 2, 3)
    target = torch.tensor([[[3.0, 4, 0], [0, 0, 0]], [[0, 0, 0], [0, 0, 1]]])
    assert metrics.rms(x, target) == pytest.approx(math.sqrt((25 + 1) / 4))


@pytest.mark.parametrize("marked", [False, True])
def test_the_unexplained_share_of_a_motion(marked):
    """A body that swings by 1 cm after frame 2, and a law that stays: all of it. One that follows halfway leaves half; a
    motion below 2 % of the body's size counts as so large."""
    still, swing = ball(0.02, 0.0), torch.tensor([0, 0, 0, 0.01, -0.01], dtype=torch.float64)
    seen = still + swing[:, None, None] * torch.tensor([0.0, 1, 0])
    x = torch.cat([still + 0.5 * (seen - still), still[None]])  # a frame more than was seen
    if marked:
        every = torch.arange(len(still))[:, None]
        seen[3, 0] = torch.nan  # a point that was not seen
        cues = MarkerCues(seen, every, torch.ones_like(every).double())
    else:
        none = torch.zeros(0)
        cues = MotionCues(seen, none, none, none, none)
    found = metrics.unexplained(still.expand(6, -1, -1), cues, 3, 0.25)
    assert found == pytest.approx({"off_m": 0.01, "share": 1.0})
    found = metrics.unexplained(x, cues, 3, 1.0)
    assert found == pytest.approx({"off_m": 0.005, "share": 0.25})


def test_results_say_that_a_law_does_not_explain_the_motion():
    world = SimpleNamespace(driven=(), colliders=(), planes=(), ground=Ground(0.0))
    figures = {"unexplained/train/off_m": 0.088, "unexplained/train/share": 13.1}
    said = unexplained_text(figures | {"unexplained/train/b/off_m": 1.0, "unexplained/train/b/share": 0.6}, world)  # fmt: skip
    assert "`train`: 88 mm" in said and "train/b" not in said
    assert "no driven sets (world.driven)" in said and "a ground" in said
    assert not unexplained_text(figures | {"unexplained/train/share": 0.6}, world)


def test_interpolation_is_exact_for_affine_motions():
    rest, query = ball(0.0125, 0.003), ball(0.016, 0.007)
    A = torch.stack([turned(60), turned(60) @ torch.diag(torch.tensor([1.2, 0.9, 1.0]).double())])
    shift = drawn(2, 1, 3)
    target = query @ A.mT + shift
    assert metrics.rms(metrics.interpolate_motion(rest, rest @ A.mT + shift, query), target) < 1e-13


def bending(points: torch.Tensor) -> torch.Tensor:
    x, y, z = points.unbind(-1)
    return (points @ turned(60).T + torch.stack([y**2, x * z, z**2], -1))[None]


def test_interpolation_of_bending_is_of_second_order():
    query = 0.18 * (drawn(4000, 3, seed=4) - 0.5)
    query = query[query.norm(dim=1) < 0.08]

    def error(spacing: float) -> float:
        rest = ball(spacing, 0.003)
        return metrics.rms(metrics.interpolate_motion(rest, bending(rest), query), bending(query))

    assert (
        error(0.02) < 0.2e-3
    )  # [m], of a 0.25 m object; a weighted mean alone is 2 mm off where a body has turned
    assert error(0.02) / error(0.01) == pytest.approx(4, rel=0.1)


def test_interpolation_at_the_true_points_is_their_motion():
    rest = ball(0.03, 0.004)
    positions = drawn(3, len(rest), 3)
    torch.testing.assert_close(
        metrics.interpolate_motion(rest, positions, rest), positions, rtol=0, atol=1e-8
    )


@pytest.mark.parametrize("count", [1, 3, 9])
def test_interpolation_of_few_or_flat_points(count):
    rest = drawn(count, 3)
    rest[:, 2] = 0.5
    shift = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
    query = rest[:1] + 0.01
    moved = metrics.interpolate_motion(rest, (rest + shift)[None], query)
    torch.testing.assert_close(moved, (query + shift)[None], rtol=0, atol=1e-12)


# --- shapes ---------------------------------------------------------------------------------------------------------


def chamfer(a, b, **options):
    return metrics.chamfer_distances(a, b, **options)["cd_m"]


def test_chamfer_by_hand():
    a = torch.tensor([[0.0, 0, 0]])
    b = torch.tensor([[3.0, 0, 0], [0, 4, 0]])
    for first, second in ((a, b), (b, a)):
        assert metrics.chamfer_distances(first, second)["cd_sq_m2"] == pytest.approx(
            9 + (9 + 16) / 2
        )
        assert chamfer(first, second) == pytest.approx(3 + (3 + 4) / 2)


def test_chamfer_of_a_cloud_with_itself():
    cloud = drawn(500, 3)
    assert chamfer(cloud, cloud) == 0
    assert chamfer(cloud, cloud, samples=400) > 0  # different subsets: the reason for floors
    assert chamfer(cloud, cloud, samples=400) == chamfer(cloud, cloud, samples=400)
    assert chamfer(cloud, cloud, samples=400, seed=1) != chamfer(cloud, cloud, samples=400)


def test_emd_is_the_best_assignment():
    a, b = drawn(6, 3), drawn(6, 3, seed=1)
    best = min((a - b[list(p)]).norm(dim=1).mean().item() for p in itertools.permutations(range(6)))
    assert metrics.emd(a, b) == pytest.approx(best, rel=1e-12)
    shuffled = a[torch.randperm(6, generator=torch.Generator().manual_seed(2))]
    assert metrics.emd(a, shuffled) == 0


def test_emd_of_unequal_clouds_and_of_subsets():
    cloud = drawn(300, 3)
    shift = torch.tensor([5.0, 0, 0]).double()
    assert metrics.emd(cloud, cloud[:200] + shift) == pytest.approx(5, abs=0.1)
    assert 0.01 < metrics.emd(cloud, cloud, samples=100) < 0.5  # not zero for identical clouds


def test_resampling_fills_the_shape_evenly():
    lattice = drawn(1)[0].item() + 0.01 * (
        torch.cartesian_prod(*[torch.arange(20.0, dtype=torch.float64)] * 3) + 0.5
    )
    points = (metrics.resample_shape(lattice, 40_000, seed=3) - lattice.amin(0) + 0.005) / 0.2
    counts, _ = np.histogramdd(points.clamp(0, 1).numpy(), bins=4, range=[(0, 1)] * 3)
    assert counts.std() / counts.mean() < 1.3 / math.sqrt(40_000 / 64)
    assert points.min() > -0.01 and points.max() < 1.01


def test_floors_are_those_of_two_random_samplings():
    """docs/figures.md: 1.5e-4 m^2 for 3,000 points in a 0.2 m cube."""
    lattice = 0.01 * (torch.cartesian_prod(*[torch.arange(20.0, dtype=torch.float64)] * 3) + 0.5)
    floors = metrics.sampling_floors(lattice, 3000, 3000, assignment=400)
    a, b = 0.2 * drawn(3000, 3, seed=1), 0.2 * drawn(3000, 3, seed=2)
    assert floors["cd_sq_m2"] == pytest.approx(1.5e-4, rel=0.08)
    assert floors["cd_sq_m2"] == pytest.approx(
        metrics.chamfer_distances(a, b)["cd_sq_m2"], rel=0.05
    )
    assert floors["cd_m"] == pytest.approx(chamfer(a, b), rel=0.03)
    assert floors["emd_m"] == pytest.approx(metrics.emd(a, b, samples=400), rel=0.15)


def test_floor_of_a_random_cloud():
    cloud = 0.2 * drawn(8000, 3, seed=5)
    assert metrics.sampling_floors(cloud, 2000, 3000, assignment=100)["cd_sq_m2"] == pytest.approx(
        metrics.chamfer_distances(0.2 * drawn(2000, 3, seed=6), 0.2 * drawn(3000, 3, seed=7))[
            "cd_sq_m2"
        ],
        rel=0.12,
    )


# --- images ---------------------------------------------------------------------------------------------------------


def test_psnr_is_averaged_over_images_not_over_errors():
    real = torch.full((2, 12, 13, 3), 0.5)
    rendered = real.clone()
    rendered[0] += 0.1  # 20 dB
    rendered[1] += 0.01  # 40 dB
    assert metrics.psnr(rendered, real) == pytest.approx(30, abs=1e-3)
    assert metrics.psnr(rendered[:1], real[:1]) == pytest.approx(20, abs=1e-3)
    assert metrics.psnr(real, real) == math.inf


def test_psnr_reads_the_range_from_its_definition_not_from_the_image():
    real = 0.05 * torch.rand(1, 12, 12, 3, generator=torch.Generator().manual_seed(0))
    assert metrics.psnr(real + 0.01, real) == pytest.approx(40, abs=1e-3)


def reference_ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Wang et al. 2004 over all pixels, borders reflected (torchmetrics' convention); (H, W, 3)."""
    x = np.arange(-5, 6)
    g = np.exp(-(x**2) / (2 * 1.5**2))
    g /= g.sum()
    pad = ((5, 5), (5, 5), (0, 0))

    def windows(u):
        return np.lib.stride_tricks.sliding_window_view(
            np.pad(u, pad, "reflect"), (11, 11), axis=(0, 1)
        )

    mean = lambda u: np.einsum("ijcxy,x,y->ijc", windows(u), g, g)  # noqa: E731
    ma, mb = mean(a), mean(b)
    va, vb, cov = mean(a * a) - ma**2, mean(b * b) - mb**2, mean(a * b) - ma * mb
    c1, c2 = 0.01**2, 0.03**2
    return float(
        (((2 * ma * mb + c1) * (2 * cov + c2)) / ((ma**2 + mb**2 + c1) * (va + vb + c2))).mean()
    )


def test_ssim_against_its_definition_and_averaged_over_images():
    a = drawn(2, 24, 20, 3)
    b = (a + 0.3 * (drawn(2, 24, 20, 3, seed=1) - 0.5)).clamp(0, 1)
    b[1] = drawn(24, 20, 3, seed=2)
    each = [reference_ssim(x.numpy(), y.numpy()) for x, y in zip(a, b)]
    assert metrics.ssim(a[:1], b[:1]) == pytest.approx(each[0], abs=1e-6)
    assert metrics.ssim(a, b) == pytest.approx(np.mean(each), abs=1e-6)
    assert metrics.ssim(a, a) == pytest.approx(1, abs=1e-9)
    with pytest.raises(ValueError, match="one shape"):
        metrics.ssim(a, b[:1])
    with pytest.raises(ValueError, match="at least 6 x 6 px"):
        metrics.ssim(a[:, :5], b[:, :5])


@pytest.mark.gpu
def test_images_on_a_gpu_have_the_figures_of_a_cpu():
    """To float32's rounding of variances, which the CPU keeps: TF32 would be three digits worse."""
    a = torch.rand(2, 60, 50, 3, generator=torch.Generator().manual_seed(0))
    b = (a + 0.1 * torch.rand(2, 60, 50, 3, generator=torch.Generator().manual_seed(1))).clamp(0, 1)
    assert metrics.ssim(a.cuda(), b.cuda()) == pytest.approx(metrics.ssim(a, b), abs=2e-6)
    assert metrics.psnr(a.cuda(), b.cuda()) == pytest.approx(metrics.psnr(a, b), abs=1e-4)


def test_identification_errors():
    assert metrics.identification_errors("E", 1.2e5, 1e5) == pytest.approx(
        {"E_relative_error": 0.2, "E_ratio": 1.2}
    )
    assert metrics.identification_errors("nu", 0.3, 0.4) == pytest.approx(
        {"nu_relative_error": 0.25}
    )

"""Figures of docs/figures.md: distances between motions and shapes [m], image similarity, and the floors to read them against."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
import torch
from kornia.filters import get_gaussian_kernel1d
from kornia.metrics import ssim as kornia_ssim
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from torch import Tensor
from torchmetrics.functional.image import peak_signal_noise_ratio

from mosa.errors import ConfigError
from mosa.settings import shown
from mosa.types import MarkerCues, MotionCues

CHAMFER_SAMPLES, ASSIGNMENT_SAMPLES = 8192, 2048
NEIGHBOURS = 8  # true points that a motion is interpolated from
RIDGE = 1e-3  # of the local fit's slopes, relative to the neighbourhood's own size


class Metric(NamedTuple):
    """A figure of every model on every sequence. function: of (T, N, 3) and (T, N, 3) [m], a model's and the true positions after
    first contact; or of (T, H, W, 3) and (T, H, W, 3), its images and the real ones of one camera. label: of its rows in
    results.md, which show it times `scale` with so many digits."""

    function: Callable[[Tensor, Tensor], float]
    label: str
    scale: float = 1.0
    digits: int = 3

    def of(self, name: str, found: Tensor, real: Tensor) -> float:
        """The figure, also of a function that gives a tensor or a number of NumPy. Errors: ConfigError for anything else."""
        value = self.function(found, real)
        try:
            return float(value)
        except (TypeError, ValueError, RuntimeError) as error:
            said = f"expected one number of its function, found {shown(value)}"
            raise ConfigError(f"metric {name!r}: {said}") from error


MOTION_METRICS: dict[str, Metric] = {}  # registered, by the figure's name
IMAGE_METRICS: dict[str, Metric] = {}  # name -> figures <part>/<name>_crop and _full


def register_metric(name: str, metric: Metric, *, images: bool = False) -> None:
    """Make a metric known; it is evaluated with the others, and has its rows in results.md. images: of images, not of the motion.

    Errors: ConfigError if another metric has the name."""
    known = IMAGE_METRICS if images else MOTION_METRICS
    free = re.fullmatch(r"\w+", name) is not None and name not in RESERVED
    if not free or known.setdefault(name, metric) != metric:
        said = "expected a name of letters and digits that no figure has yet; choose another one"
        raise ConfigError(f"metric {name!r}: {said}")


RESERVED = ("rms_m", "cd_m", "emd_m", "psnr", "ssim", "mean_abs_C")  # by `evaluate`


# --- motion ---------------------------------------------------------------------------------------------------------


def interpolate_motion(rest: Tensor, positions: Tensor, query: Tensor) -> Tensor:
    """True motion at rest positions `query` (N, 3): (T, N, 3) [m], from true rest points (M, 3) and positions (T, M, 3).

    A linear fit to the nearest true rest points, weighted by inverse distance. A plain weighted mean lies at the neighbours'
    centroid, not at the query, and has a floor of millimetres on a body that turns. What the neighbours leave open (fewer than four
    of them, or all in a plane) is taken from the affine motion of the whole, what that leaves open from its translation."""
    points, wanted = rest.cpu().double(), query.cpu().double()
    displaced = positions.cpu().double() - points
    ranks = np.arange(1, min(NEIGHBOURS, len(points)) + 1)
    distance, index = cKDTree(points.numpy()).query(wanted.numpy(), k=ranks)
    weight = torch.as_tensor(1 / np.maximum(distance, 1e-12))
    weight, index = weight / weight.sum(1, keepdim=True), torch.as_tensor(index)
    center = points.mean(0)
    basis = torch.nn.functional.pad(points - center, (0, 1), value=1.0)
    # (T, 4, 3), the shortest solution: clouds that are flat or have few points pass
    every = basis.expand(len(displaced), -1, -1)
    affine = torch.linalg.lstsq(every, displaced, driver="gelsd").solution
    residual = displaced - basis @ affine
    # value at the query of the fit = weighted sum of the neighbours' residuals with these coefficients
    reach = torch.as_tensor(distance).amax(1).clamp(min=1e-12)
    away = (points[index] - wanted[:, None]) / reach[:, None, None]
    local = torch.nn.functional.pad(away, (0, 1), value=1.0)
    moment = torch.einsum("nk,nki,nkj->nij", weight, local, local)
    moment = moment + torch.diag(torch.tensor([RIDGE, RIDGE, RIDGE, 0.0], dtype=torch.float64))
    unit = torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).expand(len(wanted), 4)
    coefficients = weight * torch.einsum("nki,ni->nk", local, torch.linalg.solve(moment, unit))
    at_query = wanted + torch.nn.functional.pad(wanted - center, (0, 1), value=1.0) @ affine
    return (at_query + torch.einsum("nk,tnkd->tnd", coefficients, residual[:, index])).to(positions)


def rms(x: Tensor, target: Tensor) -> float:
    """Root mean square distance [m] of (T, N, 3) and (T, N, 3), over particles and frames."""
    return float((x.double() - target.double()).square().sum(-1).mean().sqrt())


# --- shapes without identity ----------------------------------------------------------------------------------------


STILL = 0.02  # of the body's size: motions that are smaller than this count as so large


def unexplained(
    x: Tensor, cues: MotionCues | MarkerCues, contact: int, size: float
) -> dict[str, float]:
    """How far a motion x (T, N, 3) [m] is from the one that was seen, from the frame `contact` on. off_m: rms distance; share: of
    the rms distance of what was seen from where it was in the frame before. size: of the body [m]."""
    seen = cues.positions[contact - 1 :]
    moved = (seen[1:] - seen[0]).square().sum(-1).nanmean().sqrt()
    off = float(cues.away(x[: len(cues.positions)])[contact:].square().sum(-1).mean().sqrt())
    return {"off_m": off, "share": off / max(float(moved), STILL * size)}


def subsample(points: Tensor, count: int, seed: int) -> np.ndarray:
    """At most `count` points without replacement, float64."""
    found = points.detach().cpu().double().numpy()
    if len(found) <= count:
        return found
    return found[np.random.default_rng(seed).choice(len(found), count, replace=False)]


def _nearest(a: Tensor, b: Tensor, samples: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    first, second = subsample(a, samples, seed), subsample(b, samples, seed + 1)
    return cKDTree(second).query(first)[0], cKDTree(first).query(second)[0]


def chamfer_distances(
    a: Tensor, b: Tensor, *, samples: int = CHAMFER_SAMPLES, seed: int = 0
) -> dict[str, float]:
    """`cd_sq_m2`, two-sided sum of mean squared nearest distances [m^2] of clouds (N, 3) and (M, 3) [m], and `cd_m` [m], the same
    of the distances themselves."""
    ab, ba = _nearest(a, b, samples, seed)
    squares = float((ab**2).mean() + (ba**2).mean())
    return {"cd_sq_m2": squares, "cd_m": float(ab.mean() + ba.mean())}


def emd(a: Tensor, b: Tensor, *, samples: int = ASSIGNMENT_SAMPLES, seed: int = 0) -> float:
    """`emd_m`: mean distance [m] of the exact assignment between equally many random points of (N, 3) and (M, 3) [m]."""
    count = min(samples, len(a), len(b))
    cost = cdist(subsample(a, count, seed), subsample(b, count, seed + 1))
    return float(cost[linear_sum_assignment(cost)].mean())


def resample_shape(cloud: Tensor, count: int, seed: int) -> Tensor:
    """`count` independent random points (count, 3) [m] of the shape that `cloud` (M, 3) [m] fills, M > 1.

    A point of the cloud, drawn with replacement and displaced within its cell: a cube of side s, which the density gives, 4/3 pi
    r_k^3 = (k + 1/2) s^3 with r_k the distance to the k-th neighbour, median over the cloud."""
    points = cloud.detach().cpu().double().numpy()
    generator = np.random.default_rng(seed)
    # at 12 a lattice gives its own spacing to 2 %, and so does a random cloud
    k = min(12, len(points) - 1)
    reach = np.median(cKDTree(points).query(points, k=[k + 1])[0])
    spacing = reach * (4 / 3 * np.pi / (k + 0.5)) ** (1 / 3)
    chosen = points[generator.integers(len(points), size=count)]
    return torch.as_tensor(chosen + generator.uniform(-spacing / 2, spacing / 2, chosen.shape))


def sampling_floors(
    cloud: Tensor,
    first: int,
    second: int,
    *,
    samples: int = CHAMFER_SAMPLES,
    assignment: int = ASSIGNMENT_SAMPLES,
    seed: int = 0,
) -> dict[str, float]:
    """`cd_sq_m2`, `cd_m`, `emd_m` between two random samplings of one shape, of `first` and `second` points.

    cloud: (M, 3) [m] fills the true shape. A model can get below: regular points lie closer than random ones."""
    a = resample_shape(cloud, first, 2 * seed + 101)
    b = resample_shape(cloud, second, 2 * seed + 102)
    apart = emd(a, b, samples=assignment, seed=seed)
    return chamfer_distances(a, b, samples=samples, seed=seed) | {"emd_m": apart}


# --- images ---------------------------------------------------------------------------------------------------------


def psnr(rendered: Tensor, real: Tensor) -> float:
    """Mean over images (T, H, W, 3) in [0, 1] of each one's PSNR [dB]; infinite if one of them is exact."""
    a, b = rendered.movedim(-1, 1), real.movedim(-1, 1)
    psnrs = peak_signal_noise_ratio(a, b, 1.0, dim=(1, 2, 3), reduction="elementwise_mean")
    return float(psnrs)


def ssim(rendered: Tensor, real: Tensor) -> float:
    """Mean over images (T, H, W, 3) in [0, 1] of the SSIM (Wang et al. 2004): 11x11 Gaussian window, sigma 1.5.

    Over all pixels, with borders reflected (torchmetrics, kornia; others leave 5 px at the border out). At least 6 x 6 px."""
    shapes = tuple(rendered.shape), tuple(real.shape)
    if shapes[0] != shapes[1]:
        raise ValueError(f"ssim: expected images of one shape, found {shapes[0]} and {shapes[1]}")
    if min(rendered.shape[1:3]) < 6:
        raise ValueError(f"ssim: expected images of at least 6 x 6 px, found {shapes[0][1:3]}")
    if rendered.device.type == "cpu":
        pairs = zip(rendered.detach().numpy(), real.detach().numpy())
        return float(np.mean([_ssim_on_cpu(a, b) for a, b in pairs]))
    # in float64: convolutions on a GPU may round to TF32, and variances are small differences
    a, b = (images.movedim(-1, 1).double() for images in (rendered, real))
    return float(kornia_ssim(a, b, 11, eps=0.0).mean())


def _ssim_on_cpu(a: np.ndarray, b: np.ndarray) -> float:
    """Of one pair of images (H, W, 3): what kornia computes, in at most 0.4 of its time and closer to its float64."""
    window = get_gaussian_kernel1d(11, 1.5, dtype=torch.float64)[0].numpy()

    def mean(image: np.ndarray) -> np.ndarray:
        return cv2.sepFilter2D(image, -1, window, window, borderType=cv2.BORDER_REFLECT_101)

    ma, mb = mean(a), mean(b)
    aa, bb, ab = ma * ma, mb * mb, ma * mb
    va, vb = np.maximum(mean(a * a) - aa, 0), np.maximum(mean(b * b) - bb, 0)
    c1, c2 = 0.01**2, 0.03**2
    similarity = (2 * ab + c1) * (2 * (mean(a * b) - ab) + c2) / ((aa + bb + c1) * (va + vb + c2))
    return float(similarity.mean(dtype=np.float64))


# --- parameters -----------------------------------------------------------------------------------------------------

LOGARITHMIC = ("E", "mu", "kappa", "yield_stress")


def identification_errors(name: str, estimate: float, true: float) -> dict[str, float]:
    """`<name>_relative_error` |estimate - true| / |true|; for log-parameters also `<name>_ratio` estimate / true."""
    figures = {f"{name}_relative_error": abs(estimate - true) / abs(true)}
    if name in LOGARITHMIC:
        figures[f"{name}_ratio"] = estimate / true
    return figures
